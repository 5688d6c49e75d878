# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The fault monitor of a sensor: stuck, too noisy, biased, drifting or oscillating.

There are three signs of a fault. Raw samples repeat although they are noisy: the sensor is stuck.
Innovations are too large: it is noise if they are white; if not, the model does not fit and the
disturbance has no bound. The last seconds of the estimated disturbance have a shape, see
`fault_shapes`. A level is about size, a kind about shape; both must last to be reported.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import positive
from tsobs_ros.estimation.fault_shapes import FaultKind, Shape, shape_of
from tsobs_ros.estimation.health import Debounce, DisturbanceLimits, Level, Status

__all__ = ["Fault", "FaultKind", "FaultMonitor"]

_SAME_SIGMAS = 0.02
_STUCK_TIME = 0.1
_STUCK_SAMPLES = 10

_MEMORY = 1.0
_CLIP = 5.0
_LARGE = 2.0
_COLOURED = 0.3

_BLOCK = 100_000_000
_BLOCKS = 150
_LEAST_BLOCKS = 10
_RECOVERY_BLOCKS = 100
_EVERY = 3
_LONGEST_GAP = 1.0
_OPEN = 3.0


class Fault(NamedTuple):
    """A fault of the sensor.

    Attributes:
        kind: What it looks like.
        level: How bad it is: of a size by the limits, WARN if the innovations are too large, ERROR
            if the sensor is stuck.
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


class FaultMonitor:
    """Finds the fault of one sensor from the input and output of its estimator.

    Args:
        measurement_std: 1σ of the noise of one sample that the design expects [rad].
        limits: When a disturbance is bad, and how long that, and a kind, must last.

    Attributes:
        limits: May be changed at any time.
        fault: The present one.

    Raises:
        ModelError: The standard deviation is not a finite number above zero.
    """

    def __init__(self, measurement_std: float, limits: DisturbanceLimits | None = None) -> None:
        self.limits = limits or DisturbanceLimits()
        self.fault = Fault()
        self._std = positive("measurement_std", measurement_std)
        self._repeats = Repeats(_SAME_SIGMAS * self._std)
        self._innovations = Whiteness()
        self._history = History()
        self._kind, self._level = Debounce(FaultKind.NONE), Debounce(Level.OK)
        self._wrong = Debounce(False)
        self._candidates: dict[FaultKind, Fault] = {}
        self._predicted = 0.0
        self._stamp: int | None = None

    def measured(self, stamp: int, y: float, innovation: float, expected_std: float) -> None:
        """Take in a measurement that was used.

        Args:
            stamp: Its stamp [ns].
            y: Raw angle [rad].
            innovation: y − ŷ [rad].
            expected_std: 1σ expected of the innovation [rad].
        """
        self.unused(stamp, y)
        self._innovations.update(stamp, innovation / expected_std)
        self._predicted = y - innovation

    def unused(self, stamp: int, y: float) -> None:
        """Take in a measurement that the estimator did not use, with what `measured` is given."""
        was_stuck = self._repeats.stuck
        self._repeats.update(stamp, y)
        if was_stuck and not self._repeats.stuck:
            # The past is no guide to the future, and the estimate was led astray.
            self._history = History(after_fault=True)

    def estimated(self, stamp: int, disturbance: float, bound: float) -> Fault:
        """Take in an estimate and return the fault, which is judged ten times a second.

        Args:
            stamp: Of the estimate [ns]; one that does not rise is passed over.
            disturbance: Estimated disturbance [rad].
            bound: Its 1σ bound [rad].
        """
        if self._stamp is not None and stamp <= self._stamp:
            return self.fault
        self._stamp = stamp
        if self._history.broken_at(stamp):
            self._history = History()
        motion, widening = self._predicted - disturbance, self._innovations.widening
        if self._history.add(stamp, disturbance, motion, bound, widening) or (
            self._repeats.stuck and self.fault.kind is not FaultKind.STUCK
        ):
            self.fault = self._judge(stamp, disturbance, bound)
        return self.fault

    def status(self) -> Status:
        """Return the fault for diagnostics."""
        fault = self.fault
        values = {
            "kind": fault.kind.value,
            "magnitude [rad]": f"{fault.magnitude:.4g}",
            "bound [rad]": f"{fault.bound:.4g}",
            "normalised innovation squared": f"{self._innovations.square:.3g}",
        }
        if fault.since is not None:
            values["since [s]"] = f"{fault.since * 1e-9:.3f}"
        if fault.rate is not None:
            values["rate [rad/s]"] = f"{fault.rate:.4g}"
        if fault.frequency is not None:
            values["frequency [rad/s]"] = f"{fault.frequency:.4g}"
        return Status("sensor fault", fault.level, fault.kind.value, values)

    def _judge(self, stamp: int, disturbance: float, bound: float) -> Fault:
        now = self._candidate(disturbance, bound)
        self._candidates[now.kind] = now
        hold = 0.0 if now.kind is FaultKind.STUCK else self.limits.hold
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
        innovations, shape = self._innovations, self._history.shape
        if self._repeats.stuck:
            return Fault(FaultKind.STUCK, Level.ERROR, abs(disturbance))
        fits = innovations.white or not innovations.large
        certain = bound * innovations.widening if fits else math.inf
        level = self.limits.level_of(shape.magnitude)
        if shape.kind not in (FaultKind.NONE, FaultKind.UNKNOWN):
            return Fault(
                shape.kind, level, shape.magnitude, certain, None, shape.rate, shape.frequency
            )
        if innovations.large and innovations.white:
            std = math.sqrt(innovations.square) * self._std
            return Fault(FaultKind.NOISE, Level.WARN, std, std * innovations.relative_error)
        if innovations.large or shape.kind is FaultKind.UNKNOWN:
            magnitude = max(shape.magnitude, abs(disturbance))
            level = self.limits.level_of(magnitude)
            least = Level.WARN if innovations.large else Level.OK
            return Fault(FaultKind.UNKNOWN, max(level, least), magnitude)
        return Fault(FaultKind.NONE, Level.OK, shape.magnitude, certain)


class Repeats:
    """Detects raw samples that repeat although noisy ones would not.

    Args:
        tolerance: Samples that differ by no more than this count as the same [rad].

    Attributes:
        stuck: Whether the samples of the last tenth of a second, at least ten, are the same.
    """

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._anchor, self._since, self._count = math.nan, 0, 0
        self.stuck = False

    def update(self, stamp: int, y: float) -> None:
        """Take in a raw sample [rad] at a stamp [ns]."""
        if abs(y - self._anchor) <= self._tolerance:
            self._count += 1
            lasted = stamp - self._since >= _STUCK_TIME * 1e9
            self.stuck = lasted and self._count >= _STUCK_SAMPLES
        else:
            self._anchor, self._since, self._count, self.stuck = y, stamp, 1, False


class Whiteness:
    """One-second averages of the normalised innovation: its square, and times the one before.

    Attributes:
        square: 1 when the model fits; each sample is clipped at 5σ.
        period: Time between the last two samples [s].
    """

    def __init__(self) -> None:
        self._stamp: int | None = None
        self._last = 0.0
        self.square, self._product = 1.0, 0.0
        self.period = 0.0

    def update(self, stamp: int, normalised: float) -> None:
        """Take in an innovation divided by its expected 1σ, at a stamp [ns]; late ones pass by."""
        value = max(-_CLIP, min(_CLIP, normalised))
        if self._stamp is not None:
            if stamp <= self._stamp:
                return
            self.period = (stamp - self._stamp) * 1e-9
            weight = -math.expm1(-self.period / _MEMORY)
            self.square += weight * (value * value - self.square)
            self._product += weight * (value * self._last - self._product)
        self._stamp, self._last = stamp, value

    @property
    def large(self) -> bool:
        """Whether the innovations are too large."""
        return self.square > _LARGE

    @property
    def white(self) -> bool:
        """Whether successive innovations are nearly uncorrelated."""
        return abs(self._product) <= _COLOURED * self.square

    @property
    def widening(self) -> float:
        """By how much the sensor's noise widens a bound: √square if white, else unknown, so 1."""
        return math.sqrt(max(1.0, self.square)) if self.white else 1.0

    @property
    def relative_error(self) -> float:
        """1σ of √square relative to itself: 2·`_MEMORY` of samples are in the average."""
        return math.sqrt(0.25 * self.period / _MEMORY)


