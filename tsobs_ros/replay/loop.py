# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's loop without its clock: samples and ticks in, estimates and innovations out."""

import math
import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array, Flags
from tsobs_ros.estimation.estimator import Rows
from tsobs_ros.estimation.records import GATED, NON_FINITE, REASONS, USED, RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.replay.source import Records
from tsobs_ros.replay.windows import Window
from tsobs_ros.series import NANOSECONDS

_FOREVER = 2**62


class JointResults(NamedTuple):
    """Results of one joint: of n samples, those that are its own, and of m ticks.

    Attributes:
        rows: Estimates as of `Estimator.new_rows`, NaN where there is none, shape (m, width).
        there: Whether there is an estimate, shape (m,).
        newest: Stamp of the newest sample in use [ns], shape (m,).
        codes: Outcomes of the samples by `history.REASONS`, shape (n,).
        output_codes: The same of each output, shape (n, p).
        innovations: y − ŷ, NaN of outputs that were not used, shape (n, p).
    """

    rows: Array
    there: Flags
    newest: NDArray[np.int64]
    codes: NDArray[np.int64]
    output_codes: NDArray[np.int64]
    innovations: Array


def run_tracker(
    tracker: Tracker,
    stamps: NDArray[np.int64],
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
    stamps, y, u = np.ascontiguousarray(stamps), np.ascontiguousarray(y), np.ascontiguousarray(u)
    at, now, known, resets = map(np.ascontiguousarray, ticks)
    results = codes, output_codes, innovations, expected_std
    taken = 0
    for begin, end in pairwise([0, *np.flatnonzero(resets[1:]) + 1, len(rows)]):
        if begin == end:
            continue
        if resets[begin]:
            tracker.forget()
        own, of_ticks = slice(taken, int(known[end - 1])), slice(begin, end)
        tracker.advance(
            stamps[own], y[own], u[own], *(one[own] for one in results),
            at[of_ticks], now[of_ticks], known[of_ticks] - taken,
            newest[of_ticks], there[of_ticks], rows[of_ticks], limit,
        )  # fmt: skip
        taken = own.stop
    innovations[output_codes != USED] = np.nan
    rows[there == 0] = np.nan
    return JointResults(rows, there != 0, newest, codes, output_codes, innovations)


class Table(NamedTuple):
    """Estimates of J joints at m ticks, and innovations of n messages.

    Attributes:
        rows: Of each joint, of `Estimator.row_type`, NaN where there is none, shape (m,).
        done: Whether there is an estimate of any joint, shape (m,).
        innovations: Of each joint y − ŷ of the outputs that were used, else NaN, shape (n, p).
    """

    rows: list[Rows]
    done: Flags
    innovations: list[Array]

    def values(self, joint: int, *names: str) -> Array:
        """Return some fields of a joint's estimates side by side, shape (m, k)."""
        parts = [np.asarray(self.rows[joint][name]) for name in names]
        return np.hstack([part if part.ndim > 1 else part[:, np.newaxis] for part in parts])


class Loop:
    """An observer that runs over windows, each joint on its own.

    Args:
        trackers: Of the joints.
        stale_after: Age of a joint's newest measurement after which it is not estimated [s].
        at_samples: Whether there are only estimates at measurements that are in use.

    Attributes:
        trackers: The same.
        used: Number of measurements used, of all joints.
        rejected: Number of measurements not used, by reason.
        outputs: Of each joint, for each of its outputs, how often it was gated and how often it
            was missing, shape (p, 2).
    """

    def __init__(
        self, trackers: Sequence[Tracker], stale_after: float, *, at_samples: bool
    ) -> None:
        self.trackers = tuple(trackers)
        self._stale_after, self._at_samples = stale_after, at_samples
        self.used = 0
        self.rejected: Counter[RejectReason] = Counter()
        self.outputs = [np.zeros((one.estimator.shape.p, 2), np.int64) for one in trackers]
        self._last = 0

    @property
    def rewinds(self) -> int:
        """Number of late measurements put in their place."""
        return sum(tracker.rewinds for tracker in self.trackers)

    @property
    def failures(self) -> int:
        """Number of states or outputs that were not finite."""
        return sum(tracker.failures for tracker in self.trackers)

    def run(self, window: Window) -> Table:
        """Make the ticks of a window."""
        joints, samples = range(len(self.trackers)), window.samples
        with ThreadPoolExecutor(min(len(joints), os.cpu_count() or 1)) as pool:
            results = list(pool.map(lambda joint: self._run_joint(window, joint), joints))
        if refused := int(samples.refused.sum()):
            self.rejected[RejectReason.WRONG_JOINT] += refused
        done = self._done(window.ticks, results)
        innovations, rows = [], []
        for joint, one in enumerate(results):
            rows.append(self.trackers[joint].estimator.as_rows(one.rows))
            one.rows[~(done & one.there)] = np.nan
            spread = np.full((len(samples), one.innovations.shape[1]), np.nan)
            spread[samples.complete[:, joint]] = one.innovations
            innovations.append(spread)
            self._count(joint, one)
        return Table(rows, done, innovations)

    def _run_joint(self, window: Window, joint: int) -> JointResults:
        samples, ticks, tracker = window.samples, window.ticks, self.trackers[joint]
        own, shape = samples.complete[:, joint], tracker.estimator.shape
        known = np.append(0, np.cumsum(own))[ticks.known]
        return run_tracker(
            tracker,
            samples.stamps[own],
            samples.y[own, joint, : shape.p],
            samples.u[own, joint, : shape.m],
            (ticks.stamps, ticks.now, known, ticks.resets),
            self._stale_after,
        )

    def _count(self, joint: int, one: JointResults) -> None:
        self.used += int(np.isfinite(one.innovations).any(axis=1).sum())
        counts = np.bincount(one.codes, minlength=len(REASONS)).tolist()
        self.rejected.update(
            {reason: n for reason, n in zip(REASONS, counts, strict=True) if reason and n}
        )
        each = [(one.output_codes == code).sum(axis=0) for code in (GATED, NON_FINITE)]
        self.outputs[joint] += np.stack(each, axis=1)

    def _done(self, ticks: Records, results: Sequence[JointResults]) -> Flags:
        """Return the ticks at which a node would publish estimates; stamps rise to a restart."""
        done: Flags = np.any([one.there for one in results], axis=0) & ticks.estimated
        if self._at_samples:
            done &= np.any([one.newest == ticks.stamps for one in results], axis=0)
        for part in np.split(np.arange(len(ticks)), np.flatnonzero(ticks.resets)):
            if len(part) and ticks.resets[part[0]]:
                self._last = 0
            stamps = np.where(done[part], ticks.stamps[part], 0)
            before = np.maximum.accumulate(np.append(self._last, stamps))
            done[part] &= stamps > before[:-1]
            self._last = int(before[-1])
        return done
