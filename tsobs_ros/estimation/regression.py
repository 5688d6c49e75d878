# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Learning constant parameters from one output: e = Ω θ̃ + noise, of one arm or a stack of any.

The filtered regressor is handled as rows, Υᵀ: one a parameter. A stack has a leading axis.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.estimation.estimator import Correction
from tsobs_ros.model.products import mapped, product, transposed


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

    @classmethod
    def stack(cls, explained: Sequence["Explained"]) -> "Explained":
        """Return those of several innovations as a stack."""
        return cls(*map(np.array, zip(*explained, strict=True)))


class Memory(NamedTuple):
    """What is learnt.

    Attributes:
        theta: θ̂, shape (k,).
        gamma: Its covariance Γ, shape (k, k).
        rows: Υᵀ, shape (k, n).
        gram: Exponentially forgotten sum of ΩᵀΩ/S, shape (k, k).
    """

    theta: Array
    gamma: Array
    rows: Array
    gram: Array

    @classmethod
    def stack(cls, memories: Sequence["Memory"]) -> "Memory":
        """Return memories of equal shapes as a stack."""
        return cls(*map(np.array, zip(*memories, strict=True)))


class Regression(NamedTuple):
    """Recursive least squares on one output, with bounded parameters.

    Attributes:
        C: Augmented state to measurement, shape (n,).
        least: Smallest value of each θ, shape (k,).
        most: Largest value of each θ, shape (k,).
    """

    C: Array
    least: Array
    most: Array

    def explained(self, rows: Array, gamma: Array) -> Explained:
        """Return what the regressor Υᵀ, shape (k, n), and the covariance Γ make of θ."""
        omega = mapped(rows, self.C)
        cross = mapped(gamma, omega)
        return Explained(omega, cross, mapped(omega[..., np.newaxis, :], cross))

    @classmethod
    def stack(cls, regressions: Sequence["Regression"]) -> "Regression":
        """Return regressions of equal shapes as a stack."""
        return cls(*map(np.array, zip(*regressions, strict=True)))

    def applied(
        self,
        memory: Memory,
        x: Array,
        correction: Correction,
        explained: Explained,
        doubt: Array | float | None,
    ) -> tuple[Memory, Array]:
        """Return what is learnt after a sample, and the estimate.

        Args:
            memory: Before it.
            x: The estimate corrected for a known θ, shape (n,).
            correction: Innovation, its variance and the observer's gain.
            explained: Of the sample.
            doubt: κ ≥ 1 by which the innovation counts for less, shape (1,); None if nothing is
                to be learnt from it.
        """
        omega, cross, variance = explained
        known = correction.innovation_covariance[..., 0] - variance
        rows = memory.rows - omega[..., np.newaxis] * correction.gain[..., np.newaxis, :, 0]
        gram = memory.gram + _square(omega / np.sqrt(known))
        if doubt is None:
            return Memory(memory.theta, memory.gamma, rows, gram), x
        spread = known * doubt + variance
        moved = memory.theta + cross * (correction.innovation / spread)
        theta = np.minimum(np.maximum(moved, self.least), self.most)
        gamma = memory.gamma - _square(cross / np.sqrt(spread))
        return Memory(theta, gamma, rows, gram), x + mapped(transposed(rows), theta - memory.theta)


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
        if not pivot > 0.0:  # which NaN is not either
            return pivot == 0.0 and not any(any(row[first:]) for row in rows[first:])
        for row in rows[first + 1 :]:
            share = row[first] / pivot
            for column in range(first, len(row)):
                row[column] -= share * pivot_row[column]
    return True


def _square(vector: Array) -> Array:
    """Return v vᵀ, shape (k, k)."""
    return vector[..., np.newaxis] * vector[..., np.newaxis, :]
