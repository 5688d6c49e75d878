# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the adaptive observer's structure allows, for any T–S system; proofs in docs/method.md.

Proposition 1: the innovation is autonomous, e_y' = −L₂⁻¹(I + Σ hᵢH₂ᵢ) e_y without adaptation, and
the modes of every Aᵢ are unobservable in (A₁ᵢ, C̄). Proposition 3: in the metric of P the effect of
ΔA is orthogonal to everything M Ξ can be, so the matching assumption holds for ΔA = 0 only.
Proposition 2, on feasibility, needs a solver: `tsobs_ros.paper.stability`.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.errors import ModelError
from tsobs_ros.model.detectability import HiddenMode, format_mode, hidden_modes
from tsobs_ros.paper.augmentation import Augmentation

_TOLERANCE = 1e-6
"""Relative singular value that counts as zero in the PBH test. A pencil at a computed eigenvalue of
a nearly defective matrix is only accurate to the square root of rounding."""

_DECAYING = -1e-9


class RuleModes(NamedTuple):
    """The modes of one rule's augmented pair (A₁ᵢ, C̄) that the output does not show.

    Attributes:
        rule: Index of the rule, from 0.
        hidden: Unobservable modes; their shapes have n + p entries, [x; ω].
        persistent: Those of them that do not decay: with one of them, no observer converges.
    """

    rule: int
    hidden: tuple[HiddenMode, ...]
    persistent: tuple[HiddenMode, ...]

    @property
    def detectable(self) -> bool:
        """Whether every hidden mode decays."""
        return not self.persistent

    def __str__(self) -> str:
        verdict = "detectable" if self.detectable else "NOT DETECTABLE"
        shown = [mode for mode in self.hidden if mode.eigenvalue.imag > -1e-9]
        modes = "; ".join(format_mode(mode) for mode in shown) or "none"
        return f"rule {self.rule + 1}: {verdict}; hidden modes (one of each pair): {modes}"


@dataclass(frozen=True)
class Proposition:
    """A proposition checked on one system.

    Attributes:
        name: E.g. "Proposition 1".
        statement: What it says about this system.
        number: The number that decides it.
        holds: Whether it was confirmed to rounding.
    """

    name: str
    statement: str
    number: float
    holds: bool

    def __str__(self) -> str:
        return f"{self.name} ({'confirmed' if self.holds else 'NOT CONFIRMED'}): {self.statement}"


def augmented_modes(augmentation: Augmentation, tolerance: float = _TOLERANCE) -> list[RuleModes]:
    """Return the PBH test of (A₁ᵢ, C̄), rule by rule, with the hidden modes and their shapes."""
    found = []
    for rule, A in enumerate(augmentation.A1):
        hidden = tuple(hidden_modes(A, augmentation.C_bar, tolerance))
        edge = _DECAYING * max(1.0, float(np.abs(np.linalg.eigvals(A)).max()))
        persistent = tuple(mode for mode in hidden if mode.eigenvalue.real >= edge)
        found.append(RuleModes(rule, hidden, persistent))
    return found


def check_autonomous_innovation(augmentation: Augmentation) -> Proposition:
    """Check Proposition 1 on a system.

    The number is the largest entry of C̄ E_L⁻¹ [I; 0], relative to ‖C̄‖‖E_L⁻¹‖: how strongly the
    plant, its input and its uncertainty drive the innovation.
    """
    n, C_bar = augmentation.state_count, augmentation.C_bar
    gain = np.linalg.norm(C_bar, 2) * np.linalg.norm(augmentation.E_L_inverse, 2)
    drive = C_bar @ augmentation.E_L_inverse[:, :n]
    number = float(np.abs(drive).max() / gain)
    basis = augmentation.blind_basis
    invariance = augmentation.A1 @ basis - basis @ augmentation.system.A
    slip = float(np.abs(invariance).max() / np.linalg.norm(augmentation.A1, 2, axis=(1, 2)).max())
    return Proposition(
        "Proposition 1",
        f"the plant drives the innovation with relative gain {number:.1g}; {{C̄x̄ = 0}} is "
        f"invariant under every A₁ᵢ, which acts there as Aᵢ, to {slip:.1g}: all {n} modes of every "
        f"rule are unobservable",
        max(number, slip),
        max(number, slip) < 1e-10,
    )


