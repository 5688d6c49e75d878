# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The fault monitor of sensors: missing, stuck, too noisy, biased, drifting or oscillating.

There are four signs of a fault. Samples lack a value of the sensor: it is missing. Raw samples
repeat although they are noisy or the arm moves: the sensor is stuck. Innovations are too large, or
too many of them are: it is noise if they are white; if not, the model does not fit and the
disturbance has no bound. The last seconds of the estimated disturbance have a shape, see
`fault_shapes`. A level is about size, a kind about shape; both must last to be reported.

Samples and estimates are added up as they come; the faults are judged ten times a second.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, positive
from tsobs_ros.estimation.fault_shapes import Fault, FaultKind, shape_of
from tsobs_ros.estimation.health import Debounce, DisturbanceLimits, Level, Status, duration_text
from tsobs_ros.estimation.records import CORRECTING, GATED, NON_FINITE
from tsobs_ros.estimation.tracker import Outcomes
from tsobs_ros.series import NANOSECONDS

_MEMORY, _OUTLIER_MEMORY = 1.0, 5.0
_CLIP, _LARGE = 5.0, 2.0
_MANY_OUTLIERS, _FEW_OUTLIERS = 0.03, 0.02
_COLOURED = 0.3

_SURE = (FaultKind.STUCK, FaultKind.MISSING)
"""Kinds that are reported at once, if they last for `_BLOCK`."""

_BLOCK, _LONGEST_GAP = NANOSECONDS // 10, NANOSECONDS
_BLOCKS, _LEAST_BLOCKS, _RECOVERY_BLOCKS = 150, 10, 100
"""Tenths of a second that are remembered, and needed to judge: at first, after a stuck sensor."""

_STUCK_SAMPLES = 10
_EVERY = 3
_OPEN = 3.0


class FaultMonitor:
    """Finds the faults of some sensors from the input and output of their estimator.

    Args:
        measurement_std: 1σ of the noise of one sample that the design expects, of each sensor.
        limits: When a disturbance is bad, and how long that, and a kind, must last; may be changed
            at any time.

    Attributes:
        sensors: Each sensor, with its present fault.

    Raises:
        ModelError: A standard deviation is not a finite number above zero.
    """

    def __init__(
        self, measurement_std: Sequence[float], limits: DisturbanceLimits | None = None
    ) -> None:
        self.limits = limits or DisturbanceLimits()
        self.sensors = tuple(SensorFaults(std) for std in measurement_std)

    def measured(
        self, stamps: ArrayLike, y: ArrayLike, outcomes: Outcomes, repeats: Sequence[int]
    ) -> None:
        """Take in samples in the order of their stamps, shapes (N,) and (N, p), with the outcomes
        of a tracker and its `repeats` after them."""
        samples = (np.transpose(each).tolist() for each in (y, *outcomes[1:]))
        times = np.asarray(stamps).tolist()
        for sensor, count, *columns in zip(self.sensors, repeats, *samples, strict=True):
            for sample in zip(times, *columns, strict=True):
                sensor.measured(*sample)
            if times:
                sensor.repeated(times[-1], count)

    def estimated(self, stamp: int, disturbances: Array, bounds: Array) -> None:
        """Take in an estimate; ten times a second the faults are judged.

        Args:
            stamp: Of the estimate [ns]; one that does not rise is passed over.
            disturbances: Estimated disturbances, NaN if there is none, shape (p,).
            bounds: Their 1σ bounds, shape (p,), or none.
        """
        known = bounds.tolist() if len(bounds) else [math.inf] * len(disturbances)
        for sensor, value, bound in zip(self.sensors, disturbances.tolist(), known, strict=True):
            if sensor.estimated(stamp, value, bound):
                sensor.judge(value, bound, self.limits)


