# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording in windows of bounded size: ticks of an observer, and the samples that each takes.

The ticks are those of the recorded observer, as its tick log has them, or one for each measurement
in the order of recording, or at a fixed rate.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.joint_series import Times
from tsobs_ros.replay.live import LiveRun
from tsobs_ros.replay.source import Records, Source, passes
from tsobs_ros.series import NANOSECONDS

WINDOW = 4096
"""Number of ticks in a window: some 20 s at 200 Hz."""

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


class Window(NamedTuple):
    """A part of a recording.

    Attributes:
        samples: Measurements in the order of use, as those of a source.
        ticks: Which samples are taken when, of all that are used; records of `_TICK`.
    """

    samples: Records
    ticks: Records


class Windows:
    """The windows of a recording.

    Args:
        source: The recording.
        rate: Estimate at this rate [Hz]; None: at every measurement.
        as_live: Estimate, instead of both, when the recorded observer did.
        size: Number of ticks in a window; None for one window with everything.

    Attributes:
        live: What the recorded observer sent, if the ticks are those of its tick log.
        at_samples: Whether there are only estimates at measurements that are in use.
    """

    def __init__(
        self, source: Source, rate: float | None, as_live: bool, size: int | None = None
    ) -> None:
        self._source, self._rate, self._size = source, rate, size
        self.live = source.live() if as_live else None
        self.at_samples = self.live is None and rate is None

    def __iter__(self) -> Iterator[Window]:
        size = self._size or 2**62
        if self.live is not None:
            windows = self._of_tick_log(self.live, size)
        elif self._rate is not None:
            windows = self._at_rate(NANOSECONDS / self._rate, size)
        else:
            windows = self._at_samples(size)
        return windows if self._size else iter([_joined(list(windows))])

    def _passes(self) -> Iterator[tuple[bool, Records, Times]]:
        """Yield whether time has restarted, the samples from there on, and when they arrived."""
        samples = self._source.samples
        for begin, end in passes(samples.stamps):
            own = samples[begin:end]
            times = own.log_times if self._source.same_clock else own.stamps
            yield begin > 0, own, np.maximum.accumulate(np.append(0, times))[1:]

    def _at_samples(self, size: int) -> Iterator[Window]:
        """Yield windows with a tick for each message; those in a row with one stamp share it."""
        for restarts, samples, arrivals in self._passes():
            ends = 1 + np.flatnonzero(np.append(np.diff(samples.stamps) != 0, True))
            taken = 0
            for begin in range(0, len(ends), size):
                known = ends[begin : begin + size]
                stamps, times = samples.stamps[known - 1], samples.log_times[known - 1]
                ticks = _ticks(stamps, arrivals[known - 1], known - taken, times, times)
                ticks.resets[0] = restarts and not begin
                yield Window(samples[taken : known[-1]], ticks)
                taken = int(known[-1])

    def _at_rate(self, period: float, size: int) -> Iterator[Window]:
        """Yield windows with ticks at a fixed rate on the clock of the recording.

        They begin with the first arrival, and again when time has restarted.
        """
        latest = 0
        for restarts, samples, arrivals in self._passes():
            delays = np.append(0, samples.log_times - arrivals)
            taken, count = 0, math.ceil((int(arrivals[-1] - arrivals[0]) + 1) / period)
            for begin in range(0, count, size):
                places = np.arange(begin, min(begin + size, count))
                stamps = arrivals[0] + np.round(places * period).astype(np.int64)
                known = np.searchsorted(arrivals, stamps, side="right")
                times = np.maximum.accumulate(np.append(latest, stamps + delays[known]))[1:]
                ticks = _ticks(stamps, stamps, known - taken, times, times)
                ticks.resets[0] = restarts and not begin
                yield Window(_in_order(samples[taken : known[-1]], ticks.known), ticks)
                taken, latest = int(known[-1]), int(times[-1])
            if taken < len(samples):
                # What no tick takes is used all the same.
                rest, latest = samples[taken:], max(latest, int(samples.log_times[-1]))
                ticks = _ticks(arrivals[-1:], arrivals[-1:], len(rest), latest, latest)
                ticks.estimated = False
                yield Window(_in_order(rest, ticks.known), ticks)

    def _of_tick_log(self, live: LiveRun, size: int) -> Iterator[Window]:
        """Yield windows with the ticks of the recorded observer; at least one, without any tick."""
        taken = 0
        for begin in range(0, max(len(live.ticks), 1), size):
            own = live.ticks[begin : begin + size]
            known = np.cumsum(own.counts)
            ticks = _ticks(own.stamps, own.stamps, known, own.log_times, own.publish_times)
            ticks.resets, ticks.estimated = own.numbers == 1, own.estimated == 1
            end = taken + int(own.counts.sum())
            samples = self._source.samples[live.used[taken:end]]
            yield Window(_in_order(samples, known), ticks)
            taken = end


def _ticks(*columns: Any) -> Records:
    """Return ticks with estimates of their stamps, `now`, `known`, log and publish times."""
    stamps, now, known, log_times, publish_times = np.broadcast_arrays(*columns)
    made = (stamps, now, known, np.zeros(len(stamps)), np.ones(len(stamps)))
    return np.rec.fromarrays([*made, log_times, publish_times], _TICK)


def _joined(windows: list[Window]) -> Window:
    """Return one window of all that there is."""
    if len(windows) == 1:
        return windows[0]
    begins = np.cumsum([0, *(len(samples) for samples, _ in windows)])
    for (_, ticks), begin in zip(windows, begins.tolist(), strict=False):
        ticks.known += begin
    return Window(*(np.concatenate(one).view(np.recarray) for one in zip(*windows, strict=True)))


def _in_order(samples: Records, known: NDArray[np.int64]) -> Records:
    """Return samples in the order of their stamps within each tick."""
    if (np.diff(samples.stamps) >= 0).all():
        return samples
    of_tick = np.searchsorted(known, np.arange(len(samples)), side="right")
    return samples[np.lexsort((samples.stamps, of_tick))]
