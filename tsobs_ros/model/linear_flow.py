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
from tsobs_ros.errors import ModelError
from tsobs_ros.model.matrices import product

MAX_TERMS = 60
"""Rows of a series."""


@np.errstate(all="ignore")
def taylor_series(A: Array, B: Array, W: Array, reach: float) -> tuple[Array, int]:
    """Return Taylor coefficients of Φ, Γ and Q, and how many rows are not negligible up to `reach`.

    The coefficients are side by side, shape (MAX_TERMS, n (2n + m)); further rows are zero.
    """
    n, m = B.shape
    series = np.zeros((MAX_TERMS, n * (2 * n + m)))
    row = np.concatenate([np.eye(n), np.zeros((n, n + m))], axis=1)
    largest, power = np.zeros_like(row), 1.0
    for order in range(1, MAX_TERMS):
        size = np.abs(row) * power
        largest = np.where((size > largest) | np.isnan(size), size, largest)
        series[order - 1] = np.concatenate(
            [part.ravel() for part in np.split(row, (n, n + m), axis=1)]
        )
        # Judged entry by entry: entries differ by ten orders of magnitude.
        if order > 2 * n and (size <= 1e-3 * np.finfo(float).eps * largest).all():
            return series, order
        power *= reach
        row = product(A, row)
        row[:, n + m :] += row[:, n + m :].T.copy()
        if order == 1:
            row[:, n:] += np.concatenate([B, W], axis=1)
        row /= order
    return series, MAX_TERMS - 1


def norm(A: Array) -> float:
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
