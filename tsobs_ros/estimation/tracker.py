# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From a stream of stamped measurements to estimates at any stamp: order, reject, rewind.

Everything here is a function of stamps and measurements: the wall clock takes part only as the
`now` that a caller passes to have measurements from the future refused. A late measurement is
put in its place by rewinding to the state before it, so the estimate equals, bit for bit, the
one that arrival in order would have given.
"""

import math
from collections import Counter
from dataclasses import dataclass
from typing import Generic

import numpy as np

from tsobs_ros.checks import Array, non_negative, positive
from tsobs_ros.estimation.estimator import Correction, Estimator, Readout, S
from tsobs_ros.estimation.history import History, Step
from tsobs_ros.estimation.records import (
    NANOSECONDS,
    Estimate,
    Innovation,
    Measurement,
    RejectReason,
)

NUMERICAL_FAILURES = (ArithmeticError, np.linalg.LinAlgError)
"""What may be raised where numbers leave what floats can hold, besides those that come out NaN."""


def quiet() -> np.errstate:
    """Return a decorator for where numbers may do so: what comes of it is counted as a failure."""
    return np.errstate(over="ignore", invalid="ignore", divide="ignore")


@dataclass(frozen=True)
class TrackerOptions:
    """Limits of a tracker.

    Attributes:
        x_max: Half width of the certificate's domain [rad].
        history: How far back a late measurement may reach [s].
        future_tolerance: How far ahead of `now` a stamp may lie [s].
        restart_after: A gap in the measurements longer than this restarts [s]; no estimate
            is given further than this from a measurement.
        max_steps: How many measurements the history holds at most, however dense their stamps.
    """

    x_max: float
    history: float = 0.5
    future_tolerance: float = 0.1
    restart_after: float = 5.0
    max_steps: int = 1024

    def __post_init__(self) -> None:
        positive("x_max", self.x_max)
        non_negative("history", self.history)
        non_negative("future_tolerance", self.future_tolerance)
        positive("restart_after", self.restart_after)
        positive("max_steps", self.max_steps)


class Tracker(Generic[S]):
    """Runs an estimator over measurements in the order of their stamps.

    Attributes:
        estimator: The step functions.
        options: Limits.
        rewinds: Number of late measurements put in their place.
        forgotten: Number of measurements that left the history early because it was full: those
            that are older yet are then too old.
    """

    def __init__(self, estimator: Estimator[S], options: TrackerOptions) -> None:
        self.estimator = estimator
        self.options = options
        self._span = round(options.history * NANOSECONDS)
        self._future = round(options.future_tolerance * NANOSECONDS)
        self._restart_after = round(options.restart_after * NANOSECONDS)
        self.reset()

    def reset(self) -> None:
        """Forget everything; afterwards the tracker is as a new one."""
        self.rewinds = 0
        self.forgotten = 0
        self._accepted = 0
        self._refused: Counter[RejectReason] = Counter()
        self._bad_outputs = 0
        self._history = History(self._span, self.options.max_steps)
        self._coasted: tuple[Step, int, S] | None = None

    @property
    def newest(self) -> int | None:
        """Stamp of the newest measurement in use [ns], None before the first."""
        last = self._history.last
        return last.measurement.stamp if last is not None else None

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
        return self._history.last.restarts if self._history.last else 0

    @property
    def failures(self) -> int:
        """Number of numerical failures: states or outputs that were not finite."""
        return self._bad_outputs + (self._history.last.failures if self._history.last else 0)

    @property
    def events(self) -> dict[str, int]:
        """What the estimator noticed up to the newest measurement, by name."""
        last = self._history.last
        return self.estimator.events(last.state) if last is not None else {}

    def reject(self, reason: RejectReason) -> None:
        """Count a measurement that the caller could not even read."""
        self._refused[reason] += 1

    @quiet()
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
        newest = self.newest
        late = newest is not None and measurement.stamp < newest
        later = self._history.rewind(measurement.stamp) if late else []
        correction = self._advance(measurement)
        for waiting in later:
            self._advance(waiting)
        self.rewinds += late
        return self._used(measurement, correction)

    def plain_step(self, measurement: Measurement, now: int) -> tuple[S, Array, float] | None:
        """Return the state, the torque [N m] and the time [s] to predict a measurement from.

        Returns:
            None if there is more to it: it is refused, late or the first one after a gap.
        """
        last = self._history.last
        if last is None or self._refusal(measurement, now) is not None:
            return None
        gap = measurement.stamp - last.measurement.stamp
        if not 0 < gap <= self._restart_after:
            return None
        return last.state, last.measurement.u, gap / NANOSECONDS

    def take(
        self, measurement: Measurement, state: S, correction: Correction
    ) -> Innovation | RejectReason:
        """Go on with a plain step that was computed elsewhere; see `offer` for what is returned."""
        return self._used(measurement, self._keep(measurement, state, correction, 0))

    @quiet()
    def estimate(self, stamp: int) -> Estimate | None:
        """Return the estimate at a stamp [ns].

        Returns:
            None before the first measurement, too long after the last, or if the estimate is not
            finite, which is counted.
        """
        basis = self.basis(stamp)
        if basis is None:
            return None
        state, u, elapsed = basis
        try:
            if elapsed > 0.0:
                state = self.estimator.extrapolate(state, u, elapsed)
            readout = self.estimator.readout(state)
        except NUMERICAL_FAILURES:
            self._bad_outputs += 1
            return None
        return self.published(stamp, readout)

    def basis(self, stamp: int) -> tuple[S, Array, float] | None:
        """Return the state, the torque [N m] and the time [s] to extrapolate to a stamp from.

        The caller sees to it that numbers which overflow are `quiet`.

        Returns:
            None where there is no estimate; see `estimate`.
        """
        step = self._history.until(stamp)
        if step is None or stamp - step.measurement.stamp > self._restart_after:
            return None
        try:
            state, elapsed = self._coast(step, stamp)
        except NUMERICAL_FAILURES:
            self._bad_outputs += 1
            return None
        return state, step.measurement.u, elapsed

    def published(self, stamp: int, readout: Readout) -> Estimate | None:
        """Return the estimate that a readout at a stamp makes; see `estimate`."""
        step = self._history.until(stamp)
        if step is None or not _is_finite(*readout[:5], *readout[6:8]):
            self._bad_outputs += 1
            return None
        in_domain = abs(float(readout.state[0])) <= self.options.x_max
        age = (stamp - step.measurement.stamp) / NANOSECONDS
        return Estimate(stamp, *readout, in_domain, age)

    @property
    def _gated(self) -> int:
        return self._history.last.gated if self._history.last else 0

    def _refusal(self, measurement: Measurement, now: int) -> RejectReason | None:
        stamp = measurement.stamp
        if not all(map(math.isfinite, (*measurement.y.tolist(), *measurement.u.tolist()))):
            return RejectReason.NON_FINITE
        if stamp <= 0:
            return RejectReason.ZERO_STAMP
        if stamp > now + self._future:
            return RejectReason.FROM_FUTURE
        newest = self.newest
        if newest is None or stamp > newest:
            return None
        if not self._history.reaches(stamp):
            return RejectReason.TOO_OLD
        return RejectReason.DUPLICATE if self._history.holds(stamp) else None

    def _advance(self, measurement: Measurement) -> Correction:
        """Predict to the measurement from the step before it, correct, and remember."""
        previous = self._history.last
        gap = 0 if previous is None else measurement.stamp - previous.measurement.stamp
        restarts = int(previous is not None and gap > self._restart_after)
        try:
            if previous is None or restarts:
                predicted = self.estimator.initial()
            else:
                u = previous.measurement.u
                predicted = self.estimator.predict(previous.state, u, gap / NANOSECONDS)
            state, correction = self.estimator.correct(predicted, measurement.y)
        except NUMERICAL_FAILURES:
            return self._keep_afresh(measurement, restarts)
        return self._keep(measurement, state, correction, restarts)

    def _keep(
        self, measurement: Measurement, state: S, correction: Correction, restarts: int
    ) -> Correction:
        """Remember a step, restarted if it is not finite; return its correction."""
        if not _is_finite(correction.innovation, correction.innovation_covariance.ravel()):
            return self._keep_afresh(measurement, restarts)
        self._remember(measurement, state, correction, restarts, 0)
        return correction

    def _keep_afresh(self, measurement: Measurement, restarts: int) -> Correction:
        """Begin afresh with a measurement, or where it is to blame itself, without it."""
        initial = self.estimator.initial()
        try:
            state, correction = self.estimator.correct(initial, measurement.y)
        except NUMERICAL_FAILURES:
            nothing = np.zeros(0)
            state, correction = initial, Correction(nothing, nothing, nothing, weight=0.0)
        self._remember(measurement, state, correction, restarts + 1, 1)
        return correction

    def _remember(
        self,
        measurement: Measurement,
        state: S,
        correction: Correction,
        restarts: int,
        failures: int,
    ) -> None:
        gated, last = int(correction.weight == 0.0), self._history.last
        if last is not None:
            gated += last.gated
            restarts += last.restarts
            failures += last.failures
        self._history.append(Step(measurement, state, gated, restarts, failures))

    def _used(self, measurement: Measurement, correction: Correction) -> Innovation | RejectReason:
        """Count an accepted measurement and return what `offer` does."""
        self._accepted += 1
        self.forgotten += self._history.trim()
        if correction.weight == 0.0:
            return RejectReason.GATED
        expected_std = np.sqrt(correction.innovation_covariance.diagonal())
        return Innovation(measurement.stamp, correction.innovation, expected_std)

    def _coast(self, step: Step, stamp: int) -> tuple[S, float]:
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
        if taken == 0:
            # At once, which tells the estimator that this is no regular step.
            taken, state = 2, self.estimator.predict(state, step.measurement.u, 2.0 * period)
        for _ in range(whole - taken):
            state = self.estimator.predict(state, step.measurement.u, period)
        self._coasted = (step, whole, state)
        return state, duration - whole * period


def _is_finite(*arrays: Array) -> bool:
    """Return whether all numbers of some vectors are finite, by one sum that any other spoils."""
    return math.isfinite(sum([sum(array.tolist()) for array in arrays]))
