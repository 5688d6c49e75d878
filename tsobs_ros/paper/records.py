# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Answers of the method's design problems, with what proves them; usable without a solver."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.record import SolverReport
from tsobs_ros.paper.augmentation import Augmentation
from tsobs_ros.paper.conditions import ConditionReport, check_conditions, least_epsilon
from tsobs_ros.paper.observer import AugmentedObserver


@dataclass(frozen=True)
class StabilityVerdict:
    """Whether matrices share a Lyapunov matrix at given decay rates, with the proof.

    Attributes:
        feasible: The answer.
        margin: Feasible: the largest eigenvalue of AᵢᵀP + PAᵢ + 2α₁ᵢP over the rules, negative,
            with trace P = n. Else the smallest eigenvalue of Σ (Aᵢ + α₁ᵢI)Zᵢ + Zᵢ(…)ᵀ with
            Σ tr Zᵢ = 1, not negative but for rounding.
        P: The Lyapunov matrix, shape (n, n); None if there is none.
        Z: The proof that there is none, shape (r, n, n); None if there is one.
        reason: One line for people.
    """

    feasible: bool
    margin: float
    P: Array | None
    Z: Array | None
    reason: str


@dataclass(frozen=True)
class AdaptiveDesign:
    """A solution of the method's conditions, re-checked.

    Attributes:
        augmentation: The system in augmented form, with L (Step 1).
        alpha: Bounds αᵢ, shape (r,).
        xi: Bounds ξᵢ, shape (r,).
        epsilon: The ε that was accepted (Step 2, Remark 3).
        steps: How many ε were tried.
        P: Shape (n + p, n + p) (Step 3).
        H1: H₁ᵢ, shape (r, n + p, p) (Step 4).
        Gamma: Γᵢ, shape (r, p, p) (Step 5).
        solver: Who computed P and Qᵢ; nothing is trusted because of it.
    """

    augmentation: Augmentation
    alpha: Array
    xi: Array
    epsilon: float
    steps: int
    P: Array
    H1: Array
    Gamma: Array
    solver: SolverReport

    @cached_property
    def M(self) -> Array:
        """P⁻¹C̄ᵀ, shape (n + p, p)."""
        return np.asarray(np.linalg.solve(self.P, self.augmentation.C_bar.T))

    @cached_property
    def conditions(self) -> ConditionReport:
        """Every condition, re-checked by eigenvalues from the stored matrices."""
        return check_conditions(
            self.augmentation,
            self.P,
            alpha_1=self.augmentation.alpha_1(self.alpha),
            H1=self.H1,
            M=self.M,
            epsilon=least_epsilon(self.augmentation, self.alpha, self.xi),
        )

    def observer(self, *, adapt: bool = True, project: bool = True) -> AugmentedObserver:
        """Return the observer of Theorem 1, or 2 where the Cᵢ differ.

        Args:
            adapt: Whether the uncertainty is estimated.
            project: Whether its estimates are kept within ‖Ξ̂ᵢ‖ ≤ ξᵢ.
        """
        return AugmentedObserver(
            self.augmentation,
            self.H1,
            self.M,
            self.Gamma if adapt else None,
            self.xi if adapt and project else None,
        )
