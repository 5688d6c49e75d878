# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The shape of an estimated disturbance's recent history: a bias, a drift, a tone.

Three simple curves are fitted by least squares: two constants with a step in between, a cubic, and
a line with a tone on it. The one that leaves least gives the kind, provided that it explains
enough. A tone with which the arm itself moves more than the disturbance does is no proof of a
disturbed sensor: a wrong model of the arm looks the same.
"""

import enum
import math
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.estimation.health import Level

_LEVEL_SIGMAS = 4.0
_FLAT_SIGMAS = 1.5
_TONE_SIGMAS = 3.0
_OWN_MOTION = 1.0
_SHORTEST = 3.0
_EXPLAINED = 0.6
_CLEARLY = 0.6
_LEAST_PERIODS = 1.5
_NOW = 1.0
_PAD = 4


class FaultKind(enum.Enum):
    """Kind of a sensor's fault."""

    NONE = "none"
    BIAS = "bias"
    DRIFT = "drift"
    OSCILLATION = "oscillation"
    STUCK = "stuck"
    MISSING = "missing"
    NOISE = "noise"
    UNKNOWN = "unknown"


class Fault(NamedTuple):
    """A fault of the sensor; numbers are in its unit.

    Attributes:
        kind: What it looks like.
        magnitude: Of a bias or drift its present size, of an oscillation its amplitude, of noise
            its standard deviation, else the largest disturbance of the last second.
        bound: 1σ of the magnitude; infinite if the model does not hold.
        level: How bad it is: of a size by the limits, WARN if the innovations are too large, ERROR
            if the sensor is stuck or missing.
        since: Stamp at which the kind was first seen [ns], None if there never was another.
        rate: Of a drift [1/s], else None.
        frequency: Of an oscillation [rad/s], else None.
    """

    kind: FaultKind = FaultKind.NONE
    magnitude: float = 0.0
    bound: float = math.inf
    level: Level = Level.OK
    since: int | None = None
    rate: float | None = None
    frequency: float | None = None


def shape_of(times: Array, values: Array, motion: Array, bound: float) -> Fault:
    """Return NONE, BIAS, DRIFT, OSCILLATION or UNKNOWN, the shape of a history.

    A recent tone is looked for in the last third too, if no curve explains the whole.

    Args:
        times: Evenly spaced, rising [s], shape (samples,), at least ten.
        values: Estimated disturbance [rad], shape (samples,).
        motion: Estimated angle of the arm [rad], shape (samples,).
        bound: 1σ of one of the values [rad].
    """
    whole = _shape(times, values, motion, bound)
    last = slice(-(len(times) // 3), None)
    if whole.kind is not FaultKind.UNKNOWN or times[-1] - times[last][0] < _SHORTEST:
        return whole
    late = _shape(times[last], values[last], motion[last], bound)
    # Within a few seconds nearly everything looks like a drift.
    return late if late.kind is FaultKind.OSCILLATION else whole


def _shape(times: Array, values: Array, motion: Array, bound: float) -> Fault:
    recent = values[times > times[-1] - _NOW]
    now = float(recent.mean())
    flat = _root_mean_square(values - values.mean())
    unknown = Fault(FaultKind.UNKNOWN, float(np.abs(recent).max()))
    constant = Fault(
        FaultKind.BIAS if abs(now) > _LEVEL_SIGMAS * bound else FaultKind.NONE, abs(now)
    )
    if flat <= _FLAT_SIGMAS * bound:
        return constant
    step, (tone, amplitude, frequency) = _step_residual(values), _tone(times, values)
    cubic, slope = _cubic(times, values)
    enough = max(_FLAT_SIGMAS * bound, _EXPLAINED * flat)
    explains = tone < min(enough, _CLEARLY * step, _CLEARLY * cubic)
    if explains and amplitude > _TONE_SIGMAS * bound:
        own = _part_of(frequency, times, motion)
        if own > _OWN_MOTION * _part_of(frequency, times, values):
            return unknown
        return Fault(FaultKind.OSCILLATION, amplitude, frequency=frequency)
    if step < min(enough, cubic):
        return constant
    if cubic < enough and times[-1] - times[0] >= _SHORTEST:
        return Fault(FaultKind.DRIFT, abs(now), rate=slope)
    return unknown


def _root_mean_square(values: Array) -> float:
    return math.sqrt(float(values @ values) / len(values))


def _step_residual(values: Array) -> float:
    """Return what two constants leave at the best place of the step between them."""
    n = len(values)
    before = np.arange(1, n)
    total = np.cumsum(values)
    explained = total[:-1] ** 2 / before + (total[-1] - total[:-1]) ** 2 / (n - before)
    return math.sqrt(max(0.0, float(values @ values) - float(explained.max())) / n)


def _cubic(times: Array, values: Array) -> tuple[float, float]:
    """Return what a cubic leaves and its mean slope over the last third [rad/s]."""
    half = 0.5 * (times[-1] - times[0])
    s = (times - times[0]) / half - 1.0
    basis = np.stack([np.ones_like(s), s, s * s, s**3], axis=1)
    fit = _least_squares(basis, values)
    last = np.array([0.0, 2.0 / 3.0, 1.0 - 1.0 / 9.0, 1.0 - 1.0 / 27.0]) @ fit
    return _root_mean_square(values - basis @ fit), float(last) / (2.0 / 3.0 * half)


def _tone(times: Array, values: Array) -> tuple[float, float, float]:
    """Return what the tone, on a line, leaves that leaves least, its amplitude and frequency."""
    n, elapsed = len(values), times - times[0]
    spacing = float(elapsed[-1]) / (n - 1)
    line = np.stack([np.ones(n), elapsed], axis=1)
    level = values - line @ _least_squares(line, values)
    power = np.abs(np.fft.rfft(level * np.hanning(n), _PAD * n)) ** 2
    lowest = math.ceil(_LEAST_PERIODS * _PAD)
    peak = lowest + int(np.argmax(power[lowest:-1]))
    a, b, c = np.log(power[peak - 1 : peak + 2] + 1e-300).tolist()
    bend = a - 2.0 * b + c
    # A neighbour may be higher only at the lower end, where the search ends inside a slope.
    offset = 0.5 * (a - c) / bend if bend < 0.0 and a <= b >= c else 0.0
    frequency = math.tau * (peak + offset) / (_PAD * n * spacing)
    angle = frequency * elapsed
    basis = np.column_stack([line, np.cos(angle), np.sin(angle)])
    fit = _least_squares(basis, values)
    amplitude = math.hypot(fit[2], fit[3])
    return _root_mean_square(values - basis @ fit), amplitude, frequency


def _part_of(frequency: float, times: Array, values: Array) -> float:
    """Return, up to a factor, the amplitude of a tone in values that may have others as well."""
    window = np.hanning(len(values)) * np.exp(-1j * frequency * times)
    return float(abs(window @ (values - values.mean())))


def _least_squares(basis: Array, values: Array) -> Array:
    return np.asarray(np.linalg.solve(basis.T @ basis, basis.T @ values))
