# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Health of an estimator as data, which nodes and reports only show."""

import enum
import math
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

from tsobs_ros.checks import positive
from tsobs_ros.errors import ModelError

T = TypeVar("T")

_CLIP = 25.0
_INCONSISTENT = 2.0


class Level(enum.IntEnum):
    """Severity; the numbers are those of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Status(NamedTuple):
    """One concern: its level, a sentence for people and values for programs."""

    name: str
    level: Level
    message: str
    values: dict[str, str]


class Phase(enum.Enum):
    """How fresh the measurements behind an estimate are."""

    WAITING = "WAITING"
    TRACKING = "TRACKING"
    COASTING = "COASTING"
    STALE = "STALE"


def phase_of(age: float | None, coast_after: float, stale_after: float) -> Phase:
    """Return the phase for the age [s] of the newest measurement, None before the first."""
    if age is None:
        return Phase.WAITING
    if age > stale_after:
        return Phase.STALE
    return Phase.COASTING if age > coast_after else Phase.TRACKING


class InnovationMonitor:
    """Averages the normalised innovation squared (1 when the model fits) over about a second.

    Attributes:
        nis: The average, each sample clipped at 5σ so that a lone outlier cannot hide in it.
    """

    def __init__(self, time_constant: float = 1.0) -> None:
        self._time_constant = positive("time_constant", time_constant)
        self._stamp: int | None = None
        self.nis = 1.0

    def update(self, stamp: int, normalised: float) -> None:
        """Take in an innovation divided by its expected 1σ, at a stamp [ns]."""
        elapsed = 0.0 if self._stamp is None else max(0.0, (stamp - self._stamp) * 1e-9)
        self._stamp = stamp
        weight = -math.expm1(-elapsed / self._time_constant)
        self.nis += weight * (min(normalised * normalised, _CLIP) - self.nis)

    def status(self) -> Status:
        """Return whether the innovations are as large as the design expects."""
        fits = self.nis <= _INCONSISTENT
        return Status(
            "innovation",
            Level.OK if fits else Level.WARN,
            "consistent with the design"
            if fits
            else "larger than the design expects: noise, model or disturbance differ",
            {"normalised innovation squared": f"{self.nis:.3g}"},
        )


@dataclass(frozen=True)
class DisturbanceLimits:
    """When a disturbance counts as a fault.

    Attributes:
        warn: Magnitude from which it is worth a warning [rad].
        error: Magnitude from which it is an error [rad].
        hold: How long it must last, and be gone, before the level changes [s].
    """

    warn: float = 0.2
    error: float = 0.5
    hold: float = 0.5

    def __post_init__(self) -> None:
        positive("disturbance warn level", self.warn)
        if not self.error >= self.warn:
            raise ModelError(
                f"disturbance error level: expected at least the warn level {self.warn!r}, "
                f"got {self.error!r}"
            )

    def level_of(self, magnitude: float) -> Level:
        """Return the level of a magnitude [rad] at the moment."""
        if magnitude >= self.error:
            return Level.ERROR
        return Level.WARN if magnitude >= self.warn else Level.OK


class Debounce(Generic[T]):
    """Passes a value on once it has lasted.

    Attributes:
        value: What is passed on.
        since: When that began [ns], None as long as it is the one from the start.
    """

    def __init__(self, value: T) -> None:
        self.value = value
        self.since: int | None = None
        self._candidate = value
        self._from: int | None = None

    def update(self, stamp: int, value: T, hold: float) -> T:
        """Take in the value at a stamp [ns]; return the one that lasted `hold` [s]."""
        if value != self._candidate or self._from is None:
            self._candidate, self._from = value, stamp
        if stamp - self._from >= hold * 1e9 and value != self.value:
            self.value, self.since = value, self._from
        return self.value
