# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The exact flow of a linear system with a held input and white noise, over a step of any length.

Φ' = AΦ, Γ' = AΓ + B, Q' = AQ + QAᵀ + W, by their Taylor series with precomputed coefficients: a
step then costs one evaluation of polynomials, which matters because real stamps jitter. Where a
step is long for the fastest mode, the series serves a fraction 2⁻ˢ of it and is doubled s times; a
sum of positive semidefinite terms, so the noise stays a covariance.
"""

import math

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
from tsobs_ros.model.matrices import congruence, copy, multiply

MAX_TERMS = 60
"""Rows of a series; those behind `LinearFlow.terms` are zero."""

STRETCH = 1.25
"""A step may be longer than nominal by so much: real stamps jitter about the period."""

_LARGEST_TURN = 2.0**16
"""Most a mode may turn or decay in one step [rad]; doubling loses a digit for every factor 10."""


class LinearFlow:
    """Φ, Γ and Q of ẋ = A x + B u + noise of density W.

    Args:
        A: State matrix, shape (n, n) [1/s].
        B: Input matrix, shape (n, m).
        W: Density of the white noise, shape (n, n).
        period: The step that is taken most [s].

    Attributes:
        series: Taylor coefficients of Φ, Γ and Q side by side, shape (MAX_TERMS, n (2n + m)).
        terms: Number of rows that are not negligible.
        reach: Longest step that the series serves without doubling [s].

    Raises:
        ModelError: An entry or the flow over the period is not finite, or a step is too long
            for the fastest mode.
    """

    def __init__(self, A: Array, B: Array, W: Array, period: float) -> None:
        turn = _norm(A) * period
        if not turn <= _LARGEST_TURN:
            raise ModelError(
                f"period: expected the fastest mode to turn or decay by at most "
                f"{_LARGEST_TURN:.0f} rad in a step of {period:.4g} s, got {turn:.4g} rad; a "
                f"higher rate or a softer, heavier or less damped arm is needed"
            )
        # The series converges fast for |A|t up to 1; the common step needs no doubling.
        self.reach = STRETCH * period / max(1.0, STRETCH * turn)
        self._n, self._m = B.shape
        self.series = np.zeros((MAX_TERMS, self._n * (2 * self._n + self._m)))
        drift, forced, density = (np.array(each, np.float64, order="C") for each in (A, B, W))
        n, m, scratch = self._n, self._m, np.empty(self._n * (4 * self._n + 2 * self._m))
        self.terms = native.fill_series(
            drift, forced, density, self.reach, self.series, scratch, n, m
        )
        if not all(np.isfinite(part).all() for part in self.over(period)):
            raise ModelError(
                f"flow: every entry over a step of {period:.4g} s must be finite; "
                f"the model's numbers are too large"
            )

    def over(self, duration: float) -> tuple[Array, Array, Array]:
        """Return Φ, Γ and Q over `duration` [s] ≥ 0, shapes (n, n), (n, m) and (n, n)."""
        n, m = self._n, self._m
        phi, gamma, noise = np.empty((n, n)), np.empty((n, m)), np.empty((n, n))
        scratch = np.empty(n * (4 * n + 2 * m))
        native.flow_over(
            self.series, self.terms, self.reach, duration, phi, gamma, noise, scratch, n, m
        )
        return phi, gamma, noise


@compiled
def flow_over(
    series: Array,
    terms: int,
    reach: float,
    duration: float,
    phi: Array,
    gamma: Array,
    noise: Array,
    squares: Array,
    forced: Array,
    values: Array,
    n: int,
    m: int,
    with_noise: bool,
) -> None:
    """Write Φ, Γ and, if wanted, Q over `duration` [s] from a series.

    Args:
        series: Of a `LinearFlow`.
        terms: Of the same.
        reach: Of the same [s].
        duration: At least 0 [s].
        phi: Φ, shape (n, n).
        gamma: Γ, shape (n, m).
        noise: Q, shape (n, n).
        squares: Scratch, shape (2, n, n).
        forced: Scratch, shape (n, m).
        values: Scratch, shape (n (2n + m),).
        n: Number of states.
        m: Number of inputs.
        with_noise: Whether Q is wanted, which is a third of the work.
    """
    doublings, step = 0, duration
    while step > reach:
        doublings += 1
        step *= 0.5
    # Horner's rule.
    count = n * (2 * n + m) if with_noise else n * (n + m)
    for place in range(count):
        values[place] = 0.0
    for back in range(terms):
        row = terms - 1 - back
        for place in range(count):
            values[place] = values[place] * step + series[row, place]
    for i in range(n):
        for j in range(n):
            phi[i, j] = values[n * i + j]
        for j in range(m):
            gamma[i, j] = values[n * n + m * i + j]
        for j in range(n if with_noise else 0):
            noise[i, j] = values[n * (n + m) + n * i + j]
    first, second = squares[0], squares[1]
    for _ in range(doublings):
        multiply(phi, gamma, forced, n, n, m)
        for i in range(n):
            for j in range(m):
                gamma[i, j] += forced[i, j]
        if with_noise:
            congruence(phi, noise, noise, first, second, n, n)
            copy(second, noise, n, n)
        multiply(phi, phi, first, n, n, n)
        copy(first, phi, n, n)


@compiled
def cut_into_steps(duration: float, period: float) -> tuple[int, float]:
    """Return the number of nominal steps in `duration` [s] and the length of a last one [s].

    The last one is 0 or up to 1.25 periods long.
    """
    whole = math.floor(duration / period)
    rest = duration - whole * period
    if rest < 0.0:
        whole, rest = whole - 1, rest + period
    if whole > 0 and 0.0 < rest <= (STRETCH - 1.0) * period:
        whole, rest = whole - 1, rest + period
    return whole, rest


def _norm(A: Array) -> float:
    """Return a norm of A [1/s] in coordinates where it is close to its fastest eigenvalue.

    The states' units differ, so rows and columns are balanced by powers of two, which changes no
    flow.
    """
    if not np.isfinite(A).all():
        raise ModelError(f"state matrix: every entry must be finite, got {A.tolist()}")
    balanced = np.abs(A)
    for _ in range(100):
        settled = True
        for i in range(len(balanced)):
            column, row = (sum(line.tolist()) - line[i] for line in (balanced[:, i], balanced[i]))
            if not (0.0 < column < math.inf and 0.0 < row < math.inf):
                continue
            shift = round((math.log2(row) - math.log2(column)) / 2.0)
            if shift:
                balanced[:, i] = np.ldexp(balanced[:, i], shift)
                balanced[i] = np.ldexp(balanced[i], -shift)
                settled = False
        if settled:
            break
    return float(max((sum(column.tolist()) for column in balanced.T), default=0.0))
