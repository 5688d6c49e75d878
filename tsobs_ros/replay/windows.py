# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's loop without its clock: windows of samples, and of ticks that take them.

The ticks are those of the recorded observer's tick log; or there is one tick per measurement in the
order of recording; or they have a fixed rate. Estimates are compared with those that were recorded.
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import MessageSeries, decode_ticks
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.reader import RawMessages
from tsobs_ros.checks import Integers
from tsobs_ros.errors import MessageError, ModelError
from tsobs_ros.replay.source import BagSource, Records, passes
from tsobs_ros.series import NANOSECONDS, Spool, Stamps

WINDOW = 4096
"""Number of ticks in a window: some 20 s at 200 Hz."""

COMPARED = (
    topics.STATES,
    topics.STATE_BOUNDS,
    topics.DISTURBANCE,
    topics.DISTURBANCE_BOUND,
    *topics.TORQUE_TOPICS,
)
"""Topics of estimates, one message per tick."""

_BLOCK = 2**13
_STAMP = slice(4, 12)
_HEAD = ("stamps", "numbers", "estimated")
_LOGGED = np.dtype([(name, np.int64) for name in ("log_times", "publish_times", *_HEAD, "counts")])
_MESSAGE = np.dtype([("stamps", np.int64), ("digests", np.int64), ("counts", np.bool_)])
_TICK = np.dtype(
    [
        ("stamps", np.int64),
        # Times on the observer's clock, to recognise stamps from the future.
        ("now", np.int64),
        # Number of samples taken by the end of the tick.
        ("known", np.int64),
        # Whether there are estimates.
        ("estimated", np.bool_),
        ("log_times", np.int64),
        ("publish_times", np.int64),
    ]
)
"""A record of a tick of an observer; all times are in ns."""


@dataclass
class Agreement:
    """Comparison of the estimates with those of the live run.

    Attributes:
        recorded: Number of recorded estimates.
        reproduced: Number of recorded estimates reproduced to the last bit, bounds included.
        first_difference: Stamp of the first one that is not reproduced [ns], None if all are.
        not_recorded: Number of measurements that the live observer used but the bag lacks.
        not_received: Number of measurements in the bag that did not reach the live observer.
        lost_ticks: Number of ticks that the tick log lacks.
        ran_before: Whether the live observer had run before its recording began.
    """

    recorded: int = 0
    reproduced: int = 0
    first_difference: int | None = None
    not_recorded: int = 0
    not_received: int = 0
    lost_ticks: int = 0
    ran_before: bool = False

    def text(self) -> str:
        """Return one line for people, with the reason for any difference."""
        line = (
            f"live estimates: {self.reproduced:,} of {self.recorded:,} reproduced to the last bit"
        )
        if self.not_received:
            line += f", without {self.not_received:,} measurements that did not reach it"
        if self.reproduced == self.recorded:
            return line
        reasons = (
            (self.ran_before, "the live observer had run before the recording of it began"),
            (
                self.not_recorded,
                f"the live observer used {self.not_recorded:,} measurements that the bag lacks",
            ),
            (self.lost_ticks, f"its tick log lacks {self.lost_ticks:,} ticks"),
        )
        known = " and ".join(text for there, text in reasons if there)
        return f"{line}; {known or 'it had another design, other parameters or another version'}"


class LiveRun:
    """The messages of the observer that ran during a recording, which has its tick log.

    Attributes:
        ticks: Its ticks in the order of recording; `counts` has the numbers of their measurements.
        used: Places of their measurements among those of the bag, in the order of use.
        restarts: Its messages of restarts.
    """

    def __init__(self, source: BagSource) -> None:
        names = {topics.TICKS: source.tick_log}
        names |= source.there(source.observer, (topics.RESTARTS, *COMPARED))
        measured = source.samples.checksums
        ticks, checksums = Spool(_LOGGED), Spool(np.dtype(np.int64))
        self._estimates = Spool(_MESSAGE)
        self.restarts: list[MessageSeries] = []
        for block in source.reader.blocks(names.values(), _BLOCK, on_damage=source.damaged):
            for topic, name in names.items():
                messages = block[name]
                if topic == topics.TICKS:
                    _add_ticks(messages, ticks, checksums)
                    continue
                for at, data in messages.groups:
                    if topic == topics.RESTARTS:
                        times = messages.log_times[at], messages.publish_times[at]
                        self.restarts.append(MessageSeries(name, JOINT_STATE, *times, data))
                    elif data.shape[1] >= _STAMP.stop:
                        self._estimates.add(_digested(topic, data))
        self.ticks, wanted = ticks.read(), checksums.read()
        places = _match(wanted, measured)
        there = places >= 0
        self.used = places[there]
        # The numbers of ticks count from 1 after each restart.
        numbers = self.ticks.numbers
        steps = np.diff(numbers)
        lost = np.where(steps > 0, steps - 1, np.maximum(numbers[1:] - 1, 0))
        self._agreement = Agreement(
            not_recorded=int((~there).sum()),
            not_received=len(measured) - len(self.used),
            lost_ticks=int(lost.sum()),
            ran_before=bool((numbers[:1] > 1).any()),
        )
        before = np.append(0, np.cumsum(there))[np.append(0, np.cumsum(self.ticks.counts))]
        self.ticks.counts = np.diff(before)

    def compare(self, made: Integers) -> Agreement:
        """Return the comparison with the replay's messages, whose digests are given."""
        recorded = self._estimates.read()
        # Messages of states count as estimates; one is reproduced if all of its stamp are.
        differing = recorded.stamps[~np.isin(recorded.digests, made)]
        stamps = recorded.stamps[recorded.counts]
        wrong = stamps[np.isin(stamps, differing)]
        return replace(
            self._agreement,
            recorded=len(stamps),
            reproduced=len(stamps) - len(wrong),
            first_difference=int(wrong.min()) if len(wrong) else None,
        )


