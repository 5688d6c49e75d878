# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Proposition 2: (18)/(37) are feasible exactly if the Aᵢ share a Lyapunov matrix, decided here.

On {C̄x̄ = 0} the error of the adaptive observer moves by Aᵢ whatever the gains, so its conditions
come down to one n × n question: is there a P ≻ 0 with AᵢᵀP + PAᵢ + 2α₁ᵢP ≺ 0 for every rule? Either
answer is proved by a matrix that the solver returns and that is re-checked here by eigenvalues:

    yes:  P itself
    no:   Zᵢ ⪰ 0, not all zero, with Σ (Aᵢ + α₁ᵢI)Zᵢ + Zᵢ(Aᵢ + α₁ᵢI)ᵀ ⪰ 0, because then
          Σ tr Zᵢ(AᵢᵀP + PAᵢ + 2α₁ᵢP) = tr P Σ(…) ≥ 0 for every P ≻ 0, while (18) makes it negative.
"""

import cvxpy as cp
import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.errors import DesignError, ModelError
from tsobs_ros.model.detectability import HiddenMode, format_mode, hidden_modes
from tsobs_ros.paper.records import StabilityVerdict

_UNDECIDED = 1e-7
"""Relative eigenvalue below which neither answer counts as proved by its matrix."""


def common_lyapunov(A: ArrayLike, rates: ArrayLike) -> StabilityVerdict:
    """Decide whether one P ≻ 0 has AᵢᵀP + PAᵢ + 2 rateᵢ P ≺ 0 for every rule.

    Args:
        A: State matrices, shape (r, n, n).
        rates: Decay rates to exceed, α₁ᵢ, shape (r,) [1/s].

    Raises:
        ModelError: A matrix has the wrong shape.
        DesignError: The problem is too close to the border for either proof.
    """
    if np.ndim(A) != 3:
        raise ModelError(f"A: expected one matrix a rule, shape (r, n, n), got {np.shape(A)}")
    r, n = np.shape(A)[0], np.shape(A)[-1]
    matrices = as_matrix("A", A, (r, n, n))
    shifted = matrices + as_matrix("rates", rates, (r,))[:, None, None] * np.eye(n)
    slow = _slow_mode(shifted)
    if slow is not None:
        return _refuted_by_mode(shifted, np.asarray(rates, dtype=np.float64), *slow)
    P, Z = _solve(shifted)
    margin = max(float(np.linalg.eigvalsh(each)[-1]) for each in _products(shifted, P))
    size = float(np.linalg.norm(shifted, 2, axis=(1, 2)).max())
    if np.linalg.eigvalsh(P)[0] > 0.0 and margin < -_UNDECIDED * size:
        reason = f"a common P exists, with largest eigenvalue {margin:.4g} (trace P = {n})"
        return StabilityVerdict(True, margin, P, None, reason)
    refutation = _refutation_margin(shifted, Z)
    if refutation > -_UNDECIDED * size:
        reason = (
            f"every rule decays fast enough alone, but no P serves all {r}: proved by Zᵢ ⪰ 0 with "
            f"Σ (AᵢZᵢ + ZᵢAᵢᵀ + 2α₁ᵢZᵢ) ⪰ {refutation:.2g} and Σ tr Zᵢ = 1"
        )
        return StabilityVerdict(False, refutation, None, Z, reason)
    raise DesignError(
        f"common Lyapunov matrix: undecided, the solver's P gives {margin:.3g} (needs < 0) and its "
        f"Zᵢ give {refutation:.3g} (needs >= 0); change α₁ᵢ a little"
    )


def _slow_mode(shifted: Array) -> tuple[int, HiddenMode] | None:
    """Return the first rule with a mode that does not decay, its shape with n entries."""
    n = shifted.shape[-1]
    for rule, A in enumerate(shifted):
        edge = -1e-9 * max(1.0, float(np.linalg.norm(A, 2)))
        # A sensor that sees nothing: every mode is hidden, which is the point of Proposition 1.
        modes = [m for m in hidden_modes(A, np.zeros((1, n)), 1e-6) if m.eigenvalue.real >= edge]
        if modes:
            # Rounding must not choose between modes that are equally slow.
            return rule, max(modes, key=lambda m: (round(m.eigenvalue.real, 9), m.eigenvalue.imag))
    return None


def _refuted_by_mode(shifted: Array, rates: Array, rule: int, mode: HiddenMode) -> StabilityVerdict:
    Z = np.zeros_like(shifted)
    outer = np.real(np.outer(mode.shape, mode.shape.conj()))
    Z[rule] = outer / np.trace(outer)
    own = mode._replace(eigenvalue=mode.eigenvalue - rates[rule])
    faster = f" faster than α₁ = {rates[rule]:.4g} 1/s" if rates[rule] > 0.0 else ""
    reason = (
        f"rule {rule + 1} has a mode that does not decay{faster}: eigenvalue "
        f"{format_mode(own, 'x')}"
    )
    return StabilityVerdict(False, _refutation_margin(shifted, Z), None, Z, reason)


def _solve(shifted: Array) -> tuple[Array, Array]:
    """Minimise the largest eigenvalue over P ⪰ 0, trace P = n; return P and the duals Zᵢ."""
    n = shifted.shape[-1]
    P = cp.Variable((n, n), symmetric=True)
    largest = cp.Variable()
    decreases = []
    for A in shifted:
        product = P @ A
        decreases.append(largest * np.eye(n) - product - product.T >> 0)
    problem = cp.Problem(cp.Minimize(largest), [P >> 0, cp.trace(P) == n, *decreases])
    try:
        problem.solve(solver=cp.CLARABEL)
    except cp.SolverError as error:
        raise DesignError(f"common Lyapunov matrix: the solver failed: {error}") from error
    if P.value is None or any(each.dual_value is None for each in decreases):
        raise DesignError(f"common Lyapunov matrix: the solver answered {problem.status!r}")
    Z = np.array([0.5 * (each.dual_value + each.dual_value.T) for each in decreases])
    # Rounding leaves eigenvalues just below zero; the proof needs Zᵢ ⪰ 0 exactly.
    values, vectors = np.linalg.eigh(Z)
    Z = vectors * np.maximum(values, 0.0)[:, None, :] @ vectors.transpose(0, 2, 1)
    return 0.5 * (P.value + P.value.T), np.asarray(Z / np.trace(Z, axis1=1, axis2=2).sum())


def _products(shifted: Array, P: Array) -> Array:
    product = P @ shifted
    return np.asarray(product + product.transpose(0, 2, 1))


def _refutation_margin(shifted: Array, Z: Array) -> float:
    total = (shifted @ Z + Z @ shifted.transpose(0, 2, 1)).sum(axis=0)
    return float(np.linalg.eigvalsh(0.5 * (total + total.T))[0])
