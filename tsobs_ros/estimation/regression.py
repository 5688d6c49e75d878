# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Learning constant parameters from one output: e = Ω θ̃ + noise, of one arm or a stack of any.

The filtered regressor is handled as rows, Υᵀ: one a parameter. A stack has a leading axis.
"""

from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.model.products import mapped, product


class Explained(NamedTuple):
    """What θ's uncertainty explains of an innovation.

    Attributes:
        omega: Ω = C̄Υ, shape (k,).
        cross: ΓΩᵀ, shape (k,).
        variance: ΩΓΩᵀ, shape (1,).
    """

    omega: Array
    cross: Array
    variance: Array


class Regression(NamedTuple):
    """Recursive least squares on one output, with bounded parameters.

    Attributes:
        C: Augmented state to measurement, shape (n,).
        limits: Bound of each |θ|, shape (k,).
    """

    C: Array
    limits: Array

    def explained(self, rows: Array, gamma: Array) -> Explained:
        """Return what the regressor Υᵀ, shape (k, n), and the covariance Γ make of θ."""
        omega = mapped(rows, self.C)
        cross = mapped(gamma, omega)
        return Explained(omega, cross, mapped(omega[..., np.newaxis, :], cross))

    @staticmethod
    def filtered(
        rows: Array, gram: Array, gain: Array, explained: Explained, spread: Array
    ) -> tuple[Array, Array]:
        """Return Υᵀ and the Gram of Ω/√S after a sample.

        Args:
            rows: Υᵀ, shape (k, n).
            gram: Shape (k, k).
            gain: The observer's, shape (n, 1).
            explained: Of the sample.
            spread: S, the innovation's variance for a known θ, shape (1,).
        """
        omega = explained.omega
        rows = rows - omega[..., np.newaxis] * gain[..., np.newaxis, :, 0]
        return rows, gram + _square(omega / np.sqrt(spread))

    def learnt(
        self,
        theta: Array,
        gamma: Array,
        innovation: Array,
        explained: Explained,
        spread: Array,
    ) -> tuple[Array, Array]:
        """Return θ̂ within its limits and Γ after a sample.

        Args:
            theta: θ̂, shape (k,).
            gamma: Γ, shape (k, k).
            innovation: e, shape (1,).
            explained: Of the sample.
            spread: The variance that e is to be taken for, shape (1,).
        """
        moved = theta + explained.cross * (innovation / spread)
        within = np.minimum(np.maximum(moved, -self.limits), self.limits)
        return within, gamma - _square(explained.cross / np.sqrt(spread))


def spread_of(rows: Array, gamma: Array) -> Array:
    """Return the variances that θ's uncertainty adds to what moves with it, diag(Υ Γ Υᵀ)."""
    return np.asarray(np.add.reduce(product(gamma, rows) * rows, axis=-2))


def exceeds(matrix: list[list[float]], level: float) -> bool:
    """Return whether every eigenvalue of a symmetric matrix is at least `level`, by its pivots."""
    rows = [
        [number - level if i == j else number for j, number in enumerate(row)]
        for i, row in enumerate(matrix)
    ]
    for first, pivot_row in enumerate(rows):
        pivot = pivot_row[first]
        if pivot <= 0.0:
            return pivot == 0.0 and not any(any(row[first:]) for row in rows[first:])
        for row in rows[first + 1 :]:
            share = row[first] / pivot
            for column in range(first, len(row)):
                row[column] -= share * pivot_row[column]
    return True


def _square(vector: Array) -> Array:
    """Return v vᵀ, shape (k, k)."""
    return vector[..., np.newaxis] * vector[..., np.newaxis, :]
