# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The conditions of the method's Theorems 1 and 2, checked by eigenvalues on given matrices.

    (18), (37)   A₁ᵢᵀP + P A₁ᵢ − C̄ᵀQᵢᵀ − QᵢC̄ + 2α₁ᵢP ≺ 0 ,  Qᵢ = P H₁ᵢ ,  P = Pᵀ ≻ 0
    (19)         P M = C̄ᵀ
    (38)         ‖P⁻¹‖ ≥ ε ,  ε = max α₁ᵢ/(ξᵢ‖C̄‖)

Without gains, (18) is checked on {C̄x̄ = 0}, where Qᵢ drops out: by Finsler's lemma some Qᵢ
satisfies it if and only if it holds there.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.errors import ModelError
from tsobs_ros.paper.augmentation import Augmentation

_STRICT = 1e-9
"""Relative margin below which a strict inequality is not told from equality."""


class Condition(NamedTuple):
    """One condition with the number that decides it.

    Attributes:
        name: Its equation number and rule, e.g. "(37) rule 2".
        number: What was computed.
        limit: What it is compared with.
        upper: Whether the number must be below the limit; else at least the limit.
    """

    name: str
    number: float
    limit: float
    upper: bool

    @property
    def holds(self) -> bool:
        """Whether the condition holds; false for NaN."""
        return self.number < self.limit if self.upper else self.number >= self.limit

    def __str__(self) -> str:
        relation = "<" if self.upper else ">="
        verdict = "holds" if self.holds else "DOES NOT HOLD"
        return f"{self.name}: {verdict}, {self.number:.6g} (needs {relation} {self.limit:.6g})"


@dataclass(frozen=True)
class ConditionReport:
    """All conditions of a solution, in the order they were checked."""

    conditions: tuple[Condition, ...]

    @property
    def holds(self) -> bool:
        """Whether every condition holds."""
        return all(condition.holds for condition in self.conditions)

    @property
    def failing(self) -> tuple[Condition, ...]:
        """The conditions that do not hold."""
        return tuple(condition for condition in self.conditions if not condition.holds)

    def __getitem__(self, name: str) -> Condition:
        """Return a condition by its name.

        Raises:
            KeyError: There is none of that name.
        """
        for condition in self.conditions:
            if condition.name == name:
                return condition
        raise KeyError(name)

    def __str__(self) -> str:
        return "\n".join(str(condition) for condition in self.conditions)


def least_epsilon(augmentation: Augmentation, alpha: ArrayLike, xi: ArrayLike) -> float:
    """Return ε = max α₁ᵢ/(ξᵢ‖C̄‖), where the method's Remark 3 starts.

    Args:
        augmentation: The system in augmented form.
        alpha: Bounds ‖ΔAᵢ‖ ≤ αᵢ, shape (r,).
        xi: Bounds ‖Ξᵢ‖ ≤ ξᵢ, shape (r,); zero only where αᵢ is.

    Raises:
        ModelError: A shape is wrong, a bound is negative, or ξᵢ = 0 with αᵢ > 0.
    """
    alpha_1 = augmentation.alpha_1(alpha)
    limits = as_matrix("xi", xi, (augmentation.rule_count,))
    if (limits < 0.0).any() or (limits[alpha_1 > 0.0] == 0.0).any():
        raise ModelError(
            f"xi: expected bounds above 0 for every rule with alpha above 0, got {limits.tolist()}"
        )
    ratios = alpha_1[limits > 0.0] / limits[limits > 0.0]
    return float(ratios.max(initial=0.0) / np.linalg.norm(augmentation.C_bar, 2))


def check_conditions(
    augmentation: Augmentation,
    P: ArrayLike,
    *,
    alpha_1: ArrayLike,
    H1: ArrayLike | None = None,
    M: ArrayLike | None = None,
    epsilon: float = 0.0,
    rounding: float = 1e-9,
) -> ConditionReport:
    """Check a solution by eigenvalues; nothing is raised for a condition that fails.

    Args:
        augmentation: The system in augmented form.
        P: Shape (n + p, n + p).
        alpha_1: α₁ᵢ, shape (r,).
        H1: Gains H₁ᵢ, shape (r, n + p, p); without them (18) is checked on {C̄x̄ = 0}.
        M: Shape (n + p, p); without it (19) is left out.
        epsilon: ε of (38); zero leaves it out.
        rounding: Largest ‖P M − C̄ᵀ‖ that counts as zero.

    Raises:
        ModelError: A matrix has the wrong shape.
    """
    size, r, p = augmentation.size, augmentation.rule_count, augmentation.output_count
    matrix = as_matrix("P", P, (size, size))
    rates = as_matrix("alpha_1", alpha_1, (r,))
    asymmetry = float(np.abs(matrix - matrix.T).max())
    symmetric = 0.5 * (matrix + matrix.T)
    scale = float(np.linalg.norm(symmetric, 2))
    smallest = float(np.linalg.eigvalsh(symmetric)[0])
    conditions = [
        Condition("P symmetric", asymmetry, max(1e-12 * scale, 1e-300), True),
        Condition("P positive definite", smallest, _STRICT * scale, False),
    ]
    gains = None if H1 is None else as_matrix("H₁", H1, (r, size, p))
    for rule in range(r):
        decrease = _decrease(augmentation, symmetric, rule, float(rates[rule]), gains)
        margin = -_STRICT * max(scale, float(np.linalg.norm(decrease, 2)))
        largest = float(np.linalg.eigvalsh(decrease)[-1])
        conditions.append(Condition(f"(37) rule {rule + 1}", largest, margin, True))
    if M is not None:
        residual = symmetric @ as_matrix("M", M, (size, p)) - augmentation.C_bar.T
        conditions.append(Condition("(19)", float(np.linalg.norm(residual, 2)), rounding, True))
    if epsilon > 0.0:
        norm = 1.0 / smallest if smallest > 0.0 else float("nan")
        conditions.append(Condition("(38)", norm, epsilon, False))
    return ConditionReport(tuple(conditions))


def _decrease(
    augmentation: Augmentation, P: Array, rule: int, alpha_1: float, gains: Array | None
) -> Array:
    """Return the left side of (18) for one rule, restricted to {C̄x̄ = 0} without gains."""
    A = augmentation.A1[rule]
    if gains is not None:
        A = A - gains[rule] @ augmentation.C_bar
    product = P @ (A + alpha_1 * np.eye(augmentation.size))
    left = product + product.T
    if gains is not None:
        return np.asarray(left)
    basis = np.linalg.qr(augmentation.blind_basis)[0]
    return np.asarray(basis.T @ left @ basis)
