# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The method's own design procedure, its Steps 1–5 with Remark 3, for any T–S system.

    1  choose L                                    4  M = P⁻¹C̄ᵀ, H₁ᵢ = P⁻¹Qᵢ
    2  ε = max α₁ᵢ/(ξᵢ‖C̄‖)                          5  choose Γᵢ ≻ 0
    3  P, Qᵢ from (18)/(37), with ‖P⁻¹‖ ≥ ε (38)

The set of P with ‖P⁻¹‖ ≥ ε is not convex. As in the paper, P ⪰ I/ε is imposed and the trace is
minimised, which makes ‖P⁻¹‖ = ε up to the solver's tolerance; if the check falls short of the
bound by that tolerance, ε is stepped up and the problem solved again. The conditions do not change
when P and Qᵢ are multiplied by a number, so (38) never decides whether a design exists.
"""

import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, non_negative
from tsobs_ros.design.lyapunov import smallest_lyapunov
from tsobs_ros.errors import DesignError, DetectabilityError
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.paper.analysis import check_stability
from tsobs_ros.paper.augmentation import Augmentation, Conditions, check_conditions
from tsobs_ros.paper.observer import INNOVATION_RATE, AugmentedObserver

# Remark 3's step of ε, relative, and the number of steps.
_EPSILON_STEP = 1e-3
_MAX_STEPS = 20

# How far below zero the left side of (18) is asked to be, times its natural size 1/ε.
_MARGIN = 0.02


@dataclass(frozen=True)
class AdaptiveDesign:
    """A solution of the method's conditions, re-checked.

    Attributes:
        augmentation: The system in augmented form, with L (Step 1).
        alpha: Bounds αᵢ, shape (r,).
        xi: Bounds ξᵢ, shape (r,).
        epsilon: The ε that was accepted (Step 2, Remark 3).
        steps: Number of ε tried.
        P: Shape (n + p, n + p) (Step 3).
        H1: H₁ᵢ, shape (r, n + p, p) (Step 4).
        Gamma: Γᵢ, shape (r, p, p) (Step 5).
        seconds: Time that the solver took [s].
    """

    augmentation: Augmentation
    alpha: Array
    xi: Array
    epsilon: float
    steps: int
    P: Array
    H1: Array
    Gamma: Array
    seconds: float

    @cached_property
    def M(self) -> Array:
        """P⁻¹C̄ᵀ, shape (n + p, p)."""
        return np.asarray(np.linalg.solve(self.P, self.augmentation.C_bar.T))

    @cached_property
    def conditions(self) -> Conditions:
        """Every condition, re-checked by eigenvalues from the stored matrices."""
        return check_conditions(
            self.augmentation,
            self.P,
            alpha_1=self.augmentation.alpha_1(self.alpha),
            H1=self.H1,
            M=self.M,
            epsilon=self.augmentation.min_epsilon(self.alpha, self.xi),
        )

    def observer(self, *, adapt: bool = True) -> AugmentedObserver:
        """Return the observer of Theorem 1, or of Theorem 2 if the Cᵢ differ.

        Args:
            adapt: Whether the uncertainty is estimated, within ‖Ξ̂ᵢ‖ ≤ ξᵢ.
        """
        laws = (self.Gamma, self.xi) if adapt else ()
        return AugmentedObserver(self.augmentation, self.H1, self.M, *laws)


def design_adaptive_observer(
    system: TSModel,
    alpha: ArrayLike,
    xi: ArrayLike,
    *,
    Gamma: ArrayLike | None = None,
    L: ArrayLike | None = None,
    innovation_rate: float = INNOVATION_RATE,
) -> AdaptiveDesign:
    """Run Steps 1–5.

    Args:
        system: The T–S system.
        alpha: Bounds ‖ΔAᵢ‖ ≤ αᵢ, shape (r,).
        xi: Bounds ‖Ξᵢ‖ ≤ ξᵢ, shape (r,).
        Gamma: Γᵢ ≻ 0, shape (r, p, p); the identity by default.
        L: Shape (n + p, p); [0; I] by default.
        innovation_rate: Asked decay of the innovation [1/s], which (37) leaves open. It is asked
            for in the direction of the smallest P; in others the rate may be lower by up to
            cond(P).

    Raises:
        ModelError: A matrix has the wrong shape, or E_L is singular.
        DetectabilityError: No P exists; the text names the rule, the mode and what would help.
        DesignError: The solver failed, or its answer did not pass the re-check.

    >>> from tsobs_ros.paper.examples import example_1
    >>> example = example_1()
    >>> design_adaptive_observer(example.system, example.alpha, example.xi).conditions.failing
    {}
    """
    started = time.perf_counter()
    augmentation = Augmentation(system, free_matrix=L)
    r, p = augmentation.rule_count, augmentation.output_count
    gains = as_matrix("Γ", [np.eye(p)] * r if Gamma is None else Gamma, (r, p, p))
    non_negative("innovation_rate", innovation_rate)
    bound = augmentation.min_epsilon(alpha, xi)
    alpha_1 = augmentation.alpha_1(alpha)
    proof, reason = check_stability(system.A, alpha_1)
    if proof.P is None:
        raise DetectabilityError(_explain_infeasible(reason))
    # Without uncertainty ε is zero and (38) empty; any scale of P will do.
    epsilon = bound if bound > 0.0 else 1.0
    C_bar, identity = augmentation.C_bar, np.eye(augmentation.size)
    # Only the part of the error that the output shows can be made to decay at will.
    seen = np.linalg.pinv(C_bar) @ C_bar
    decrease = _MARGIN * identity + 2.0 * innovation_rate * seen
    for step in range(1, _MAX_STEPS + 1):
        # Solved for εP and εQᵢ, whose size does not depend on ε.
        solution = smallest_lyapunov(
            augmentation.A1 + alpha_1[:, None, None] * identity, C_bar, decrease
        )
        P = solution.P / epsilon
        design = AdaptiveDesign(
            augmentation=augmentation,
            alpha=as_matrix("alpha", alpha, (r,)),
            xi=as_matrix("xi", xi, (r,)),
            epsilon=epsilon,
            steps=step,
            P=P,
            H1=np.asarray(np.linalg.solve(P, solution.Q / epsilon)),
            Gamma=gains,
            seconds=round(time.perf_counter() - started, 3),
        )
        failing = design.conditions.failing
        if not failing:
            return design
        if set(failing) != {"(38)"}:
            break
        epsilon *= 1.0 + _EPSILON_STEP
    raise DesignError(
        f"the solver answered {solution.status!r}, but on re-checking: "
        + "; ".join(f"{name}: {condition}" for name, condition in failing.items())
    )


def _explain_infeasible(reason: str) -> str:
    """Return why the method's conditions have no solution, and what would help."""
    return (
        "the adaptive observer cannot be designed: the error along C̄x̄ = 0 moves by Aᵢ, which no "
        f"gain changes, and\n  - {reason}\n"
        "what would help:\n"
        "  - damping that makes every Aᵢ decay faster than α₁ᵢ with one Lyapunov matrix (the "
        "estimate is then an open-loop simulation that forgets its start at that rate)\n"
        "  - a model of the disturbance (bias, gauss_markov, sinusoid, ramp) in place of an "
        "arbitrary one\n"
        "  - a sensor known to be clean"
    )
