# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's loop without its clock: windows of samples and ticks in, estimates out.

The ticks are those of the recorded observer, as its tick log has them, or one for each measurement
in the order of recording, or at a fixed rate.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array, Flags, Integers
from tsobs_ros.estimation.records import USED
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.replay.live import LiveRun
from tsobs_ros.replay.source import Records, Source, passes
from tsobs_ros.series import NANOSECONDS, Stamps

WINDOW = 4096
"""Number of ticks in a window: some 20 s at 200 Hz."""

_FOREVER = 2**62
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
    """The windows of a recording; at least one.

    Args:
        source: The recording.
        rate: Estimate at this rate [Hz]; None: at every measurement.
        as_live: Estimate, instead of both, when the recorded observer did.
        size: Number of ticks in a window; None for one window with everything.

    Attributes:
        live: What the recorded observer sent, if the ticks are those of its tick log.
        at_samples: Whether there are only estimates at measurements that are in use.
    """

    def __init__(self, source: Source, rate: float | None, as_live: bool, size: int | None) -> None:
        self._source, self._rate, self._size = source, rate, size
        self.live = source.live() if as_live else None
        self.at_samples = self.live is None and rate is None

    def __iter__(self) -> Iterator[Window]:
        size, taken, samples = self._size or _FOREVER, 0, self._source.samples
        if self.live is not None:
            parts = self._of_tick_log(self.live, size)
        elif self._rate is not None:
            parts = self._at_rate(NANOSECONDS / self._rate, size)
        else:
            parts = self._at_samples(size)
        if self._size is None:
            parts = iter([np.concatenate(list(parts)).view(np.recarray)])
        for ticks in parts:
            end = int(ticks.known[-1]) if len(ticks) else taken
            own = samples[taken:end] if self.live is None else samples[self.live.used[taken:end]]
            ticks.known -= taken
            taken = end
            yield Window(_in_order(own, ticks.known), ticks)

    def _passes(self) -> Iterator[tuple[int, Records, Stamps]]:
        """Yield where each pass of time begins, its samples, and when they arrived."""
        samples = self._source.samples
        for begin, end in passes(samples.stamps):
            own = samples[begin:end]
            times = own.log_times if self._source.same_clock else own.stamps
            yield begin, own, np.maximum.accumulate(np.append(0, times))[1:]

    def _at_samples(self, size: int) -> Iterator[Records]:
        """Yield a tick for each message; those in a row with one stamp share it."""
        for first, samples, arrivals in self._passes():
            ends = 1 + np.flatnonzero(np.append(np.diff(samples.stamps) != 0, True))
            for begin in range(0, len(ends), size):
                known = ends[begin : begin + size]
                stamps, times = samples.stamps[known - 1], samples.log_times[known - 1]
                ticks = _ticks(stamps, arrivals[known - 1], first + known, times, times)
                ticks.resets[0] = first > 0 and not begin
                yield ticks

    def _at_rate(self, period: float, size: int) -> Iterator[Records]:
        """Yield ticks at a fixed rate on the clock of the recording.

        They begin with the first arrival, and again when time has restarted.
        """
        latest = 0
        for first, samples, arrivals in self._passes():
            delays = np.append(0, samples.log_times - arrivals)
            count = math.ceil((int(arrivals[-1] - arrivals[0]) + 1) / period)
            for begin in range(0, count, size):
                places = np.arange(begin, min(begin + size, count))
                stamps = arrivals[0] + np.round(places * period).astype(np.int64)
                known = np.searchsorted(arrivals, stamps, side="right")
                times = np.maximum.accumulate(np.append(latest, stamps + delays[known]))[1:]
                ticks = _ticks(stamps, stamps, first + known, times, times)
                ticks.resets[0] = first > 0 and not begin
                yield ticks
                latest = int(times[-1])
            if known[-1] < len(samples):
                # What no tick takes is used all the same.
                latest = max(latest, int(samples.log_times[-1]))
                ticks = _ticks(arrivals[-1:], arrivals[-1:], first + len(samples), latest, latest)
                ticks.estimated = False
                yield ticks

    def _of_tick_log(self, live: LiveRun, size: int) -> Iterator[Records]:
        """Yield the ticks of the recorded observer."""
        taken = 0
        for begin in range(0, max(len(live.ticks), 1), size):
            own = live.ticks[begin : begin + size]
            known = taken + np.cumsum(own.counts)
            ticks = _ticks(own.stamps, own.stamps, known, own.log_times, own.publish_times)
            ticks.resets, ticks.estimated = own.numbers == 1, own.estimated == 1
            yield ticks
            taken = int(known[-1]) if len(known) else taken


