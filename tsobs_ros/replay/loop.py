# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's loop without its clock: windows of samples and ticks in, estimates out.

The ticks are those of the recorded observer, as its tick log has them, or one for each measurement
in the order of recording, or at a fixed rate.
"""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Integers
from tsobs_ros.replay.live import LiveRun
from tsobs_ros.replay.source import BagSource, Records, passes
from tsobs_ros.series import NANOSECONDS, Stamps

WINDOW = 4096
"""Number of ticks in a window: some 20 s at 200 Hz."""

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


class Window(NamedTuple):
    """A part of a recording.

    Attributes:
        samples: Measurements in the order of use, as those of a source.
        ticks: Which samples are taken when, of all that are used; records of `_TICK`.
        restarts: Whether the observer forgets everything before it.
    """

    samples: Records
    ticks: Records
    restarts: bool


class Windows:
    """The windows of a recording; at least one, and another one whenever time restarts.

    Args:
        source: The recording.
        rate: Estimate at this rate [Hz]; None: at every measurement.
        as_live: Estimate, instead of both, when the recorded observer did.
        size: Largest number of ticks in a window.

    Attributes:
        live: What the recorded observer sent, if the ticks are those of its tick log.
        at_samples: Whether there are only estimates at measurements that are in use.
    """

    def __init__(self, source: BagSource, rate: float | None, as_live: bool, size: int) -> None:
        self._source, self._rate, self._size = source, rate, size
        self.live = source.live() if as_live else None
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
        """Yield the ticks of each pass of time, and whether they begin another one."""
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
        """Yield a tick for each message; those in a row with one stamp share it."""
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
                # What no tick takes is used all the same.
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
    """Return ticks with estimates of their stamps, `now`, `known`, log and publish times."""
    stamps, now, known, log_times, publish_times = np.broadcast_arrays(*columns)
    made = (stamps, now, known, np.ones(len(stamps)), log_times, publish_times)
    return np.rec.fromarrays(made, _TICK)


def _in_order(samples: Records, known: Integers) -> Records:
    """Return samples in the order of their stamps within each tick."""
    if (np.diff(samples.stamps) >= 0).all():
        return samples
    of_tick = np.searchsorted(known, np.arange(len(samples)), side="right")
    return samples[np.lexsort((samples.stamps, of_tick))]
