# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The fault monitor of sensors: missing, stuck, too noisy, biased, drifting or oscillating.

There are four signs of a fault. Samples lack a value of the sensor: it is missing. Raw samples
repeat although they are noisy or the arm moves: the sensor is stuck. Innovations are too large, or
too many of them are: it is noise if they are white; if not, the model does not fit and the
disturbance has no bound. The last seconds of the estimated disturbance have a shape, see
`fault_shapes`. A level is about size, a kind about shape; both must last to be reported.

What is added up at each sample and estimate is a record for core/faults.c, one a sensor; the rest
is done ten times a second.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, positive
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.estimation.fault_shapes import Fault, FaultKind, shape_of
from tsobs_ros.estimation.health import Debounce, DisturbanceLimits, Level, Status, duration_text

_MEMORY = 1.0
_LARGE = 2.0
_MANY_OUTLIERS, _FEW_OUTLIERS = 0.03, 0.02
_COLOURED = 0.3

_SURE = (FaultKind.STUCK, FaultKind.MISSING)
"""Kinds that are reported at once."""

_LEAST_BLOCKS = 10
_EVERY = 3
_OPEN = 3.0


class FaultMonitor:
    """Finds the faults of some sensors from the input and output of their estimator.

    Args:
        measurement_std: 1σ of the noise of one sample that the design expects, of each sensor.
        limits: When a disturbance is bad, and how long that, and a kind, must last; may be changed
            at any time.

    Attributes:
        watches: What is remembered of the sensors, records that core/faults.h describes.
        sensors: Each sensor, with its present fault.

    Raises:
        ModelError: A standard deviation is not a finite number above zero.
    """

    def __init__(
        self, measurement_std: Sequence[float], limits: DisturbanceLimits | None = None
    ) -> None:
        self.limits = limits or DisturbanceLimits()
        self.watches: Any = np.zeros(
            len(measurement_std), np.dtype((np.record, record_type("watch")))
        )
        self.watches["std"] = [positive("measurement_std", std) for std in measurement_std]
        self.watches["value"], self.watches["square"] = math.nan, 1.0
        self.watches["least"] = _LEAST_BLOCKS
        self.sensors = tuple(SensorFaults(watch) for watch in self.watches)

    def measured(
        self,
        stamps: ArrayLike,
        y: ArrayLike,
        codes: ArrayLike,
        innovations: ArrayLike,
        expected_std: ArrayLike,
    ) -> None:
        """Take in N samples of p sensors in the order of their stamps.

        Args:
            stamps: [ns], shape (N,).
            y: Raw values, shape (N, p).
            codes: `Outcomes.output_codes` of a tracker, as are the innovations and 1σ expected of
                them, shape (N, p).
        """
        columns = [
            np.ascontiguousarray(np.transpose(each))
            for each in (y, codes, innovations, expected_std)
        ]
        native.faults_add_samples(self.watches.view(np.float64), np.asarray(stamps), *columns)

    def estimated(self, stamp: int, disturbances: Array, bounds: Array) -> None:
        """Take in an estimate; ten times a second the faults are judged.

        Args:
            stamp: Of the estimate [ns]; one that does not rise is passed over.
            disturbances: Estimated disturbances, NaN if there is none, shape (p,).
            bounds: Their 1σ bounds, shape (p,), or none.
        """
        known = bounds if len(bounds) else np.full(len(disturbances), math.inf)
        watches = self.watches.view(np.float64)
        if native.faults_add_estimates(watches, stamp, disturbances, known):
            pairs = zip(disturbances.tolist(), known.tolist(), strict=True)
            for sensor, (disturbance, bound) in zip(self.sensors, pairs, strict=True):
                sensor.judge(disturbance, bound, self.limits)


