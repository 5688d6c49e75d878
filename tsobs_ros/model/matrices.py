# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Products, factors and solutions for matrices of a few rows, as loops in a fixed order.

A BLAS library has other kernels for other CPUs, and so other last bits.
"""

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array
from tsobs_ros.core import native


def product(a: ArrayLike, b: ArrayLike) -> Array:
    """Return a b as a new matrix."""
    left, right = _rows(a), _rows(b)
    result = np.empty((left.shape[0], right.shape[1]))
    rows, inner = left.shape
    native.multiply(left, right, result, rows, inner, right.shape[1])
    return result


def congruent(a: ArrayLike, s: ArrayLike, added: ArrayLike = 0.0) -> Array:
    """Return a s aᵀ + `added` as a new matrix, exactly symmetric."""
    left = _rows(a)
    rows, inner = left.shape
    result = np.empty((rows, rows))
    extra = np.broadcast_to(added, (rows, rows))
    scratch = np.empty((rows, inner))
    native.congruence(left, _rows(s), _rows(extra), scratch, result, rows, inner)
    return result


def joseph(C: ArrayLike, R: ArrayLike, covariance: ArrayLike, gain: ArrayLike) -> Array:
    """Return (I − KC) Σ (I − KC)ᵀ + K R Kᵀ as a new matrix, exactly symmetric."""
    K = _rows(gain)
    n, p = K.shape
    result, scratch = np.empty((n, n)), np.empty((3, n, max(n, p)))
    native.joseph_form(_rows(C), _rows(R), _rows(covariance), K, scratch, result, n, p)
    return result


def inverse(matrix: ArrayLike) -> Array:
    """Return the inverse of a symmetric positive definite matrix; not finite if it is not."""
    rows = _rows(matrix)
    n = len(rows)
    result = np.empty((n, n))
    native.solve(rows, np.eye(n), np.empty((n, n)), result, n, n)
    return np.asarray(0.5 * (result + result.T))


def _rows(matrix: ArrayLike) -> Array:
    """Return a copy by rows, as the compiled core takes them."""
    return np.array(matrix, np.float64, order="C")
