# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sine, cosine, the falling exponential and the logarithm with the same bits on every CPU.

The system's differ: glibc has variants with and without fused multiplication and addition, which
disagree in the last bit of one sine in 1,300. These are products and sums in a fixed order (the
polynomials of Sun's fdlibm), within two units in the last place of the true value, up to 10⁶ rad.
Of an angle that is not finite they are NaN, and raise nothing.
"""

import math

import numpy as np

from tsobs_ros.compiled import compiled, inlined

_QUARTERS = 2.0 / math.pi
# π/2 in three parts; the first two have 33 bits, so that small multiples of them are exact.
_PART_1 = 1.57079632673412561417e00
_PART_2 = 6.07710050630396597660e-11
_PART_3 = 2.02226624879595063154e-21
_MAX_EXACT = 1e6


@compiled
def sine(angle: float) -> float:
    """Return sin of an angle [rad]."""
    return sine_and_cosine(angle)[0]


@compiled
def cosine(angle: float) -> float:
    """Return cos of an angle [rad]."""
    return sine_and_cosine(angle)[1]


@compiled
def sine_and_cosine(angle: float) -> tuple[float, float]:
    """Return sin and cos of an angle [rad], which together cost little more than one of them."""
    if not math.fabs(angle) <= _MAX_EXACT:
        if not math.fabs(angle) < math.inf:
            return math.nan, math.nan
        # What is lost is less than the rounding of so large an angle.
        angle = angle % math.tau
    quarters = 0
    if math.fabs(angle) > 0.25 * math.pi:
        whole = math.floor(angle * _QUARTERS + 0.5)
        angle = ((angle - whole * _PART_1) - whole * _PART_2) - whole * _PART_3
        quarters = int(whole)
    sin, cos = _first_sine(angle), _first_cosine(angle)
    if quarters & 1:
        sin, cos = cos, -sin
    return (-sin, -cos) if quarters & 2 else (sin, cos)


@inlined
def unbranched_sine(angle: float) -> float:
    """Return what `sine` returns up to 10⁶ rad, NaN beyond, so that loops of it are vectorised."""
    whole = float(np.floor(angle * _QUARTERS + 0.5))
    whole = whole if math.fabs(angle) > 0.25 * math.pi else 0.0
    rest = ((angle - whole * _PART_1) - whole * _PART_2) - whole * _PART_3
    halves = float(np.floor(0.5 * whole))
    at_sine, at_cosine = _first_sine(rest), _first_cosine(rest)
    value = at_cosine if whole != 2.0 * halves else at_sine
    value = -value if halves != 2.0 * float(np.floor(0.5 * halves)) else value
    return value if math.fabs(angle) <= _MAX_EXACT else math.nan


@inlined
def _first_sine(angle: float) -> float:
    """Return the sine up to π/4."""
    z = angle * angle
    r = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10
    r = -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * r)
    r = -1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * r)
    return angle + angle * z * r


@inlined
def _first_cosine(angle: float) -> float:
    """Return the cosine up to π/4."""
    z = angle * angle
    r = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11
    r = 2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * r)
    r = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * r)
    half = 0.5 * z
    value = 1.0 - half
    return value + (((1.0 - value) - half) + z * (z * r))


@compiled
def exponential(x: float) -> float:
    """Return exp x for x ≤ 0; NaN of NaN."""
    if not x >= -745.2:
        return x if math.isnan(x) else 0.0
    whole = math.floor(x * 1.44269504088896338700e00 + 0.5)
    high, low = x - whole * 6.93147180369123816490e-01, whole * 1.90821492927058770002e-10
    r = high - low
    t = r * r
    c = 6.61375632143793436117e-05 + t * (
        -1.65339022054652515390e-06 + t * 4.13813679705723846039e-08
    )
    c = r - t * (1.66666666666666019037e-01 + t * (-2.77777777770155933842e-03 + t * c))
    return math.ldexp(1.0 - ((low - r * c / (2.0 - c)) - high), int(whole))


@compiled
def logarithm(x: float) -> float:
    """Return the natural logarithm of x > 0; NaN of other numbers."""
    if not 0.0 < x < math.inf:
        return math.nan
    mantissa, power = math.frexp(x)
    if mantissa < 0.70710678118654752440:
        mantissa, power = 2.0 * mantissa, power - 1
    f = mantissa - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    even = w * (0.3999999999940941908 + w * (0.2222219843214978396 + w * 0.1531383769920937332))
    odd = 0.1818357216161805012 + w * 0.1479819860511658591
    odd = z * (0.6666666666666735130 + w * (0.2857142874366239149 + w * odd))
    half = 0.5 * f * f
    low = power * 1.90821492927058770002e-10
    return power * 6.93147180369123816490e-01 - ((half - (s * (half + even + odd) + low)) - f)
