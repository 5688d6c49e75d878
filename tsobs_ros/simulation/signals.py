# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Torques that move a simulated plant, and disturbances of outputs and torques over time.

The time of a torque that moves the plant counts from its start. A disturbance is a sum of
components, and its time counts from the moment it is put in, which is the plant's start unless it
is exchanged while the plant runs. Units of components are those of an angle; a component of
another output has that output's unit in place of rad, one of a torque has N m.

A signal of this module is evaluated by compiled code from a row: the code of its kind, then its
numbers. Others are evaluated by their own methods.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from tsobs_ros.checks import Array, check_each, finite, non_negative, positive
from tsobs_ros.compiled import compiled
from tsobs_ros.errors import ModelError
from tsobs_ros.model.trigonometry import cosine, exponential, sine

ROW = 5
"""Length of a row."""

_NO_TORQUE, _SINE, _MULTISINE, _SQUARE, _CHIRP, _CONSTANT = range(6)
_BIAS_STEP, _SINUSOID, _RAMP, _TWO_TONE, GAUSS_MARKOV, STUCK, _PULSES = range(7)


class Excitation(ABC):
    """A torque over time."""

    @abstractmethod
    def torque(self, time: float) -> float:
        """Return the torque [N m] at a time [s] since the start."""


class _CompiledExcitation(Excitation):
    code: ClassVar[int]

    def torque(self, time: float) -> float:
        return torque_at(_row(self.code, self), float(time))


@dataclass(frozen=True)
class NoTorque(_CompiledExcitation):
    """The motor is not driven."""

    code: ClassVar[int] = _NO_TORQUE


@dataclass(frozen=True)
class Constant(_CompiledExcitation):
    """u = a.

    Attributes:
        amplitude: a [N m].
    """

    code: ClassVar[int] = _CONSTANT
    amplitude: float = 1.0

    def __post_init__(self) -> None:
        finite("constant amplitude", self.amplitude)


@dataclass(frozen=True)
class Sine(_CompiledExcitation):
    """u = a sin ωt; the defaults are the method's u = sin t.

    Attributes:
        amplitude: a [N m].
        frequency: ω [rad/s].
    """

    code: ClassVar[int] = _SINE
    amplitude: float = 1.0
    frequency: float = 1.0

    def __post_init__(self) -> None:
        _check_signal("sine", self.amplitude, self.frequency)


@dataclass(frozen=True)
class Multisine(_CompiledExcitation):
    """A sum of tones, equally spaced from the lowest to the highest, with Schroeder's phases.

    Schroeder's phases −πi(i − 1)/n spread the tones' crests, so that the peak stays near that of
    noise of the same power (M. R. Schroeder, IEEE Trans. Information Theory 16, 1970).

    Attributes:
        amplitude: Root of the tones' summed squared amplitudes [N m].
        lowest: Lowest tone [rad/s].
        highest: Highest tone [rad/s].
        tones: Their number.
    """

    code: ClassVar[int] = _MULTISINE
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


@dataclass(frozen=True)
class Square(_CompiledExcitation):
    """Alternately +a and −a, half a period each, + first.

    Attributes:
        amplitude: a [N m].
        frequency: ω [rad/s]; the period is 2π/ω.
    """

    code: ClassVar[int] = _SQUARE
    amplitude: float = 1.0
    frequency: float = 1.0

    def __post_init__(self) -> None:
        _check_signal("square", self.amplitude, self.frequency)


@dataclass(frozen=True)
class Chirp(_CompiledExcitation):
    """A tone whose frequency rises linearly from the lowest to the highest, again and again.

    Attributes:
        amplitude: [N m].
        lowest: Frequency at the beginning of a sweep [rad/s].
        highest: Frequency at its end [rad/s].
        sweep: Length of a sweep [s].
    """

    code: ClassVar[int] = _CHIRP
    amplitude: float = 1.0
    lowest: float = 0.5
    highest: float = 6.0
    sweep: float = 20.0

    def __post_init__(self) -> None:
        _check_signal("chirp", self.amplitude, self.lowest)
        check_each(positive, self, "highest", "sweep", prefix="chirp ")


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


