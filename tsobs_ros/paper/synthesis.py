# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The method's own design procedure, its Steps 1–5, for any T–S system.

    1  choose L                                    4  M = P⁻¹C̄ᵀ, H₁ᵢ = P⁻¹Qᵢ
    2  ε = max α₁ᵢ/(ξᵢ‖C̄‖)                          5  choose Γᵢ ≻ 0
    3  P, Qᵢ from (18)/(37), with ‖P⁻¹‖ ≥ ε (38)

(18) and (37) do not change if P and Qᵢ are multiplied by a number, so (38) never decides whether a
design exists: the smallest P ⪰ I is divided by its smallest eigenvalue and by ε.
"""

from dataclasses import dataclass

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.feasibility import format_mode, undetectable_modes
from tsobs_ros.design.lyapunov import (
    CommonLyapunov,
    common_lyapunov,
    refutation_margin,
    smallest_lyapunov,
)
from tsobs_ros.errors import DesignError, DetectabilityError
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.paper.augmentation import Augmentation, Condition, check_conditions, failing

INNOVATION_RATE = 20.0
"""Required decay rate of the innovation [1/s], which (37) leaves open. The slower the decay, the
longer the adaptive law integrates the rest of the observer's own start, and the further Ξ̂ drifts.
The rate is required where P is smallest; in other directions it may be lower by up to cond(P)."""

_MARGIN = 0.02
"""Required distance of the left side of (18) below zero, for P ⪰ I."""


@dataclass(frozen=True)
class AdaptiveDesign:
    """A solution of the method's conditions, re-checked.

    Attributes:
        augmentation: The system in augmented form, with L (Step 1).
        epsilon: ε (Step 2).
        P: Shape (n + p, n + p) (Step 3).
        H1: H₁ᵢ, shape (r, n + p, p) (Step 4).
        M: P⁻¹C̄ᵀ, shape (n + p, p).
        conditions: Every condition, by eigenvalues of these matrices.
    """

    augmentation: Augmentation
    epsilon: float
    P: Array
    H1: Array
    M: Array
    conditions: dict[str, Condition]


def design_adaptive_observer(system: TSModel, alpha: Array, xi: Array) -> AdaptiveDesign:
    """Run Steps 1–4 for bounds ‖ΔAᵢ‖ ≤ αᵢ and ‖Ξᵢ‖ ≤ ξᵢ, shape (r,), with L = [0; I].

    Raises:
        DetectabilityError: No P exists; the text names the rule, the mode and what would help.
        DesignError: The solver failed, or its answer did not pass the re-check.

    >>> from tsobs_ros.paper.examples import example_1
    >>> example = example_1()
    >>> failing(design_adaptive_observer(example.system, example.alpha, example.xi).conditions)
    []
    """
    aug = Augmentation(system)
    alpha_1 = aug.alpha_1(alpha)
    proof, reason = check_stability(system.A, alpha_1)
    if proof.P is None:
        raise DetectabilityError(_INFEASIBLE.format(reason))
    epsilon, identity = aug.epsilon(alpha, xi), np.eye(len(aug.L))
    # Only the part of the error that is visible in the output can be made to decay at will.
    seen = np.linalg.pinv(aug.C_bar) @ aug.C_bar
    decrease = _MARGIN * identity + 2.0 * INNOVATION_RATE * seen
    smallest, Q = smallest_lyapunov(aug.A1 + alpha_1[:, None, None] * identity, aug.C_bar, decrease)
    # P is a little smaller than needed, so that rounding does not decide.
    P = smallest * ((1.0 - 1e-9) / (epsilon * np.linalg.eigvalsh(smallest)[0]))
    H1 = np.asarray(np.linalg.solve(smallest, Q))
    M = np.asarray(np.linalg.solve(P, aug.C_bar.T))
    conditions = check_conditions(aug, P, alpha_1, H1=H1, M=M, epsilon=epsilon)
    if lacking := failing(conditions):
        raise DesignError(
            "on re-checking the solver's answer these do not hold: "
            + ", ".join(f"{name}: {conditions[name].number:.6g}" for name in lacking)
        )
    return AdaptiveDesign(aug, epsilon, P, H1, M, conditions)


_INFEASIBLE = """\
the adaptive observer cannot be designed: the error along C̄x̄ = 0 moves by Aᵢ, which no gain
changes, and
  - {}
what would help:
  - damping that makes every Aᵢ decay faster than α₁ᵢ with one Lyapunov matrix (the estimate is
    then an open-loop simulation that forgets its start at that rate)
  - a model of the disturbance (bias, gauss_markov, sinusoid, ramp) in place of an arbitrary one
  - a sensor known to be clean"""


def check_stability(A: Array, rates: Array) -> tuple[CommonLyapunov, str]:
    """Decide Proposition 2's question: does one P ≻ 0 satisfy AᵢᵀP + PAᵢ + 2 rateᵢ P ≺ 0 for all i?

    Returns:
        The answer for Aᵢ + rateᵢ I, shapes (r, n, n) and (r,), with its proof, and a line in words.

    Raises:
        DesignError: The problem is too close to the border for either proof.
    """
    r, n = A.shape[:2]
    shifted = A + rates[:, None, None] * np.eye(n)
    for rule, matrix in enumerate(shifted):
        # With a sensor that has no signal, every mode is hidden, as in Proposition 1.
        if slow := undetectable_modes(matrix, np.zeros((1, n))):
            # Rounding must not choose between modes that are equally slow.
            mode = max(slow, key=lambda m: (round(m.eigenvalue.real, 9), m.eigenvalue.imag))
            Z, rate = np.zeros_like(shifted), float(rates[rule])
            outer = np.real(np.outer(mode.shape, mode.shape.conj()))
            Z[rule] = outer / np.trace(outer)
            own = mode._replace(eigenvalue=mode.eigenvalue - rate)
            faster = f" faster than α₁ = {rate:.4g} 1/s" if rate > 0.0 else ""
            return CommonLyapunov(refutation_margin(shifted, Z), None, Z), (
                f"rule {rule + 1} has a mode that does not decay{faster}: eigenvalue "
                f"{format_mode(own, 'x')}"
            )
    proof = common_lyapunov(shifted)
    if proof.P is not None:
        return proof, f"a common P exists, with largest eigenvalue {proof.margin:.4g}"
    return proof, (
        f"every rule decays fast enough alone, but no P serves all {r}: proved by Zᵢ ⪰ 0 with "
        f"Σ (AᵢZᵢ + ZᵢAᵢᵀ + 2α₁ᵢZᵢ) ⪰ {proof.margin:.2g} and Σ tr Zᵢ = 1"
    )
