# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording is complete by file, by snapshot and after a pause; latched messages are in each."""

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from foreign import STRING, cdr
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.bag import BagReader, QosProfile
from tsobs_ros.bag.metadata import read_metadata
from tsobs_ros.bag.recording import (
    BufferedMessage,
    Latch,
    LatchedMessages,
    Recording,
    SnapshotBuffer,
)
from tsobs_ros.bag.verification import verify
from tsobs_ros.errors import BagWriteError

EMPTY, MAP = cdr(""), cdr("map")
ONE = Latch(number=1, publishers=1)


def begin(path: Path, **options: Any) -> Recording:
    recording = Recording(path, **options)
    for topic in ("/map", "/a"):
        recording.add_topic(topic, STRING, [QosProfile()])
    return recording


def message(topic: str, time: int, data: bytes = EMPTY) -> BufferedMessage:
    return BufferedMessage(topic, data, time, time)


def stored(path: Path) -> list[tuple[str, int, int]]:
    return [(m.topic, m.log_time, m.publish_time) for m in BagReader(path).messages()]


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """Give a path for a bag, and check that it is strictly one."""
    path = tmp_path / "bag"
    yield path
    found = verify(path)
    assert (found.errors, found.remarks) == ((), ())


@pytest.mark.parametrize("repeat", [0, 1])
def test_every_file_begins_with_what_is_latched(folder: Path, repeat: int) -> None:
    recording = begin(folder, max_duration_ns=9, repeat_latched=repeat)
    recording.record(message("/map", 1, MAP), ONE)
    for time in range(2, 25):
        recording.record(message("/a", time))
    recording.split()
    recording.split()
    recording.record(message("/map", 30, MAP), ONE)
    recording.close()

    files = [BagReader(folder / f.path) for f in read_metadata(folder).files]
    begins = [next((m.topic, m.log_time, m.publish_time) for m in f.messages()) for f in files]
    repeated = [("/map", 11, 1), ("/map", 21, 1)] if repeat else [("/a", t, t) for t in (11, 21)]
    assert begins == [("/map", 1, 1), *repeated, ("/map", 30, 30)]
    assert recording.file_count == 4
    assert recording.counts == {"/map": 2, "/a": 23}


def test_what_is_latched_during_a_pause_comes_after_it(folder: Path) -> None:
    recording = begin(folder)
    recording.record(message("/a", 1))
    for topic, latch in (("/a", None), ("/map", ONE), ("/map", ONE)):
        recording.discard(message(topic, 2, MAP), latch)
    recording.record(message("/a", 5))
    recording.close()
    assert stored(folder) == [("/a", 1, 1), ("/map", 5, 2), ("/a", 5, 5)]
    assert (recording.discarded, recording.bytes) == (3, 2 * len(EMPTY) + len(MAP))


def test_snapshots_hold_the_last_seconds_and_what_is_latched(folder: Path) -> None:
    recording = begin(folder, snapshot=SnapshotBuffer(10, 10**6))
    recording.record(message("/map", 1, MAP), ONE)
    for time in range(50):
        recording.record(message("/a", 10 + time))
    assert recording.take_snapshot() == 12
    for time in range(100, 103):
        recording.record(message("/a", time))
    assert recording.take_snapshot() == 4
    assert not recording.write_pending()
    recording.record(message("/a", 200))
    recording.close()

    first = [("/map", 49, 1)] + [("/a", time, time) for time in range(49, 60)]
    second = [("/map", 100, 1)] + [("/a", time, time) for time in range(100, 103)]
    assert stored(folder) == first + second


