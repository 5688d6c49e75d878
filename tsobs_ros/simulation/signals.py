# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Signals over time: the inputs of simulated plants, and disturbances of outputs and torques.

The time of an input's signal counts from the plant's start. A disturbance is a sum of signals. Its
time counts from the moment when it is set, which is the plant's start unless it is exchanged while
the plant runs. A disturbance has the unit of the quantity to which it is added: rad for an angle,
N m for a torque.

`EXCITATIONS` and `KINDS` are the tables of all signals. Their numbers are settings: parameters of
the simulator and, by `signal_of`, entries of campaigns and arguments of the API.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from tsobs_ros.checks import Array, Flags, shown
from tsobs_ros.core.functions import evaluate
from tsobs_ros.errors import ModelError
from tsobs_ros.schema import decode
from tsobs_ros.settings import check, live_setting


@dataclass(frozen=True)
class Numbers:
    """The numbers of a simulated component; errors name its kind.

    Raises:
        ModelError: A number is out of range.
    """

    kind: ClassVar[str]

    def __init_subclass__(cls, kind: str = "signal") -> None:
        cls.kind = kind

    def __post_init__(self) -> None:
        check(self, self.kind)


@dataclass(frozen=True)
class Signal(Numbers, kind="none"):
    """A value over time: 0, unless a subclass, which may be a user's own, has other values."""

    def values(self, times: Array) -> Array:
        """Return the values at times [s], shape (samples,)."""
        return np.zeros(len(times))


def signal_of(kinds: Mapping[str, type[Signal]], entry: object) -> Any:
    """Return the signal that an entry describes: a kind, or a mapping of `kind` and its numbers.

    Kinds are `EXCITATIONS` or `KINDS`. Omitted numbers have their defaults.

    Raises:
        ModelError: The kind is unknown, or a number is out of range.
        DesignFileError: A number's name is unknown, or its value is not a number.

    >>> signal_of(KINDS, {"kind": "ramp", "rate": 0.5})
    Ramp(rate=0.5, start=0.0)
    """
    numbers: dict[str, Any] = dict(entry) if isinstance(entry, Mapping) else {"kind": entry}
    kind = numbers.pop("kind", None)
    if not isinstance(kind, str) or kind not in kinds:
        raise ModelError(f"kind: expected one of {', '.join(kinds)}, got {shown(kind)}")
    return decode(numbers, kinds[kind])


@dataclass(frozen=True)
class Constant(Signal, kind="constant"):
    """u = a."""

    amplitude: float = live_setting(1.0, "Value", unit="N m")

    def values(self, times: Array) -> Array:
        return np.full(len(times), self.amplitude, np.float64)


@dataclass(frozen=True)
class Sine(Signal, kind="sine"):
    """u = a sin ωt; the defaults are the method's u = sin t."""

    amplitude: float = live_setting(1.0, "Amplitude", unit="N m")
    frequency: float = live_setting(1.0, "Frequency", unit="rad/s", minimum=0.0)

    def values(self, times: Array) -> Array:
        return self.amplitude * evaluate("sine", self.frequency * times)


@dataclass(frozen=True)
class Multisine(Signal, kind="multisine"):
    """A sum of tones, equally spaced from the lowest to the highest, with Schroeder's phases.

    Schroeder's phases −πi(i − 1)/n spread the tones' crests, so that the peak stays near that of
    noise of the same power (M. R. Schroeder, IEEE Trans. Information Theory 16, 1970).
    """

    amplitude: float = live_setting(1.0, "Root of the tones' summed squared amplitudes", unit="N m")
    lowest: float = live_setting(0.5, "Lowest tone", unit="rad/s", minimum=0.0)
    highest: float = live_setting(6.0, "Highest tone", unit="rad/s", minimum=0.0)
    tones: int = live_setting(8, "Number of tones", minimum=1, maximum=1000)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.highest < self.lowest:
            raise ModelError(
                f"multisine highest: expected at least lowest = {self.lowest!r} rad/s, "
                f"got {self.highest!r}"
            )

    def values(self, times: Array) -> Array:
        spacing = (self.highest - self.lowest) / max(1.0, self.tones - 1.0)
        total = np.zeros(len(times))
        for i in range(self.tones):
            phase = math.pi * i * (i + 1) / self.tones
            total += evaluate("sine", (self.lowest + i * spacing) * times - phase)
        return self.amplitude / math.sqrt(self.tones) * total


@dataclass(frozen=True)
class Square(Signal, kind="square"):
    """Alternately +a and −a, each for half a period 2π/ω, +a first."""

    amplitude: float = live_setting(1.0, "Amplitude", unit="N m")
    frequency: float = live_setting(1.0, "Frequency", unit="rad/s", minimum=0.0)

    def values(self, times: Array) -> Array:
        is_first = (self.frequency * times / math.tau) % 1.0 < 0.5
        return self.amplitude * np.where(is_first, 1.0, -1.0)


