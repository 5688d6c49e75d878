# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the adaptive observer can do for a model: one call, one verdict that people can read."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array
from tsobs_ros.model.fuzzy import TSSystem
from tsobs_ros.paper.analysis import (
    Proposition,
    RuleModes,
    augmented_modes,
    check_autonomous_innovation,
    check_matching,
)
from tsobs_ros.paper.augmentation import Augmentation
from tsobs_ros.paper.records import StabilityVerdict
from tsobs_ros.paper.stability import common_lyapunov


@dataclass(frozen=True)
class Analysis:
    """The verdict on one model.

    Attributes:
        innovation: Proposition 1: what drives the innovation.
        modes: PBH test of the augmented pair, rule by rule.
        stability: Proposition 2: whether the LMIs (37) have a solution, with the proof.
        matching: Proposition 3: what the adaptation can reproduce; None without a solution, to
            have a P from, or without an uncertainty.
    """

    innovation: Proposition
    modes: tuple[RuleModes, ...]
    stability: StabilityVerdict
    matching: Proposition | None

    @property
    def feasible(self) -> bool:
        """Whether the method's observer can be designed at all."""
        return self.stability.feasible

    def __str__(self) -> str:
        answer = "FEASIBLE" if self.feasible else "INFEASIBLE"
        lines = [str(self.innovation), *(str(modes) for modes in self.modes)]
        lines.append(f"Proposition 2: (37) is {answer}: {self.stability.reason}")
        if self.matching is not None:
            lines.append(str(self.matching))
        return "\n".join(lines)


def analyse(
    system: TSSystem,
    alpha: ArrayLike | None = None,
    *,
    delta_A: ArrayLike | None = None,
    L: ArrayLike | None = None,
    output_rule: int = 0,
) -> Analysis:
    """Return what the adaptive observer can do for a T–S system with an arbitrary disturbance.

    Args:
        system: The T–S system.
        alpha: Bounds ‖ΔAᵢ‖ ≤ αᵢ, shape (r,); zero by default.
        delta_A: An uncertainty to try the matching assumption on, shape (r, n, n); by default
            αᵢI, and as the answer is the same for all, any will do.
        L: Shape (n + p, p); [0; I] by default.
        output_rule: Index of the rule whose Cᵢ is the common C.

    Raises:
        ModelError: A matrix has the wrong shape, or E_L is singular.
        DesignError: Feasibility is too close to its border to be decided.
    """
    free = None if L is None else np.asarray(L, dtype=np.float64)
    augmentation = Augmentation(system, output_rule, free)
    n, r = augmentation.state_count, augmentation.rule_count
    bounds = np.zeros(r) if alpha is None else np.asarray(alpha, dtype=np.float64)
    alpha_1 = augmentation.alpha_1(bounds)
    stability = common_lyapunov(system.A, alpha_1)
    change = bounds[:, None, None] * np.eye(n) if delta_A is None else np.asarray(delta_A)
    matching = None
    if stability.P is not None and change.any():
        P = _lifted(augmentation, stability.P)
        matching = check_matching(augmentation, P, change)
    return Analysis(
        innovation=check_autonomous_innovation(augmentation),
        modes=tuple(augmented_modes(augmentation)),
        stability=stability,
        matching=matching,
    )


def _lifted(augmentation: Augmentation, P: Array) -> Array:
    """Return S⁻ᵀ diag(P, I) S⁻¹, S = [T [0; I]]: a solution of (37) from one on {C̄x̄ = 0}."""
    n, p = augmentation.state_count, augmentation.output_count
    to_blind = np.hstack([np.eye(n), np.zeros((n, p))])
    C_bar = augmentation.C_bar
    return np.asarray(to_blind.T @ P @ to_blind + C_bar.T @ C_bar)