class SensorFaults:
    """The faults of one sensor.

    Attributes:
        fault: The present one.
    """

    def __init__(self, watch: Any) -> None:
        self.fault = Fault()
        self._watch = watch
        self._shape = Fault()
        self._kind, self._level = Debounce(FaultKind.NONE), Debounce(Level.OK)
        self._wrong = Debounce(False)
        self._many_outliers = False
        self._candidates: dict[FaultKind, Fault] = {}

    @property
    def square(self) -> float:
        """Average over a second of the normalised innovation squared, 1 if the model fits.

        Each innovation is clipped at 5σ, so that a lone outlier cannot hide in it.
        """
        return float(self._watch.square)

    @property
    def _white(self) -> bool:
        return bool(abs(self._watch.product) <= _COLOURED * self.square)

    def judge(self, disturbance: float, bound: float, limits: DisturbanceLimits) -> None:
        """Find the present fault, if the latest estimate and its 1σ bound give occasion to."""
        watch = self._watch
        # White noise that is larger than the design's widens the bound.
        widening = math.sqrt(max(1.0, self.square)) if self._white else 1.0
        if watch.renewed:
            self._shape = Fault(FaultKind.UNKNOWN if watch.renewed == 2 else FaultKind.NONE)
            watch.renewed = 0
        if watch.complete:
            if watch.count >= watch.least and watch.block % _EVERY == 0:
                self._look(widening)
        elif not (watch.stuck or watch.missing) or self.fault.kind in _SURE:
            return
        watch.complete = 0
        now = self._candidate(abs(disturbance), bound * widening, limits)
        self._candidates[now.kind] = now
        stamp, hold = int(watch.estimated), 0.0 if now.kind in _SURE else limits.hold
        kind = self._kind.update(stamp, now.kind, hold)
        level = self._level.update(stamp, now.level, hold)
        wrong = self._wrong.update(stamp, now.kind is not FaultKind.NONE, hold)
        if wrong and kind is FaultKind.NONE:
            # Something has lasted, but no kind of it has.
            since = self._wrong.since
            self.fault = Fault(FaultKind.UNKNOWN, now.magnitude, level=level, since=since)
        else:
            known = self._candidates.get(kind, Fault())
            self.fault = known._replace(level=level, since=self._kind.since)

    def _look(self, widening: float) -> None:
        """See the shape since the bound was last wide open, if that is long enough ago."""
        blocks = self._watch.blocks[: self._watch.count]
        bound = float(blocks[-1, 3])
        opened = np.flatnonzero(blocks[:, 3] > _OPEN * bound)
        times, values, motion, _ = (blocks[opened[-1] + 1 :] if len(opened) else blocks).T
        if len(times) >= _LEAST_BLOCKS:
            self._shape = shape_of(times, values, motion, bound * widening)

    def _candidate(self, disturbance: float, bound: float, limits: DisturbanceLimits) -> Fault:
        """Return the fault as it looks at the moment."""
        watch, shape, white = self._watch, self._shape, self._white
        large = self.square > _LARGE
        if watch.missing or watch.stuck:
            kind = FaultKind.MISSING if watch.missing else FaultKind.STUCK
            return Fault(kind, disturbance, level=Level.ERROR)
        certain = bound if white or not large else math.inf
        if shape.kind not in (FaultKind.NONE, FaultKind.UNKNOWN):
            return shape._replace(level=limits.level_of(shape.magnitude), bound=certain)
        limit = _FEW_OUTLIERS if self._many_outliers else _MANY_OUTLIERS
        self._many_outliers = bool(watch.outliers > limit)
        if white and (large or self._many_outliers):
            std = math.sqrt(self.square) * float(watch["std"])
            # 2·`_MEMORY` of samples are in the average.
            relative_error = math.sqrt(0.25 * watch.period / _MEMORY)
            return Fault(FaultKind.NOISE, std, std * relative_error, Level.WARN)
        if large or shape.kind is FaultKind.UNKNOWN:
            magnitude = max(shape.magnitude, disturbance)
            level = max(limits.level_of(magnitude), Level.WARN if large else Level.OK)
            return Fault(FaultKind.UNKNOWN, magnitude, level=level)
        return Fault(FaultKind.NONE, shape.magnitude, certain)

    def status(self, now: int, unit: str = "rad") -> Status:
        """Return the fault for diagnostics, at a time of the stamps' clock [ns]."""
        fault, of_unit = self.fault, f" [{unit}]" if unit else ""
        values = {
            "kind": fault.kind.value,
            f"magnitude{of_unit}": f"{fault.magnitude:.4g}",
            f"bound{of_unit}": f"{fault.bound:.4g}",
            "normalised innovation squared": f"{self.square:.3g}",
        }
        if fault.since is not None:
            values["since"] = duration_text(now - fault.since)
        if fault.rate is not None:
            values[f"rate{of_unit.replace(']', '/s]')}"] = f"{fault.rate:.4g}"
        if fault.frequency is not None:
            values["frequency [rad/s]"] = f"{fault.frequency:.4g}"
        return Status("sensor fault", fault.level, fault.kind.value, values)

    def innovation_status(self) -> Status:
        """Return whether the innovations are as large as the design expects, for diagnostics."""
        level, text = Level.OK, "consistent with the design"
        if self.square > _LARGE:
            text = "larger than the design expects: noise, model, torque or disturbance differ"
            level = Level.WARN
        return Status(
            "innovation", level, text, {"normalised innovation squared": f"{self.square:.3g}"}
        )