def _ticks(*columns: Any) -> Records:
    """Return ticks with estimates of their stamps, `now`, `known`, log and publish times."""
    stamps, now, known, log_times, publish_times = np.broadcast_arrays(*columns)
    made = (stamps, now, known, np.zeros(len(stamps)), np.ones(len(stamps)))
    return np.rec.fromarrays([*made, log_times, publish_times], _TICK)


def _in_order(samples: Records, known: Integers) -> Records:
    """Return samples in the order of their stamps within each tick."""
    if (np.diff(samples.stamps) >= 0).all():
        return samples
    of_tick = np.searchsorted(known, np.arange(len(samples)), side="right")
    return samples[np.lexsort((samples.stamps, of_tick))]


class JointResults(NamedTuple):
    """Results of one joint: of n samples, those that are its own, and of m ticks.

    Attributes:
        rows: Estimates as of `Estimator.new_rows`, NaN where there is none, shape (m, width).
        there: Whether there is an estimate, shape (m,).
        newest: Stamp of the newest sample in use [ns], shape (m,).
        codes: Outcomes of the samples by `estimation.records.REASONS`, shape (n,).
        output_codes: The same of each output, shape (n, p).
        innovations: y − ŷ, NaN of outputs that were not used, shape (n, p).
    """

    rows: Array
    there: Flags
    newest: Stamps
    codes: Integers
    output_codes: Integers
    innovations: Array


def run_tracker(
    tracker: Tracker,
    stamps: Stamps,
    y: Array,
    u: Array,
    ticks: Sequence[NDArray[np.int64]],
    stale_after: float = math.inf,
) -> JointResults:
    """Run a tracker over samples and ticks; other threads of Python can run meanwhile.

    Args:
        tracker: The tracker.
        stamps: Of n samples in the order of use [ns], shape (n,).
        y: Outputs, shape (n, p).
        u: Inputs from each sample until the next one, shape (n, m).
        ticks: Stamps of the estimates and times on the clock [ns], numbers of samples taken by the
            end of each tick, and whether the tracker forgets everything before it.
        stale_after: Age of the newest sample after which nothing is estimated [s].
    """
    count, rows = len(stamps), tracker.estimator.new_rows(len(ticks[0]))
    codes, output_codes = np.zeros(count, np.int64), np.zeros(y.shape, np.int64)
    innovations, expected_std = np.full((2, *y.shape), np.nan)
    newest, there = np.zeros((2, len(rows)), np.int64)
    limit = _FOREVER if math.isinf(stale_after) else int(stale_after * NANOSECONDS)
    at, now, known, resets = map(np.ascontiguousarray, ticks)
    columns = *map(np.ascontiguousarray, (stamps, y, u)), codes, output_codes
    columns = *columns, innovations, expected_std
    taken = 0
    for begin, end in pairwise([0, *np.flatnonzero(resets[1:]) + 1, len(rows)]):
        if begin == end:
            continue
        if resets[begin]:
            tracker.forget()
        own, of_ticks = slice(taken, int(known[end - 1])), slice(begin, end)
        tracker.advance(
            *(one[own] for one in columns),
            at[of_ticks], now[of_ticks], known[of_ticks] - taken,
            newest[of_ticks], there[of_ticks], rows[of_ticks], limit,
        )  # fmt: skip
        taken = own.stop
    innovations[output_codes != USED] = np.nan
    rows[there == 0] = np.nan
    return JointResults(rows, there != 0, newest, codes, output_codes, innovations)
