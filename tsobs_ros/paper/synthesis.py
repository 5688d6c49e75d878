# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The method's own design procedure, its Steps 1–5 with Remark 3, for any T–S system.

    1  choose L                                    4  M = P⁻¹C̄ᵀ, H₁ᵢ = P⁻¹Qᵢ
    2  ε = max α₁ᵢ/(ξᵢ‖C̄‖)                          5  choose Γᵢ ≻ 0
    3  P, Qᵢ from (18)/(37), with ‖P⁻¹‖ ≥ ε (38)

The set of P with ‖P⁻¹‖ ≥ ε is not convex. As the paper does, P ⪰ I/ε is imposed and the trace is
minimised, which makes ‖P⁻¹‖ = ε up to the solver's tolerance; where the check falls short of the
bound by that tolerance, ε is stepped up and the problem solved again. The conditions do not change
when P and Qᵢ are multiplied by a number, so (38) never decides whether a design exists.
"""

import time
from importlib.metadata import version

import cvxpy as cp
import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, non_negative, positive
from tsobs_ros.design.record import SolverReport
from tsobs_ros.errors import DesignError, DetectabilityError
from tsobs_ros.model.fuzzy import TSSystem
from tsobs_ros.paper.adaptation import checked_gamma
from tsobs_ros.paper.augmentation import Augmentation
from tsobs_ros.paper.conditions import least_epsilon
from tsobs_ros.paper.records import AdaptiveDesign, StabilityVerdict
from tsobs_ros.paper.stability import common_lyapunov

EPSILON_STEP = 1e-3
"""Remark 3's step of ε, relative."""

INNOVATION_RATE = 20.0
"""Default of the decay asked of the innovation [1/s]. The slower it is, the longer the adaptive law
integrates what is left of the observer's own start, and the further Ξ̂ wanders from the truth."""

_MOST_STEPS = 20
_MARGIN = 0.02
"""How far below zero the left side of (18) is asked to be, times its natural size 1/ε."""

_GAIN_WEIGHT = 1e-2


def design_adaptive_observer(
    system: TSSystem,
    alpha: ArrayLike,
    xi: ArrayLike,
    *,
    Gamma: ArrayLike | None = None,
    L: ArrayLike | None = None,
    output_rule: int = 0,
    epsilon_step: float = EPSILON_STEP,
    innovation_rate: float = INNOVATION_RATE,
) -> AdaptiveDesign:
    """Run Steps 1–5.

    Args:
        system: The T–S system.
        alpha: Bounds ‖ΔAᵢ‖ ≤ αᵢ, shape (r,).
        xi: Bounds ‖Ξᵢ‖ ≤ ξᵢ, shape (r,).
        Gamma: Γᵢ, shape (r, p, p), or one for all rules, shape (p, p); the identity by default.
        L: Shape (n + p, p); [0; I] by default.
        output_rule: Index of the rule whose Cᵢ is the common C.
        epsilon_step: Relative step of ε.
        innovation_rate: Asked decay of the innovation [1/s], which (37) leaves open. It is asked
            for where P is smallest; elsewhere the rate may be lower by up to cond(P).

    Raises:
        ModelError: A matrix has the wrong shape, Γᵢ is not symmetric positive definite, or E_L
            is singular.
        DetectabilityError: No P exists; the text names the rule, the mode and what would help.
        DesignError: The solver failed, or its answer did not pass the re-check.
    """
    started = time.perf_counter()
    free = None if L is None else np.asarray(L, dtype=np.float64)
    augmentation = Augmentation(system, output_rule, free)
    r, p = augmentation.rule_count, augmentation.output_count
    gains = checked_gamma(np.eye(p) if Gamma is None else Gamma, r, p)
    positive("epsilon_step", epsilon_step)
    non_negative("innovation_rate", innovation_rate)
    bound = least_epsilon(augmentation, alpha, xi)
    alpha_1 = augmentation.alpha_1(alpha)
    verdict = common_lyapunov(system.A, alpha_1)
    if not verdict.feasible:
        raise DetectabilityError(explain_infeasible(verdict))
    # Without uncertainty ε is zero and (38) empty; any scale of P will do.
    epsilon = bound if bound > 0.0 else 1.0
    for step in range(1, _MOST_STEPS + 1):
        P, Q, status, iterations = _solve(augmentation, alpha_1, epsilon, innovation_rate)
        design = AdaptiveDesign(
            augmentation=augmentation,
            alpha=as_matrix("alpha", alpha, (r,)),
            xi=as_matrix("xi", xi, (r,)),
            epsilon=epsilon,
            steps=step,
            P=P,
            H1=np.asarray(np.linalg.solve(P, Q)),
            Gamma=gains,
            solver=SolverReport(
                name="Clarabel",
                version=f"{version('clarabel')} (cvxpy {version('cvxpy')})",
                status=status,
                iterations=iterations,
                seconds=round(time.perf_counter() - started, 3),
            ),
        )
        if design.conditions.holds:
            return design
        if any(condition.name != "(38)" for condition in design.conditions.failing):
            break
        epsilon *= 1.0 + epsilon_step
    raise DesignError(
        f"the solver answered {status!r}, but on re-checking: "
        + "; ".join(str(condition) for condition in design.conditions.failing)
    )


