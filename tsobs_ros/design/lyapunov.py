# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Common Lyapunov matrices of several systems, by semidefinite programming (cvxpy with Clarabel).

A common P ≻ 0 with AᵢᵀP + PAᵢ ≺ 0 for every i either exists or not. Matrices prove either answer,
and their eigenvalues are re-checked:

    yes:  P itself
    no:   Zᵢ ⪰ 0, not all zero, with Σ AᵢZᵢ + ZᵢAᵢᵀ ⪰ 0, because then
          Σ tr Zᵢ(AᵢᵀP + PAᵢ) = tr P Σ(AᵢZᵢ + ZᵢAᵢᵀ) ≥ 0 for every P ≻ 0
"""

from typing import NamedTuple

import cvxpy as cp
import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.errors import DesignError

_WEIGHT = 1e-2
"""The weight w of the gains in `smallest_lyapunov`."""

_UNDECIDED = 1e-7
"""Relative eigenvalue below which a matrix proves neither answer."""


class CommonLyapunov(NamedTuple):
    """P, shape (n, n), of trace n, or a proof that there is none: Z, shape (r, n, n), of traces 1.

    `margin` is the largest eigenvalue of all AᵢᵀP + PAᵢ, which is negative; or the smallest one of
    Σ AᵢZᵢ + ZᵢAᵢᵀ, which is not negative except for rounding.
    """

    margin: float
    P: Array | None
    Z: Array | None


def common_lyapunov(A: Array) -> CommonLyapunov:
    """Decide whether one P ≻ 0 has AᵢᵀP + PAᵢ ≺ 0 for every matrix of A, shape (r, n, n).

    Raises:
        DesignError: The solver failed, or the problem is too close to the border for a proof.

    >>> common_lyapunov(np.array([[[-1.0, 0.5], [0.0, -2.0]]])).P is not None
    True
    """
    n = A.shape[-1]
    variable, largest = cp.Variable((n, n), symmetric=True), cp.Variable()
    products = [variable @ matrix for matrix in A]
    decreases = [largest * np.eye(n) - product - product.T >> 0 for product in products]
    constraints = [variable >> 0, cp.trace(variable) == n, *decreases]
    _solve(cp.Problem(cp.Minimize(largest), constraints), "common Lyapunov matrix")
    P = 0.5 * (variable.value + variable.value.T)
    sums = P @ A + (P @ A).transpose(0, 2, 1)
    margin = float(np.linalg.eigvalsh(sums).max())
    size = float(np.linalg.norm(A, 2, axis=(1, 2)).max())
    if np.linalg.eigvalsh(P)[0] > 0.0 and margin < -_UNDECIDED * size:
        return CommonLyapunov(margin, P, None)
    duals = np.array([0.5 * (each.dual_value + each.dual_value.T) for each in decreases])
    values, vectors = np.linalg.eigh(duals)  # rounding leaves eigenvalues just below zero
    Z = vectors * np.maximum(values, 0.0)[:, None, :] @ vectors.transpose(0, 2, 1)
    Z = np.asarray(Z / np.trace(Z, axis1=1, axis2=2).sum())
    refutation = refutation_margin(A, Z)
    if refutation > -_UNDECIDED * size:
        return CommonLyapunov(refutation, None, Z)
    raise DesignError(
        f"common Lyapunov matrix: undecided, the solver's P gives {margin:.3g} (needs < 0) and its "
        f"Zᵢ give {refutation:.3g} (needs >= 0); change the decay rates a little"
    )


def refutation_margin(A: Array, Z: Array) -> float:
    """Return the smallest eigenvalue of Σ AᵢZᵢ + ZᵢAᵢᵀ; both of shape (r, n, n)."""
    total = (A @ Z + Z @ A.transpose(0, 2, 1)).sum(axis=0)
    return float(np.linalg.eigvalsh(0.5 * (total + total.T))[0])


def smallest_lyapunov(M: Array, C: Array, D: Array) -> tuple[Array, Array]:
    """Return P ⪰ I and Qᵢ with sym(P Mᵢ − Qᵢ C) + D ⪯ 0 and the least tr P + w Σ ‖Qᵢ‖².

    Here sym(X) = X + Xᵀ. M has the shape (r, n, n), C (p, n), and D, the inequalities' margin,
    (n, n). Qᵢ enters only as QᵢC and could grow without bound; the weight w prevents that.

    Returns:
        P of shape (n, n) and Q of shape (r, n, p).

    Raises:
        DesignError: The solver failed or found no solution.
    """
    n, p = M.shape[-1], C.shape[0]
    P = cp.Variable((n, n), symmetric=True)
    Q = [cp.Variable((n, p)) for _ in M]
    products = [P @ matrix - gain @ C for matrix, gain in zip(M, Q, strict=True)]
    constraints = [P >> np.eye(n), *(each + each.T + D << 0 for each in products)]
    effort = sum(cp.sum_squares(each) for each in Q)
    problem = cp.Problem(cp.Minimize(cp.trace(P) + _WEIGHT * effort), constraints)
    _solve(problem, "smallest Lyapunov matrix")
    return 0.5 * (P.value + P.value.T), np.array([each.value for each in Q])


def _solve(problem: cp.Problem, what: str) -> None:
    try:
        problem.solve(solver=cp.CLARABEL)
    except cp.SolverError as error:
        raise DesignError(f"{what}: the solver failed: {error}") from error
    if problem.variables()[0].value is None:
        raise DesignError(f"{what}: the solver answered {problem.status!r}")