def innovation_rate(augmentation: Augmentation, H1: ArrayLike, weights: ArrayLike) -> Array:
    """Return F with e_y' = −F e_y without adaptation, F = L₂⁻¹(I + Σ hᵢH₂ᵢ), shape (p, p).

    Args:
        augmentation: The system in augmented form.
        H1: Gains H₁ᵢ = E_L⁻¹Hᵢ, shape (r, n + p, p).
        weights: Rule weights h, shape (r,).
    """
    r, p = augmentation.rule_count, augmentation.output_count
    gains = as_matrix("H₁", H1, (r, augmentation.size, p))
    blended = np.tensordot(as_matrix("weights", weights, (r,)), gains, axes=1)
    assert augmentation.L is not None
    lower = np.linalg.inv(augmentation.L[augmentation.state_count :])
    return np.asarray(lower + augmentation.C_bar @ blended)


def check_matching(augmentation: Augmentation, P: ArrayLike, delta_A: ArrayLike) -> Proposition:
    """Check Proposition 3 on a system: how much of ΔA any Ξ can reproduce through M = P⁻¹C̄ᵀ.

    The number is the part of E_L⁻¹ΔĀ that the best Ξ leaves over, in the norm of P, at the rule
    where it is smallest; the proposition says it is all of it, 1.

    Args:
        augmentation: The system in augmented form.
        P: Symmetric positive definite, shape (n + p, n + p).
        delta_A: ΔAᵢ, shape (r, n, n), not all zero.

    Raises:
        ModelError: P is not symmetric positive definite, or every ΔAᵢ is zero.
    """
    size = augmentation.size
    matrix = as_matrix("P", P, (size, size))
    root = _root(matrix)
    M = np.linalg.solve(matrix, augmentation.C_bar.T)
    changes = [each for each in augmentation.augmented_uncertainty(delta_A) if each.any()]
    if not changes:
        raise ModelError("ΔA: expected at least one rule with an uncertainty, got zeros")
    left_over = []
    for change in changes:
        Xi = np.linalg.lstsq(root @ M, root @ change, rcond=None)[0]
        left_over.append(
            float(np.linalg.norm(root @ (change - M @ Xi)) / np.linalg.norm(root @ change))
        )
    smallest = float(np.linalg.eigvalsh(augmentation.C_bar @ M)[0])
    number = min(left_over)
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
        ModelError: P is not symmetric positive definite.
    """
    matrix = np.asarray(P, dtype=np.float64)
    _root(matrix)
    eigenvalues = np.linalg.eigvalsh(matrix)
    root = float(np.sqrt(eigenvalues[-1] / eigenvalues[0]))
    return (root + 1.0 / root) / 2.0


def worst_uncertainty(P: ArrayLike) -> tuple[Array, Array]:
    """Return ΔA of unit norm and e for which the bound of `uncertainty_factor` is attained."""
    values, vectors = np.linalg.eigh(np.asarray(P, dtype=np.float64))
    e = vectors[:, -1] / np.sqrt(values[-1]) + vectors[:, 0] / np.sqrt(values[0])
    image = np.asarray(P) @ e
    delta_A = np.outer(image / np.linalg.norm(image), e / np.linalg.norm(e))
    return delta_A, np.asarray(e)


def _root(P: Array) -> Array:
    """Return R with P = RᵀR."""
    if float(np.abs(P - P.T).max()) > 1e-9 * float(np.abs(P).max()):
        raise ModelError(
            f"P: expected a symmetric matrix, got one unsymmetric by {np.abs(P - P.T).max():.3g}"
        )
    try:
        return np.asarray(np.linalg.cholesky(0.5 * (P + P.T)).T)
    except np.linalg.LinAlgError as error:
        smallest = float(np.linalg.eigvalsh(0.5 * (P + P.T))[0])
        raise ModelError(
            f"P: expected a positive definite matrix, got smallest eigenvalue {smallest:.6g}"
        ) from error
