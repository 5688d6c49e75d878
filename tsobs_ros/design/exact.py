# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certificate in exact rational arithmetic: no floating-point number enters the verdict.

The numbers of the model, P and K are floats, and every float is a fraction. So X = P⁻¹ and the
claim of `certificate` can be written in fractions, except for three quantities:

- the linear flow Φ = e^{AT} and its noise Q. Taylor polynomials in fractions enclose them, with a
  bound d on the error of each entry of Φ W Φᵀ + Q. A symmetric error with entries up to d is
  ⪯ n d I (Gershgorin), so n d I is added like process noise;
- cos x_max, replaced by a fraction just below it: a slightly larger domain;
- e^{−2ρT}, replaced by a fraction just below it: a slightly faster decay.

A symmetric matrix of fractions is positive definite if and only if all pivots of its LDLᵀ
factorisation are positive. Integer arithmetic decides this. The margins are proved, too: μ is
printed only if the inequality still holds after μ X per second is subtracted. Candidates for μ come
from the floating-point check; the proof does not rely on them.

A and the noise are those of the observer's own model. Memberships do not enter, because every blend
of the vertices is covered.
"""

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance

from tsobs_ros.design.certificate import CertificateReport, Inequality
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import ModelError

Rational = NDArray[Any]
"""An array of `Fraction`; NumPy's products and sums of such arrays are exact."""

_LARGEST_GROWTH = 1000

_SHARES = (1.0 - 2.0**-20, 1.0 - 2.0**-10, 1.0 - 2.0**-4, 0.5, 0.1, 1e-3, 1e-6)
"""Shares of the floating-point margin that are tried, in this order, until one is proved."""

_LEAST_MARGIN = 1e-300
"""Last candidate, for a matrix that is positive definite by less than all of these shares."""


class Enclosure(NamedTuple):
    """A matrix whose entries differ from those of `centre` by at most `radius`."""

    centre: Rational
    radius: Fraction


def verify_exactly(design: Design) -> CertificateReport:
    """Return every inequality of a design with an exactly proved margin, or 0 without a proof.

    Raises:
        ModelError: The model is too fast for the period, so its flow cannot be enclosed.
    """
    report, P = design.certificate, rational(design.P)
    guesses = {(each.name, each.where): each.margin for each in report.inequalities}
    name, margin = "P symmetric and positive definite", 0.0
    if (P == P.T).all():
        margin = _margin(P, np.diag(np.diag(P)), guesses[name, ""])
    found = [Inequality(name, "", margin, 0.0)]
    name = "covariance decrease"
    for where, decrease, unit in _decreases(design) if margin else ():
        margin = _margin(decrease, unit, guesses.get((name, where), 0.0))
        found.append(Inequality(name, where, margin, 0.0))
    return CertificateReport(tuple(found), report.contraction_rate)


def _margin(matrix: Rational, unit: Rational, guess: float) -> float:
    """Return a μ > 0 of four decimal digits with matrix − μ unit ≻ 0, or 0 if none is found."""
    if is_positive_definite(matrix):
        for candidate in (*(share * guess for share in _SHARES), _LEAST_MARGIN):
            text = f"{candidate:.3e}"
            if candidate > 0.0 and is_positive_definite(matrix - Fraction(text) * unit):
                return float(text)
    return 0.0


def _decreases(design: Design) -> Iterator[tuple[str, Rational, Rational]]:
    """Yield each vertex, λ²X minus an upper bound on the covariance a step after X, and T X.

    Coordinates are scaled by powers of two. The scale does not affect the claim; this one keeps the
    norm of the flow small.
    """
    request, period = design.request, 1 / Fraction(design.request.rate)
    drift, duration = request.flow.drift, Fraction(request.flow.linear_share) * period
    _, (scale, _) = matrix_balance(drift, permute=False, separate=True)
    D, inverted = np.diag(rational(scale)), np.diag(1 / rational(scale))
    flow = inverted @ (duration * rational(drift)) @ D
    phi = exponential(flow)
    noise = noise_integral(flow, inverted @ (duration * rational(request.flow.density)) @ inverted)
    gain: Rational = inverted @ rational(design.K)
    X = inverse(D @ rational(design.P) @ D)
    closed = np.eye(len(gain), dtype=object) - gain @ rational(request.flow.output_matrix) @ D
    posterior = closed @ X @ closed.T + (gain * rational(request.output_std) ** 2) @ gain.T
    kept = decay_below(2 * Fraction(request.decay_rate) * period)
    if isinstance(request, ArmRequest):
        slopes = cosine_below(Fraction(request.x_max)), Fraction(1)
        corners = request.flow.corners(slopes, request.covered, 1, period / 2, rational)
    else:
        corners = request.corners(number=rational)
    pairs = product([inverted @ corner.matrix @ D for corner in corners], repeat=2)
    for vertex, (first, second) in zip(request.vertices(), pairs, strict=True):
        if isinstance(request, ArmRequest):
            after = second @ _bounded(phi, noise, first @ posterior @ first.T) @ second.T
        else:
            after = _after_system_step(phi, noise, period, first, second, posterior)
        yield vertex.where, kept * X - after, period * X


