# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Compiled grades of named membership functions, and the rule weights that follow from them.

A rule base is two arrays here: a code of the shape for each rule and premise, (r, q), and four
parameters, (r, q, 4); `tsobs_ros.model.fuzzy.RuleBase.coded` makes them. No function allocates.
"""

import math

from tsobs_ros.checks import Array, Integers
from tsobs_ros.compiled import compiled
from tsobs_ros.model.trigonometry import cosine, exponential, sine

ALWAYS, LINEAR, TRAPEZOID, GAUSSIAN, SINE_UPPER, SINE_LOWER, SQUARE, SQUARE_REST = range(8)
"""Codes of the shapes. Their parameters, in this order; the rest of the four is not read:

LINEAR: zero, one. TRAPEZOID: left, top_left, top_right, right. GAUSSIAN: centre, width.
SINE_UPPER, SINE_LOWER: half_width, sin(half_width)/half_width. SQUARE, SQUARE_REST: half_width.
"""


@compiled
def grade_and_slope(
    shape: int, z: float, a: float, b: float, c: float, d: float
) -> tuple[float, float]:
    """Return the grade at z and its derivative, at a corner that of one side.

    Args:
        shape: Code of the shape.
        z: Premise variable. Grades are NaN if it is, but for ALWAYS.
        a: First parameter of the shape, and so on.
        b: Second parameter.
        c: Third parameter.
        d: Fourth parameter.
    """
    if shape == ALWAYS:
        return 1.0, 0.0
    if math.isnan(z):
        return z, z
    if shape == LINEAR:
        grade = min(max((z - a) / (b - a), 0.0), 1.0)
        inside = min(a, b) <= z < max(a, b)
        return grade, 1.0 / (b - a) if inside else 0.0
    if shape == TRAPEZOID:
        if a <= z < b:
            return (z - a) / (b - a), 1.0 / (b - a)
        if c <= z < d:
            return (d - z) / (d - c), -1.0 / (d - c)
        return (1.0 if b <= z < c else 0.0), 0.0
    if shape == GAUSSIAN:
        distance = (z - a) / b
        grade = exponential(-0.5 * distance * distance)
        return grade, -distance / b * grade if grade > 0.0 else 0.0
    is_square = shape in (SQUARE, SQUARE_REST)
    share, slope = _square(z, a) if is_square else _share_of_sine(z, a, b)
    if shape in (SINE_UPPER, SQUARE):
        return share, slope
    return 1.0 - share, -slope


@compiled
def _square(z: float, half_width: float) -> tuple[float, float]:
    """Return (z/width)², and its slope; 1 and level outside of |z| < width."""
    if abs(z) >= half_width:
        return 1.0, 0.0
    share = z / half_width
    return share * share, 2.0 * share / half_width


@compiled
def _share_of_sine(z: float, half_width: float, bottom: float) -> tuple[float, float]:
    """Return h in sin z = (h + (1 − h) bottom) z, and its slope; level outside of |z| < width."""
    if abs(z) >= half_width:
        return 0.0, 0.0
    # (z cos z − sin z)/z² loses every digit near 0.
    near = abs(z) < 1e-3
    fall = -z / 3.0 + z * z * z / 30.0 if near else (z * cosine(z) - sine(z)) / (z * z)
    ratio = sine(z) / z if z != 0.0 else 1.0
    upper = (ratio - bottom) / (1.0 - bottom)
    return min(max(upper, 0.0), 1.0), fall / (1.0 - bottom)


@compiled
def rule_weights(shapes: Integers, parameters: Array, z: Array, weights: Array) -> None:
    """Write the normalised weights h(z) of the rules; all are NaN if no rule fires.

    Args:
        shapes: Integers, shape (r, q).
        parameters: Shape (r, q, 4).
        z: Premise variables, shape (q,).
        weights: Written, shape (r,).
    """
    for i in range(shapes.shape[0]):
        weights[i] = 1.0
        for j in range(shapes.shape[1]):
            one = parameters[i, j]
            weights[i] *= grade_and_slope(shapes[i, j], z[j], one[0], one[1], one[2], one[3])[0]
    normalise(weights)


@compiled
def rule_weights_and_slopes(
    shapes: Integers, parameters: Array, z: Array, weights: Array, slopes: Array
) -> None:
    """Write the weights h(z), and ∂hᵢ/∂zⱼ; all are NaN if no rule fires.

    Args:
        shapes: Integers, shape (r, q).
        parameters: Shape (r, q, 4).
        z: Premise variables, shape (q,).
        weights: Written, shape (r,); the same numbers as those of `rule_weights`.
        slopes: Written, shape (r, q).
    """
    r, q = shapes.shape
    for i in range(r):
        weights[i] = 1.0
        for j in range(q):
            one = parameters[i, j]
            grade, slope = grade_and_slope(shapes[i, j], z[j], one[0], one[1], one[2], one[3])
            for before in range(j):
                slopes[i, before] *= grade
            slopes[i, j] = slope * weights[i]
            weights[i] *= grade
    total = normalise(weights)
    for j in range(q):
        sum_of_slopes = 0.0
        for i in range(r):
            slopes[i, j] /= total
            sum_of_slopes += slopes[i, j]
        for i in range(r):
            slopes[i, j] -= weights[i] * sum_of_slopes


@compiled
def normalise(grades: Array) -> float:
    """Divide the grades of the rules, shape (r,), by their sum, in place, and return the sum.

    Both are NaN if no grade is above 0, or one is negative or not finite; the sum of huge grades
    is infinite.
    """
    largest = 0.0
    for i in range(grades.size):
        if not 0.0 <= grades[i] < math.inf:
            largest = math.nan
            break
        largest = max(largest, grades[i])
    if not largest > 0.0:
        for i in range(grades.size):
            grades[i] = math.nan
        return math.nan
    # A sum of huge grades overflows; multiplying them by 2⁻¹⁰⁰ loses no digit.
    scale = 7.888609052210118e-31 if largest > 1e300 else 1.0
    total = 0.0
    for i in range(grades.size):
        grades[i] *= scale
        total += grades[i]
    for i in range(grades.size):
        grades[i] /= total
    return total / scale


@compiled
def grades_and_slopes(
    shape: int, parameters: Array, z: Array, grades: Array, slopes: Array
) -> None:
    """Write the grade at every z and its derivative.

    Args:
        shape: Code of the shape.
        parameters: Shape (4,).
        z: Shape (samples,).
        grades: Written, shape (samples,).
        slopes: Written, shape (samples,).
    """
    a, b, c, d = parameters
    for k in range(z.size):
        grades[k], slopes[k] = grade_and_slope(shape, z[k], a, b, c, d)


@compiled
def weights_and_slopes_of_each(
    shapes: Integers, parameters: Array, z: Array, weights: Array, slopes: Array
) -> None:
    """Do `rule_weights_and_slopes` for z (samples, q): (samples, r) and (samples, r, q)."""
    for k in range(z.shape[0]):
        rule_weights_and_slopes(shapes, parameters, z[k], weights[k], slopes[k])


@compiled
def normalise_each(grades: Array) -> None:
    """Do `normalise` for grades of shape (samples, r)."""
    for k in range(grades.shape[0]):
        normalise(grades[k])
