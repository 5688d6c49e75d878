# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Descriptor augmentation of an adaptive T–S observer, the conditions on its solutions, its limits.

With x̄ = [x; ω] and one output matrix C chosen among the Cᵢ, the system reads (the method's (5)–(8))

    Ē x̄' = Āᵢ x̄ + B̄ᵢ u + N y − N C̄₀ x̄ ,     y = C̄ x̄ ,     C̄ = [C I],  C̄₀ = [C 0],  N = [0; I]

and adding L ẏ on both sides makes E_L = Ē + L C̄ invertible. The conditions of Theorems 1 and 2 are

    (18), (37)   A₁ᵢᵀP + P A₁ᵢ − C̄ᵀQᵢᵀ − QᵢC̄ + 2α₁ᵢP ≺ 0 ,  Qᵢ = P H₁ᵢ ,  P = Pᵀ ≻ 0
    (19)         P M = C̄ᵀ
    (38)         ‖P⁻¹‖ ≥ ε ,  ε = max α₁ᵢ/(ξᵢ‖C̄‖)

Without gains, (18) is checked on {C̄x̄ = 0}, where Qᵢ drops out: by Finsler's lemma, some Qᵢ
satisfies (18) if and only if it holds there. docs/method.md has the propositions with their proofs.
"""

from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.model.ts_model import TSModel

_STRICT = 1e-9
"""Relative margin below which a strict inequality cannot be distinguished from equality."""


class Augmentation:
    """A T–S system with the disturbance of its outputs as additional states.

    Attributes:
        system: The T–S system; n states, m inputs, p outputs, r rules.
        C: The common output matrix, that of the first rule, shape (p, n).
        C_bar: C̄ = [C I], shape (p, n + p).
        blind_basis: T = [I; −C], a basis of {x̄ : C̄x̄ = 0}, shape (n + p, n).
        L: The free matrix, shape (n + p, p); its lower p rows are invertible.
        E_L_inverse: (Ē + L C̄)⁻¹, shape (n + p, n + p).
        A1: A₁ᵢ = E_L⁻¹(Āᵢ − N C̄₀), shape (r, n + p, n + p).
        B1: E_L⁻¹B̄ᵢ with B̄ᵢ = [Bᵢ; 0], shape (r, n + p, m).
        N1: E_L⁻¹N, shape (n + p, p).
        L1: E_L⁻¹L, which maps the output to x̂̄ − ξ (see `observer`), shape (n + p, p). It is [0; I]
            for every L: E_L w = L v gives L₂(C̄w − v) = 0, hence C̄w = v and w_x = 0.
    """

    def __init__(self, system: TSModel, L: Array | None = None) -> None:
        """Augment a system; L is [0; I] by default."""
        r, n, p = system.rule_count, system.state_count, len(system.C)
        self.system = system
        self.C: Array = np.asarray(system.rule_outputs[0])
        self.C_bar: Array = np.hstack([self.C, np.eye(p)])
        self.blind_basis: Array = np.vstack([np.eye(n), -self.C])
        self.L: Array = np.eye(n + p, p, -n) if L is None else L
        E_L = np.diag([1.0] * n + [0.0] * p) + self.L @ self.C_bar
        A0 = np.zeros((r, n + p, n + p))
        A0[:, :n, :n], A0[:, n:] = system.A, -self.C_bar
        self.E_L_inverse: Array = np.asarray(np.linalg.inv(E_L))
        self.A1: Array = self.E_L_inverse @ A0
        self.B1: Array = self.E_L_inverse[:, :n] @ system.B
        self.N1: Array = self.E_L_inverse[:, n:]
        self.L1: Array = self.E_L_inverse @ self.L

    def alpha_1(self, alpha: Array) -> Array:
        """Return α₁ᵢ = ‖E_L⁻¹‖ αᵢ ≥ ‖E_L⁻¹ΔĀᵢ‖, shape (r,), for bounds ‖ΔAᵢ‖ ≤ αᵢ.

        The product is the method's choice: it reproduces its printed ε to .02 %.
        """
        return np.asarray(np.linalg.norm(self.E_L_inverse, 2) * alpha)

    def epsilon(self, alpha: Array, xi: Array) -> float:
        """Return the least ε = max α₁ᵢ/(ξᵢ‖C̄‖) for bounds ‖ΔAᵢ‖ ≤ αᵢ, ‖Ξᵢ‖ ≤ ξᵢ, shape (r,)."""
        return float((self.alpha_1(alpha) / xi).max() / np.linalg.norm(self.C_bar, 2))


def blend(matrices: Array, weights: Array, vector: Array) -> Array:
    """Return Σ hᵢ Mᵢ v: (..., r, a, b), (..., r) and (..., b) to (..., a)."""
    return np.asarray(np.einsum("...rab,...r,...b->...a", matrices, weights, vector))


class Condition(NamedTuple):
    """A condition: the number that decides it, and whether it holds."""

    number: float
    holds: bool


def check_conditions(
    aug: Augmentation,
    P: Array,
    alpha_1: Array,
    *,
    H1: Array | None = None,
    M: Array | None = None,
    epsilon: float = 0.0,
    rounding: float = 1e-9,
) -> dict[str, Condition]:
    """Return the conditions of a solution by equation and rule, checked by eigenvalues.

    Args:
        aug: The system in augmented form.
        P: Symmetric, shape (n + p, n + p).
        alpha_1: α₁ᵢ, shape (r,).
        H1: Gains H₁ᵢ, shape (r, n + p, p); without them (18) is checked on {C̄x̄ = 0}.
        M: Shape (n + p, p); without it (19) is left out.
        epsilon: ε of (38); zero leaves it out.
        rounding: Largest ‖P M − C̄ᵀ‖ that counts as zero.
    """
    scale, smallest = float(np.linalg.norm(P, 2)), float(np.linalg.eigvalsh(P)[0])
    conditions = {"P positive definite": Condition(smallest, smallest >= _STRICT * scale)}
    A, basis = aug.A1, np.linalg.qr(aug.blind_basis)[0]
    if H1 is not None:
        A, basis = A - H1 @ aug.C_bar, np.eye(len(P))
    for rule, (matrix, rate) in enumerate(zip(A, alpha_1, strict=True)):
        product = P @ (matrix + rate * np.eye(len(P)))
        decrease = basis.T @ (product + product.T) @ basis
        margin = _STRICT * max(scale, float(np.linalg.norm(decrease, 2)))
        largest = float(np.linalg.eigvalsh(decrease)[-1])
        conditions[f"(37) rule {rule + 1}"] = Condition(largest, largest < -margin)
    if M is not None:
        residual = float(np.linalg.norm(P @ M - aug.C_bar.T, 2))
        conditions["(19)"] = Condition(residual, residual < rounding)
    if epsilon > 0.0:
        norm = 1.0 / smallest
        conditions["(38)"] = Condition(norm, norm >= epsilon)
    return conditions


def failing(conditions: dict[str, Condition]) -> list[str]:
    """Return the names of the conditions that do not hold; none for a solution."""
    return [name for name, each in conditions.items() if not each.holds]


def innovation_drive(aug: Augmentation) -> float:
    """Return how strongly the plant, its input and its uncertainty drive the innovation.

    It is the largest entry of C̄ E_L⁻¹ [I; 0], relative to ‖C̄‖‖E_L⁻¹‖: 0 by Proposition 1.
    """
    gain = np.linalg.norm(aug.C_bar, 2) * np.linalg.norm(aug.E_L_inverse, 2)
    return float(np.abs(aug.C_bar @ aug.E_L_inverse[:, : aug.system.state_count]).max() / gain)


def unmatched_share(aug: Augmentation, P: Array, delta_A: Array) -> float:
    """Return the share of E_L⁻¹ΔĀ that the best Ξ cannot match, for the rule with the least share.

    By Proposition 3 the share is 1 in the norm of P, with M = P⁻¹C̄ᵀ: nothing is matched.
    """
    root = np.linalg.cholesky(P).T
    reached = root @ np.linalg.solve(P, aug.C_bar.T)
    shares = []
    for change in root @ aug.E_L_inverse[:, : len(delta_A[0])] @ delta_A:
        best = reached @ np.linalg.lstsq(reached, change, rcond=None)[0]
        shares.append(float(np.linalg.norm(change - best) / np.linalg.norm(change)))
    return min(shares)


def uncertainty_factor(P: Array) -> float:
    """Return the least κ with |eᵀPΔA e| ≤ κ ‖ΔA‖ eᵀPe for every e and ΔA.

    It is (√c + 1/√c)/2 with c = cond(P) (Proposition 5); the term 2α₁P of (18) assumes 1.
    """
    root = float(np.sqrt(np.linalg.cond(P)))
    return (root + 1.0 / root) / 2.0
