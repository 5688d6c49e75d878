# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The last messages of latched publishers are kept, in order and in bounded memory."""

from tsobs_ros.bag.recording import latched
from tsobs_ros.bag.recording.latched import LatchedMessage, LatchedMessages


def message(topic: str, publish: int, log: int | None) -> LatchedMessage:
    return LatchedMessage(topic, b"%d" % publish, publish, log)


def published(messages: list[LatchedMessage]) -> list[int]:
    return [m.publish_time_ns for m in messages]


def test_the_last_of_each_publisher_are_kept_in_order_of_publication() -> None:
    kept = LatchedMessages(depth=2)
    for publisher, topic, time in ((b"a", "/x", 1), (b"b", "/x", 2), (b"a", "/y", 3)):
        kept.keep(publisher, message(topic, time, time))
    for time in (5, 4, 6):
        kept.keep(b"a", message("/x", time, time))
    assert published(kept.before(100)) == [2, 3, 4, 6]


def test_what_is_logged_later_is_not_repeated() -> None:
    kept = LatchedMessages(depth=1)
    kept.keep(b"a", message("/x", 1, 10))
    kept.keep(b"b", message("/x", 2, 20))
    assert published(kept.before(20)) == [1]


def test_what_a_pause_hid_is_told_once() -> None:
    kept = LatchedMessages(depth=1)
    kept.keep(b"a", message("/x", 1, 1))
    kept.keep(b"b", message("/x", 2, None))
    assert kept.take_unlogged(log_time_ns=7) == [message("/x", 2, None)]
    assert kept.take_unlogged(log_time_ns=8) == []
    assert kept.before(7) == [message("/x", 1, 1)]
    assert kept.before(8) == [message("/x", 1, 1), message("/x", 2, 7)]


def test_countless_publishers_take_no_memory(monkeypatch) -> None:
    monkeypatch.setattr(latched, "_MAX_PUBLISHERS", 3)
    kept = LatchedMessages(depth=1)
    for time in range(10):
        kept.keep(b"%d" % time, message("/x", time, time))
    assert published(kept.before(100)) == [7, 8, 9]
