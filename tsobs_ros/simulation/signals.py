# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Disturbances of the sensor as signals: what really happens, whatever an estimator assumes.

A disturbance is a sum of components. Time counts from the moment the disturbance is put in, which
is the plant's start unless it is exchanged while the plant runs.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

from tsobs_ros.checks import non_negative, positive
from tsobs_ros.errors import ModelError


class Component(Protocol):
    """One kind of disturbance with its numbers."""

    kind: ClassVar[str]

    @property
    def start(self) -> float:
        """When it sets in [s]."""
        ...

    def value(self, time: float) -> float:
        """Return what it adds [rad] at a time [s], zero before its start."""
        ...


@dataclass(frozen=True)
class BiasStep:
    """d = a from the start on.

    Attributes:
        amplitude: a [rad].
        start: [s].
    """

    kind: ClassVar[str] = "bias_step"
    amplitude: float = 0.1
    start: float = 30.0

    def __post_init__(self) -> None:
        _check(self, "amplitude", "start")

    def value(self, time: float) -> float:
        """Return d [rad] at a time [s]."""
        return self.amplitude if time >= self.start else 0.0


@dataclass(frozen=True)
class Sinusoid:
    """d = a sin ω(t − start) from the start on; the defaults are Example 2's first fault.

    Attributes:
        amplitude: a [rad].
        frequency: ω [rad/s].
        start: [s].
    """

    kind: ClassVar[str] = "sinusoid"
    amplitude: float = 0.2
    frequency: float = 3.0
    start: float = 2.0

    def __post_init__(self) -> None:
        _check(self, "amplitude", "frequency", "start")

    def value(self, time: float) -> float:
        """Return d [rad] at a time [s]."""
        elapsed = time - self.start
        return self.amplitude * math.sin(self.frequency * elapsed) if elapsed >= 0.0 else 0.0


@dataclass(frozen=True)
class Ramp:
    """d = r (t − start) from the start on.

    Attributes:
        rate: r [rad/s].
        start: [s].
    """

    kind: ClassVar[str] = "ramp"
    rate: float = 0.004
    start: float = 10.0

    def __post_init__(self) -> None:
        _check(self, "rate", "start")

    def value(self, time: float) -> float:
        """Return d [rad] at a time [s]."""
        return self.rate * max(0.0, time - self.start)


@dataclass(frozen=True)
class TwoTone:
    """d = a (sin 2t + cos 3t) from the start on; the defaults are Example 2's third fault.

    Attributes:
        amplitude: a [rad].
        start: When it sets in [s]; its phase does not depend on it.
    """

    kind: ClassVar[str] = "two_tone"
    amplitude: float = 0.4
    start: float = 0.0

    def __post_init__(self) -> None:
        _check(self, "amplitude", "start")

    def value(self, time: float) -> float:
        """Return d [rad] at a time [s]."""
        if time < self.start:
            return 0.0
        return self.amplitude * (math.sin(2.0 * time) + math.cos(3.0 * time))


@dataclass(frozen=True)
class GaussMarkov:
    """A drift of bounded variance, ḋ = −d/τ + noise, which leaves zero at its start.

    Its variance grows as std² (1 − e^(−2t/τ)). `value` is its mean, zero; the random part comes
    from the exact discretisation in `DisturbanceSource`.

    Attributes:
        std: 1σ once it has become stationary [rad].
        time_constant: τ [s].
        start: [s].
    """

    kind: ClassVar[str] = "gauss_markov"
    std: float = 0.1
    time_constant: float = 20.0
    start: float = 0.0

    def __post_init__(self) -> None:
        non_negative("gauss_markov std", self.std)
        positive("gauss_markov time_constant", self.time_constant)
        _check(self, "start")

    def value(self, time: float) -> float:
        """Return the mean of d [rad]: zero."""
        return 0.0


@dataclass(frozen=True)
class StuckSensor:
    """The measured value freezes at the start and stays for a while.

    Attributes:
        start: [s].
        duration: [s], infinite for ever.
    """

    kind: ClassVar[str] = "stuck"
    start: float = 30.0
    duration: float = 1.0

    def __post_init__(self) -> None:
        _check(self, "start")
        if not self.duration >= 0.0:
            raise ModelError(f"stuck duration: expected at least 0 s, got {self.duration!r}")

    def value(self, time: float) -> float:
        """Return zero: a stuck sensor adds nothing, it replaces."""
        return 0.0

    def holds(self, time: float) -> bool:
        """Return whether the sensor is stuck at a time [s]."""
        return self.start <= time < self.start + self.duration


def _check(component: object, *names: str) -> None:
    for name in names:
        value = getattr(component, name)
        if not math.isfinite(value):
            kind = getattr(component, "kind", "disturbance")
            raise ModelError(f"{kind} {name}: expected a finite number, got {value!r}")


def example2_faults() -> tuple[Sinusoid, Sinusoid, TwoTone]:
    """Return the sensor faults fs₁, fs₂, fs₃ of the method's Example 2."""
    return Sinusoid(0.2, 3.0, 2.0), Sinusoid(0.2, 4.0, 3.0), TwoTone(0.4, 0.0)


KINDS: dict[str, Component] = {
    component.kind: component
    for component in (
        BiasStep(),
        Sinusoid(),
        Ramp(),
        TwoTone(),
        GaussMarkov(),
        StuckSensor(),
    )
}
"""Every kind of component under its name, with its default numbers."""


def parse_kinds(kinds: str) -> tuple[str, ...]:
    """Return the component names in "none", "bias_step" or a sum such as "bias_step+sinusoid".

    Raises:
        ModelError: A name is unknown or comes twice.
    """
    names = tuple(name.strip() for name in kinds.split("+"))
    if names == ("none",):
        return ()
    if unknown := [name for name in names if name not in KINDS]:
        raise ModelError(
            f"disturbance kind: expected none or a sum of {', '.join(KINDS)}, got {unknown[0]!r}"
        )
    if len(set(names)) < len(names):
        raise ModelError(f"disturbance kind: expected every kind at most once, got {kinds!r}")
    return names