class _Block(NamedTuple):
    time: float
    disturbance: float
    motion: float
    bound: float


class History:
    """Means over tenths of a second of the last quarter of a minute, and their shape.

    Args:
        after_fault: Whether the estimate has to recover first: then the shape is unknown for 10 s.

    Attributes:
        shape: As of the last look at it, three times a second.
    """

    def __init__(self, after_fault: bool = False) -> None:
        self._least = _RECOVERY_BLOCKS if after_fault else _LEAST_BLOCKS
        self._blocks: deque[_Block] = deque(maxlen=_BLOCKS)
        self._begun: int | None = None
        self._stamp = 0
        self._block = self._count = 0
        self._sums = (0.0, 0.0, 0.0)
        self.shape = Shape(FaultKind.UNKNOWN if after_fault else FaultKind.NONE, 0.0)

    def broken_at(self, stamp: int) -> bool:
        """Return whether an estimate at a stamp [ns] comes after a gap."""
        return self._begun is not None and stamp - self._stamp > _LONGEST_GAP * 1e9

    def add(
        self, stamp: int, disturbance: float, motion: float, bound: float, widening: float
    ) -> bool:
        """Take in an estimate.

        Args:
            stamp: Of the estimate, later than the one before [ns].
            disturbance: [rad].
            motion: Estimated angle of the arm [rad].
            bound: 1σ of the disturbance [rad].
            widening: Factor of the bound.

        Returns:
            Whether a block is complete.
        """
        if self._begun is None:
            self._begun = stamp
        self._stamp = stamp
        a, b, c = self._sums
        self._sums = a + disturbance, b + motion, c + bound
        self._count += 1
        elapsed = stamp - self._begun
        if elapsed < (self._block + 1) * _BLOCK:
            return False
        means = (total / self._count for total in self._sums)
        self._blocks.append(_Block(elapsed * 1e-9, *means))
        self._sums, self._count = (0.0, 0.0, 0.0), 0
        self._block = elapsed // _BLOCK
        if len(self._blocks) >= self._least and self._block % _EVERY == 0:
            self._look(widening)
        return True

    def _look(self, widening: float) -> None:
        """See the shape since the bound was last wide open, if that is long enough ago."""
        blocks = np.array(self._blocks)
        bound = float(blocks[-1, 3])
        opened = np.flatnonzero(blocks[:, 3] > _OPEN * bound)
        times, values, motion, _ = (blocks[opened[-1] + 1 :] if len(opened) else blocks).T
        if len(times) >= _LEAST_BLOCKS:
            self.shape = shape_of(times, values, motion, bound * widening)
