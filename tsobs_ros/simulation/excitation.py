# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Torques with which a simulated plant moves itself; pure functions of the time since its start."""

import math
from dataclasses import dataclass
from typing import Protocol

from tsobs_ros.checks import positive
from tsobs_ros.errors import ModelError


class Excitation(Protocol):
    """A torque over time."""

    def torque(self, time: float) -> float:
        """Return the torque [N m] at a time [s] since the start."""
        ...


@dataclass(frozen=True)
class NoTorque:
    """The motor is not driven."""

    def torque(self, time: float) -> float:
        """Return zero."""
        return 0.0


@dataclass(frozen=True)
class Sine:
    """u = a sin ωt; the defaults are the method's u = sin t.

    Attributes:
        amplitude: a [N m].
        frequency: ω [rad/s].
    """

    amplitude: float = 1.0
    frequency: float = 1.0

    def __post_init__(self) -> None:
        _check_signal("sine", self.amplitude, self.frequency)

    def torque(self, time: float) -> float:
        """Return the torque [N m] at a time [s]."""
        return self.amplitude * math.sin(self.frequency * time)


@dataclass(frozen=True)
class Multisine:
    """A sum of tones, equally spaced from the lowest to the highest, with Schroeder's phases.

    Schroeder's phases −πi(i − 1)/n spread the tones' crests, so that the peak stays near that of
    noise of the same power (M. R. Schroeder, IEEE Trans. Information Theory 16, 1970).

    Attributes:
        amplitude: Root of the tones' summed squared amplitudes [N m].
        lowest: Lowest tone [rad/s].
        highest: Highest tone [rad/s].
        tones: Their number.
    """

    amplitude: float = 1.0
    lowest: float = 0.5
    highest: float = 6.0
    tones: int = 8

    def __post_init__(self) -> None:
        _check_signal("multisine", self.amplitude, self.lowest)
        if not (math.isfinite(self.highest) and self.highest >= self.lowest):
            raise ModelError(
                f"multisine highest: expected at least lowest = {self.lowest!r} rad/s, "
                f"got {self.highest!r}"
            )
        if self.tones < 1:
            raise ModelError(f"multisine tones: expected at least 1, got {self.tones!r}")

    def torque(self, time: float) -> float:
        """Return the torque [N m] at a time [s]."""
        spacing = (self.highest - self.lowest) / max(1, self.tones - 1)
        total = sum(
            math.sin((self.lowest + i * spacing) * time - math.pi * i * (i + 1) / self.tones)
            for i in range(self.tones)
        )
        return self.amplitude / math.sqrt(self.tones) * total


@dataclass(frozen=True)
class Square:
    """Alternately +a and −a, half a period each, + first.

    Attributes:
        amplitude: a [N m].
        frequency: ω [rad/s]; the period is 2π/ω.
    """

    amplitude: float = 1.0
    frequency: float = 1.0

    def __post_init__(self) -> None:
        _check_signal("square", self.amplitude, self.frequency)

    def torque(self, time: float) -> float:
        """Return the torque [N m] at a time [s]."""
        return self.amplitude if (self.frequency * time / math.tau) % 1.0 < 0.5 else -self.amplitude


@dataclass(frozen=True)
class Chirp:
    """A tone whose frequency rises linearly from the lowest to the highest, again and again.

    Attributes:
        amplitude: [N m].
        lowest: Frequency at the beginning of a sweep [rad/s].
        highest: Frequency at its end [rad/s].
        sweep: Length of a sweep [s].
    """

    amplitude: float = 1.0
    lowest: float = 0.5
    highest: float = 6.0
    sweep: float = 20.0

    def __post_init__(self) -> None:
        _check_signal("chirp", self.amplitude, self.lowest)
        positive("chirp highest", self.highest)
        positive("chirp sweep", self.sweep)

    def torque(self, time: float) -> float:
        """Return the torque [N m] at a time [s]."""
        within = time % self.sweep
        growth = (self.highest - self.lowest) / self.sweep
        return self.amplitude * math.sin((self.lowest + 0.5 * growth * within) * within)


def _check_signal(kind: str, amplitude: float, frequency: float) -> None:
    if not math.isfinite(amplitude):
        raise ModelError(f"{kind} amplitude: expected a finite number, got {amplitude!r}")
    positive(f"{kind} frequency", frequency)
