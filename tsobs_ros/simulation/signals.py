# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Torques that move a simulated plant, and disturbances of outputs and torques over time.

The time of a torque that moves the plant counts from its start. A disturbance is a sum of
components, and its time counts from the moment it is put in, which is the plant's start unless it
is exchanged while the plant runs. Units of components are those of an angle; a component of
another output has that output's unit in place of rad, one of a torque has N m.

Signals of this module are evaluated at many times at once. Others are evaluated time by time.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np

from tsobs_ros.checks import Array, Flags, check_each, finite, non_negative, positive
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError


class Excitation(ABC):
    """A torque over time."""

    @abstractmethod
    def torque(self, time: float) -> float:
        """Return the torque [N m] at a time [s] since the start."""

    def torques(self, times: Array) -> Array:
        """Return the torques at times, shape (samples,)."""
        return np.array([self.torque(time) for time in times.tolist()], np.float64)


class _KnownExcitation(Excitation):
    def torque(self, time: float) -> float:
        return float(_at_once(self._at, np.array([time], np.float64))[0])

    def torques(self, times: Array) -> Array:
        if type(self).torque is not _KnownExcitation.torque:
            return super().torques(times)
        return _at_once(self._at, times)

    @abstractmethod
    def _at(self, times: Array) -> Array:
        """Return the torques at times."""


@dataclass(frozen=True)
class NoTorque(_KnownExcitation):
    """The motor is not driven."""

    def _at(self, times: Array) -> Array:
        return np.zeros(len(times))


@dataclass(frozen=True)
class Constant(_KnownExcitation):
    """u = a.

    Attributes:
        amplitude: a [N m].
    """

    amplitude: float = 1.0

    def __post_init__(self) -> None:
        finite("constant amplitude", self.amplitude)

    def _at(self, times: Array) -> Array:
        return np.full(len(times), self.amplitude, np.float64)


@dataclass(frozen=True)
class Sine(_KnownExcitation):
    """u = a sin ωt; the defaults are the method's u = sin t.

    Attributes:
        amplitude: a [N m].
        frequency: ω [rad/s].
    """

    amplitude: float = 1.0
    frequency: float = 1.0

    def __post_init__(self) -> None:
        _check_signal("sine", self.amplitude, self.frequency)

    def _at(self, times: Array) -> Array:
        return self.amplitude * _sine(self.frequency * times)


@dataclass(frozen=True)
class Multisine(_KnownExcitation):
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

    def _at(self, times: Array) -> Array:
        spacing = (self.highest - self.lowest) / max(1.0, self.tones - 1.0)
        total = np.zeros(len(times))
        for i in range(self.tones):
            phase = math.pi * i * (i + 1) / self.tones
            total += _sine((self.lowest + i * spacing) * times - phase)
        return self.amplitude / math.sqrt(self.tones) * total


@dataclass(frozen=True)
class Square(_KnownExcitation):
    """Alternately +a and −a, half a period each, + first.

    Attributes:
        amplitude: a [N m].
        frequency: ω [rad/s]; the period is 2π/ω.
    """

    amplitude: float = 1.0
    frequency: float = 1.0

    def __post_init__(self) -> None:
        _check_signal("square", self.amplitude, self.frequency)

    def _at(self, times: Array) -> Array:
        is_first = (self.frequency * times / math.tau) % 1.0 < 0.5
        return self.amplitude * np.where(is_first, 1.0, -1.0)


@dataclass(frozen=True)
class Chirp(_KnownExcitation):
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
        check_each(positive, self, "highest", "sweep", prefix="chirp ")

    def _at(self, times: Array) -> Array:
        within = times % self.sweep
        half_rate = 0.5 * ((self.highest - self.lowest) / self.sweep)
        return self.amplitude * _sine((self.lowest + half_rate * within) * within)


EXCITATIONS: Mapping[str, type[Excitation]] = {
    "none": NoTorque,
    "constant": Constant,
    "sine": Sine,
    "multisine": Multisine,
    "square": Square,
    "chirp": Chirp,
}
"""Every kind of signal of an input under its name."""


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
        names = (item.name for item in fields(self))
        check_each(finite, self, *names, prefix=f"{self.kind} ")

    @abstractmethod
    def value(self, time: float) -> float:
        """Return the addition to the measurement [rad] at a time [s], zero before the start."""

    def values(self, times: Array) -> Array:
        """Return the additions at times, shape (samples,)."""
        return np.array([self.value(time) for time in times.tolist()], np.float64)


class _KnownComponent(Component):
    def value(self, time: float) -> float:
        return float(_at_once(self._at, np.array([time], np.float64))[0])

    def values(self, times: Array) -> Array:
        if type(self).value is not _KnownComponent.value:
            return super().values(times)
        return _at_once(self._at, times)

    def _at(self, times: Array) -> Array:
        """Return the additions at times."""
        return np.zeros(len(times))


