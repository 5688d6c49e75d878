# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording in windows of bounded size: ticks of an observer, and the samples that each takes.

The ticks are those of the recorded observer, as its tick log has them, or one for each measurement
in the order of recording, or at a fixed rate.
"""

import math
from collections import defaultdict
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_series import RawMessages, Times
from tsobs_ros.bag.tick_log import decode_ticks
from tsobs_ros.errors import MessageError
from tsobs_ros.replay.live import Agreement
from tsobs_ros.replay.source import Part, Records, Source, joined, restarts
from tsobs_ros.series import NANOSECONDS

WINDOW = 2**15
"""Number of messages that are read at once: some 25 s of a bag with live estimates at 200 Hz."""

_MAX_TICKS = 4096
# A tick's messages and measurements are recorded in another order than they were sent [ns].
_GRACE = NANOSECONDS
# Messages at the end of a part that are looked at again with the next one.
_HELD = 64


_TICK = np.dtype(
    [
        ("stamps", np.int64),
        # Times on the observer's clock, to recognise stamps from the future.
        ("now", np.int64),
        # Number of samples taken by the end of the tick.
        ("known", np.int64),
        # 1 if the observer forgets everything before it, else 0.
        ("resets", np.int64),
        # Whether there are estimates.
        ("estimated", np.bool_),
        ("log_times", np.int64),
        ("publish_times", np.int64),
    ]
)
"""A record of a tick of an observer; all times are in ns."""


@dataclass(frozen=True)
class Window:
    """A part of a recording.

    Attributes:
        samples: Measurements in the order of use, records of `sample_type`.
        ticks: Which samples are taken when, of all that are used; records of `_TICK`.
        live: The recorded observer's messages by topic, in groups of the same size.
        horizon: Smallest log time of what follows [ns]; infinite in the last window.
        at_samples: Whether there are only estimates at measurements that are in use.
        is_whole: Whether the live messages of all ticks until now have come.
    """

    samples: Records
    ticks: Records
    live: dict[str, RawMessages] = field(default_factory=dict)
    horizon: float = math.inf
    at_samples: bool = False
    is_whole: bool = True

    def pieces(self) -> Iterator["Window"]:
        """Yield the window in parts with few ticks each; the first has the live messages."""
        ticks, live, taken = self.ticks, self.live, 0
        for begin in range(0, max(1, len(ticks)), _MAX_TICKS):
            own, following = ticks[begin : begin + _MAX_TICKS].copy(), ticks[begin + _MAX_TICKS :]
            begins, taken = taken, int(own.known[-1]) if len(own) else 0
            own.known -= begins
            horizon = min(self.horizon, following.log_times.min(initial=2**62))
            samples, is_last = self.samples[begins:taken], not len(following)
            yield Window(samples, own, live, horizon, self.at_samples, is_last)
            live = {}


class Windows:
    """The windows of a recording.

    Args:
        source: The recording.
        rate: Estimate at this rate [Hz]; None: at every measurement.
        as_live: Estimate, instead of both, when the recorded observer did.
        size: Number of messages that are read at once, divisible by 4; None for all.

    Attributes:
        as_live: Whether the ticks are those of the tick log.
        counts: What the tick log has of it until now.
    """

    def __init__(
        self, source: Source, rate: float | None, as_live: bool, size: int | None = None
    ) -> None:
        self._source, self._rate, self._size = source, rate, size
        self.as_live = as_live and source.has_ticks
        self.counts = Agreement()

    def __iter__(self) -> Iterator[Window]:
        parts = self._source.parts(self._size, with_live=self.as_live)
        made = self._of_tick_log(parts) if self.as_live else self._of_samples(parts)
        if self._size is None:
            yield _together(list(made))
        else:
            for window in made:
                yield from window.pieces()

    def _of_samples(self, parts: Iterator[Part]) -> Iterator[Window]:
        """Yield windows whose ticks are at samples, or at a rate, in the order of recording."""
        waiting: Records = None
        highest = latest = 0
        clock = _RateClock(self._rate, self._size or 2**62) if self._rate else None
        for samples, _, horizon in parts:
            waiting = samples if waiting is None else joined([waiting, samples])
            is_last, taken = horizon == math.inf, 0
            # Whether time restarts at a message shows in the next ones.
            count = len(waiting) if is_last else max(0, len(waiting) - _HELD)
            begins = [begin for begin in restarts(waiting.stamps, highest) if begin < count]
            for number, end in enumerate([*begins, count]):
                own, following = waiting[taken:end], waiting.log_times[end:]
                if number:
                    highest = latest = 0
                times = own.log_times if self._source.same_clock else own.stamps
                arrivals = np.maximum.accumulate(np.append(latest, times))[1:]
                if clock is not None:
                    if number:
                        clock.restart()
                    ends = is_last or number < len(begins)
                    used = yield from clock.windows(own, arrivals, ends=ends)
                else:
                    used, next_ = len(own), float(following.min()) if len(following) else math.inf
                    ticks = _at_samples(own, arrivals, reset=number > 0)
                    yield Window(own, ticks, {}, next_, True)
                highest = int(own.stamps[:used].max(initial=highest))
                latest = int(arrivals[:used].max(initial=latest))
                taken += used
            waiting = waiting[taken:]

    def _of_tick_log(self, parts: Iterator[Part]) -> Iterator[Window]:
        """Yield windows with the ticks of the recorded observer."""
        log = _TickLog(self.counts)
        pool: Records = None
        for samples, live, horizon in parts:
            pool = samples if pool is None else joined([pool, samples])
            log.add(live.pop(topics.TICKS))
            ticks, checksums = log.take(horizon - _GRACE)
            places = _match(checksums, pool.checksums)
            there = places >= 0
            self.counts.not_recorded += int((~there).sum())
            ticks.known[:] = np.append(0, np.cumsum(there))[ticks.known]
            used = pool[places[there]]
            yield Window(_in_order(used, ticks.known), ticks, live, horizon - _GRACE)
            left = np.ones(len(pool), np.bool_)
            left[places[there]] = False
            keep = left & (pool.log_times >= horizon - 2 * _GRACE)
            self.counts.not_received += int((left & ~keep).sum())
            pool = pool[keep]


def _together(windows: list[Window]) -> Window:
    """Return one window of all that there is."""
    if len(windows) > 1:
        begins = np.cumsum([0, *(len(one.samples) for one in windows)])
        for one, begin in zip(windows, begins.tolist(), strict=False):
            one.ticks.known += begin
        samples, ticks = ([getattr(one, name) for one in windows] for name in ("samples", "ticks"))
        return Window(joined(samples), joined(ticks), at_samples=windows[0].at_samples)
    return windows[0]


def _at_samples(samples: Records, arrivals: Times, *, reset: bool) -> Records:
    """Return a tick for each message; messages in a row with the same stamp share one."""
    last = np.append(samples.stamps[1:] != samples.stamps[:-1], len(samples) > 0)
    places = np.flatnonzero(last)
    resets = reset * (np.arange(len(places)) == 0)
    stamps, times = samples.stamps[places], samples.log_times[places]
    return _ticks(stamps, arrivals[places], places + 1, resets, True, times, times)


def _ticks(*columns: Any) -> Records:
    """Return records of ticks made of their columns; one number holds for all of them."""
    return np.rec.fromarrays(np.broadcast_arrays(*columns), _TICK)


class _RateClock:
    """Ticks at a fixed rate on the clock of the recording, from the first arrival on.

    Args:
        rate: Ticks per second [Hz].
        limit: Largest number of ticks in a window.
    """

    def __init__(self, rate: float, limit: int) -> None:
        self._period, self._limit = NANOSECONDS / rate, limit
        self._begin: int | None = None
        self._made = self._reset = self._latest = self._delay = 0

    def restart(self) -> None:
        """Begin again with the next arrival."""
        self._begin, self._made, self._reset = None, 0, 1

    def windows(
        self, samples: Records, arrivals: Times, *, ends: bool
    ) -> Generator[Window, None, int]:
        """Yield windows up to the last arrival; return how many samples they take, at an end all.

        More samples may yet arrive at the time of the last one if this is no end.
        """
        if not len(arrivals):
            return 0
        if self._begin is None:
            self._begin = int(arrivals[0])
        count, taken = math.ceil((int(arrivals[-1]) + ends - self._begin) / self._period), 0
        delays = np.append(self._delay, samples.log_times - arrivals)
        while self._made < count:
            places = np.arange(self._made, min(count, self._made + self._limit))
            stamps = self._begin + np.round(places * self._period).astype(np.int64)
            known = np.searchsorted(arrivals, stamps, side="right")
            yield self._window(samples[taken:], stamps, known - taken, stamps + delays[known])
            self._made, taken = self._made + len(stamps), int(known[-1])
        if ends and taken < len(samples):
            # What no tick takes is used all the same.
            rest = samples[taken:]
            known = np.array([len(rest)])
            yield self._window(rest, arrivals[-1:], known, rest.log_times[-1:], estimated=False)
            taken = len(samples)
        self._delay = int(delays[taken])
        return taken

    def _window(
        self, samples: Records, stamps: Times, known: Times, times: Times, estimated: bool = True
    ) -> Window:
        resets = self._reset * (np.arange(len(stamps)) == 0)
        times = np.maximum.accumulate(np.append(self._latest, times))[1:]
        self._reset, self._latest = 0, int(times[-1])
        ticks = _ticks(stamps, stamps, known, resets, estimated, times, times)
        return Window(_in_order(samples[: int(known[-1])], known), ticks, {}, self._latest)


def _in_order(samples: Records, known: NDArray[np.int64]) -> Records:
    """Return samples in the order of their stamps within each tick."""
    if (np.diff(samples.stamps) >= 0).all():
        return samples
    of_tick = np.searchsorted(known, np.arange(len(samples)), side="right")
    return samples[np.lexsort((samples.stamps, of_tick))]


class _TickLog:
    """The ticks of a tick log that are not due yet."""

    def __init__(self, counts: Agreement) -> None:
        self._counts = counts
        self._rows: list[tuple[int, int, list[int]]] = []
        self._number = 0
        self._is_first = True

    def add(self, messages: RawMessages) -> None:
        """Take in messages; those that are none of a tick log count as lost."""
        log_times, publish_times = messages.log_times.tolist(), messages.publish_times.tolist()
        for places, data in messages.groups:
            try:
                values = decode_ticks(data).tolist()
            except MessageError:
                continue
            self._rows += [
                (log_times[place], publish_times[place], one)
                for place, one in zip(places.tolist(), values, strict=True)
            ]
        # In the order of sending.
        self._rows.sort(key=lambda row: row[1])

    def take(self, until: float) -> tuple[Records, NDArray[np.int64]]:
        """Return the ticks that were recorded before a log time, and their checksums."""
        due = next((k for k, row in enumerate(self._rows) if row[0] >= until), len(self._rows))
        rows, self._rows = self._rows[:due], self._rows[due:]
        values = np.array([one[:3] for _, _, one in rows], np.int64).reshape(-1, 3)
        resets = (values[:, 1] == 1).astype(np.int64)
        for number in values[:, 1].tolist():
            if self._is_first:
                self._counts.ran_before, self._is_first = number > 1, False
            elif number > self._number + 1:
                self._counts.lost_ticks += number - self._number - 1
            elif number <= self._number and number > 1:
                self._counts.lost_ticks += number - 1
            self._number = number
        times = np.array([row[:2] for row in rows], np.int64).reshape(-1, 2)
        known = np.cumsum([len(one) - 3 for _, _, one in rows]).astype(np.int64)
        checksums = np.array([each for _, _, one in rows for each in one[3:]], np.int64)
        stamps = values[:, 0]
        return _ticks(stamps, stamps, known, resets, values[:, 2] == 1, *times.T), checksums


def _match(wanted: NDArray[np.int64], there: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return the place of each wanted number, -1 for none, and no place twice, shape (n,)."""
    count = len(wanted)
    if count <= len(there) and (wanted == there[:count]).all():
        return np.arange(count)
    places: dict[int, list[int]] = defaultdict(list)
    for place in range(len(there) - 1, -1, -1):
        places[int(there[place])].append(place)
    found = [places[one].pop() if places.get(one) else -1 for one in wanted.tolist()]
    return np.array(found, np.intp)
