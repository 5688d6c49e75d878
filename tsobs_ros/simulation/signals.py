# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Torques that move a simulated plant, and disturbances of its sensor, as functions of time.

The time of a torque counts from the plant's start. A disturbance is a sum of components, and its
time counts from the moment it is put in, which is the plant's start unless it is exchanged while
the plant runs.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np

from tsobs_ros.checks import Array, finite, non_negative, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.simulation.sensor import RandomStream, Seeds, Source, batch_shape


class Excitation(ABC):
    """A torque over time."""

    @abstractmethod
    def torque(self, time: float) -> float:
        """Return the torque [N m] at a time [s] since the start."""


@dataclass(frozen=True)
class NoTorque(Excitation):
    """The motor is not driven."""

    def torque(self, time: float) -> float:
        return 0.0


@dataclass(frozen=True)
class Sine(Excitation):
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
        return self.amplitude * math.sin(self.frequency * time)


@dataclass(frozen=True)
class Multisine(Excitation):
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
        spacing = (self.highest - self.lowest) / max(1, self.tones - 1)
        total = sum(
            math.sin((self.lowest + i * spacing) * time - math.pi * i * (i + 1) / self.tones)
            for i in range(self.tones)
        )
        return self.amplitude / math.sqrt(self.tones) * total


@dataclass(frozen=True)
class Square(Excitation):
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
        return self.amplitude if (self.frequency * time / math.tau) % 1.0 < 0.5 else -self.amplitude


@dataclass(frozen=True)
class Chirp(Excitation):
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
        within = time % self.sweep
        growth = (self.highest - self.lowest) / self.sweep
        return self.amplitude * math.sin((self.lowest + 0.5 * growth * within) * within)


def _check_signal(kind: str, amplitude: float, frequency: float) -> None:
    finite(f"{kind} amplitude", amplitude)
    positive(f"{kind} frequency", frequency)


@dataclass(frozen=True)
class Component(ABC):
    """One kind of disturbance with its numbers.

    Raises:
        ModelError: A number is not finite.
    """

    kind: ClassVar[str]

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not math.isfinite(value):
                raise ModelError(
                    f"{self.kind} {item.name}: expected a finite number, got {value!r}"
                )

    @abstractmethod
    def value(self, time: float) -> float:
        """Return the addition to the measurement [rad] at a time [s], zero before the start."""


@dataclass(frozen=True)
class BiasStep(Component):
    """d = a from the start on.

    Attributes:
        amplitude: a [rad].
        start: [s].
    """

    kind: ClassVar[str] = "bias_step"
    amplitude: float = 0.1
    start: float = 30.0

    def value(self, time: float) -> float:
        return self.amplitude if time >= self.start else 0.0


@dataclass(frozen=True)
class Sinusoid(Component):
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

    def value(self, time: float) -> float:
        elapsed = time - self.start
        return self.amplitude * math.sin(self.frequency * elapsed) if elapsed >= 0.0 else 0.0


@dataclass(frozen=True)
class Ramp(Component):
    """d = r (t − start) from the start on.

    Attributes:
        rate: r [rad/s].
        start: [s].
    """

    kind: ClassVar[str] = "ramp"
    rate: float = 0.004
    start: float = 10.0

    def value(self, time: float) -> float:
        return self.rate * max(0.0, time - self.start)


@dataclass(frozen=True)
class TwoTone(Component):
    """d = a (sin 2t + cos 3t) from the start on; the defaults are Example 2's third fault.

    Attributes:
        amplitude: a [rad].
        start: When it sets in [s]; its phase does not depend on it.
    """

    kind: ClassVar[str] = "two_tone"
    amplitude: float = 0.4
    start: float = 0.0

    def value(self, time: float) -> float:
        if time < self.start:
            return 0.0
        return self.amplitude * (math.sin(2.0 * time) + math.cos(3.0 * time))


@dataclass(frozen=True)
class GaussMarkov(Component):
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
        super().__post_init__()

    def value(self, time: float) -> float:
        return 0.0


@dataclass(frozen=True)
class StuckSensor(Component):
    """The measured value freezes at the start and stays for a while; it adds nothing.

    Attributes:
        start: [s].
        duration: [s], infinite for ever.
    """

    kind: ClassVar[str] = "stuck"
    start: float = 30.0
    duration: float = 1.0

    def __post_init__(self) -> None:
        finite("stuck start", self.start)
        if not self.duration >= 0.0:
            raise ModelError(f"stuck duration: expected at least 0 s, got {self.duration!r}")

    def value(self, time: float) -> float:
        return 0.0

    def holds(self, time: float) -> bool:
        """Return whether the sensor is stuck at a time [s]."""
        return self.start <= time < self.start + self.duration


KINDS: dict[str, Component] = {
    each.kind: each
    for each in (BiasStep(), Sinusoid(), Ramp(), TwoTone(), GaussMarkov(), StuckSensor())
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


class DisturbanceSource:
    """The sum of components, sampled once a period and in order.

    Args:
        components: Parts of the sum; any stuck sensor that holds freezes the value.
        period: Sampling period [s].
        seeds: One seed, or one for each run.
        generation: Distinguishes the random streams of disturbances put in one after another.
    """

    def __init__(
        self, components: Sequence[Component], period: float, seeds: Seeds, generation: int = 0
    ) -> None:
        self._plain = [c for c in components if not isinstance(c, GaussMarkov | StuckSensor)]
        self._stuck = [c for c in components if isinstance(c, StuckSensor)]
        self._ones = np.ones((*batch_shape(seeds), 1))
        self._drifts = [
            _Drift(component, period, seeds, (generation, place))
            for place, component in enumerate(components)
            if isinstance(component, GaussMarkov)
        ]

    def sample(self, time: float) -> Array:
        """Return the added disturbance [rad] at the next time [s], shape (1,) or (runs, 1)."""
        value = 0.0
        for component in self._plain:
            value += component.value(time)
        total = value * self._ones
        for drift in self._drifts:
            total = total + drift.sample(time)
        return total

    def stuck(self, time: float) -> bool:
        """Return whether the sensor is stuck at a time [s]."""
        return bool(self._stuck) and any(component.holds(time) for component in self._stuck)


class _Drift:
    """The running value of a Gauss–Markov component."""

    def __init__(
        self, component: GaussMarkov, period: float, seeds: Seeds, key: tuple[int, ...]
    ) -> None:
        self._start = component.start
        self._decay = math.exp(-period / component.time_constant)
        self._step_std = component.std * math.sqrt(1.0 - self._decay**2)
        self._stream = RandomStream(seeds, Source.DISTURBANCE, (1,), key=key)
        self._value: Array | None = None

    def sample(self, time: float) -> Array:
        step = self._stream.draw()
        if time < self._start:
            return np.zeros_like(step)
        if self._value is None:
            self._value = np.zeros_like(step)
        else:
            self._value = np.asarray(self._decay * self._value + self._step_std * step)
        return self._value
