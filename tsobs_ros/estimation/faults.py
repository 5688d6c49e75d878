# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The fault monitor of a sensor: missing, stuck, too noisy, biased, drifting or oscillating.

There are four signs of a fault. Samples lack a value of the sensor: it is missing. Raw samples
repeat although they are noisy or the arm moves: the sensor is stuck. Innovations are too large, or
too many of them are: it is noise if they are white; if not, the model does not fit and the
disturbance has no bound. The last seconds of the estimated disturbance have a shape, see
`fault_shapes`. A level is about size, a kind about shape; both must last to be reported.

What is added up at each sample and estimate is a record in an array of them, one a sensor, for
core/faults.c; the rest is done ten times a second.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array, positive
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.estimation.fault_shapes import FaultKind, Shape, shape_of
from tsobs_ros.estimation.health import (
    Debounce,
    DisturbanceLimits,
    Level,
    Status,
    duration_text,
)
from tsobs_ros.estimation.records import USED

__all__ = ["Fault", "FaultKind", "FaultMonitor", "add_estimates", "add_samples", "new_watches"]

_MEMORY = 1.0
_LARGE = 2.0
_MANY_OUTLIERS, _FEW_OUTLIERS = 0.03, 0.02
_COLOURED = 0.3

_SURE = (FaultKind.STUCK, FaultKind.MISSING)
"""Kinds that are reported at once."""

_LEAST_BLOCKS = 10
_EVERY = 3
_OPEN = 3.0


class Fault(NamedTuple):
    """A fault of the sensor.

    Attributes:
        kind: What it looks like.
        level: How bad it is: of a size by the limits, WARN if the innovations are too large, ERROR
            if the sensor is stuck or missing.
        magnitude: Of a bias or drift its present size, of an oscillation its amplitude, of noise
            its standard deviation, else the largest disturbance of the last second [rad].
        bound: 1σ of the magnitude [rad]; infinite if the model does not hold.
        since: Stamp at which the kind was first seen [ns], None if there never was another.
        rate: Of a drift [rad/s], else None.
        frequency: Of an oscillation [rad/s], else None.
    """

    kind: FaultKind = FaultKind.NONE
    level: Level = Level.OK
    magnitude: float = 0.0
    bound: float = math.inf
    since: int | None = None
    rate: float | None = None
    frequency: float | None = None


_WATCH = np.dtype((np.record, record_type("watch")))
"""What is remembered of a sensor; core/faults.h describes it."""


def new_watches(measurement_std: list[float]) -> Any:
    """Return records for sensors whose samples have these 1σ of noise [rad]."""
    watches = np.zeros(len(measurement_std), _WATCH)
    watches["std"] = measurement_std
    watches["value"], watches["square"], watches["least"] = math.nan, 1.0, _LEAST_BLOCKS
    return watches


def add_samples(
    watches: Any,
    stamps: NDArray[np.int64],
    y: Array,
    codes: NDArray[np.int64],
    innovations: Array,
    expected_std: Array,
) -> None:
    """Take in m samples of each of k sensors, in the order of their stamps.

    Args:
        watches: Records of the sensors, shape (k,).
        stamps: [ns], shape (m,).
        y: Raw values, shape (k, m).
        codes: Outcomes by the codes of `history.REASONS`, shape (k, m).
        innovations: y − ŷ, shape (k, m).
        expected_std: 1σ expected of the innovations, shape (k, m).
    """
    native.faults_add_samples(watches.view(np.float64), stamps, y, codes, innovations, expected_std)


def add_estimates(watches: Any, stamp: int, disturbances: Array, bounds: Array) -> bool:
    """Take in an estimate of each of k sensors; return whether there is something to judge.

    Args:
        watches: Records of the sensors, shape (k,).
        stamp: Of the estimates [ns]; one that does not rise is passed over.
        disturbances: Estimated disturbances, NaN if there is none [rad], shape (k,).
        bounds: Their 1σ bounds [rad], shape (k,).
    """
    return native.faults_add_estimates(watches.view(np.float64), stamp, disturbances, bounds)


