# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Directions in which the matrices of a T–S system may differ: ΔAᵢ = Σ θ_k E_{i,k}."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.model.ts_model import TSModel


@dataclass(frozen=True, eq=False)
class MatrixUncertainty:
    """What is uncertain about a T–S system, and by how much at most.

    Attributes:
        model: The nominal system.
        directions: E_{i,k} by name, shape (r, n, n); one (n, n) serves every rule.
        bounds: |θ| at most so much, by the same names; they set the order of θ.

    Raises:
        ModelError: Names differ, a direction is zero or of the wrong shape, or a bound is not
            above zero.
    """

    model: TSModel
    directions: Mapping[str, ArrayLike]
    bounds: Mapping[str, float]

    def __post_init__(self) -> None:
        if set(self.directions) != set(self.bounds):
            raise ModelError(
                f"uncertainty: expected a bound for each of {', '.join(self.directions) or '–'}, "
                f"got {', '.join(self.bounds) or '–'}"
            )
        rules, n = self.model.rule_count, self.model.state_count
        for name, matrix in self.directions.items():
            shape = (n, n) if np.ndim(matrix) == 2 else (rules, n, n)
            if not as_matrix(f"direction of {name}", matrix, shape).any():
                raise ModelError(f"direction of {name}: expected a matrix other than zero")
            positive(f"bound of {name}", self.bounds[name])

    @property
    def names(self) -> tuple[str, ...]:
        """The directions, in the order of θ."""
        return tuple(self.bounds)

    @property
    def count(self) -> int:
        """Number k of uncertain parameters."""
        return len(self.bounds)

    @cached_property
    def limits(self) -> Array:
        """Bound of each |θ|, shape (k,)."""
        return np.array([float(bound) for bound in self.bounds.values()])

    @cached_property
    def matrices(self) -> Array:
        """E_{i,k}, shape (k, r, n, n)."""
        n = self.model.state_count
        shape = (self.model.rule_count, n, n)
        stack = [np.broadcast_to(np.asarray(self.directions[k], float), shape) for k in self.names]
        return np.array(stack).reshape(len(stack), *shape)

    @cached_property
    def common(self) -> bool:
        """Whether every direction is the same in all rules."""
        return bool((self.matrices == self.matrices[:, :1]).all())

    @cached_property
    def wide(self) -> Array:
        """[E_{i,k} 0], whose zeros meet the input, shape (k, r, n, n + m)."""
        widths = [(0, 0)] * 3 + [(0, self.model.input_count)]
        return np.pad(self.matrices, widths)

    @cached_property
    def _stacked(self) -> Array:
        """All directions of a rule above each other, shape (r, k n, n + m)."""
        turned = np.moveaxis(self.wide, 0, 1)
        return np.asarray(turned.reshape(turned.shape[0], -1, turned.shape[-1]))

    def regressor(self, x: Array, u: Array, weights: Array | None = None) -> Array:
        """Return Σᵢ hᵢ E_{i,k} x, what ẋ changes by for θ = 1, shape (n, k).

        Args:
            x: State of the plant, shape (n,).
            u: Inputs and scheduled signals, shape (m + s,).
            weights: h, for callers that have it already, shape (r,).
        """
        return self.model.blended(self._stacked, x, u, weights).reshape(self.count, -1).T

    def model_with(self, theta: ArrayLike) -> TSModel:
        """Return the T–S system that θ, shape (k,), describes."""
        change = np.tensordot(as_matrix("θ", theta, (self.count,)), self.matrices, 1)
        nominal = self.model
        return TSModel(
            nominal.A + change,
            nominal.B,
            nominal.C,
            nominal.rule_base,
            nominal.premise,
            nominal.schedule,
        )
