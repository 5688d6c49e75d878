# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What is played when: in order, complete, without drift, whenever the caller comes."""

import threading
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.bag import BagReader, BagWriter
from tsobs_ros.bag.playback import MAX_LAG, NEVER, Event, Playback, read_passes
from tsobs_ros.bag.reader import BagMessage
from tsobs_ros.errors import BagReadError

MS = 1_000_000
S = 1_000 * MS
# Bag time is far from zero and from steady time, as it is in life.
START = 1_700_000_000 * S
NOW = 5_000 * S

rates = st.floats(0.01, 100.0)
times = st.integers(0, 10**15)


def message(offset: int, topic: str = "/a") -> BagMessage:
    return BagMessage(topic, "std_msgs/msg/String", b"", START + offset, START + offset)


class Bag:
    """Messages in memory; those of /latched before a pass starts come first."""

    def __init__(self, messages: Sequence[BagMessage], start: int = START) -> None:
        self.messages = sorted(messages, key=lambda m: m.log_time)
        self.start = start

    def read(self) -> Iterator[BagMessage | None]:
        while True:
            before = [m for m in self.messages if m.log_time < self.start]
            yield from [m for m in before if m.topic == "/latched"][-1:]
            yield from (m for m in self.messages if m.log_time >= self.start)
            yield None

    def playback(self, end: int | None = None, **options: Any) -> Playback:
        last = max((m.log_time for m in self.messages), default=START)
        return Playback(self.read(), self.start, last if end is None else end, NOW, **options)


def play(playback: Playback, until: int, step: Callable[[int], int] = lambda _: 0) -> list[Event]:
    """Take what is due, waking up when told to plus something, until a time or the end."""
    events, now = [], NOW
    playback.resume(now)
    while not playback.ended:
        while (event := playback.take(now)) is not None:
            events.append(event)
        wait = playback.wait(now)
        if now + wait > until:
            break
        now += wait + step(now)
    return events


def played(events: Sequence[Event]) -> list[int]:
    return [e.message.log_time - START for e in events if e.message is not None]


def ticks(events: Sequence[Event]) -> list[int]:
    return [e.time - START for e in events if e.message is None]


@settings(max_examples=30)
@given(
    st.lists(st.integers(0, 3 * S), min_size=1, max_size=40),
    rates,
    st.sampled_from([0.0, 40.0, 997.0]),
    st.lists(st.integers(0, 50 * MS), min_size=1),
)
def test_all_is_played_once_in_order_and_on_time_whenever_the_caller_comes(
    offsets, rate, clock_rate, delays
) -> None:
    bag = Bag([message(offset) for offset in offsets])
    playback = bag.playback(rate=rate, clock_rate=clock_rate if rate > 0.5 else 0.0)
    late = iter(delays * 100_000)

    events = play(playback, NEVER, lambda _: next(late))

    assert played(events) == sorted(offsets)
    assert all(first.due <= second.due for first, second in pairwise(events))
    assert all(first.time <= second.time for first, second in pairwise(events))
    for event in events:
        if event.message is not None:
            exact = NOW + Fraction(event.message.log_time - START) / Fraction(rate)
            assert 0 <= event.due - exact < 1
    assert playback.held_back == 0
    assert playback.position(NOW) == START + max(offsets)


@pytest.mark.parametrize(
    ("clock_rate", "rate", "last", "end", "expected"),
    [
        # The end may be after the last message.
        (100.0, 1.0, 0, 50 * MS, [10 * k * MS for k in range(6)]),
        # Each tick is rounded by itself: there is no drift.
        (1 / 3, 1.0, 3000 * S, 3000 * S, [(3 * k * S) for k in range(1001)]),
    ],
)
def test_the_clock_ticks_on_its_grid_and_never_ahead_of_a_message(
    clock_rate: float, rate: float, last: int, end: int, expected: list[int]
) -> None:
    bag = Bag([message(0), message(last)])
    playback = bag.playback(START + end, clock_rate=clock_rate, rate=rate)

    events = play(playback, NEVER)

    assert ticks(events) == pytest.approx(expected, abs=1)
    assert [e.message is None for e in events[:2]] == [True, False]
    assert playback.ended