@dataclass(frozen=True)
class Chirp(Signal, kind="chirp"):
    """A tone whose frequency rises linearly from the lowest to the highest, again and again."""

    amplitude: float = live_setting(1.0, "Amplitude", unit="N m")
    lowest: float = live_setting(0.5, "Frequency a sweep starts at", unit="rad/s", minimum=0.0)
    highest: float = live_setting(6.0, "Frequency it ends at", unit="rad/s", minimum=0.0)
    sweep: float = live_setting(20.0, "Length of a sweep", unit="s", minimum=1e-3)

    def values(self, times: Array) -> Array:
        within = times % self.sweep
        half_rate = 0.5 * ((self.highest - self.lowest) / self.sweep)
        return self.amplitude * evaluate("sine", (self.lowest + half_rate * within) * within)


def seconds(default: float, description: str) -> float:
    """Declare a live setting of a length of time [s]."""
    return live_setting(default, description, unit="s", minimum=0.0)


def _start() -> Any:
    return live_setting(0.0, "Start, counted from when it was put in", unit="s")


@dataclass(frozen=True)
class BiasStep(Signal, kind="bias_step"):
    """d = a from the start on."""

    amplitude: float = live_setting(0.1, "Bias")
    start: float = _start()

    def values(self, times: Array) -> Array:
        return np.where(times >= self.start, self.amplitude, 0.0)


@dataclass(frozen=True)
class Sinusoid(Signal, kind="sinusoid"):
    """d = a sin(ω(t − start) + φ) from the start on, like the first fault of Example 2."""

    amplitude: float = live_setting(0.2, "Amplitude")
    frequency: float = live_setting(3.0, "Frequency", unit="rad/s")
    start: float = _start()
    phase: float = live_setting(0.0, "Phase at the start", unit="rad")

    def values(self, times: Array) -> Array:
        since = times - self.start
        values = self.amplitude * evaluate("sine", self.frequency * since + self.phase)
        return np.where(since >= 0.0, values, 0.0)


@dataclass(frozen=True)
class Ramp(Signal, kind="ramp"):
    """d = r (t − start) from the start on."""

    rate: float = live_setting(0.004, "Growth per second")
    start: float = _start()

    def values(self, times: Array) -> Array:
        return self.rate * np.maximum(0.0, times - self.start)


@dataclass(frozen=True)
class GaussMarkov(Signal, kind="gauss_markov"):
    """A drift of bounded variance, ḋ = −d/τ + noise, which leaves zero at its start.

    Its variance grows as std² (1 − e^(−2t/τ)). `values` is its mean, zero; the plant adds the
    random part.
    """

    std: float = live_setting(0.1, "1σ once it has become stationary", minimum=0.0)
    time_constant: float = live_setting(20.0, "Time constant τ", unit="s", minimum=1e-6)
    start: float = _start()


@dataclass(frozen=True)
class StuckSensor(Signal, kind="stuck"):
    """The measured value freezes at the start and stays for a while; the signal adds nothing."""

    start: float = _start()
    duration: float = seconds(1.0, "How long; 0: for ever")

    def holds(self, times: Array) -> Flags:
        """Return whether the measured value is held at times [s], shape (samples,)."""
        return (self.start <= times) & (times < self.start + (self.duration or math.inf))


@dataclass(frozen=True)
class Pulses(Signal, kind="pulses"):
    """d = a for a while from the start on, again and again, or once."""

    amplitude: float = live_setting(0.5, "Height of a pulse")
    start: float = _start()
    duration: float = seconds(1.5, "Length of a pulse")
    interval: float = seconds(8.0, "Time between the beginnings of pulses; 0 for one")

    def values(self, times: Array) -> Array:
        is_on = recurs(times - self.start, self.duration, self.interval)
        return np.where(is_on, self.amplitude, 0.0)


EXCITATIONS: Mapping[str, type[Signal]] = {
    each.kind: each for each in (Signal, Constant, Sine, Multisine, Square, Chirp)
}
"""Every kind of signal of an input by its name."""

KINDS: Mapping[str, type[Signal]] = {
    each.kind: each for each in (BiasStep, Sinusoid, Ramp, GaussMarkov, StuckSensor, Pulses)
}
"""Every kind of signal in the sum of a disturbance, by its name."""


def parse_kinds(kinds: str) -> tuple[str, ...]:
    """Return the names in "none", "bias_step" or a sum such as "bias_step+sinusoid".

    Raises:
        ModelError: A name is unknown.
    """
    names = tuple(name.strip() for name in kinds.split("+"))
    if names == ("none",):
        return ()
    if unknown := [name for name in names if name not in KINDS]:
        raise ModelError(
            f"disturbance kind: expected none or a sum of {', '.join(KINDS)}, got {unknown[0]!r}"
        )
    return names


def recurs(times: Array, duration: float, interval: float) -> Flags:
    """Return whether times [s] are in the first `duration` of each interval, or of time if 0."""
    # The margin keeps a sample on a border on its side, regardless of the rounding in %.
    since = times + 1e-9
    return (since >= 0.0) & ((since % interval if interval > 0.0 else since) < duration)
