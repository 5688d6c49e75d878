# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A T–S system as an estimator needs it: one output matrix, and premises linear in what is known.

    ẋ = Σ hᵢ(z)(Aᵢx + Bᵢu),   y = C x + disturbance + noise,   z = Z x + Z_s s

s are scheduled signals, which are known: an ambient temperature, a set point, or a measurement
that is as good as exact. They are held over a step and travel with the input, as [u; s].
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.errors import ModelError
from tsobs_ros.model.fuzzy import RuleBase

_LARGEST = 1e100
"""Largest number of a model: products of two are finite."""


@dataclass(frozen=True, eq=False)
class TSModel:
    """The rules of a T–S system with a common output matrix.

    Attributes:
        A: State matrices, shape (r, n, n).
        B: Input matrices, shape (r, n, m); a single (n, m) serves every rule.
        C: Output matrix, shape (p, n).
        rule_base: Memberships of the q premise variables.
        premise: State to premise variables Z, shape (q, n).
        schedule: Scheduled signals to premise variables Z_s, shape (q, s); none by default.
        outputs: Output matrices Cᵢ of the rules, if they differ, shape (r, p, n). Estimators take C
            for all of them, and the difference Σ hᵢ(Cᵢ − C)x for a disturbance.

    Raises:
        ModelError: A matrix has the wrong shape; the text names it.
    """

    A: Array
    B: Array
    C: Array
    rule_base: RuleBase
    premise: Array
    schedule: Array = field(default_factory=lambda: np.zeros((0, 0)))
    outputs: Array | None = None

    def __post_init__(self) -> None:
        rules, q = self.rule_base.coded[0].shape
        n = _length("A", self.A, -1, 3)
        B = self.B if np.ndim(self.B) == 3 else np.repeat([self.B], rules, axis=0)
        schedule = self.schedule if np.size(self.schedule) else np.zeros((q, 0))
        checked = {
            "A": as_matrix("A", self.A, (rules, n, n)),
            "B": as_matrix("B", B, (rules, n, _length("B", B, -1, 3))),
            "C": as_matrix("C", self.C, (_length("C", self.C, 0, 2), n)),
            "premise": as_matrix("premise", self.premise, (q, n)),
            "schedule": as_matrix("schedule", schedule, (q, _length("schedule", schedule, -1, 2))),
        }
        if self.outputs is not None:
            checked["outputs"] = as_matrix("outputs", self.outputs, (rules, *checked["C"].shape))
        for name, matrix in checked.items():
            if np.abs(matrix).max(initial=0.0) > _LARGEST:
                raise ModelError(f"{name}: expected numbers up to {_LARGEST:g}, got a larger one")
            object.__setattr__(self, name, matrix)

    @property
    def rule_count(self) -> int:
        """Number of rules r."""
        return int(self.A.shape[0])

    @property
    def state_count(self) -> int:
        """Number of states n."""
        return int(self.A.shape[-1])

    @property
    def input_count(self) -> int:
        """Number of inputs m, scheduled signals not among them."""
        return int(self.B.shape[-1])

    @property
    def rule_outputs(self) -> Array:
        """Cᵢ of every rule, shape (r, p, n)."""
        same = np.repeat(self.C[np.newaxis], self.rule_count, axis=0)
        return same if self.outputs is None else self.outputs

    @cached_property
    def premise_known(self) -> bool:
        """Whether the premise is made of scheduled signals only, so that no estimate enters."""
        return not self.premise.any()

    @cached_property
    def rates(self) -> Array:
        """[Aᵢ Bᵢ] of every rule, shape (r, n, n + m)."""
        return np.concatenate([self.A, self.B], axis=-1)

    def weights(self, x: Array, held: Array) -> Array:
        """Return h(z), shape (..., r), for states (..., n) and held signals [u; s] (..., m + s)."""
        scheduled = held[..., self.input_count :]
        return self.rule_base.weights(x @ self.premise.T + scheduled @ self.schedule.T)

    def derivative(self, x: Array, held: Array) -> Array:
        """Return ẋ, shape (..., n), for states and held signals as of `weights`."""
        signals = np.concatenate([x, held[..., : self.input_count]], axis=-1)
        weights = self.weights(x, held)
        return np.asarray(np.einsum("...r,rnk,...k->...n", weights, self.rates, signals))


def _length(name: str, matrix: ArrayLike, axis: int, axes: int) -> int:
    """Return the length of an axis of a matrix with so many axes."""
    shape = np.shape(matrix)
    if len(shape) != axes:
        kind = "one matrix per rule, shape (r, ·, ·)" if axes == 3 else "a matrix"
        raise ModelError(f"{name}: expected {kind}, got shape {shape}")
    return int(shape[axis])
