# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A snapshot is the newest messages that fit into a time and into memory."""

from hypothesis import given
from hypothesis import strategies as st

from tsobs_ros.bag.recording.snapshot import BufferedMessage, SnapshotBuffer

MESSAGE_SIZE = 256  # of an empty one

arrivals = st.lists(st.tuples(st.integers(0, 1000), st.integers(0, 600)), max_size=60)


def message(time: int, size: int = 0) -> BufferedMessage:
    return BufferedMessage("/x", bytes(size), time, time)


@given(arrivals, st.integers(1, 300), st.integers(0, 4000))
def test_it_holds_the_longest_end_that_fits(
    arrived: list[tuple[int, int]], duration: int, size: int
) -> None:
    times = sorted(time for time, _ in arrived)
    messages = [message(t, s) for t, (_, s) in zip(times, arrived, strict=True)]
    buffer = SnapshotBuffer(duration, size)
    fitting = [m for m in messages if MESSAGE_SIZE + len(m.data) <= size]
    for each in messages:
        buffer.add(each)
        assert buffer.size <= size

    def fits(end: list[BufferedMessage]) -> bool:
        total = sum(MESSAGE_SIZE + len(m.data) for m in end)
        return total <= size and end[-1].log_time_ns - end[0].log_time_ns <= duration

    ends = [fitting[i:] for i in range(len(fitting)) if fits(fitting[i:])]
    expected = max(ends, key=len, default=[])
    assert buffer.refused == len(messages) - len(fitting)
    assert len(buffer) == len(expected)
    assert buffer.size == sum(MESSAGE_SIZE + len(m.data) for m in expected)
    assert list(buffer.take()) == expected
    assert (len(buffer), buffer.size, buffer.duration_ns) == (0, 0, 0)


def test_time_that_goes_back_drops_nothing_too_early() -> None:
    buffer = SnapshotBuffer(10, 10**6)
    for time in (100, 105, 3, 4):
        buffer.add(message(time))
    assert buffer.duration_ns == 0
    assert [m.log_time_ns for m in buffer.take()] == [100, 105, 3, 4]


def test_it_tells_how_far_it_goes_back() -> None:
    buffer = SnapshotBuffer(10, 10**6)
    for time in range(100):
        buffer.add(message(time))
    assert (len(buffer), buffer.duration_ns) == (11, 10)
