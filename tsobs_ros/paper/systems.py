# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The T–S fuzzy systems of the method, and the arm as one of them.

Their outputs may differ from rule to rule, which the certified observers' `TSModel` does not know.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, shown
from tsobs_ros.core.functions import evaluate
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.fuzzy import RuleBase, membership


@dataclass(frozen=True)
class TSSystem:
    """A T–S fuzzy system ẋ = Σ hᵢ(z)(Aᵢx + Bᵢu), y = Σ hᵢ(z) Cᵢx (the paper's (2)–(3)).

    Attributes:
        A: State matrices, shape (r, n, n).
        B: Input matrices, shape (r, n, m).
        C: Output matrices, shape (r, p, n); they may differ from rule to rule.
        rule_base: Memberships of the premise variables z.
    """

    A: Array
    B: Array
    C: Array
    rule_base: RuleBase

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

        return cls(stacked("A", A), stacked("B", B), stacked("C", C), rule_base)

    @property
    def state_count(self) -> int:
        """Number of states n."""
        return int(self.A.shape[-1])

    def output(self, x: ArrayLike, z: ArrayLike) -> Array:
        """Return the undisturbed output Σ hᵢ(z) Cᵢx, shape (..., p)."""
        return blend(self.C, self.rule_base.weights(z), np.asarray(x, dtype=np.float64))


def blend(matrices: Array, weights: Array, vector: Array) -> Array:
    """Return Σ hᵢ Mᵢ v: (r, a, b), (..., r) and (..., b) to (..., a)."""
    blended = np.einsum("...r,rab->...ab", weights, matrices)
    return np.asarray(np.einsum("...ab,...b->...a", blended, vector))


def arm_system(arm: ElasticJointArm, x_max: float = math.pi / 2) -> TSSystem:
    """Return the two-rule T–S form of an arm, equal to it wherever |q₁| ≤ x_max.

    Sector nonlinearity: sin q₁ = (h₁·1 + h₂·b) q₁ with b = sin(x_max)/x_max, the paper's
    (48)–(49) at x_max = π/2.

    Args:
        arm: The nonlinear arm.
        x_max: Half width of the domain [rad], 0 < x_max < π.

    Raises:
        ModelError: The half width is out of range.
    """
    if not 0.0 < x_max < math.pi:
        raise ModelError(f"x_max: expected 0 < x_max < π, got {x_max!r}")
    return TSSystem.from_rules(
        A=[arm.slope_matrix(1.0), arm.slope_matrix(evaluate("sine", x_max).item() / x_max)],
        B=[arm.input_matrix],
        C=[arm.output_matrix],
        rule_base=RuleBase(
            tuple(
                (membership(name, {"half_width": x_max}),) for name in ("sine_upper", "sine_lower")
            )
        ),
    )


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