def _after_system_step(
    phi: Enclosure, noise: Enclosure, T: Fraction, first: Rational, second: Rational, W: Rational
) -> Rational:
    """Return an upper bound on the covariance after a T–S system's step from W."""
    one = np.eye(len(W), dtype=object)
    kick, drive, spread = one + T / 2 * first, T * second, one + T * second
    # Each entry of M ΔΦ N is at most (row sum of M) (largest entry of ΔΦ) (column sum of N).
    radius = phi.radius * (1 + _row_sum(drive) * _row_sum(kick.T))
    middle = Enclosure(phi.centre + drive @ phi.centre @ kick, radius)
    half = Enclosure(spread @ noise.centre @ spread.T, noise.radius * _row_sum(spread) ** 2)
    return _bounded(phi, noise, _bounded(middle, half, W))


def _bounded(phi: Enclosure, noise: Enclosure, W: Rational) -> Rational:
    """Return an upper bound (in the sense of ⪯) on Φ W Φᵀ + Q for all enclosed Φ and Q."""
    n = len(W)
    largest = np.abs(phi.centre).max() + phi.radius
    # Each entry of ΔΦ W Φᵀ + Φ̃ W ΔΦᵀ is at most twice this sum of n² products.
    error = 2 * n * n * phi.radius * np.abs(W).max() * largest + noise.radius
    centre = phi.centre @ W @ phi.centre.T + noise.centre
    return np.asarray(centre + n * error * np.eye(n, dtype=object))


def rational(values: Any) -> Rational:
    """Return numbers as exact fractions; every float is a fraction."""
    array = np.asarray(values, dtype=object)
    return np.vectorize(Fraction, otypes=[object])(array) if array.size else array


def is_positive_definite(matrix: Rational) -> bool:
    """Return whether every pivot of M = L D Lᵀ is positive, for a symmetric M.

    A common denominator turns M into integers. Fraction-free elimination (Bareiss) then leaves the
    leading principal minors on the diagonal, and the pivots are their ratios.
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
    table = np.hstack([matrix, np.eye(n, dtype=object)])
    for place in range(n):
        table[place] = table[place] / table[place, place]
        others = np.arange(n) != place
        table[others] = table[others] - np.outer(table[others, place], table[place])
    return table[:, n:]


def exponential(matrix: Rational) -> Enclosure:
    """Return an enclosure of e^M."""
    one = np.eye(len(matrix), dtype=object)
    return _series(one, lambda term: matrix @ term, _row_sum(matrix), 1)


def noise_integral(matrix: Rational, density: Rational) -> Enclosure:
    """Return an enclosure of ∫₀¹ e^{Ms} W e^{Mᵀs} ds for a density W."""
    growth = _row_sum(matrix) + _row_sum(matrix.T)
    return _series(density, lambda term: matrix @ term + term @ matrix.T, growth, 2)


def cosine_below(angle: Fraction) -> Fraction:
    """Return a fraction just below cos x."""
    turn = exponential(np.array([[Fraction(0), -angle], [angle, Fraction(0)]], dtype=object))
    return Fraction(turn.centre[0, 0] - turn.radius)


def decay_below(exponent: Fraction) -> Fraction:
    """Return a fraction just below e^{−x}."""
    decay = exponential(np.array([[-exponent]], dtype=object))
    return Fraction(decay.centre[0, 0] - decay.radius)


def _series(
    term: Rational, operator: Callable[[Rational], Rational], growth: Fraction, first: int
) -> Enclosure:
    """Return an enclosure of Σ tₖ with tₖ = operator(tₖ₋₁)/k for k = `first`, `first` + 1, …

    All bounds are in the maximum row sum norm, in which `growth` bounds the operator. Every term
    is rounded to `bits` binary places, because its fractions would otherwise grow without end. The
    error of a term enters the next one multiplied by growth/k. Once growth/k ≤ 1/2, all omitted
    terms together are at most as large as the last one.
    """
    if growth > _LARGEST_GROWTH:
        raise ModelError(
            f"exact proof: expected a norm of the linear flow of at most {_LARGEST_GROWTH} in a "
            f"step, got {float(growth):.4g}; the model is too fast for the period"
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