def test_a_disk_that_fails_to_sync_ends_the_recording(tmp_path: Path, monkeypatch) -> None:
    recording = begin(tmp_path / "bag", sync_period=0.001)
    recording.record(message("/a", 1))

    def fail(descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr("os.fdatasync", fail)
        with pytest.raises(BagWriteError, match="Input/output error"):
            any(recording.flush() for _ in count())
    recording.close()
    assert stored(tmp_path / "bag") == [("/a", 1, 1)]


def kept(depth: int, *arrivals: tuple[str, int | None, int]) -> list[int]:
    """Return which messages, by their order of arrival, are kept of publishers and numbers."""
    latched = LatchedMessages(depth)
    for k, (_, number, publishers) in enumerate(arrivals):
        latched.keep(message("/x", k), Latch(number, publishers))
    return [m.publish_time_ns for m in latched.before(1000)]


@pytest.mark.parametrize(
    ("depth", "arrivals", "expected"),
    [
        # One publisher, with numbers and without.
        (1, [("a", 1, 1), ("a", 2, 1)], [1]),
        # Two that publish once, whatever numbers they have come to.
        (1, [("a", 1, 2), ("b", 1, 2)], [0, 1]),
        # One of them goes on: unclear whose the first ones are, until the other one does, too.
        (1, [("a", 1, 2), ("b", 1, 2), ("a", 2, 2), ("a", 3, 2)], [0, 1, 3]),
        (1, [("a", 1, 2), ("b", 1, 2), ("a", 2, 2), ("b", 2, 2)], [2, 3]),
        (2, [("a", 3, 2), ("b", 1, 2), ("a", 4, 2), ("a", 5, 2), ("a", 6, 2)], [0, 1, 3, 4]),
        # One is restarted: what the first one latched stays.
        (1, [("a", 8, 1), ("a", 9, 1), ("a", 1, 2), ("a", 2, 2), ("a", 3, 2)], [1, 4]),
        # Restarted without end.
        (1, [("a", 1, k) for k in range(1, 101)], list(range(36, 100))),
    ],
)
def test_the_last_of_each_latched_publisher_is_kept(
    depth: int, arrivals: list[tuple[str, int | None, int]], expected: list[int]
) -> None:
    assert kept(depth, *arrivals) == expected


# Publishers' turns: each publishes its next number when it is named.
turns = st.lists(st.sampled_from("abc"), min_size=1, max_size=40)


@settings(max_examples=30)
@given(turns, st.integers(1, 3))
def test_no_publishers_last_messages_are_missing_however_they_take_turns(
    order: list[str], depth: int
) -> None:
    arrivals = [(who, order[: k + 1].count(who), 3) for k, who in enumerate(order)]
    needed = {k for who in "abc" for k in [i for i, o in enumerate(order) if o == who][-depth:]}
    assert needed <= set(kept(depth, *arrivals))


SIZE = 256  # of an empty message in a snapshot
buffered = st.lists(st.tuples(st.integers(0, 1000), st.integers(0, 600)), max_size=60)


@settings(max_examples=30)
@given(buffered, st.integers(1, 300), st.integers(0, 4000))
def test_a_snapshot_holds_the_longest_end_that_fits(
    arrived: list[tuple[int, int]], duration: int, size: int
) -> None:
    times = sorted(time for time, _ in arrived)
    messages = [message("/x", t, bytes(s)) for t, (_, s) in zip(times, arrived, strict=True)]
    buffer = SnapshotBuffer(duration, size)
    for each in messages:
        buffer.add(each)
    expected: list[BufferedMessage] = []
    fitting = [each for each in messages if SIZE + len(each.data) <= size]
    for each in reversed(fitting):
        total = sum(SIZE + len(m.data) for m in (each, *expected))
        if total > size or each.log_time_ns < fitting[-1].log_time_ns - duration:
            break
        expected.insert(0, each)
    assert buffer.refused == len(messages) - len(fitting)
    assert list(buffer.take()) == expected
    assert (len(buffer), buffer.size) == (0, 0)


def test_time_that_goes_back_as_in_a_looped_bag_drops_nothing() -> None:
    buffer = SnapshotBuffer(10, 10**6)
    for time in (100, 105, 3, 4):
        buffer.add(message("/x", time))
    assert (len(buffer), buffer.duration_ns) == (4, 0)


def test_syncing_while_a_bag_is_written_split_and_closed_does_no_harm(tmp_path: Path) -> None:
    number = 1_000
    with Recording(tmp_path / "bag", max_duration_ns=number // 20, sync_period=0.0) as writer:
        for time in range(number):
            topic = f"/t{time // 100}"
            writer.add_topic(topic, STRING)
            writer.write(topic, b"data", time, time)
            if time % 10 == 0:
                writer.flush()
    reader = BagReader(tmp_path / "bag")
    assert [m.log_time for m in reader.messages()] == list(range(number))
    assert reader.metadata is not None
    assert reader.metadata.to_map()["message_count"] == number
