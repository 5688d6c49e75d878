# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Products and inverses of small matrices, with sums in the same order as in the compiled core.

A BLAS library uses different kernels on different CPUs, which give different last bits.
"""

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array


def product(a: ArrayLike, b: ArrayLike) -> Array:
    """Return a b as a new matrix."""
    left, right = np.asarray(a, np.float64), np.asarray(b, np.float64)
    result = np.zeros((len(left), right.shape[1]))
    for column, row in zip(left.T, right, strict=True):
        result += column[:, np.newaxis] * row
    return result


def congruent(a: ArrayLike, s: ArrayLike, added: ArrayLike = 0.0) -> Array:
    """Return a s aᵀ + `added` as a new matrix, exactly symmetric."""
    upper = np.triu(product(product(a, s), np.transpose(a)) + np.asarray(added, np.float64))
    return np.asarray(upper + np.triu(upper, 1).T)


def joseph(C: ArrayLike, R: ArrayLike, covariance: ArrayLike, gain: ArrayLike) -> Array:
    """Return (I − KC) Σ (I − KC)ᵀ + K R Kᵀ as a new matrix, exactly symmetric."""
    closed = np.eye(len(np.asarray(gain))) - product(gain, C)
    return congruent(closed, covariance, congruent(gain, R))


def block_diagonal(*blocks: ArrayLike) -> Array:
    """Return a matrix with the given blocks along its diagonal."""
    given = [np.asarray(block, np.float64) for block in blocks]
    result = np.zeros(np.sum([block.shape for block in given], axis=0))
    row = column = 0
    for block in given:
        rows, columns = block.shape
        result[row : row + rows, column : column + columns] = block
        row, column = row + rows, column + columns
    return result


def inverse(matrix: ArrayLike) -> Array:
    """Return the inverse of a symmetric positive definite matrix; others may give infinities."""
    s = np.array(matrix, np.float64)
    n = len(s)
    L, D, result = np.eye(n), np.zeros(n), np.eye(n)
    with np.errstate(all="ignore"):
        for j in range(n):
            column = s[j:, j].copy()
            for k in range(j):
                column -= L[j:, k] * L[j, k] * D[k]
            D[j], L[j + 1 :, j] = column[0], column[1:] / column[0]
        for i in range(n):
            for k in range(i):
                result[i] -= L[i, k] * result[k]
        result /= D[:, np.newaxis]
        for i in reversed(range(n)):
            for k in range(i + 1, n):
                result[i] -= L[k, i] * result[k]
        return np.asarray(0.5 * (result + result.T))
