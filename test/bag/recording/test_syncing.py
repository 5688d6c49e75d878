# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Syncing goes on in its own thread until it is stopped or the disk fails."""

from pathlib import Path
from threading import Event, get_ident

import pytest

from tsobs_ros.bag import BagReader, BagWriter
from tsobs_ros.bag.recording.syncing import BackgroundSync
from tsobs_ros.errors import BagWriteError

LIMIT = 10.0


def test_it_calls_again_and_again_in_another_thread() -> None:
    calls: list[int] = []
    enough = Event()

    def sync() -> None:
        calls.append(get_ident())
        if len(calls) == 3:
            enough.set()

    background = BackgroundSync(sync, period=0.001)
    assert enough.wait(LIMIT)
    background.stop()
    background.stop()
    stopped_at = len(calls)
    assert get_ident() not in calls
    assert len(calls) == stopped_at
    assert background.error is None


def test_it_hurries_where_the_pause_is_long_and_knows_how_long_ago_that_was() -> None:
    called, again = Event(), Event()

    def sync() -> None:
        (again if called.is_set() else called).set()

    background = BackgroundSync(sync, period=3600.0)
    assert not called.is_set()
    background.hurry()
    assert called.wait(LIMIT)
    background.hurry()
    assert again.wait(LIMIT)
    background.stop()
    assert 0.0 <= background.age < LIMIT


def test_a_disk_that_fails_is_remembered() -> None:
    called = Event()

    def sync() -> None:
        called.set()
        raise BagWriteError("disk failed")

    background = BackgroundSync(sync, period=0.001)
    assert called.wait(LIMIT)
    background.stop()
    with pytest.raises(BagWriteError, match="disk failed"):
        raise background.error or AssertionError("no error was kept")


def test_syncing_while_a_bag_is_written_split_and_closed_does_no_harm(tmp_path: Path) -> None:
    count = 3_000
    with BagWriter(tmp_path / "bag", max_duration_ns=count // 20) as writer:
        background = BackgroundSync(writer.sync, period=0.0)
        for time in range(count):
            topic = f"/t{time // 100}"
            writer.add_topic(topic, "std_msgs/msg/String")
            writer.write(topic, b"data", time, time)
            if time % 10 == 0:
                writer.flush()
    background.stop()
    assert background.error is None
    reader = BagReader(tmp_path / "bag")
    assert [m.log_time for m in reader.messages()] == list(range(count))
    assert reader.metadata is not None
    assert reader.metadata.message_count == count
    assert len(reader.metadata.topics) == count // 100
