# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Products for one system, a batch of equal systems, or a stack in which each has its matrices.

What belongs to one system of a stack does not depend on the others: its numbers are, to the last
bit, those of the system alone.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array


def mapped(matrix: Array, x: Array) -> Array:
    """Return M x, shape (..., m).

    Args:
        matrix: M, shape (m, n), or (k, m, n) with one for each vector.
        x: Shape (..., n), or (k, n).
    """
    if matrix.shape[-1] == 1:
        # Exact, also in the sign of a zero, which a library is free to choose.
        return matrix[..., 0] * x
    if x.ndim == 1:
        # The method takes a third of the operator's time, and gives the stack's bits.
        return np.asarray(matrix.dot(x))
    if matrix.ndim == 2:
        return np.asarray(x @ matrix.T)
    return np.asarray((matrix @ x[..., np.newaxis])[..., 0])


def transposed(matrix: NDArray[np.floating[Any]]) -> Array:
    """Return Mᵀ of each matrix, shape (..., n, m)."""
    return np.asarray(matrix.T if matrix.ndim == 2 else matrix.swapaxes(-1, -2))


def product(left: Array, right: Array) -> Array:
    """Return the product of two matrices, or of each two of a stack."""
    if left.ndim == right.ndim == 2:
        return np.asarray(left.dot(right))
    return np.asarray(left @ right)
