# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Products, factors and solutions for matrices of a few rows, as compiled loops in fixed order.

A BLAS library has other kernels for other CPUs, and so other last bits. Results go into arrays that
the caller provides, which must not be an argument at the same time unless that is said.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled
from tsobs_ros.core import native


@compiled
def dot(a: Array, b: Array, n: int) -> float:
    """Return a · b."""
    total = 0.0
    for i in range(n):
        total += a[i] * b[i]
    return total


@compiled
def is_finite(a: Array, n: int) -> bool:
    """Return whether all of the first n numbers are finite."""
    finite = True
    for i in range(n):
        finite = finite and math.isfinite(a[i])
    return finite


@compiled
def has_finite(a: Array, n: int) -> bool:
    """Return whether one of the first n numbers is finite."""
    found = bool(0)
    for i in range(n):
        found = found or math.isfinite(a[i])
    return found


@compiled
def larger(value: float, least: float) -> float:
    """Return the value, but at least so much; NaN stays."""
    return least if value < least else value


@compiled
def quadratic(s: Array, a: Array, n: int) -> float:
    """Return aᵀ s a."""
    total = 0.0
    for i in range(n):
        for j in range(n):
            total += a[i] * s[i, j] * a[j]
    return total


@compiled
def apply(a: Array, x: Array, result: Array, rows: int, columns: int) -> None:
    """Write a x into `result`."""
    for i in range(rows):
        total = 0.0
        for j in range(columns):
            total += a[i, j] * x[j]
        result[i] = total


@compiled
def multiply(a: Array, b: Array, result: Array, rows: int, inner: int, columns: int) -> None:
    """Write a b into `result`."""
    for i in range(rows):
        for j in range(columns):
            result[i, j] = 0.0
        for k in range(inner):
            factor = a[i, k]
            for j in range(columns):
                result[i, j] += factor * b[k, j]


@compiled
def multiply_padded(a: Array, b: Array, result: Array, rows: int, width: int) -> None:
    """Write a b into `result`, for matrices whose rows have room for `width` numbers.

    The same bits as of `multiply`, in a third of the time. What is in the room behind the numbers
    in use must be zero in a or b, and finite in the other. `width` is a multiple of four, and at
    least 8: loops of such lengths are those that become vector instructions.
    """
    for i in range(rows):
        for j in range(width):
            total = 0.0
            for k in range(8):
                total += a[i, k] * b[k, j]
            result[i, j] = total
    for block in range(8, width, 4):
        for i in range(rows):
            for j in range(width):
                total = result[i, j]
                for k in range(4):
                    total += a[i, block + k] * b[block + k, j]
                result[i, j] = total


@compiled
def congruence(
    a: Array, s: Array, added: Array, scratch: Array, result: Array, rows: int, inner: int
) -> None:
    """Write a s aᵀ + `added`, symmetric, into `result`, which may be s; s and `added` symmetric."""
    multiply(a, s, scratch, rows, inner, inner)
    for i in range(rows):
        for j in range(i, rows):
            total = 0.0
            for k in range(inner):
                total += scratch[i, k] * a[j, k]
            total += added[i, j]
            result[i, j] = total
            result[j, i] = total


@compiled
def is_below(s: Array, bound: Array, scratch: Array, n: int) -> bool:
    """Return whether s ⪯ bound, for symmetric matrices, by the pivots of their difference."""
    for i in range(n):
        for j in range(n):
            scratch[i, j] = bound[i, j] - s[i, j]
    return is_nonnegative(scratch, n)


@compiled
def is_nonnegative(s: Array, n: int) -> bool:
    """Return whether a symmetric matrix is positive semidefinite; overwrites its upper part."""
    for first in range(n):
        pivot = s[first, first]
        if not pivot > 0.0:  # which NaN is not either
            if pivot != 0.0:
                return False
            for column in range(first + 1, n):
                if s[first, column] != 0.0:
                    return False
        else:
            for row in range(first + 1, n):
                share = s[first, row] / pivot
                for column in range(row, n):
                    s[row, column] -= share * s[first, column]
    return True


@compiled
def solve(s: Array, b: Array, factor: Array, result: Array, n: int, columns: int) -> None:
    """Write s⁻¹ b into `result`, which may be b, for a symmetric positive definite s.

    By s = L D Lᵀ, so that a 1 × 1 system is one division. `factor` is scratch of the shape of s.
    What comes of a singular s is not finite.
    """
    for j in range(n):
        pivot = s[j, j]
        for k in range(j):
            pivot -= factor[j, k] * factor[j, k] * factor[k, k]
        factor[j, j] = pivot
        for i in range(j + 1, n):
            total = s[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k] * factor[k, k]
            factor[i, j] = total / pivot
    for column in range(columns):
        for i in range(n):
            total = b[i, column]
            for k in range(i):
                total -= factor[i, k] * result[k, column]
            result[i, column] = total
        for i in range(n):
            result[i, column] /= factor[i, i]
        for back in range(n):
            i = n - 1 - back
            total = result[i, column]
            for k in range(i + 1, n):
                total -= factor[k, i] * result[k, column]
            result[i, column] = total


@compiled
def copy(source: Array, result: Array, rows: int, columns: int) -> None:
    """Write a matrix into `result`."""
    for i in range(rows):
        for j in range(columns):
            result[i, j] = source[i, j]


@compiled
def joseph_form(
    C: Array,
    R: Array,
    covariance: Array,
    gain: Array,
    squares: Array,
    nothing: Array,
    result: Array,
    n: int,
    p: int,
) -> None:
    """Write (I − KC) Σ (I − KC)ᵀ + K R Kᵀ, symmetric and positive for any K.

    `squares` is scratch of three matrices of n rows and the larger of n and p columns, `nothing`
    is zero and n × n, `result` may be Σ.
    """
    closed, noise, scratch = squares[0], squares[1], squares[2]
    congruence(gain, R, nothing, scratch, noise, n, p)
    multiply(gain, C, closed, n, p, n)
    for i in range(n):
        for j in range(n):
            closed[i, j] = (1.0 if i == j else 0.0) - closed[i, j]
    congruence(closed, covariance, noise, scratch, result, n, n)


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
    """Return a writable copy by rows, the one kind of array that is compiled for."""
    return np.array(matrix, np.float64, order="C")
