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

LEVEL_SIGMAS = 4.0
"""A disturbance, or the amplitude of a tone, counts from so many bounds on."""

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


class Shape(NamedTuple):
    """The history in a few numbers.

    Attributes:
        kind: NONE, BIAS, DRIFT, OSCILLATION or UNKNOWN.
        magnitude: Its present size, of a tone its amplitude [rad].
        rate: Slope of a drift [rad/s], else None.
        frequency: Of a tone [rad/s], else None.
    """

    kind: FaultKind
    magnitude: float
    rate: float | None = None
    frequency: float | None = None


class _Tone(NamedTuple):
    residual: float
    amplitude: float
    frequency: float


def shape_of(times: Array, values: Array, motion: Array, bound: float) -> Shape:
    """Return the shape of a history.

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


def _shape(times: Array, values: Array, motion: Array, bound: float) -> Shape:
    recent = values[times > times[-1] - _NOW]
    now = float(recent.mean())
    flat = _root_mean_square(values - values.mean())
    unknown = Shape(FaultKind.UNKNOWN, float(np.abs(recent).max()))
    constant = Shape(
        FaultKind.BIAS if abs(now) > LEVEL_SIGMAS * bound else FaultKind.NONE, abs(now)
    )
    if flat <= _FLAT_SIGMAS * bound:
        return constant
    step, tone = _step_residual(values), _tone(times, values)
    cubic, slope = _cubic(times, values)
    enough = max(_FLAT_SIGMAS * bound, _EXPLAINED * flat)
    if tone.amplitude > _TONE_SIGMAS * bound and tone.residual < min(
        enough, _CLEARLY * step, _CLEARLY * cubic
    ):
        own = _part_of(tone.frequency, times, motion)
        if own > _OWN_MOTION * _part_of(tone.frequency, times, values):
            return unknown
        return Shape(FaultKind.OSCILLATION, tone.amplitude, frequency=tone.frequency)
    if step < min(enough, cubic):
        return constant
    if cubic < enough and times[-1] - times[0] >= _SHORTEST:
        return Shape(FaultKind.DRIFT, abs(now), rate=slope)
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


def _tone(times: Array, values: Array) -> _Tone:
    """Return the tone, on a line, that leaves least."""
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
    return _Tone(_root_mean_square(values - basis @ fit), amplitude, frequency)


def _part_of(frequency: float, times: Array, values: Array) -> float:
    """Return, up to a factor, the amplitude of a tone in values that may have others as well."""
    window = np.hanning(len(values)) * np.exp(-1j * frequency * times)
    return float(abs(window @ (values - values.mean())))


def _least_squares(basis: Array, values: Array) -> Array:
    return np.asarray(np.linalg.solve(basis.T @ basis, basis.T @ values))