class Window(NamedTuple):
    """A part of a recording.

    Attributes:
        samples: Measurements in the order of use, with the fields of a source's `samples`.
        ticks: The ticks that take these samples; records of `_TICK`.
        restarts: Whether the observer restarts, forgetting everything, before this window.
    """

    samples: Records
    ticks: Records
    restarts: bool


_MAX_RATE = 1e4  # [Hz]


class Windows:
    """The windows of a recording; at least one, and another one whenever time restarts.

    Estimates are made at `rate` [Hz], or at every measurement if it is None; with `as_live`, at the
    ticks of the recorded observer, if the bag has them. A window has at most `size` ticks.

    Attributes:
        live: The recorded observer's messages, if the ticks are those of its tick log.
        at_samples: Whether estimates are made only at measurements that are used.
    """

    def __init__(self, source: BagSource, rate: float | None, as_live: bool, size: int) -> None:
        if rate is not None and not 1e-6 <= rate <= _MAX_RATE:
            raise ModelError(f"rate: expected 1e-06 to {_MAX_RATE:g} Hz, got {rate!r}")
        self._source, self._rate, self._size = source, rate, size
        self.live = LiveRun(source) if as_live and source.tick_log else None
        self.at_samples = self.live is None and rate is None

    def __iter__(self) -> Iterator[Window]:
        taken, samples = 0, self._source.samples
        parts = self._of_recording() if self.live is None else self._of_tick_log(self.live)
        for restarts, ticks in parts:
            end = int(ticks.known[-1]) if len(ticks) else taken
            own = samples[taken:end] if self.live is None else samples[self.live.used[taken:end]]
            ticks.known -= taken
            taken = end
            yield Window(_in_order(own, ticks.known), ticks, restarts)

    def _of_recording(self) -> Iterator[tuple[bool, Records]]:
        """Yield the ticks of each pass of time, and whether they begin a further pass."""
        whole, latest = self._source.samples, 0
        for first, end in passes(whole.stamps):
            samples = whole[first:end]
            times = samples.log_times if self._source.same_clock else samples.stamps
            arrivals = np.maximum.accumulate(np.append(0, times))[1:]
            make = self._at_samples if self._rate is None else self._at_rate
            for place, ticks in enumerate(make(samples, arrivals)):
                ticks.known += first
                ticks.log_times = ticks.publish_times = np.maximum(ticks.log_times, latest)
                yield first > 0 and place == 0, ticks
            latest = int(ticks.log_times[-1])

    def _at_samples(self, samples: Records, arrivals: Stamps) -> Iterator[Records]:
        """Yield a tick for each message; messages in a row with the same stamp share a tick."""
        ends = 1 + np.flatnonzero(np.append(np.diff(samples.stamps) != 0, True))
        for begin in range(0, len(ends), self._size):
            known = ends[begin : begin + self._size]
            stamps, times = samples.stamps[known - 1], samples.log_times[known - 1]
            yield _ticks(stamps, arrivals[known - 1], known, times, times)

    def _at_rate(self, samples: Records, arrivals: Stamps) -> Iterator[Records]:
        """Yield ticks at a fixed rate on the clock of the recording, from the first arrival on."""
        assert self._rate is not None
        period, latest = NANOSECONDS / self._rate, 0
        delays = np.append(0, samples.log_times - arrivals)
        count = math.ceil((int(arrivals[-1] - arrivals[0]) + 1) / period)
        for begin in range(0, count, self._size):
            places = np.arange(begin, min(begin + self._size, count))
            stamps = arrivals[0] + np.round(places * period).astype(np.int64)
            known = np.searchsorted(arrivals, stamps, side="right")
            times = np.maximum.accumulate(np.append(latest, stamps + delays[known]))[1:]
            ticks, latest = _ticks(stamps, stamps, known, times, times), int(times[-1])
            if begin + self._size >= count and known[-1] < len(samples):
                # Samples that no tick takes are used all the same.
                last = max(latest, int(samples.log_times[-1]))
                rest = _ticks(arrivals[-1:], arrivals[-1:], len(samples), last, last)
                rest.estimated = False
                ticks = np.append(ticks, rest).view(np.recarray)
            yield ticks

    def _of_tick_log(self, live: LiveRun) -> Iterator[tuple[bool, Records]]:
        """Yield the ticks of the recorded observer, and whether it has restarted."""
        taken, numbers = 0, live.ticks.numbers
        edges = [0, *np.flatnonzero(numbers[1:] == 1) + 1, len(numbers)]
        for first, end in pairwise(edges):
            for begin in range(first, max(end, 1), self._size):
                own = live.ticks[begin : min(begin + self._size, end)]
                known = taken + np.cumsum(own.counts)
                ticks = _ticks(own.stamps, own.stamps, known, own.log_times, own.publish_times)
                ticks.estimated = own.estimated == 1
                yield begin == first and bool((own.numbers[:1] == 1).any()), ticks
                taken = int(known[-1]) if len(known) else taken