def explain_infeasible(verdict: StabilityVerdict) -> str:
    """Return why the method's conditions have no solution, and what would help."""
    return "\n".join(
        [
            "the adaptive observer cannot be designed: the error along C̄x̄ = 0 moves by Aᵢ, which "
            "no gain changes, and",
            f"  - {verdict.reason}",
            "what would help:",
            "  - damping that makes every Aᵢ decay faster than α₁ᵢ with one Lyapunov matrix (the "
            "estimate is then an open-loop simulation that forgets its start at that rate)",
            "  - a model of the disturbance (bias, gauss_markov, sinusoid, ramp) in place of an "
            "arbitrary one",
            "  - a sensor known to be clean",
        ]
    )


def _solve(
    augmentation: Augmentation, alpha_1: Array, epsilon: float, innovation_rate: float
) -> tuple[Array, Array, str, int]:
    """Return P, Qᵢ of (18)/(37) with P ⪰ I/ε, the solver's status and its iterations.

    Solved for εP and εQᵢ, whose size does not depend on ε.
    """
    r, size, p = augmentation.rule_count, augmentation.size, augmentation.output_count
    identity = np.eye(size)
    P = cp.Variable((size, size), symmetric=True)
    Q = [cp.Variable((size, p)) for _ in range(r)]
    C_bar = augmentation.C_bar
    # Only the part of the error that the output shows can be made to decay at will.
    seen = np.linalg.pinv(C_bar) @ C_bar
    decrease = _MARGIN * identity + 2.0 * innovation_rate * seen
    constraints = [P >> identity]
    for rule in range(r):
        product = P @ (augmentation.A1[rule] + alpha_1[rule] * identity)
        product = product - Q[rule] @ C_bar
        constraints.append(product + product.T + decrease << 0)
    # Qᵢ enters only through QᵢC̄ and could grow without bound; a small weight keeps it in reason.
    effort = sum(cp.sum_squares(each) for each in Q)
    problem = cp.Problem(cp.Minimize(cp.trace(P) + _GAIN_WEIGHT * effort), constraints)
    try:
        problem.solve(solver=cp.CLARABEL)
    except cp.SolverError as error:
        raise DesignError(f"the solver failed on (37): {error}") from error
    if P.value is None:
        raise DesignError(f"the solver answered {problem.status!r} for (37)")
    symmetric = 0.5 * (P.value + P.value.T) / epsilon
    gains = np.array([each.value for each in Q]) / epsilon
    return symmetric, gains, str(problem.status), int(problem.solver_stats.num_iters or 0)
