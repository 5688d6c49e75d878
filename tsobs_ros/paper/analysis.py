# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Limits of the adaptive observer's structure for any T–S system; proofs in docs/method.md.

Proposition 1: the innovation is autonomous, e_y' = −L₂⁻¹(I + Σ hᵢH₂ᵢ) e_y without adaptation, and
the modes of every Aᵢ are unobservable in (A₁ᵢ, C̄). Proposition 2: (18)/(37) are feasible exactly
if the Aᵢ share a Lyapunov matrix with decay rates above α₁ᵢ, because on {C̄x̄ = 0} the error moves
by Aᵢ whatever the gains. Proposition 3: in the metric of P the effect of ΔA is orthogonal to
everything M Ξ can be, so the matching assumption holds for ΔA = 0 only.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.design.lyapunov import common_lyapunov, refutation_margin
from tsobs_ros.errors import ModelError
from tsobs_ros.model.detectability import HiddenMode, format_mode, hidden_modes
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.paper.augmentation import Augmentation

# Relative singular value that counts as zero in the PBH test. A pencil at a computed eigenvalue of
# a nearly defective matrix is only accurate to the square root of rounding.
_TOLERANCE = 1e-6
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


@dataclass(frozen=True)
class StabilityVerdict:
    """Proposition 2 on one system: is there a common Lyapunov matrix at given decay rates?

    Attributes:
        feasible: The answer.
        margin: The eigenvalue that proves it, as in `design.lyapunov.CommonLyapunov`.
        P: The Lyapunov matrix, shape (n, n); None if there is none.
        reason: One line for people.
        Z: The proof that there is none, shape (r, n, n); None if there is one.
    """

    feasible: bool
    margin: float
    P: Array | None
    reason: str
    Z: Array | None = None


@dataclass(frozen=True)
class Analysis:
    """The verdict on one model.

    Attributes:
        innovation: Proposition 1: the plant's influence on the innovation.
        modes: PBH test of the augmented pair, rule by rule.
        stability: Proposition 2: feasibility of the LMIs (37), with the proof.
        matching: Proposition 3: the part of ΔA that the adaptation can reproduce; None without an
            uncertainty or without a P.
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
    system: TSModel,
    alpha: ArrayLike | None = None,
    *,
    delta_A: ArrayLike | None = None,
    L: ArrayLike | None = None,
) -> Analysis:
    """Return the limits of the adaptive observer for a system with an arbitrary disturbance.

    Args:
        system: The T–S system.
        alpha: Bounds ‖ΔAᵢ‖ ≤ αᵢ, shape (r,); zero by default.
        delta_A: An uncertainty to try the matching assumption on, shape (r, n, n); αᵢI by
            default, and the answer is the same for all.
        L: Shape (n + p, p); [0; I] by default.

    Raises:
        ModelError: A matrix has the wrong shape, or E_L is singular.
        DesignError: Feasibility is too close to its border to be decided.

    >>> from tsobs_ros.model.arm import ElasticJointArm
    >>> from tsobs_ros.paper.examples import arm_system
    >>> analyse(arm_system(ElasticJointArm())).feasible
    False
    """
    augmentation = Augmentation(system, free_matrix=L)
    n, r = augmentation.state_count, augmentation.rule_count
    bounds = np.zeros(r) if alpha is None else np.asarray(alpha, dtype=np.float64)
    stability = check_stability(system.A, augmentation.alpha_1(bounds))
    change = bounds[:, None, None] * np.eye(n) if delta_A is None else np.asarray(delta_A)
    matching = None
    if stability.P is not None and change.any():
        # S⁻ᵀ diag(P, I) S⁻¹ with S = [T [0; I]] solves (37) for a P on {C̄x̄ = 0}.
        lifted = augmentation.C_bar.T @ augmentation.C_bar
        lifted[:n, :n] += stability.P
        matching = check_matching(augmentation, lifted, change)
    return Analysis(
        innovation=check_autonomous_innovation(augmentation),
        modes=tuple(augmented_modes(augmentation)),
        stability=stability,
        matching=matching,
    )


def augmented_modes(augmentation: Augmentation) -> list[RuleModes]:
    """Return the PBH test of (A₁ᵢ, C̄), rule by rule, with the hidden modes and their shapes."""
    found = []
    for rule, A in enumerate(augmentation.A1):
        hidden = tuple(hidden_modes(A, augmentation.C_bar, _TOLERANCE))
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


def check_stability(A: ArrayLike, rates: ArrayLike) -> StabilityVerdict:
    """Decide Proposition 2's question: has one P ≻ 0 AᵢᵀP + PAᵢ + 2 rateᵢ P ≺ 0 for every rule?

    Args:
        A: State matrices, shape (r, n, n).
        rates: Decay rates to exceed, α₁ᵢ, shape (r,) [1/s].

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
    margin, P, Z = common_lyapunov(shifted)
    if P is not None:
        reason = f"a common P exists, with largest eigenvalue {margin:.4g} (trace P = {n})"
        return StabilityVerdict(True, margin, P, reason)
    reason = (
        f"every rule decays fast enough alone, but no P serves all {r}: proved by Zᵢ ⪰ 0 with "
        f"Σ (AᵢZᵢ + ZᵢAᵢᵀ + 2α₁ᵢZᵢ) ⪰ {margin:.2g} and Σ tr Zᵢ = 1"
    )
    return StabilityVerdict(False, margin, None, reason, Z)


def _refuted_by_mode(shifted: Array, rule: int, mode: HiddenMode, rate: float) -> StabilityVerdict:
    Z = np.zeros_like(shifted)
    outer = np.real(np.outer(mode.shape, mode.shape.conj()))
    Z[rule] = outer / np.trace(outer)
    own = mode._replace(eigenvalue=mode.eigenvalue - rate)
    faster = f" faster than α₁ = {rate:.4g} 1/s" if rate > 0.0 else ""
    reason = (
        f"rule {rule + 1} has a mode that does not decay{faster}: eigenvalue "
        f"{format_mode(own, 'x')}"
    )
    return StabilityVerdict(False, refutation_margin(shifted, Z), None, reason, Z)


def check_matching(augmentation: Augmentation, P: ArrayLike, delta_A: ArrayLike) -> Proposition:
    """Check Proposition 3 on a system: how much of ΔA any Ξ can reproduce through M = P⁻¹C̄ᵀ.

    The number is the part of E_L⁻¹ΔĀ that the best Ξ leaves over, in the norm of P, at the rule
    with the least; by the proposition it is all of it, 1.

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