def _ticks(*columns: Any) -> Records:
    """Return ticks with estimates from their stamps, `now`, `known`, log and publish times."""
    stamps, now, known, log_times, publish_times = np.broadcast_arrays(*columns)
    made = (stamps, now, known, np.ones(len(stamps)), log_times, publish_times)
    return np.rec.fromarrays(made, _TICK)


def _in_order(samples: Records, known: Integers) -> Records:
    """Return samples in the order of their stamps within each tick."""
    if (np.diff(samples.stamps) >= 0).all():
        return samples
    of_tick = np.searchsorted(known, np.arange(len(samples)), side="right")
    return samples[np.lexsort((samples.stamps, of_tick))]


def digests(topic: str, data: NDArray[np.uint8]) -> Integers:
    """Return a number for each of n messages of a topic, whose bytes have the shape (n, size).

    Equal messages have equal numbers, in this process only.
    """
    rows = np.ascontiguousarray(data).view(f"V{data.shape[1]}")[:, 0].tolist()
    return np.fromiter((hash((topic, row)) for row in rows), np.int64, len(rows))


def _digested(topic: str, data: NDArray[np.uint8]) -> NDArray[Any]:
    """Return the stamps in the headers of little-endian messages [ns], and their digests."""
    parts = np.ascontiguousarray(data[:, _STAMP])
    found = np.zeros(len(data), _MESSAGE)
    found["stamps"] = parts.view("<i4")[:, 0].astype(np.int64) * NANOSECONDS
    found["stamps"] += parts.view("<u4")[:, 1]
    found["digests"], found["counts"] = digests(topic, data), topic == topics.STATES
    return found


def _add_ticks(messages: RawMessages, ticks: Spool, checksums: Spool) -> None:
    """Add messages to ticks and their checksums; messages that are no ticks are left out."""
    known = dict[int, Integers]()
    for at, data in messages.groups:
        with suppress(MessageError):
            known |= zip(at.tolist(), decode_ticks(data), strict=True)
    log_times, publish_times, head = messages.log_times, messages.publish_times, len(_HEAD)
    rows = sorted(known.items())
    found = [(log_times[at], publish_times[at], *row[:head], len(row) - head) for at, row in rows]
    ticks.add(np.array(found, _LOGGED))
    for _, row in rows:
        checksums.add(row[head:])


def _match(wanted: Integers, there: Integers) -> NDArray[np.intp]:
    """Return the place of each wanted checksum, no place twice, -1 for none, shape (n,)."""
    if len(wanted) <= len(there) and (wanted == there[: len(wanted)]).all():
        return np.arange(len(wanted))
    # Of equal checksums, the first belongs to the first, the second to the second, and so on.
    keys, known = (each << 31 | _occurrences(each) for each in (wanted, there))
    order = np.argsort(known)
    found = order[np.searchsorted(known, keys, sorter=order).clip(max=len(known) - 1)]
    return np.where(known[found] == keys, found, -1)


def _occurrences(numbers: Integers) -> NDArray[np.intp]:
    """Return for each number how many numbers before it are equal to it, shape (n,)."""
    order = np.argsort(numbers, kind="stable")
    found = np.empty(len(numbers), np.intp)
    found[order] = np.arange(len(numbers)) - np.searchsorted(numbers[order], numbers[order])
    return found
