# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Propositions 1 to 3 on the adaptive observer's limits, checked on any T–S system.

docs/method.md has them with their proofs.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.design.lyapunov import CommonLyapunov, common_lyapunov, refutation_margin
from tsobs_ros.errors import ModelError
from tsobs_ros.model.detectability import HiddenMode, format_mode, hidden_modes
from tsobs_ros.paper.augmentation import Augmentation

# Relative singular value that counts as zero.
_TOLERANCE = 1e-6
_DECAYING = -1e-9


class Proposition(NamedTuple):
    """A proposition checked on one system.

    Attributes:
        name: E.g. "Proposition 1".
        statement: The proposition for this system.
        number: The number that decides it.
        holds: Whether it was confirmed to rounding.
    """

    name: str
    statement: str
    number: float
    holds: bool

    def __str__(self) -> str:
        return f"{self.name} ({'confirmed' if self.holds else 'NOT CONFIRMED'}): {self.statement}"


def check_autonomous_innovation(augmentation: Augmentation) -> Proposition:
    """Check Proposition 1 on a system.

    The number is the largest entry of C̄ E_L⁻¹ [I; 0], relative to ‖C̄‖‖E_L⁻¹‖: how strongly the
    plant, its input and its uncertainty drive the innovation.
    """
    aug, n = augmentation, augmentation.state_count
    gain = np.linalg.norm(aug.C_bar, 2) * np.linalg.norm(aug.E_L_inverse, 2)
    number = float(np.abs(aug.C_bar @ aug.E_L_inverse[:, :n]).max() / gain)
    invariance = aug.A1 @ aug.blind_basis - aug.blind_basis @ aug.system.A
    slip = float(np.abs(invariance).max() / np.linalg.norm(aug.A1, 2, axis=(1, 2)).max())
    return Proposition(
        "Proposition 1",
        f"the plant drives the innovation with relative gain {number:.1g}; {{C̄x̄ = 0}} is "
        f"invariant under every A₁ᵢ, which acts there as Aᵢ, to {slip:.1g}: all {n} modes of every "
        f"rule are unobservable",
        max(number, slip),
        max(number, slip) < 1e-10,
    )


def check_stability(A: ArrayLike, rates: ArrayLike) -> tuple[CommonLyapunov, str]:
    """Decide Proposition 2's question: has one P ≻ 0 AᵢᵀP + PAᵢ + 2 rateᵢ P ≺ 0 for every rule?

    Args:
        A: State matrices, shape (r, n, n).
        rates: Decay rates to exceed, α₁ᵢ, shape (r,) [1/s].

    Returns:
        The answer for Aᵢ + rateᵢ I with its proof, and a line for people.

    Raises:
        ModelError: A matrix has the wrong shape.
        DesignError: The problem is too close to the border for either proof.
    """
    r, n = np.shape(A)[0], np.shape(A)[-1]
    decays = as_matrix("rates", rates, (r,))
    shifted = as_matrix("A", A, (r, n, n)) + decays[:, None, None] * np.eye(n)
    for rule, matrix in enumerate(shifted):
        edge = _DECAYING * max(1.0, float(np.linalg.norm(matrix, 2)))
        # To a sensor without any signal every mode is hidden, which is Proposition 1.
        modes = hidden_modes(matrix, np.zeros((1, n)), _TOLERANCE)
        slow = [mode for mode in modes if mode.eigenvalue.real >= edge]
        if slow:
            # Rounding must not choose between modes that are equally slow.
            mode = max(slow, key=lambda m: (round(m.eigenvalue.real, 9), m.eigenvalue.imag))
            return _refuted_by_mode(shifted, rule, mode, float(decays[rule]))
    proof = common_lyapunov(shifted)
    if proof.P is not None:
        size = f"largest eigenvalue {proof.margin:.4g} (trace P = {n})"
        return proof, f"a common P exists, with {size}"
    return proof, (
        f"every rule decays fast enough alone, but no P serves all {r}: proved by Zᵢ ⪰ 0 with "
        f"Σ (AᵢZᵢ + ZᵢAᵢᵀ + 2α₁ᵢZᵢ) ⪰ {proof.margin:.2g} and Σ tr Zᵢ = 1"
    )


