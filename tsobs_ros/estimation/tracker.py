# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From a stream of stamped measurements to estimates at any stamp: order, reject, rewind.

Everything here is a function of stamps and measurements: the wall clock takes part only as the
`now` that a caller passes to have measurements from the future refused. A late measurement is
put in its place by rewinding to the state before it, so the estimate equals, bit for bit, the
one that arrival in order would have given.
"""

import math
from bisect import bisect_left, bisect_right
from collections import Counter
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple

import numpy as np

from tsobs_ros.checks import non_negative, positive
from tsobs_ros.estimation.estimator import Correction, Estimator, Readout, S
from tsobs_ros.estimation.records import (
    NANOSECONDS,
    Estimate,
    Innovation,
    Measurement,
    RejectReason,
)


@dataclass(frozen=True)
class TrackerOptions:
    """Limits of a tracker.

    Attributes:
        x_max: Half width of the certificate's domain [rad].
        history: How far back a late measurement may reach [s].
        future_tolerance: How far ahead of `now` a stamp may lie [s].
        restart_after: A gap in the measurements longer than this starts afresh [s].
    """

    x_max: float
    history: float = 0.5
    future_tolerance: float = 0.1
    restart_after: float = 5.0

    def __post_init__(self) -> None:
        positive("x_max", self.x_max)
        non_negative("history", self.history)
        non_negative("future_tolerance", self.future_tolerance)
        positive("restart_after", self.restart_after)


class _Step(NamedTuple):
    """A measurement, the state after it, and what happened up to it since the last reset.

    The counts are kept with the steps, so that a rewind takes them back too.
    """

    measurement: Measurement
    state: Any
    gated: int
    restarts: int
    failures: int


class Tracker(Generic[S]):
    """Runs an estimator over measurements in the order of their stamps.

    Attributes:
        estimator: The step functions.
        options: Limits.
        rewinds: Number of late measurements put in their place.
    """

    def __init__(self, estimator: Estimator[S], options: TrackerOptions) -> None:
        self.estimator = estimator
        self.options = options
        self._history = round(options.history * NANOSECONDS)
        self._future = round(options.future_tolerance * NANOSECONDS)
        self._restart_after = round(options.restart_after * NANOSECONDS)
        self.reset()

    def reset(self) -> None:
        """Forget everything; afterwards the tracker is as a new one."""
        self.rewinds = 0
        self._accepted = 0
        self._refused: Counter[RejectReason] = Counter()
        self._bad_outputs = 0
        self._base: _Step | None = None
        self._steps: list[_Step] = []
        self._stamps: list[int] = []
        self._coasted: tuple[_Step, int, S] | None = None

    @property
    def newest(self) -> int | None:
        """Stamp of the newest measurement in use [ns], None before the first."""
        return self._steps[-1].measurement.stamp if self._steps else None

    @property
    def used(self) -> int:
        """Number of measurements that corrected the estimate."""
        return self._accepted - self._gated

    @property
    def rejected(self) -> Counter[RejectReason]:
        """Number of measurements not used, by reason."""
        gated = {RejectReason.GATED: self._gated} if self._gated else {}
        return self._refused + Counter(gated)

    @property
    def restarts(self) -> int:
        """Number of fresh starts after a gap or a numerical failure."""
        return self._steps[-1].restarts if self._steps else 0

    @property
    def failures(self) -> int:
        """Number of numerical failures: states or outputs that were not finite."""
        return self._bad_outputs + (self._steps[-1].failures if self._steps else 0)

    @property
    def events(self) -> dict[str, int]:
        """What the estimator noticed up to the newest measurement, by name."""
        return self.estimator.events(self._steps[-1].state) if self._steps else {}

    def reject(self, reason: RejectReason) -> None:
        """Count a measurement that the caller could not even read."""
        self._refused[reason] += 1

    def offer(self, measurement: Measurement, now: int) -> Innovation | RejectReason:
        """Use a measurement, or say why not.

        Args:
            measurement: May be late by up to the history.
            now: Time on the clock of the stamps [ns].

        Returns:
            Its innovation, or the reason of its rejection, which has been counted.
        """
        reason = self._refusal(measurement, now)
        if reason is not None:
            self._refused[reason] += 1
            return reason
        place = bisect_left(self._stamps, measurement.stamp)
        later = [step.measurement for step in self._steps[place:]]
        del self._stamps[place:], self._steps[place:]
        correction = self._advance(measurement)
        for waiting in later:
            self._advance(waiting)
        self.rewinds += bool(later)
        self._accepted += 1
        self._trim()
        if correction.weight == 0.0:
            return RejectReason.GATED
        expected_std = np.sqrt(np.diagonal(correction.spread))
        return Innovation(measurement.stamp, correction.innovation, expected_std)

    def estimate(self, stamp: int) -> Estimate | None:
        """Return the estimate at a stamp [ns].

        Returns:
            None before the first measurement, or if the estimate is not finite, which is counted.
        """
        step = self._latest_until(stamp)
        if step is None:
            return None
        state, elapsed = self._coast(step, stamp)
        state = self.estimator.extrapolate(state, step.measurement.u, elapsed)
        readout = self.estimator.readout(state)
        if not _is_finite(readout):
            self._bad_outputs += 1
            return None
        return Estimate(
            stamp,
            *readout,
            in_domain=bool(abs(readout.state[0]) <= self.options.x_max),
            age=(stamp - step.measurement.stamp) / NANOSECONDS,
        )

    @property
    def _gated(self) -> int:
        return self._steps[-1].gated if self._steps else 0

    def _latest_until(self, stamp: int) -> _Step | None:
        place = bisect_right(self._stamps, stamp) - 1
        if place >= 0:
            return self._steps[place]
        if self._base is not None and self._base.measurement.stamp <= stamp:
            return self._base
        return None

    def _refusal(self, measurement: Measurement, now: int) -> RejectReason | None:
        stamp = measurement.stamp
        if not (np.isfinite(measurement.y).all() and np.isfinite(measurement.u).all()):
            return RejectReason.NON_FINITE
        if stamp <= 0:
            return RejectReason.ZERO_STAMP
        if stamp > now + self._future:
            return RejectReason.FROM_FUTURE
        newest = self.newest
        if newest is None or stamp > newest:
            return None
        if self._base is not None and stamp <= self._base.measurement.stamp:
            return RejectReason.TOO_OLD
        if stamp < newest - self._history:
            return RejectReason.TOO_OLD
        place = bisect_left(self._stamps, stamp)
        return RejectReason.DUPLICATE if self._stamps[place] == stamp else None

    def _advance(self, measurement: Measurement) -> Correction:
        """Predict to the measurement from the step before it, correct, and remember."""
        previous = self._steps[-1] if self._steps else self._base
        gated, restarts, failures = previous[2:] if previous is not None else (0, 0, 0)
        gap = 0 if previous is None else measurement.stamp - previous.measurement.stamp
        if previous is None or gap > self._restart_after:
            predicted = self.estimator.initial()
            restarts += previous is not None
        else:
            u = previous.measurement.u
            predicted = self.estimator.predict(previous.state, u, gap / NANOSECONDS)
        state, correction = self.estimator.correct(predicted, measurement.y)
        if not math.isfinite(float(correction.innovation.sum() + correction.spread.sum())):
            state, correction = self.estimator.correct(self.estimator.initial(), measurement.y)
            restarts, failures = restarts + 1, failures + 1
        gated += correction.weight == 0.0
        self._stamps.append(measurement.stamp)
        self._steps.append(_Step(measurement, state, gated, restarts, failures))
        return correction

    def _trim(self) -> None:
        keep_from = bisect_left(self._stamps, self._stamps[-1] - self._history)
        if keep_from:
            self._base = self._steps[keep_from - 1]
            del self._stamps[:keep_from], self._steps[:keep_from]

    def _coast(self, step: _Step, stamp: int) -> tuple[S, float]:
        """Return the state at the last whole period before `stamp`, and what remains [s].

        Whole periods are remembered from one call to the next; without that every tick of a
        long gap would predict through the whole gap again.
        """
        period = self.estimator.period
        duration = (stamp - step.measurement.stamp) / NANOSECONDS
        whole = int(duration // period)
        if duration <= 2.0 * period:
            return step.state, duration
        taken, state = 0, step.state
        if self._coasted is not None and self._coasted[0] is step and self._coasted[1] <= whole:
            _, taken, state = self._coasted
        for _ in range(whole - taken):
            state = self.estimator.predict(state, step.measurement.u, period)
        self._coasted = (step, whole, state)
        return state, duration - whole * period


def _is_finite(readout: Readout) -> bool:
    """Return whether every number of a readout is finite, by one sum that any other spoils."""
    numbers = (*readout[:5], readout.parameters, readout.parameter_bound)
    return math.isfinite(float(sum(array.sum() for array in numbers)))