class FaultMonitor:
    """Finds the fault of one sensor from the input and output of its estimator.

    Args:
        measurement_std: 1σ of the noise of one sample that the design expects.
        limits: When a disturbance is bad, and how long that, and a kind, must last.
        watch: One of the records of several sensors, as an array of one; its own if None.
        unit: Unit of the sensor's values, for diagnostics; "" if it is not known.

    Attributes:
        limits: May be changed at any time.
        fault: The present one.

    Raises:
        ModelError: The standard deviation is not a finite number above zero.
    """

    def __init__(
        self,
        measurement_std: float,
        limits: DisturbanceLimits | None = None,
        watch: Any = None,
        unit: str = "rad",
    ) -> None:
        self._unit = unit
        self.limits = limits or DisturbanceLimits()
        self.fault = Fault()
        self._std = positive("measurement_std", measurement_std)
        self._watches = new_watches([self._std]) if watch is None else watch
        self._shape = Shape(FaultKind.NONE, 0.0)
        self._kind, self._level = Debounce(FaultKind.NONE), Debounce(Level.OK)
        self._wrong = Debounce(False)
        self._many_outliers = False
        self._candidates: dict[FaultKind, Fault] = {}

    def measured(self, stamp: int, y: float, innovation: float, expected_std: float) -> None:
        """Take in a measurement that was used.

        Args:
            stamp: Its stamp [ns].
            y: Raw angle [rad].
            innovation: y − ŷ [rad].
            expected_std: 1σ expected of the innovation [rad].
        """
        angles, innovations, deviations = np.array([y, innovation, expected_std]).reshape(3, 1, 1)
        codes = np.full((1, 1), USED)
        add_samples(self._watches, np.array([stamp]), angles, codes, innovations, deviations)

    def estimated(self, stamp: int, disturbance: float, bound: float) -> Fault:
        """Take in an estimate and return the fault, which is judged ten times a second.

        Args:
            stamp: Of the estimate [ns]; one that does not rise is passed over.
            disturbance: Estimated disturbance [rad].
            bound: Its 1σ bound [rad].
        """
        if add_estimates(self._watches, stamp, np.array([disturbance]), np.array([bound])):
            self.judge(disturbance, bound)
        return self.fault

    def judge(self, disturbance: float, bound: float) -> None:
        """Find the present fault, if the latest estimate gives occasion to.

        Args:
            disturbance: Of the latest estimate [rad].
            bound: Its 1σ bound [rad].
        """
        watch = self._watches[0]
        if watch.renewed:
            unknown = watch.renewed == 2
            self._shape = Shape(FaultKind.UNKNOWN if unknown else FaultKind.NONE, 0.0)
            watch.renewed = 0
        if watch.complete:
            if watch.count >= watch.least and watch.block % _EVERY == 0:
                self._look()
        elif not (watch.stuck or watch.missing) or self.fault.kind in _SURE:
            return
        watch.complete = 0
        self.fault = self._judge(int(watch.estimated), disturbance, bound)

    def status(self, now: int) -> Status:
        """Return the fault for diagnostics.

        Args:
            now: Time on the clock of the stamps [ns].
        """
        fault = self.fault

        def entry(name: str, per: str = "") -> str:
            unit = f"{self._unit}{per}" if self._unit else ""
            return f"{name} [{unit}]" if unit else name

        values = {
            "kind": fault.kind.value,
            entry("magnitude"): f"{fault.magnitude:.4g}",
            entry("bound"): f"{fault.bound:.4g}",
            "normalised innovation squared": f"{self.square:.3g}",
        }
        if fault.since is not None:
            values["since"] = duration_text(now - fault.since)
        if fault.rate is not None:
            values[entry("rate", "/s")] = f"{fault.rate:.4g}"
        if fault.frequency is not None:
            values["frequency [rad/s]"] = f"{fault.frequency:.4g}"
        return Status("sensor fault", fault.level, fault.kind.value, values)

    def innovation_status(self) -> Status:
        """Return whether the innovations are as large as the design expects, for diagnostics."""
        return Status(
            "innovation",
            Level.WARN if self.large else Level.OK,
            "larger than the design expects: noise, model, torque or disturbance differ"
            if self.large
            else "consistent with the design",
            {"normalised innovation squared": f"{self.square:.3g}"},
        )

    @property
    def square(self) -> float:
        """Average over a second of the normalised innovation squared, 1 if the model fits.

        Each innovation is clipped at 5σ, so that a lone outlier cannot hide in it.
        """
        return float(self._watches[0].square)

    @property
    def large(self) -> bool:
        """Whether the innovations are too large."""
        return self.square > _LARGE

    @property
    def white(self) -> bool:
        """Whether successive innovations are nearly uncorrelated."""
        return bool(abs(self._watches[0].product) <= _COLOURED * self.square)

    @property
    def widening(self) -> float:
        """By how much the sensor's noise widens a bound: √square if white, else unknown, so 1."""
        return math.sqrt(max(1.0, self.square)) if self.white else 1.0

    def _judge(self, stamp: int, disturbance: float, bound: float) -> Fault:
        now = self._candidate(disturbance, bound)
        self._candidates[now.kind] = now
        hold = 0.0 if now.kind in _SURE else self.limits.hold
        kind = self._kind.update(stamp, now.kind, hold)
        level = self._level.update(stamp, now.level, hold)
        wrong = self._wrong.update(stamp, now.kind is not FaultKind.NONE, hold)
        if wrong and kind is FaultKind.NONE:
            # Something has lasted, but no kind of it has.
            return Fault(FaultKind.UNKNOWN, level, now.magnitude, since=self._wrong.since)
        known = self._candidates.get(kind, Fault())
        return known._replace(level=level, since=self._kind.since)

    def _candidate(self, disturbance: float, bound: float) -> Fault:
        """Return the fault as it looks at the moment."""
        watch, shape = self._watches[0], self._shape
        if watch.missing:
            return Fault(FaultKind.MISSING, Level.ERROR, abs(disturbance))
        if watch.stuck:
            return Fault(FaultKind.STUCK, Level.ERROR, abs(disturbance))
        fits = self.white or not self.large
        certain = bound * self.widening if fits else math.inf
        level = self.limits.level_of(shape.magnitude)
        if shape.kind not in (FaultKind.NONE, FaultKind.UNKNOWN):
            return Fault(
                shape.kind, level, shape.magnitude, certain, None, shape.rate, shape.frequency
            )
        limit = _FEW_OUTLIERS if self._many_outliers else _MANY_OUTLIERS
        self._many_outliers = bool(watch.outliers > limit)
        if self.white and (self.large or self._many_outliers):
            std = math.sqrt(self.square) * self._std
            # 2·`_MEMORY` of samples are in the average.
            relative_error = math.sqrt(0.25 * watch.period / _MEMORY)
            return Fault(FaultKind.NOISE, Level.WARN, std, std * relative_error)
        if self.large or shape.kind is FaultKind.UNKNOWN:
            magnitude = max(shape.magnitude, abs(disturbance))
            level = self.limits.level_of(magnitude)
            least = Level.WARN if self.large else Level.OK
            return Fault(FaultKind.UNKNOWN, max(level, least), magnitude)
        return Fault(FaultKind.NONE, Level.OK, shape.magnitude, certain)

    def _look(self) -> None:
        """See the shape since the bound was last wide open, if that is long enough ago."""
        watch = self._watches[0]
        blocks = watch.blocks[: watch.count]
        bound = float(blocks[-1, 3])
        opened = np.flatnonzero(blocks[:, 3] > _OPEN * bound)
        times, values, motion, _ = (blocks[opened[-1] + 1 :] if len(opened) else blocks).T
        if len(times) >= _LEAST_BLOCKS:
            self._shape = shape_of(times, values, motion, bound * self.widening)
