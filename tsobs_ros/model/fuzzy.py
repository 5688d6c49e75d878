# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Takagi–Sugeno fuzzy systems: local linear models blended by normalised memberships."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, shown
from tsobs_ros.errors import ModelError

MembershipFunction = Callable[[Array], Array]
"""Grade in [0, ∞) of one premise variable, evaluated elementwise on an array."""


@dataclass(frozen=True)
class RuleBase:
    """The premises of a T–S system: for each rule one membership function a premise variable.

    The weight of rule i is hᵢ(z) = μᵢ(z) / Σ μ(z) with μᵢ(z) = Πⱼ μⱼᵢ(zⱼ), so that the weights
    are non-negative and sum to one.
    """

    rules: tuple[tuple[MembershipFunction, ...], ...]

    def __post_init__(self) -> None:
        if not self.rules or not self.rules[0]:
            raise ModelError("rules: expected at least one rule with one premise variable")
        lengths = {len(rule) for rule in self.rules}
        if len(lengths) != 1:
            raise ModelError(
                f"rules: every rule needs one membership function a premise variable, "
                f"got {[len(rule) for rule in self.rules]}"
            )

    @property
    def rule_count(self) -> int:
        """Number of rules r."""
        return len(self.rules)

    @property
    def premise_count(self) -> int:
        """Number of premise variables."""
        return len(self.rules[0])

    def weights(self, z: ArrayLike) -> Array:
        """Return the normalised rule weights h(z).

        Args:
            z: Premise variables, shape (..., premise_count).

        Returns:
            Weights, shape (..., r), each ≥ 0, summing to one.

        Raises:
            ModelError: z has the wrong last axis, a grade is negative or not finite, or no rule
                fires at some z.
        """
        premise = np.asarray(z, dtype=np.float64)
        if premise.ndim == 0 or premise.shape[-1] != self.premise_count:
            raise ModelError(
                f"z: expected a last axis of {self.premise_count} premise variables, "
                f"got shape {premise.shape}"
            )
        grades = np.stack([self._grade(index, premise) for index in range(self.rule_count)], -1)
        # A sum of huge grades overflows; dividing by a power of two loses no digit.
        largest = grades.max(axis=-1, keepdims=True)
        silent = np.argwhere(largest[..., 0] <= 0.0)
        if len(silent):
            where = premise[tuple(silent[0])].tolist()
            raise ModelError(f"memberships: no rule fires at z = {where}")
        shares = np.ldexp(grades, -np.frexp(largest)[1])
        return np.asarray(shares / shares.sum(axis=-1, keepdims=True))

    def _grade(self, rule: int, premise: Array) -> Array:
        """Return μᵢ(z), shape (...); the product of huge grades may be beyond all numbers."""
        grade = np.ones(premise.shape[:-1])
        for place, membership in enumerate(self.rules[rule]):
            one = np.asarray(membership(premise[..., place]), dtype=np.float64)
            if one.shape not in ((), grade.shape):
                raise ModelError(
                    f"membership of rule {rule + 1}: expected one grade an entry, "
                    f"shape {grade.shape}, got shape {one.shape}"
                )
            grade = grade * one
        wrong = ~((grade >= 0.0) & np.isfinite(grade))
        if wrong.any():
            raise ModelError(
                f"membership of rule {rule + 1}: expected finite grades of at least 0, "
                f"got {float(grade[wrong][0])!r}"
            )
        return grade


@dataclass(frozen=True)
class TSSystem:
    """A T–S fuzzy system ẋ = Σ hᵢ(z)(Aᵢx + Bᵢu), y = Σ hᵢ(z) Cᵢx (the paper's (2)–(3)).

    Attributes:
        A: State matrices, shape (r, n, n).
        B: Input matrices, shape (r, n, m).
        C: Output matrices, shape (r, p, n); they may differ from rule to rule.
        rule_base: Memberships of the premise variables z.
        premise: Maps a state or its estimate, shape (..., n), to z, shape (..., q).
    """

    A: Array
    B: Array
    C: Array
    rule_base: RuleBase
    premise: Callable[[Array], Array]

    def __post_init__(self) -> None:
        rules = self.rule_base.rule_count
        n = _last_axis("A", self.A)
        m = _last_axis("B", self.B)
        _last_axis("C", self.C)
        p = np.shape(self.C)[1]
        object.__setattr__(self, "A", as_matrix("A", self.A, (rules, n, n)))
        object.__setattr__(self, "B", as_matrix("B", self.B, (rules, n, m)))
        object.__setattr__(self, "C", as_matrix("C", self.C, (rules, p, n)))

    @classmethod
    def from_rules(
        cls,
        A: Sequence[ArrayLike],
        B: Sequence[ArrayLike],
        C: Sequence[ArrayLike],
        rule_base: RuleBase,
        premise: Callable[[Array], Array],
    ) -> "TSSystem":
        """Build a system from one matrix a rule; a single B or C serves every rule."""
        rules = rule_base.rule_count

        def stacked(name: str, matrices: Sequence[ArrayLike]) -> Array:
            if len(matrices) not in (1, rules):
                raise ModelError(f"{name}: expected 1 or {rules} matrices, got {len(matrices)}")
            shapes = {_shape(name, matrix) for matrix in matrices}
            if len(shapes) != 1:
                raise ModelError(f"{name}: every rule needs the same shape, got {sorted(shapes)}")
            repeated = list(matrices) * (rules if len(matrices) == 1 else 1)
            return np.array(repeated, dtype=np.float64)

        return cls(stacked("A", A), stacked("B", B), stacked("C", C), rule_base, premise)

    @property
    def state_count(self) -> int:
        """Number of states n."""
        return int(self.A.shape[-1])

    def blend(self, matrices: Array, z: ArrayLike) -> Array:
        """Return Σ hᵢ(z) Mᵢ for matrices of shape (r, a, b): shape (..., a, b)."""
        return np.asarray(np.einsum("...r,rab->...ab", self.rule_base.weights(z), matrices))

    def derivative(self, x: ArrayLike, u: ArrayLike, z: ArrayLike | None = None) -> Array:
        """Return ẋ.

        Args:
            x: State, shape (..., n).
            u: Input, shape (..., m).
            z: Premise variables, shape (..., q); taken from x by `premise` if not given.
        """
        state = np.asarray(x, dtype=np.float64)
        premise = self.premise(state) if z is None else z
        drift = np.einsum("...ab,...b->...a", self.blend(self.A, premise), state)
        forced = np.einsum("...ab,...b->...a", self.blend(self.B, premise), np.asarray(u, float))
        return np.asarray(drift + forced)

    def output(self, x: ArrayLike, z: ArrayLike | None = None) -> Array:
        """Return the undisturbed output Σ hᵢ(z) Cᵢx, shape (..., p)."""
        state = np.asarray(x, dtype=np.float64)
        premise = self.premise(state) if z is None else z
        return np.asarray(np.einsum("...ab,...b->...a", self.blend(self.C, premise), state))


def _shape(name: str, matrix: ArrayLike) -> tuple[int, ...]:
    try:
        return np.shape(matrix)
    except ValueError as error:
        raise ModelError(f"{name}: expected rows of equal length, got {shown(matrix)}") from error


def _last_axis(name: str, matrix: ArrayLike) -> int:
    shape = _shape(name, matrix)
    if len(shape) != 3:
        raise ModelError(f"{name}: expected one matrix a rule, shape (r, ·, ·), got {shape}")
    return shape[-1]
