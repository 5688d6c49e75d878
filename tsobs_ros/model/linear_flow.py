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
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
from tsobs_ros.model.matrices import product

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
        self.terms = self._fill(A, B, W)
        if not all(np.isfinite(part).all() for part in self.over(period)):
            raise ModelError(
                f"flow: every entry over a step of {period:.4g} s must be finite; "
                f"the model's numbers are too large"
            )

    @np.errstate(all="ignore")
    def _fill(self, A: Array, B: Array, W: Array) -> int:
        """Write the series; return the number of rows that are not negligible."""
        n, m = self._n, self._m
        row = np.concatenate([np.eye(n), np.zeros((n, n + m))], axis=1)
        largest, power = np.zeros_like(row), 1.0
        for order in range(1, MAX_TERMS):
            size = np.abs(row) * power
            largest = np.where((size > largest) | np.isnan(size), size, largest)
            self.series[order - 1] = np.concatenate(
                [part.ravel() for part in np.split(row, (n, n + m), axis=1)]
            )
            # Judged entry by entry: entries differ by ten orders of magnitude.
            if order > 2 * n and (size <= 1e-3 * np.finfo(float).eps * largest).all():
                return order
            power *= self.reach
            row = product(A, row)
            row[:, n + m :] += row[:, n + m :].T.copy()
            if order == 1:
                row[:, n:] += np.concatenate([B, W], axis=1)
            row /= order
        return MAX_TERMS - 1

    def over(self, duration: float) -> tuple[Array, Array, Array]:
        """Return Φ, Γ and Q over `duration` [s] ≥ 0, shapes (n, n), (n, m) and (n, n)."""
        n, m = self._n, self._m
        phi, gamma, noise = np.empty((n, n)), np.empty((n, m)), np.empty((n, n))
        scratch = np.empty(n * (4 * n + 2 * m))
        native.flow_over(
            self.series, self.terms, self.reach, duration, phi, gamma, noise, scratch, n, m
        )
        return phi, gamma, noise


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
