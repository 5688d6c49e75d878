# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The faults of sensors: missing, stuck, oscillating, drifting, biased or noisy.

The estimator's state shows them: the time since a sensor's last value, repetitions of its value,
the named hypothesis, the size of its noise, and the estimated disturbance. A kind and a level must
last for some time to be reported.
"""

import enum
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.events import NOISY
from tsobs_ros.estimation.health import Debounce, DisturbanceLimits, Level, Status, lasting
from tsobs_ros.estimation.records import Estimate, Hypothesis
from tsobs_ros.estimation.state import likeliest
from tsobs_ros.model.prediction import Record
from tsobs_ros.series import NANOSECONDS

_PERIOD = 0.1  # time between two checks, and shortest time of a missing or stuck sensor [s]
_STUCK_REPEATS = 10
_BIAS_SIGMAS = 4.0


class FaultKind(enum.Enum):
    """Kind of a sensor's fault; if several apply, the first."""

    NONE = "none"
    MISSING = "missing"
    STUCK = "stuck"
    OSCILLATION = "oscillation"
    DRIFT = "drift"
    BIAS = "bias"
    NOISE = "noise"


_SURE = (FaultKind.MISSING, FaultKind.STUCK)
"""Kinds that are reported at once."""
_LEVELS = {FaultKind.NONE: Level.OK, FaultKind.NOISE: Level.WARN} | dict.fromkeys(
    _SURE, Level.ERROR
)
"""Levels of the kinds whose level does not depend on the size."""
_SUPPOSED = {
    Hypothesis.TONE: FaultKind.OSCILLATION,
    Hypothesis.DRIFT: FaultKind.DRIFT,
    Hypothesis.COLOURED_NOISE: FaultKind.NOISE,
}
"""Fault that a hypothesis assumes for the sensor whose part of the states it moves most."""


class Fault(NamedTuple):
    """A fault of a sensor; numbers are in its unit.

    Attributes:
        kind: The apparent kind.
        magnitude: Amplitude of an oscillation, standard deviation of noise, otherwise the
            disturbance.
        bound: 1σ bound of the disturbance; infinite if it is not claimed to hold.
        level: Severity: by the limits for a size, WARN for noise, ERROR for a sensor that is stuck
            or missing.
        since: Stamp at which the kind was first seen [ns], None if there never was another.
        frequency: Frequency of an oscillation [rad/s], else None.
    """

    kind: FaultKind = FaultKind.NONE
    magnitude: float = 0.0
    bound: float = math.inf
    level: Level = Level.OK
    since: int | None = None
    frequency: float | None = None

    def status(self, now: int, unit: str = "rad", output: str = "") -> Status:
        """Return the fault for diagnostics at a time [ns]; `output` names one of several."""
        of_unit, of_output = f" [{unit}]" * bool(unit), f" of {output}" * bool(output)
        values = {
            "kind": self.kind.value,
            f"magnitude{of_unit}": f"{self.magnitude:.4g}",
            f"bound{of_unit}": f"{self.bound:.4g}",
        }
        values |= lasting(self.since, now)
        if self.frequency is not None:
            values["frequency [rad/s]"] = f"{self.frequency:.4g}"
        return Status(f"sensor fault{of_output}", self.level, self.kind.value, values)


class FaultMonitor:
    """Finds the faults of an estimator's sensors.

    Args:
        estimator: The estimator, whose model has the sensors' noise.
        limits: Limits of a disturbance, and the time that a level or a kind must last; may be
            changed at any time.

    Attributes:
        faults: The present fault of each sensor.
    """

    def __init__(self, estimator: Estimator, limits: DisturbanceLimits | None = None) -> None:
        self.limits = limits or DisturbanceLimits()
        self._stds, self._states = np.sqrt(np.diag(estimator.model["R"][0])), estimator.shape.n
        self.faults = [Fault() for _ in self._stds]
        self._looked, self._values = 0, np.full(len(self._stds), np.nan)
        # For each sensor: kind, level, and the latest fault of each kind.
        self._known = [
            (Debounce(FaultKind.NONE), Debounce(Level.OK), {FaultKind.NONE: Fault()})
            for _ in self._stds
        ]

    def update(self, estimate: Estimate, state: Record) -> None:
        """Take in an estimate and its state; the faults are judged ten times per second."""
        stamp = estimate.stamp
        if stamp - self._looked < _PERIOD * NANOSECONDS:
            return
        for place, now in enumerate(self._seen(estimate, state)):
            kind, level, latest = self._known[place]
            latest[now.kind] = now
            hold = 0.0 if now.kind in _SURE else self.limits.hold
            self.faults[place] = latest[kind.update(stamp, now.kind, hold)]._replace(
                level=level.update(stamp, now.level, hold), since=kind.since
            )
        self._looked, self._values = stamp, state["sensors"]["value"][0].copy()

    def _seen(self, estimate: Estimate, state: Record) -> Iterator[Fault]:
        """Yield the momentary fault of each sensor."""
        best = likeliest(state)
        parts, supposed = best["x"][self._states + 1 :], _SUPPOSED.get(estimate.hypothesis)
        suspect = best["output"]
        if supposed in (FaultKind.DRIFT, FaultKind.NOISE):
            suspect = np.argmax(np.abs(parts[: len(self._stds)]) / self._stds)
        for place, sensor in enumerate(state["sensors"][0]):
            size, bound, frequency = 0.0, math.inf, None
            if estimate.disturbance.size:
                size = abs(float(estimate.disturbance[place]))
            if estimate.disturbance_bound.size:
                bound = float(estimate.disturbance_bound[place])
            if sensor["since"] >= _PERIOD:
                kind = FaultKind.MISSING
            elif sensor["repeats"] >= _STUCK_REPEATS and sensor["value"] == self._values[place]:
                kind = FaultKind.STUCK
            elif supposed in (FaultKind.OSCILLATION, FaultKind.DRIFT) and place == suspect:
                kind = supposed
            elif size > _BIAS_SIGMAS * bound:
                kind = FaultKind.BIAS
            elif sensor["noise_scale"] >= NOISY or (supposed and place == suspect):
                kind = FaultKind.NOISE
            else:
                kind = FaultKind.NONE
            if kind is FaultKind.OSCILLATION:
                size, frequency = math.hypot(*parts[:2]), float(parts[2])
            elif kind is FaultKind.NOISE:
                size = float(sensor["noise_scale"] * self._stds[place])
            level = _LEVELS.get(kind, self.limits.level_of(size))
            claimed = bound if estimate.claimed else math.inf
            yield Fault(kind, size, claimed, level, frequency=frequency)