class _CompiledComponent(Component):
    code: ClassVar[int]

    def value(self, time: float) -> float:
        return _value_at(_row(self.code, self), float(time))


@dataclass(frozen=True)
class BiasStep(_CompiledComponent):
    """d = a from the start on.

    Attributes:
        amplitude: a [rad].
        start: [s].
    """

    kind: ClassVar[str] = "bias_step"
    code: ClassVar[int] = _BIAS_STEP
    amplitude: float = 0.1
    start: float = 30.0


@dataclass(frozen=True)
class Sinusoid(_CompiledComponent):
    """d = a sin(ω(t − start) + φ) from the start on; the defaults are Example 2's first fault.

    Attributes:
        amplitude: a [rad].
        frequency: ω [rad/s].
        start: [s].
        phase: φ [rad].
    """

    kind: ClassVar[str] = "sinusoid"
    code: ClassVar[int] = _SINUSOID
    amplitude: float = 0.2
    frequency: float = 3.0
    start: float = 2.0
    phase: float = 0.0


@dataclass(frozen=True)
class Ramp(_CompiledComponent):
    """d = r (t − start) from the start on.

    Attributes:
        rate: r [rad/s].
        start: [s].
    """

    kind: ClassVar[str] = "ramp"
    code: ClassVar[int] = _RAMP
    rate: float = 0.004
    start: float = 10.0


@dataclass(frozen=True)
class TwoTone(_CompiledComponent):
    """d = a (sin 2t + cos 3t) from the start on; the defaults are Example 2's third fault.

    Attributes:
        amplitude: a [rad].
        start: When it sets in [s]; its phase does not depend on it.
    """

    kind: ClassVar[str] = "two_tone"
    code: ClassVar[int] = _TWO_TONE
    amplitude: float = 0.4
    start: float = 0.0


@dataclass(frozen=True)
class GaussMarkov(_CompiledComponent):
    """A drift of bounded variance, ḋ = −d/τ + noise, which leaves zero at its start.

    Its variance grows as std² (1 − e^(−2t/τ)). `value` is its mean, zero; the plant adds the random
    part.

    Attributes:
        std: 1σ once it has become stationary [rad].
        time_constant: τ [s].
        start: [s].
    """

    kind: ClassVar[str] = "gauss_markov"
    code: ClassVar[int] = GAUSS_MARKOV
    std: float = 0.1
    time_constant: float = 20.0
    start: float = 0.0

    def __post_init__(self) -> None:
        non_negative("gauss_markov std", self.std)
        positive("gauss_markov time_constant", self.time_constant)
        super().__post_init__()


@dataclass(frozen=True)
class StuckSensor(_CompiledComponent):
    """The measured value freezes at the start and stays for a while; it adds nothing.

    Attributes:
        start: [s].
        duration: [s], infinite for ever.
    """

    kind: ClassVar[str] = "stuck"
    code: ClassVar[int] = STUCK
    start: float = 30.0
    duration: float = 1.0

    def __post_init__(self) -> None:
        finite("stuck start", self.start)
        if not self.duration >= 0.0:
            raise ModelError(f"stuck duration: expected at least 0 s, got {self.duration!r}")


@dataclass(frozen=True)
class Pulses(_CompiledComponent):
    """d = a for a while from the start on, again and again, or once.

    Attributes:
        amplitude: a [rad].
        start: Of the first pulse [s].
        duration: Of a pulse [s].
        interval: From the beginning of one to that of the next [s]; 0 for a single one.
    """

    kind: ClassVar[str] = "pulses"
    code: ClassVar[int] = _PULSES
    amplitude: float = 0.5
    start: float = 8.0
    duration: float = 1.5
    interval: float = 8.0

    def __post_init__(self) -> None:
        check_each(non_negative, self, "duration", "interval", prefix="pulses ")
        super().__post_init__()


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