@pytest.mark.parametrize("stop", [MAX_LAG, 60 * S])
def test_a_short_stop_is_caught_up_and_a_long_one_held_back(stop: int) -> None:
    playback = Bag([message(k * 100 * MS) for k in range(20)]).playback()
    playback.resume(NOW)
    assert playback.take(NOW)

    events = [e for _ in range(20) if (e := playback.take(NOW + stop))]

    if stop == MAX_LAG:
        assert played(events) == [k * 100 * MS for k in range(1, 11)]
        assert playback.held_back == 0
    else:
        assert [(e.due, e.time) for e in events] == [(NOW + stop, START + 100 * MS)]
        assert playback.held_back == stop - 100 * MS
    assert playback.wait(NOW + stop) == 100 * MS


def test_a_loop_reads_ahead_without_drift_and_the_clock_jumps_back() -> None:
    bag = Bag([message(0), message(25 * MS)])
    events = play(bag.playback(clock_rate=100.0, loop=True), NOW + 40 * MS)
    assert played(events) == [0, 25 * MS, 0]
    assert ticks(events) == [0, 10 * MS, 20 * MS, 0, 10 * MS]

    late = play(bag.playback(loop=True, rate=0.3), NOW + 50 * S, lambda _: 70 * MS)
    firsts = [event.due - NOW for event in late if event.time == START]
    assert len(firsts) > 500
    for k, due in enumerate(firsts):
        assert 0 <= due - k * 25 * MS / Fraction(0.3) <= k + 1


STRING = "std_msgs/msg/String"
PAYLOAD = b"\0\1\0\0\1\0\0\0\0"


@pytest.fixture
def reader(tmp_path: Path) -> BagReader:
    """Give a bag with /a at 0, 10 … 90 ns and /latched at 5, 25, 45 and 45 ns."""
    with BagWriter(tmp_path / "bag") as writer:
        for topic, times in (("/a", range(0, 100, 10)), ("/latched", (5, 25, 45, 45))):
            writer.add_topic(topic, STRING)
            for time in times:
                writer.write(topic, PAYLOAD, time, 0)
    return BagReader(tmp_path / "bag")


def test_passes_are_read_with_what_is_latched_before_them(reader: BagReader) -> None:
    def read(start: int, end: int, count: int, **latched: int) -> list[tuple[str, int] | None]:
        topics, depths = ["/a", "/latched"][: 1 + len(latched)], {"/latched": 2} if latched else {}
        passes = read_passes(reader, topics, depths, start, end, 10_000)
        found = list(islice(passes, count))
        passes.close()
        return [None if m is None else (m.topic, m.log_time) for m in found]

    assert read(46, 60, 6, latched=2) == [
        ("/latched", 45), ("/latched", 45), ("/a", 50), ("/a", 60), None, ("/latched", 45),
    ]  # fmt: skip
    assert read(26, 45, 5, latched=2) == [
        ("/latched", 5), ("/latched", 25), ("/a", 30), ("/a", 40), ("/latched", 45),
    ]  # fmt: skip
    assert read(100, 200, 3, latched=2) == [("/latched", 45), ("/latched", 45), None]
    again = [("/a", 70), ("/a", 80), None]
    assert read(70, 80, 5) == [*again, *again[:2]]


@pytest.mark.parametrize("error", [BagReadError("damaged"), RuntimeError("a bug")])
def test_no_more_is_read_ahead_than_allowed_and_an_error_comes_last(error: Exception) -> None:
    class Reader:
        read = 0

        def messages(self, *_: object) -> Iterator[BagMessage]:
            while self.read < 700:
                self.read += 1
                yield message(self.read)
            raise error

    reader: Any = Reader()
    ahead = read_passes(reader, ["/a"], {}, 0, 10**9, 300 * 100)
    assert [m and m.log_time - START for m in islice(ahead, 500)] == list(range(1, 501))
    assert 500 <= reader.read <= 600
    assert len(list(islice(ahead, 200))) == 200
    with pytest.raises(type(error), match=str(error)):
        next(ahead)
    assert not any(thread.name.startswith("read ahead") for thread in threading.enumerate())
