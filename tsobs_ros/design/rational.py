# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Matrices of fractions, and rigorous enclosures of matrix exponentials by them.

No floating point number decides anything here; scaling by rounded numbers is free to choose,
because what is scaled is equivalent whatever the scale.
"""

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.errors import ModelError

Rational = NDArray[Any]
"""An array of `Fraction`; NumPy's products and sums of such arrays are exact."""

_LARGEST_GROWTH = 1000


class Enclosure(NamedTuple):
    """A matrix each of whose entries is within `radius` of that of `centre`."""

    centre: Rational
    radius: Fraction


def rational(values: Any) -> Rational:
    """Return numbers as the fractions they are; every float is one."""
    array = np.asarray(values, dtype=object)
    return np.vectorize(Fraction, otypes=[object])(array) if array.size else array


def identity(n: int) -> Rational:
    """Return the unit matrix."""
    return rational(np.eye(n))


def is_positive_definite(matrix: Rational) -> bool:
    """Return whether every pivot of M = L D Lᵀ is positive, for a symmetric M.

    M is brought to integers by a common denominator and eliminated without fractions (Bareiss);
    the diagonal then holds the leading principal minors, whose ratios are the pivots.
    """
    common = math.lcm(*(entry.denominator for entry in matrix.flat))
    rest = np.vectorize(int, otypes=[object])(matrix * common)
    previous = 1
    while rest.size:
        pivot = rest[0, 0]
        if pivot <= 0:
            return False
        rest = (pivot * rest[1:, 1:] - np.outer(rest[1:, 0], rest[0, 1:])) // previous
        previous = pivot
    return True


def inverse(matrix: Rational) -> Rational:
    """Return the inverse of a positive definite matrix, by elimination without pivoting."""
    n = matrix.shape[0]
    table = np.hstack([matrix, identity(n)])
    for place in range(n):
        table[place] = table[place] / table[place, place]
        others = np.arange(n) != place
        table[others] = table[others] - np.outer(table[others, place], table[place])
    return table[:, n:]


def exponential(matrix: Rational) -> Enclosure:
    """Return an enclosure of e^M."""
    return _series(identity(matrix.shape[0]), lambda term: matrix @ term, _row_sum(matrix), 1)


def noise_integral(matrix: Rational, density: Rational) -> Enclosure:
    """Return an enclosure of ∫₀¹ e^{Ms} W e^{Mᵀs} ds for a density W."""
    growth = _row_sum(matrix) + _row_sum(matrix.T)
    return _series(density, lambda term: matrix @ term + term @ matrix.T, growth, 2)


def cosine_below(angle: Fraction) -> Fraction:
    """Return a fraction at most cos x, and hardly less."""
    turn = exponential(np.array([[Fraction(0), -angle], [angle, Fraction(0)]], dtype=object))
    lowest: Fraction = turn.centre[0, 0] - turn.radius
    return max(lowest, Fraction(-1))


def decay_below(exponent: Fraction) -> Fraction:
    """Return a fraction at most e^{−x} for x ≥ 0, and hardly less; e⁰ is 1."""
    if exponent == 0:
        return Fraction(1)
    decay = exponential(np.array([[-exponent]], dtype=object))
    lowest: Fraction = decay.centre[0, 0] - decay.radius
    return max(lowest, Fraction(0))


def _series(
    term: Rational, operator: Callable[[Rational], Rational], growth: Fraction, first: int
) -> Enclosure:
    """Return an enclosure of Σ tₖ with tₖ = operator(tₖ₋₁)/k for k = `first`, `first` + 1, …

    All bounds are in the norm of the largest row sum, in which `growth` bounds the operator.
    Every term is rounded to `bits` binary places, or its fractions would grow without end; an
    error of one term reaches the next multiplied by growth/k. Once growth/k ≤ 1/2, all that is
    left out is at most as large as the last term.
    """
    if growth > _LARGEST_GROWTH:
        raise ModelError(
            f"exact proof: expected a norm of the linear flow of at most {_LARGEST_GROWTH} in a "
            f"step, got {float(growth):.4g}; the arm is too fast for the period"
        )
    bits = 256 + 4 * math.ceil(growth)
    unit = 1 << bits
    rounding = Fraction(term.shape[1], 2 * unit)

    def rounded(entry: Fraction) -> Fraction:
        return Fraction(round(entry * unit), unit)

    on_grid = np.vectorize(rounded, otypes=[object])
    total, error, term_error, order = term, Fraction(0), Fraction(0), first
    while True:
        term = on_grid(operator(term) / order)
        term_error = rounded(growth / order * term_error) + 2 * rounding
        total, error = total + term, error + term_error
        size = _row_sum(term) + term_error
        if 2 * growth <= order + 1 and size <= 8 * rounding:
            return Enclosure(total, error + size)
        order += 1


def _row_sum(matrix: Rational) -> Fraction:
    return max(np.abs(matrix).sum(axis=1), default=Fraction(0))