@dataclass(frozen=True)
class BiasStep(_KnownComponent):
    """d = a from the start on.

    Attributes:
        amplitude: a [rad].
        start: [s].
    """

    kind: ClassVar[str] = "bias_step"
    amplitude: float = 0.1
    start: float = 30.0

    def _at(self, times: Array) -> Array:
        return np.where(times >= self.start, self.amplitude, 0.0)


@dataclass(frozen=True)
class Sinusoid(_KnownComponent):
    """d = a sin(ω(t − start) + φ) from the start on; the defaults are Example 2's first fault.

    Attributes:
        amplitude: a [rad].
        frequency: ω [rad/s].
        start: [s].
        phase: φ [rad].
    """

    kind: ClassVar[str] = "sinusoid"
    amplitude: float = 0.2
    frequency: float = 3.0
    start: float = 2.0
    phase: float = 0.0

    def _at(self, times: Array) -> Array:
        since = times - self.start
        values = self.amplitude * _sine(self.frequency * since + self.phase)
        return np.where(since >= 0.0, values, 0.0)


@dataclass(frozen=True)
class Ramp(_KnownComponent):
    """d = r (t − start) from the start on.

    Attributes:
        rate: r [rad/s].
        start: [s].
    """

    kind: ClassVar[str] = "ramp"
    rate: float = 0.004
    start: float = 10.0

    def _at(self, times: Array) -> Array:
        return self.rate * np.maximum(0.0, times - self.start)


@dataclass(frozen=True)
class TwoTone(_KnownComponent):
    """d = a (sin 2t + cos 3t) from the start on; the defaults are Example 2's third fault.

    Attributes:
        amplitude: a [rad].
        start: When it sets in [s]; its phase does not depend on it.
    """

    kind: ClassVar[str] = "two_tone"
    amplitude: float = 0.4
    start: float = 0.0

    def _at(self, times: Array) -> Array:
        values = self.amplitude * (_sine(2.0 * times) + _cosine(3.0 * times))
        return np.where(times >= self.start, values, 0.0)


@dataclass(frozen=True)
class GaussMarkov(_KnownComponent):
    """A drift of bounded variance, ḋ = −d/τ + noise, which leaves zero at its start.

    Its variance grows as std² (1 − e^(−2t/τ)). `value` is its mean, zero; the plant adds the random
    part.

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


@dataclass(frozen=True)
class StuckSensor(_KnownComponent):
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

    def holds(self, times: Array) -> Flags:
        """Return whether the measured value is held at times, shape (samples,)."""
        return (self.start <= times) & (times < self.start + self.duration)


@dataclass(frozen=True)
class Pulses(_KnownComponent):
    """d = a for a while from the start on, again and again, or once.

    Attributes:
        amplitude: a [rad].
        start: Of the first pulse [s].
        duration: Of a pulse [s].
        interval: From the beginning of one to that of the next [s]; 0 for a single one.
    """

    kind: ClassVar[str] = "pulses"
    amplitude: float = 0.5
    start: float = 8.0
    duration: float = 1.5
    interval: float = 8.0

    def __post_init__(self) -> None:
        check_each(non_negative, self, "duration", "interval", prefix="pulses ")
        super().__post_init__()

    def _at(self, times: Array) -> Array:
        is_on = recurs(times - self.start, self.duration, self.interval)
        return np.where(is_on, self.amplitude, 0.0)


KINDS: dict[str, Component] = {
    each.kind: each
    for each in (
        BiasStep(),
        Sinusoid(),
        Ramp(),
        TwoTone(),
        GaussMarkov(),
        StuckSensor(),
        Pulses(),
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


def recurs(times: Array, duration: float, interval: float) -> Flags:
    """Return whether times [s] are in the first seconds of an interval, or of time itself if 0."""
    # The margin keeps a sample that lies on a border on its side, whatever % rounds to.
    since = times + 1e-9
    return (since >= 0.0) & ((since % interval if interval > 0.0 else since) < duration)


def markov_step(period: float, time_constant: float) -> tuple[float, float]:
    """Return what multiplies a Gauss–Markov process of unit variance, and a normal number, added.

    So it is moved on by a period [s], by the exact discretisation.
    """
    decay = native.exponential(-period / time_constant)
    return decay, math.sqrt(1.0 - decay * decay)


def _at_once(formula: Callable[[Array], Array], times: Array) -> Array:
    """Evaluate a formula, whose numbers may be too large for a sine, without a warning."""
    with np.errstate(all="ignore"):
        return formula(times)


def _sine(angles: Array) -> Array:
    """Return the sines of angles that are not used otherwise."""
    native.take_sines(angles)
    return angles


def _cosine(angles: Array) -> Array:
    """Return the cosines of angles that are not used otherwise."""
    native.take_cosines(angles)
    return angles
