# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The tracker: from a stream of stamped measurements to estimates at any stamp.

Everything here is a function of stamps and measurements: the wall clock takes part only as the
`now` that a caller passes to have measurements from the future refused. A late measurement is
put in its place by rewinding to the state before it, so the estimate equals, bit for bit, the
one that arrival in order would have given.
"""

import math
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple

import numpy as np

from tsobs_ros.checks import Array, non_negative, positive
from tsobs_ros.estimation.estimator import Correction, Estimator, Readout, S
from tsobs_ros.estimation.records import (
    NANOSECONDS,
    Estimate,
    Innovation,
    Measurement,
    RejectReason,
)

_NUMERICAL_FAILURES = (ArithmeticError, np.linalg.LinAlgError)
"""What may be raised when numbers overflow, besides those that come out NaN."""


@dataclass(frozen=True)
class TrackerOptions:
    """Limits of a tracker.

    Attributes:
        x_max: Half width of the certificate's domain [rad].
        history: How far back a late measurement may reach [s].
        future_tolerance: How far ahead of `now` a stamp may lie [s].
        restart_after: A gap in the measurements longer than this restarts the estimator [s]; no
            estimate is given further than this from a measurement.
        max_steps: Largest number of measurements in the history, however dense their stamps.
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
        self._history = _History(self._span, self.options.max_steps)
        self._coasted: tuple[_Step, int, S] | None = None

    def copy(self) -> "Tracker[S]":
        """Return a tracker that goes on from here by itself."""
        other = Tracker(self.estimator, self.options)
        other.__dict__.update(self.__dict__)
        other._refused, other._history = self._refused.copy(), self._history.copy()
        return other

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
        """Number of restarts after a gap or a numerical failure."""
        return self._history.last.restarts if self._history.last else 0

    @property
    def failures(self) -> int:
        """Number of numerical failures: states or outputs that were not finite."""
        return self._bad_outputs + (self._history.last.failures if self._history.last else 0)

    @property
    def events(self) -> dict[str, int]:
        """The estimator's counts up to the newest measurement, by name."""
        last = self._history.last
        return self.estimator.events(last.state) if last is not None else {}

    def reject(self, reason: RejectReason) -> None:
        """Count a measurement that the caller could not even read."""
        self._refused[reason] += 1

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def offer(self, measurement: Measurement, now: int) -> Innovation | RejectReason:
        """Use a measurement, or refuse it.

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
        self._accepted += 1
        self.forgotten += self._history.trim()
        if correction.weight == 0.0:
            return RejectReason.GATED
        expected_std = np.sqrt(correction.innovation_covariance.diagonal())
        return Innovation(measurement.stamp, correction.innovation, expected_std)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def estimate(self, stamp: int) -> Estimate | None:
        """Return the estimate at a stamp [ns].

        Returns:
            None before the first measurement, too long after the last, or if the estimate is not
            finite, which is counted.
        """
        step = self._history.until(stamp)
        if step is None or stamp - step.measurement.stamp > self._restart_after:
            return None
        try:
            readout = self._read(step, stamp)
        except _NUMERICAL_FAILURES:
            readout = None
        if readout is None or not _is_finite(*readout[:5], *readout[6:8]):
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
        last = self._history.last
        gap = 0 if last is None else measurement.stamp - last.measurement.stamp
        gated, restarts, failures = (0, 0, 0) if last is None else last[2:]
        restart = last is not None and gap > self._restart_after
        try:
            if last is None or restart:
                predicted = self.estimator.initial()
            else:
                predicted = self.estimator.predict(
                    last.state, last.measurement.u, gap / NANOSECONDS
                )
            state, correction = self.estimator.correct(predicted, measurement.y)
            failed = not _is_finite(correction.innovation, correction.innovation_covariance.ravel())
        except _NUMERICAL_FAILURES:
            failed = True
        if failed:
            state, correction = self._restart(measurement)
        self._history.append(
            _Step(
                measurement,
                state,
                gated + (correction.weight == 0.0),
                restarts + restart + failed,
                failures + failed,
            )
        )
        return correction

    def _restart(self, measurement: Measurement) -> tuple[S, Correction]:
        """Return the initial state, corrected unless the measurement itself is to blame."""
        initial = self.estimator.initial()
        try:
            return self.estimator.correct(initial, measurement.y)
        except _NUMERICAL_FAILURES:
            nothing = np.zeros(0)
            return initial, Correction(nothing, nothing, nothing, weight=0.0)

    def _read(self, step: "_Step", stamp: int) -> Readout:
        """Return the estimate at a stamp after a step.

        Whole periods of a gap are remembered from one call to the next; without that every tick
        of a long gap would predict through the whole gap again.
        """
        period, u, state = self.estimator.period, step.measurement.u, step.state
        remaining = (stamp - step.measurement.stamp) / NANOSECONDS
        if remaining > 2.0 * period:
            whole, taken = int(remaining // period), 0
            if self._coasted is not None and self._coasted[0] is step and self._coasted[1] <= whole:
                _, taken, state = self._coasted
            if taken == 0:
                # Two at once, so that it is no regular step for the estimator.
                taken, state = 2, self.estimator.predict(state, u, 2.0 * period)
            for _ in range(whole - taken):
                state = self.estimator.predict(state, u, period)
            self._coasted = (step, whole, state)
            remaining -= whole * period
        if remaining > 0.0:
            state = self.estimator.extrapolate(state, u, remaining)
        return self.estimator.readout(state)


class JointTrackers:
    """The trackers of k independent joints, side by side.

    Attributes:
        trackers: One a joint, with its counts and events.
    """

    def __init__(self, trackers: Sequence[Tracker[Any]]) -> None:
        self.trackers = tuple(trackers)

    def reset(self) -> None:
        """Forget everything; afterwards every tracker is as a new one."""
        for tracker in self.trackers:
            tracker.reset()

    def copy(self) -> "JointTrackers":
        """Return trackers that go on from here by themselves."""
        return JointTrackers([tracker.copy() for tracker in self.trackers])

    def offer(
        self, measurements: Sequence[Measurement | None], now: int
    ) -> list[Innovation | RejectReason | None]:
        """Offer each joint its measurement, if there is one; see `Tracker.offer`.

        Raises:
            ValueError: There are not as many entries as joints.
        """
        pairs = zip(self.trackers, measurements, strict=True)
        return [one and tracker.offer(one, now) for tracker, one in pairs]

    def estimate(self, stamp: int, wanted: Sequence[bool] | None = None) -> list[Estimate | None]:
        """Return the estimate of each joint, or of those that are wanted; see `Tracker.estimate`.

        Raises:
            ValueError: There are not as many entries as joints.
        """
        asked = [True] * len(self.trackers) if wanted is None else wanted
        pairs = zip(self.trackers, asked, strict=True)
        return [tracker.estimate(stamp) if one else None for tracker, one in pairs]


class _Step(NamedTuple):
    """A measurement, the state after it, and counts up to it since the last reset.

    The counts are kept with the steps, so that a rewind takes them back too.
    """

    measurement: Measurement
    state: Any
    gated: int
    restarts: int
    failures: int


class _History:
    """Steps in the order of their stamps, and the one before them to begin a rewind from.

    Args:
        span: How far it reaches back from its newest step [ns].
        max_steps: Largest number of steps; a burst of stamps must not take memory without bound,
            nor a rewind time.

    Attributes:
        last: The newest step, None before the first.
    """

    def __init__(self, span: int, max_steps: int) -> None:
        self._span, self._max_steps = span, max_steps
        self.last: _Step | None = None
        self._base: _Step | None = None
        self._steps: list[_Step] = []
        self._stamps: list[int] = []

    def copy(self) -> "_History":
        """Return a history that goes on from here by itself."""
        other = _History(self._span, self._max_steps)
        other.last, other._base = self.last, self._base
        other._steps, other._stamps = self._steps.copy(), self._stamps.copy()
        return other

    def append(self, step: _Step) -> None:
        """Add a step that is newer than all others."""
        self.last = step
        self._steps.append(step)
        self._stamps.append(step.measurement.stamp)

    def until(self, stamp: int) -> _Step | None:
        """Return the newest step at a stamp [ns] or before it."""
        last = self.last
        if last is None or last.measurement.stamp <= stamp:
            return last
        place = bisect_right(self._stamps, stamp) - 1
        if place >= 0:
            return self._steps[place]
        base = self._base
        return base if base is not None and base.measurement.stamp <= stamp else None

    def reaches(self, stamp: int) -> bool:
        """Return whether a measurement with a stamp [ns] can still be put in its place."""
        if self._base is not None and stamp <= self._base.measurement.stamp:
            return False
        return self.last is None or stamp >= self.last.measurement.stamp - self._span

    def holds(self, stamp: int) -> bool:
        """Return whether there is a step with exactly this stamp [ns]."""
        place = bisect_left(self._stamps, stamp)
        return place < len(self._stamps) and self._stamps[place] == stamp

    def rewind(self, stamp: int) -> list[Measurement]:
        """Take out the steps after a stamp [ns]; return their measurements."""
        place = bisect_left(self._stamps, stamp)
        later = [step.measurement for step in self._steps[place:]]
        del self._stamps[place:], self._steps[place:]
        self.last = self._steps[-1] if self._steps else self._base
        return later

    def trim(self) -> int:
        """Forget what is out of reach; return how many were it for their number alone."""
        oldest = self._stamps[-1] - self._span
        if self._stamps[0] >= oldest and len(self._steps) <= self._max_steps:
            return 0
        expired = bisect_left(self._stamps, oldest)
        forgotten = max(0, len(self._steps) - expired - self._max_steps)
        keep_from = expired + forgotten
        self._base = self._steps[keep_from - 1]
        del self._stamps[:keep_from], self._steps[:keep_from]
        return forgotten


def _is_finite(*arrays: Array) -> bool:
    """Return whether all numbers of some vectors are finite, by one sum that any other spoils."""
    return math.isfinite(sum([sum(array.tolist()) for array in arrays]))