def _refuted_by_mode(
    shifted: Array, rule: int, mode: HiddenMode, rate: float
) -> tuple[CommonLyapunov, str]:
    Z = np.zeros_like(shifted)
    outer = np.real(np.outer(mode.shape, mode.shape.conj()))
    Z[rule] = outer / np.trace(outer)
    own = mode._replace(eigenvalue=mode.eigenvalue - rate)
    faster = f" faster than α₁ = {rate:.4g} 1/s" if rate > 0.0 else ""
    return CommonLyapunov(refutation_margin(shifted, Z), None, Z), (
        f"rule {rule + 1} has a mode that does not decay{faster}: eigenvalue "
        f"{format_mode(own, 'x')}"
    )


def check_matching(augmentation: Augmentation, P: ArrayLike, delta_A: ArrayLike) -> Proposition:
    """Check Proposition 3 on a system: how much of ΔA any Ξ can reproduce through M = P⁻¹C̄ᵀ.

    The number is the part of E_L⁻¹ΔĀ that the best Ξ leaves over, in the norm of P, at the rule
    with the least; by the proposition it is all of it, 1.

    Args:
        augmentation: The system in augmented form.
        P: Symmetric positive definite, shape (n + p, n + p).
        delta_A: ΔAᵢ, shape (r, n, n), not all zero.

    Raises:
        ModelError: P is not positive definite, or every ΔAᵢ is zero.
    """
    matrix = as_matrix("P", P, (augmentation.size, augmentation.size))
    root, M = _root(matrix), np.linalg.solve(matrix, augmentation.C_bar.T)
    n, r = augmentation.state_count, augmentation.rule_count
    driven = augmentation.E_L_inverse[:, :n] @ as_matrix("ΔA", delta_A, (r, n, n))
    changes = [root @ each for each in driven if each.any()]
    if not changes:
        raise ModelError("ΔA: expected at least one rule with an uncertainty, got zeros")
    number = min(
        float(np.linalg.norm(each - root @ M @ np.linalg.lstsq(root @ M, each, rcond=None)[0]))
        / float(np.linalg.norm(each))
        for each in changes
    )
    smallest = float(np.linalg.eigvalsh(augmentation.C_bar @ M)[0])
    return Proposition(
        "Proposition 3",
        f"the best Ξ reproduces {1.0 - number:.1g} of E_L⁻¹ΔĀ (C̄ P⁻¹C̄ᵀ has smallest eigenvalue "
        f"{smallest:.4g} > 0, while C̄ E_L⁻¹ΔĀ = 0): the matching assumption (15) holds for ΔA = 0 "
        f"only",
        number,
        smallest > 0.0 and abs(number - 1.0) < 1e-9,
    )


def uncertainty_factor(P: ArrayLike) -> float:
    """Return the least κ with |eᵀPΔA e| ≤ κ ‖ΔA‖ eᵀPe for every e and ΔA.

    It is (√c + 1/√c)/2 with c = cond(P) (Kantorovich's inequality), between 1 and √c; the term
    2α₁P of (18) takes it for 1.

    Raises:
        ModelError: P is not positive definite.
    """
    matrix = np.asarray(P, dtype=np.float64)
    _root(matrix)
    eigenvalues = np.linalg.eigvalsh(matrix)
    root = float(np.sqrt(eigenvalues[-1] / eigenvalues[0]))
    return (root + 1.0 / root) / 2.0


def _root(P: Array) -> Array:
    """Return R with P = RᵀR."""
    try:
        return np.asarray(np.linalg.cholesky(0.5 * (P + P.T)).T)
    except np.linalg.LinAlgError as error:
        raise ModelError(f"P: expected a positive definite matrix, got {P.tolist()}") from error
