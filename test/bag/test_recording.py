# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording keeps what is latched, and ends if the disk fails."""

from itertools import count
from pathlib import Path
from typing import Any

import pytest
from foreign import STRING, cdr
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.bag import BagReader, QosProfile
from tsobs_ros.bag.metadata import read_metadata
from tsobs_ros.bag.recording import LatchedMessages, Received, Recording
from tsobs_ros.errors import BagWriteError

EMPTY = cdr("")


def begin(path: Path, **options: Any) -> Recording:
    recording = Recording(path, **options)
    for topic in ("/map", "/a"):
        recording.add_topic(topic, STRING, [QosProfile()])
    return recording


def message(topic: str, time: int, data: bytes = EMPTY, *latch: int | None) -> Received:
    return Received(topic, data, time, time, *latch)


def stored(path: Path) -> list[tuple[str, int, int]]:
    return [(m.topic, m.log_time, m.publish_time) for m in BagReader(path).messages()]


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


def kept(*arrivals: tuple[str, int | None, int]) -> list[int]:
    """Return which messages, by their order of arrival, are kept of publishers and numbers."""
    latched = LatchedMessages()
    for k, (_, number, publishers) in enumerate(arrivals):
        latched.keep(message("/x", k, EMPTY, number, publishers))
    return [m.publish_time_ns for m in latched.others()]


@pytest.mark.parametrize(
    ("arrivals", "expected"),
    [
        # One publisher, with numbers and without.
        ([("a", 1, 1), ("a", 2, 1)], [1]),
        # Both go on.
        ([("a", 1, 2), ("b", 1, 2), ("a", 2, 2), ("b", 2, 2)], [2, 3]),
        # One is restarted: what the first one latched stays.
        ([("a", 8, 1), ("a", 9, 1), ("a", 1, 2), ("a", 2, 2), ("a", 3, 2)], [1, 4]),
    ],
)
def test_the_last_of_each_latched_publisher_is_kept(
    arrivals: list[tuple[str, int | None, int]], expected: list[int]
) -> None:
    assert kept(*arrivals) == expected


# Publishers' turns: each publishes its next number when it is named.
@settings(max_examples=30)
@given(st.lists(st.sampled_from("abc"), min_size=1, max_size=40))
def test_no_publishers_last_message_is_missing_however_they_take_turns(order: list[str]) -> None:
    arrivals = [(who, order[: k + 1].count(who), 3) for k, who in enumerate(order)]
    last = {who: k for k, who in enumerate(order)}
    assert set(last.values()) <= set(kept(*arrivals))


def test_a_file_has_what_is_latched_even_if_log_times_stand_still_or_go_back(
    tmp_path: Path,
) -> None:
    with begin(tmp_path / "bag") as recording:
        recording.record(message("/map", 5, EMPTY, 1, 1))
        for time in (5, 3):
            recording.split()
            recording.record(message("/a", time))
        recording.split()
        recording.record(message("/map", 3, EMPTY, 2, 1))
    files = [stored(file) for file in sorted((tmp_path / "bag").glob("*.mcap"))]
    assert files[1:] == [[("/map", 5, 5), ("/a", 5, 5)], [("/map", 3, 5), ("/a", 3, 3)],
                         [("/map", 3, 3)]]  # fmt: skip


def test_all_counts_of_an_unfinished_bag_are_of_finished_chunks(tmp_path: Path) -> None:
    with begin(tmp_path / "bag") as recording:
        recording.write("/a", EMPTY, 1, 1)
        recording.sync()
        metadata = read_metadata(tmp_path / "bag")
        counts = [each.message_count for each in metadata.topics_with_message_count]
        assert sum(counts) == metadata.message_count


def test_syncing_while_a_bag_is_written_split_and_closed_does_no_harm(tmp_path: Path) -> None:
    number = 1_000
    with Recording(tmp_path / "bag", max_duration_ns=number // 20, sync_period=0.0) as writer:
        for time in range(number):
            topic = f"/t{time // 100}"
            writer.add_topic(topic, STRING)
            writer.write(topic, b"data", time, time)
            if time % 10 == 0:
                writer.flush()
    assert [log_time for _, log_time, _ in stored(tmp_path / "bag")] == list(range(number))
    assert read_metadata(tmp_path / "bag").message_count == number