class SensorFaults:
    """The faults of one sensor, whose innovations are in sigmas, within ±5.

    Attributes:
        fault: The present one.
        square: Average over a second of the normalised innovation squared, 1 if the model fits.
            Each is clipped, so that a lone outlier cannot hide in it.
    """

    def __init__(self, std: float) -> None:
        self.fault, self.square = Fault(), 1.0
        self._std = positive("measurement_std", std)
        # Of innovations that were used: stamp, value, period, average product of neighbours.
        self._stamp, self._before, self._period, self._product = 0, 0.0, 0.0, 0.0
        # Of all that have a value: stamp, value, share of outliers.
        self._seen, self._last, self._outliers = 0, 0.0, 0.0
        self._lacking, self._missing = 0, False
        self._value, self._since, self._stuck = math.nan, 0, False
        self._predicted, self._estimated = 0.0, 0
        self._renew(FaultKind.NONE, _LEAST_BLOCKS)
        self._kind, self._level = Debounce(FaultKind.NONE), Debounce(Level.OK)
        self._wrong = Debounce(False)
        self._many_outliers = False
        self._candidates: dict[FaultKind, Fault] = {}

    def _renew(self, kind: FaultKind, least: int) -> None:
        """Forget the history of the disturbance."""
        self._begun, self._block, self._complete = 0, 0, False
        self._sums, self._in_block = [0.0, 0.0, 0.0], 0
        self._blocks: deque[Any] = deque(maxlen=_BLOCKS)
        self._shape, self._least = Fault(kind), least

    def measured(
        self, stamp: int, y: float, code: int, innovation: float, expected_std: float
    ) -> None:
        """Take in one sample, used, gated or without a value; late ones are in no average."""
        if code == NON_FINITE and stamp > 0:
            self._lacking = self._lacking or stamp
            self._missing = stamp - self._lacking >= _BLOCK
        if code != GATED and code not in CORRECTING:
            return
        self._lacking, self._missing = 0, False
        if y != self._value:
            self._value, self._since = y, stamp
        value = max(-_CLIP, min(_CLIP, innovation / expected_std))
        if stamp > self._seen:
            # Far off, and not as those of a jump all are.
            outlier = abs(value) == _CLIP and value != self._last
            if self._seen:
                share = min(1.0, 1e-9 * (stamp - self._seen) / _OUTLIER_MEMORY)
                self._outliers += share * (outlier - self._outliers)
            self._seen, self._last = stamp, value
        if code == GATED:
            return
        self._predicted = y - innovation
        if stamp > self._stamp:
            if self._stamp:
                self._period = 1e-9 * (stamp - self._stamp)
                share = min(1.0, self._period / _MEMORY)
                self.square += share * (value * value - self.square)
                self._product += share * (value * self._before - self._product)
            self._stamp, self._before = stamp, value

    def repeated(self, stamp: int, repeats: int) -> None:
        """Take in how often the latest value has repeated, in a way that counts."""
        was_stuck = self._stuck
        self._stuck = repeats >= _STUCK_SAMPLES and stamp - self._since >= _BLOCK
        if was_stuck and not self._stuck:
            # The past is no guide to the future: the estimate was led astray.
            self._renew(FaultKind.UNKNOWN, _RECOVERY_BLOCKS)

    def estimated(self, stamp: int, disturbance: float, bound: float) -> bool:
        """Take in an estimate; return whether there is something to judge."""
        self._complete = False
        if math.isnan(disturbance) or stamp <= self._estimated:
            return False
        if self._begun and stamp - self._estimated > _LONGEST_GAP:
            self._renew(FaultKind.NONE, _LEAST_BLOCKS)
        self._estimated, self._begun = stamp, self._begun or stamp
        new = disturbance, self._predicted - disturbance, bound
        self._sums = [total + each for total, each in zip(self._sums, new, strict=True)]
        self._in_block += 1
        elapsed = stamp - self._begun
        if elapsed >= (self._block + 1) * _BLOCK:
            self._blocks.append((1e-9 * elapsed, *(each / self._in_block for each in self._sums)))
            self._sums, self._in_block = [0.0, 0.0, 0.0], 0
            self._block, self._complete = elapsed // _BLOCK, True
        return self._complete or self._stuck or self._missing

    @property
    def _white(self) -> bool:
        return bool(abs(self._product) <= _COLOURED * self.square)

    def judge(self, disturbance: float, bound: float, limits: DisturbanceLimits) -> None:
        """Find the present fault, if the latest estimate and its 1σ bound give occasion to."""
        # White noise that is larger than the design's widens the bound.
        widening = math.sqrt(max(1.0, self.square)) if self._white else 1.0
        if self._complete:
            if len(self._blocks) >= self._least and self._block % _EVERY == 0:
                self._look(widening)
        elif self.fault.kind in _SURE:
            return
        now = self._candidate(abs(disturbance), bound * widening, limits)
        self._candidates[now.kind] = now
        stamp, hold = self._estimated, 0.0 if now.kind in _SURE else limits.hold
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
        blocks = np.array(self._blocks)
        bound = float(blocks[-1, 3])
        opened = np.flatnonzero(blocks[:, 3] > _OPEN * bound)
        times, values, motion, _ = (blocks[opened[-1] + 1 :] if len(opened) else blocks).T
        if len(times) >= _LEAST_BLOCKS:
            self._shape = shape_of(times, values, motion, bound * widening)

    def _candidate(self, disturbance: float, bound: float, limits: DisturbanceLimits) -> Fault:
        """Return the fault as it looks at the moment."""
        shape, white = self._shape, self._white
        large = self.square > _LARGE
        if self._missing or self._stuck:
            kind = FaultKind.MISSING if self._missing else FaultKind.STUCK
            return Fault(kind, disturbance, level=Level.ERROR)
        certain = bound if white or not large else math.inf
        if shape.kind not in (FaultKind.NONE, FaultKind.UNKNOWN):
            return shape._replace(level=limits.level_of(shape.magnitude), bound=certain)
        limit = _FEW_OUTLIERS if self._many_outliers else _MANY_OUTLIERS
        self._many_outliers = bool(self._outliers > limit)
        if white and (large or self._many_outliers):
            std = math.sqrt(self.square) * self._std
            # 2·`_MEMORY` of samples are in the average.
            relative_error = math.sqrt(0.25 * self._period / _MEMORY)
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