def excitation_row(excitation: Excitation) -> Array | None:
    """Return the row of an excitation, None if its torque is not that of this module."""
    if not isinstance(excitation, _CompiledExcitation):
        return None
    known = type(excitation).torque is _CompiledExcitation.torque
    return _row(excitation.code, excitation) if known else None


def component_row(component: Component) -> Array | None:
    """Return the row of a component, None if its value is not that of this module."""
    if not isinstance(component, _CompiledComponent):
        return None
    known = type(component).value is _CompiledComponent.value
    return _row(component.code, component) if known else None


def _row(code: int, signal: Any) -> Array:
    """Return the code and the numbers of a signal, of a subclass those it inherits."""
    row = np.zeros(ROW)
    row[0] = code
    for place, item in enumerate(fields(signal)[: ROW - 1], 1):
        row[place] = getattr(signal, item.name)
    return row


@compiled
def torque_at(row: Array, time: float) -> float:
    """Return the torque [N m] of an excitation's row at a time [s]."""
    code, a, b, c, d = int(row[0]), float(row[1]), float(row[2]), float(row[3]), float(row[4])
    if code == _SINE:
        return a * sine(b * time)
    if code == _MULTISINE:
        spacing = (c - b) / max(1.0, d - 1.0)
        total = 0.0
        for i in range(int(d)):
            total += sine((b + i * spacing) * time - math.pi * i * (i + 1) / d)
        return a / math.sqrt(d) * total
    if code == _SQUARE:
        return a if (b * time / math.tau) % 1.0 < 0.5 else -a
    if code == _CHIRP:
        within = time % d
        return a * sine((b + 0.5 * ((c - b) / d) * within) * within)
    return a if code == _CONSTANT else 0.0


@compiled
def disturbance_at(rows: Array, time: float) -> float:
    """Return what components add at a time [s], without drifts and stuck sensors [rad]."""
    total = 0.0
    for place in range(rows.shape[0]):
        total += _value_at(rows[place], time)
    return total


@compiled
def _value_at(row: Array, time: float) -> float:
    code, a, b, c, d = int(row[0]), float(row[1]), float(row[2]), float(row[3]), float(row[4])
    if code == _BIAS_STEP:
        return a if time >= b else 0.0
    if code == _SINUSOID:
        return a * sine(b * (time - c) + d) if time - c >= 0.0 else 0.0
    if code == _RAMP:
        return a * max(0.0, time - b)
    if code == _TWO_TONE:
        return a * (sine(2.0 * time) + cosine(3.0 * time)) if time >= b else 0.0
    if code == _PULSES:
        return a if recurs(time - b, c, d) else 0.0
    return 0.0


@compiled
def recurs(time: float, duration: float, interval: float) -> bool:
    """Return whether a time [s] is in the first seconds of an interval, or of time itself if 0."""
    # The margin keeps a sample that lies on a border on its side, whatever % rounds to.
    since = time + 1e-9
    if since < 0.0:
        return False
    return (since % interval if interval > 0.0 else since) < duration


@compiled
def is_stuck(rows: Array, time: float) -> bool:
    """Return whether one of the components holds the measured value at a time [s]."""
    for place in range(rows.shape[0]):
        if int(rows[place, 0]) == STUCK:
            start, duration = float(rows[place, 1]), float(rows[place, 2])
            if start <= time < start + duration:
                return True
    return False


@compiled
def markov_step(period: float, time_constant: float) -> tuple[float, float]:
    """Return what multiplies a Gauss–Markov process of unit variance, and a normal number, added.

    So it is moved on by a period [s], by the exact discretisation.
    """
    decay = exponential(-period / time_constant)
    return decay, math.sqrt(1.0 - decay * decay)
