# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Descriptor augmentation of an adaptive T–S observer, and the conditions on its solutions.

With x̄ = [x; ω] and one output matrix C chosen among the Cᵢ, the system reads (the method's (5)–(8))

    Ē x̄' = Āᵢ x̄ + B̄ᵢ u + N y − N C̄₀ x̄ ,     y = C̄ x̄ ,     C̄ = [C I],  C̄₀ = [C 0],  N = [0; I]

and L ẏ added on both sides makes E_L = Ē + L C̄ invertible. The conditions of Theorems 1 and 2 are

    (18), (37)   A₁ᵢᵀP + P A₁ᵢ − C̄ᵀQᵢᵀ − QᵢC̄ + 2α₁ᵢP ≺ 0 ,  Qᵢ = P H₁ᵢ ,  P = Pᵀ ≻ 0
    (19)         P M = C̄ᵀ
    (38)         ‖P⁻¹‖ ≥ ε ,  ε = max α₁ᵢ/(ξᵢ‖C̄‖)

Without gains, (18) is checked on {C̄x̄ = 0}, on which Qᵢ drops out: by Finsler's lemma some Qᵢ
satisfies it if and only if it holds there.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.errors import ModelError
from tsobs_ros.model.ts_model import TSModel

# Reciprocal condition number below which E_L counts as singular.
_SINGULAR = 1e-12
# Relative margin below which a strict inequality cannot be distinguished from equality.
_STRICT = 1e-9


class Augmentation:
    """A T–S system with the disturbance of its outputs as additional states.

    Attributes:
        system: The T–S system; n states, m inputs, p outputs, r rules.
        state_count: n.
        output_count: p, also of disturbances.
        rule_count: r.
        size: n + p.
        C: The common output matrix, that of the first rule, shape (p, n).
        C_bar: C̄ = [C I], shape (p, n + p).
        blind_basis: T = [I; −C], a basis of {x̄ : C̄x̄ = 0}, shape (n + p, n).
        L: The free matrix, shape (n + p, p).
        E_L: Ē + L C̄, shape (n + p, n + p).
        E_L_inverse: E_L⁻¹.
        A1: A₁ᵢ = E_L⁻¹(Āᵢ − N C̄₀), shape (r, n + p, n + p).
        B1: E_L⁻¹B̄ᵢ with B̄ᵢ = [Bᵢ; 0], shape (r, n + p, m).
        N1: E_L⁻¹N, shape (n + p, p).
        L1: E_L⁻¹L, what the output adds to the observer's own state, shape (n + p, p). It is [0; I]
            whatever L is: E_L w = L v gives L₂(C̄w − v) = 0, hence C̄w = v and w_x = 0.
    """

    def __init__(self, system: TSModel, free_matrix: ArrayLike | None = None) -> None:
        """Augment a system.

        Args:
            system: The T–S system.
            free_matrix: L, shape (n + p, p); [0; I] by default.

        Raises:
            ModelError: L has another shape, or E_L is singular.
        """
        r, n, p = system.rule_count, system.state_count, len(system.C)
        self.system = system
        self.rule_count, self.state_count, self.output_count, self.size = r, n, p, n + p
        self.C: Array = np.asarray(system.rule_outputs[0])
        self.C_bar: Array = np.hstack([self.C, np.eye(p)])
        self.blind_basis: Array = np.vstack([np.eye(n), -self.C])
        self.L = as_matrix(
            "L", np.eye(n + p, p, -n) if free_matrix is None else free_matrix, (n + p, p)
        )
        self.E_L: Array = np.diag([1.0] * n + [0.0] * p) + self.L @ self.C_bar
        singular = np.linalg.svd(self.E_L, compute_uv=False)
        if singular[-1] < _SINGULAR * singular[0]:
            raise ModelError(
                f"L: expected E_L = Ē + L C̄ to be invertible, which needs an invertible lower "
                f"({p}, {p}) block; got E_L with singular values {singular[0]:.3g} to "
                f"{singular[-1]:.3g} for the lower block {self.L[n:].tolist()}"
            )
        A0 = np.zeros((r, n + p, n + p))
        A0[:, :n, :n], A0[:, n:] = system.A, -self.C_bar
        self.E_L_inverse: Array = np.asarray(np.linalg.inv(self.E_L))
        self.A1: Array = self.E_L_inverse @ A0
        self.B1: Array = self.E_L_inverse[:, :n] @ system.B
        self.N1: Array = self.E_L_inverse[:, n:]
        self.L1: Array = self.E_L_inverse @ self.L

    def alpha_1(self, alpha: ArrayLike) -> Array:
        """Return α₁ᵢ = ‖E_L⁻¹‖ αᵢ ≥ ‖E_L⁻¹ΔĀᵢ‖, shape (r,), for bounds ‖ΔAᵢ‖ ≤ αᵢ.

        The product is the method's choice: it reproduces its printed ε to .02 %.
        """
        bounds = as_matrix("alpha", alpha, (self.rule_count,))
        if (bounds < 0.0).any():
            raise ModelError(f"alpha: expected bounds of at least 0, got {bounds.tolist()}")
        return np.asarray(np.linalg.norm(self.E_L_inverse, 2) * bounds)

    def min_epsilon(self, alpha: ArrayLike, xi: ArrayLike) -> float:
        """Return ε = max α₁ᵢ/(ξᵢ‖C̄‖), the start of the method's Remark 3.

        Args:
            alpha: Bounds ‖ΔAᵢ‖ ≤ αᵢ, shape (r,).
            xi: Bounds ‖Ξᵢ‖ ≤ ξᵢ, shape (r,); zero only if αᵢ is.

        Raises:
            ModelError: A shape is wrong, a bound is negative, or ξᵢ = 0 with αᵢ > 0.
        """
        alpha_1 = self.alpha_1(alpha)
        limits = as_matrix("xi", xi, (self.rule_count,))
        if (limits < 0.0).any() or (limits[alpha_1 > 0.0] == 0.0).any():
            raise ModelError(
                "xi: expected bounds above 0 for every rule with alpha above 0, "
                f"got {limits.tolist()}"
            )
        ratios = alpha_1[limits > 0.0] / limits[limits > 0.0]
        return float(ratios.max(initial=0.0) / np.linalg.norm(self.C_bar, 2))


def blend(matrices: Array, weights: Array, vector: Array) -> Array:
    """Return Σ hᵢ Mᵢ v: (r, a, b), (..., r) and (..., b) to (..., a)."""
    blended = np.einsum("...r,rab->...ab", weights, matrices)
    return np.asarray(np.einsum("...ab,...b->...a", blended, vector))


class Condition(NamedTuple):
    """One condition with the number that decides it.

    Attributes:
        number: The computed number.
        limit: The number it is compared with.
        upper: Whether the number must be below the limit; else it must be at least the limit.
    """

    number: float
    limit: float
    upper: bool = True

    @property
    def holds(self) -> bool:
        """Whether the condition holds; false for NaN."""
        return self.number < self.limit if self.upper else self.number >= self.limit

    def __str__(self) -> str:
        relation = "<" if self.upper else ">="
        verdict = "holds" if self.holds else "DOES NOT HOLD"
        return f"{verdict}, {self.number:.6g} (needs {relation} {self.limit:.6g})"


class Conditions(dict[str, Condition]):
    """The conditions of a solution by equation number and rule, e.g. "(37) rule 2"."""

    @property
    def failing(self) -> dict[str, Condition]:
        """Those that do not hold; empty for a solution."""
        return {name: each for name, each in self.items() if not each.holds}


def check_conditions(
    augmentation: Augmentation,
    P: ArrayLike,
    *,
    alpha_1: ArrayLike,
    H1: ArrayLike | None = None,
    M: ArrayLike | None = None,
    epsilon: float = 0.0,
    rounding: float = 1e-9,
) -> Conditions:
    """Check a solution by eigenvalues; a condition that fails raises nothing.

    Args:
        augmentation: The system in augmented form.
        P: Shape (n + p, n + p).
        alpha_1: α₁ᵢ, shape (r,).
        H1: Gains H₁ᵢ, shape (r, n + p, p); without them (18) is checked on {C̄x̄ = 0}.
        M: Shape (n + p, p); without it (19) is left out.
        epsilon: ε of (38); zero leaves it out.
        rounding: Largest ‖P M − C̄ᵀ‖ that counts as zero.

    Raises:
        ModelError: A matrix has the wrong shape.
    """
    size, r, p = augmentation.size, augmentation.rule_count, augmentation.output_count
    matrix = as_matrix("P", P, (size, size))
    rates = as_matrix("alpha_1", alpha_1, (r,))
    symmetric = 0.5 * (matrix + matrix.T)
    scale = float(np.linalg.norm(symmetric, 2))
    smallest = float(np.linalg.eigvalsh(symmetric)[0])
    asymmetry = float(np.abs(matrix - matrix.T).max())
    conditions = Conditions()
    conditions["P symmetric"] = Condition(asymmetry, max(1e-12 * scale, 1e-300))
    conditions["P positive definite"] = Condition(smallest, _STRICT * scale, upper=False)
    A, basis = augmentation.A1, np.linalg.qr(augmentation.blind_basis)[0]
    if H1 is not None:
        A, basis = A - as_matrix("H₁", H1, (r, size, p)) @ augmentation.C_bar, np.eye(size)
    for rule in range(r):
        product = symmetric @ (A[rule] + rates[rule] * np.eye(size))
        decrease = basis.T @ (product + product.T) @ basis
        margin = _STRICT * max(scale, float(np.linalg.norm(decrease, 2)))
        largest = float(np.linalg.eigvalsh(decrease)[-1])
        conditions[f"(37) rule {rule + 1}"] = Condition(largest, -margin)
    if M is not None:
        residual = symmetric @ as_matrix("M", M, (size, p)) - augmentation.C_bar.T
        conditions["(19)"] = Condition(float(np.linalg.norm(residual, 2)), rounding)
    if epsilon > 0.0:
        norm = 1.0 / smallest if smallest > 0.0 else float("nan")
        conditions["(38)"] = Condition(norm, epsilon, upper=False)
    return conditions
