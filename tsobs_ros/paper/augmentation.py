# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The descriptor augmentation of the adaptive T–S observer: the disturbance as p more states.

With x̄ = [x; ω] and one output matrix C chosen among the Cᵢ, the system reads (the method's (5)–(8))

    Ē x̄' = Āᵢ x̄ + B̄ᵢ u + N y − N C̄₀ x̄ ,     y = C̄ x̄ ,     C̄ = [C I],  C̄₀ = [C 0],  N = [0; I]

and L ẏ added on both sides makes E_L = Ē + L C̄ invertible. `Augmentation` holds what follows from
that choice; A₁ᵢ = E_L⁻¹(Āᵢ − N C̄₀) and its kin are what the design and the observer work with.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.errors import ModelError
from tsobs_ros.model.fuzzy import RuleBase, TSSystem

_SINGULAR = 1e-12
"""Reciprocal condition number below which E_L counts as singular."""

_PARTITION = 1e-9


@dataclass(frozen=True)
class Augmentation:
    """A T–S system with the disturbance of its outputs as additional states.

    Attributes:
        system: The T–S system; n states, m inputs, p outputs, r rules.
        output_rule: Index of the rule whose Cᵢ serves as the common C.
        L: The free matrix, shape (n + p, p); [0; I] if not given.

    Raises:
        ModelError: There is no such rule, L has another shape, or E_L is singular.
    """

    system: TSSystem
    output_rule: int = 0
    L: Array | None = None

    def __post_init__(self) -> None:
        n, p = self.state_count, self.output_count
        if not 0 <= self.output_rule < self.rule_count:
            raise ModelError(
                f"output_rule: expected 0 to {self.rule_count - 1}, got {self.output_rule!r}"
            )
        free = np.vstack([np.zeros((n, p)), np.eye(p)]) if self.L is None else self.L
        object.__setattr__(self, "L", as_matrix("L", free, (n + p, p)))
        singular = np.linalg.svd(self.E_L, compute_uv=False)
        if singular[-1] < _SINGULAR * singular[0]:
            raise ModelError(
                f"L: expected E_L = Ē + L C̄ to be invertible, which needs an invertible lower "
                f"({p}, {p}) block; got E_L with singular values {singular[0]:.3g} to "
                f"{singular[-1]:.3g} for the lower block {self._lower_L.tolist()}"
            )

    @property
    def rule_count(self) -> int:
        """Number of rules r."""
        return self.system.rule_base.rule_count

    @property
    def state_count(self) -> int:
        """Number of states n of the system itself."""
        return self.system.state_count

    @property
    def output_count(self) -> int:
        """Number of outputs p, and of disturbances."""
        return int(self.system.C.shape[1])

    @property
    def size(self) -> int:
        """Length n + p of the augmented state."""
        return self.state_count + self.output_count

    @property
    def C(self) -> Array:
        """The common output matrix, shape (p, n)."""
        return np.asarray(self.system.C[self.output_rule])

    @cached_property
    def C_bar(self) -> Array:
        """C̄ = [C I], shape (p, n + p)."""
        return np.hstack([self.C, np.eye(self.output_count)])

    @cached_property
    def E_L(self) -> Array:
        """Ē + L C̄, shape (n + p, n + p)."""
        n, p = self.state_count, self.output_count
        assert self.L is not None
        return np.asarray(block_diag(np.eye(n), np.zeros((p, p))) + self.L @ self.C_bar)

    @cached_property
    def E_L_inverse(self) -> Array:
        """E_L⁻¹, shape (n + p, n + p)."""
        return np.asarray(np.linalg.inv(self.E_L))

    @property
    def _lower_L(self) -> Array:
        assert self.L is not None
        return self.L[self.state_count :]

    @cached_property
    def A0(self) -> Array:
        """A₀ᵢ = Āᵢ − N C̄₀, shape (r, n + p, n + p)."""
        n, p, r = self.state_count, self.output_count, self.rule_count
        matrices = np.zeros((r, n + p, n + p))
        matrices[:, :n, :n] = self.system.A
        matrices[:, n:] = -self.C_bar
        return matrices

    @cached_property
    def A1(self) -> Array:
        """A₁ᵢ = E_L⁻¹A₀ᵢ, shape (r, n + p, n + p)."""
        return np.asarray(self.E_L_inverse @ self.A0)

    @cached_property
    def B1(self) -> Array:
        """E_L⁻¹B̄ᵢ with B̄ᵢ = [Bᵢ; 0], shape (r, n + p, m)."""
        return np.asarray(self.E_L_inverse[:, : self.state_count] @ self.system.B)

    @cached_property
    def N1(self) -> Array:
        """E_L⁻¹N with N = [0; I], shape (n + p, p)."""
        return np.asarray(self.E_L_inverse[:, self.state_count :])

    @cached_property
    def L1(self) -> Array:
        """E_L⁻¹L, shape (n + p, p): what the output adds to the observer's own state.

        It is [0; I] whatever L is: E_L w = L v gives L₂(C̄w − v) = 0, hence C̄w = v and w_x = 0.
        """
        assert self.L is not None
        return np.asarray(self.E_L_inverse @ self.L)

    @cached_property
    def blind_basis(self) -> Array:
        """T = [I; −C], a basis of {x̄ : C̄x̄ = 0}, shape (n + p, n)."""
        return np.vstack([np.eye(self.state_count), -self.C])

    def augmented_uncertainty(self, delta_A: ArrayLike) -> Array:
        """Return E_L⁻¹ΔĀᵢ with ΔĀᵢ = diag(ΔAᵢ, 0), shape (r, n + p, n + p).

        Args:
            delta_A: ΔAᵢ, shape (r, n, n).
        """
        n, p, r = self.state_count, self.output_count, self.rule_count
        change = as_matrix("ΔA", delta_A, (r, n, n))
        return np.concatenate([self.E_L_inverse[:, :n] @ change, np.zeros((r, n + p, p))], axis=-1)

    def alpha_1(self, alpha: ArrayLike) -> Array:
        """Return α₁ᵢ = ‖E_L⁻¹‖ αᵢ ≥ ‖E_L⁻¹ΔĀᵢ‖, shape (r,), for bounds ‖ΔAᵢ‖ ≤ αᵢ.

        The product is the method's choice: it reproduces its printed ε to .02 %.
        """
        bounds = as_matrix("alpha", alpha, (self.rule_count,))
        if (bounds < 0.0).any():
            raise ModelError(f"alpha: expected bounds of at least 0, got {bounds.tolist()}")
        return np.asarray(np.linalg.norm(self.E_L_inverse, 2) * bounds)

    def recover_disturbance(self, x: Array, omega_0: Array, weights: Array) -> Array:
        """Return ω = ω₀ − Σ hᵢ(Cᵢ − C) x, the (29) of the method, shape (..., p).

        Args:
            x: State or its estimate, shape (..., n).
            omega_0: Lumped disturbance Σ hᵢ(Cᵢ − C)x + ω, or its estimate, shape (..., p).
            weights: Rule weights h, shape (..., r).
        """
        mismatch = np.einsum("...i,ipn->...pn", weights, self.system.C - self.C)
        return np.asarray(omega_0 - (mismatch @ x[..., np.newaxis])[..., 0])


def recover_fault(omega: Array, D_s: ArrayLike) -> Array:
    """Return the sensor faults f with ω = D_s f, by least squares: (42)–(43) of the method.

    Args:
        omega: Output disturbance or its estimate, shape (..., p).
        D_s: Fault distribution, shape (p, k), of full column rank.

    Returns:
        Faults, shape (..., k).

    Raises:
        ModelError: D_s has another number of rows or not full column rank.
    """
    columns = np.shape(D_s)[1] if np.ndim(D_s) == 2 else 0
    distribution = as_matrix("D_s", D_s, (omega.shape[-1], columns))
    rank = int(np.linalg.matrix_rank(distribution)) if columns else 0
    if rank < max(1, columns):
        raise ModelError(f"D_s: expected full column rank {columns}, got rank {rank}")
    return np.asarray(omega @ np.linalg.pinv(distribution).T)


def require_partition(rule_base: RuleBase, z: ArrayLike) -> None:
    """Check that memberships given as the weights hᵢ themselves sum to one at given premises.

    A `RuleBase` normalises its grades, which would hide a slip in weights that were meant to be
    normalised already.

    Args:
        rule_base: Memberships whose products are meant to be the weights.
        z: Premise variables to try, shape (..., q).

    Raises:
        ModelError: The grades at some z do not sum to one; the text names z and the sum.
    """
    premise = np.asarray(z, dtype=np.float64)
    grades = [
        np.prod([mu(premise[..., j]) for j, mu in enumerate(rule)], axis=0)
        for rule in rule_base.rules
    ]
    total = np.sum(grades, axis=0)
    wrong = np.argwhere(~(np.abs(total - 1.0) <= _PARTITION))
    if wrong.size:
        where = tuple(wrong[0])
        raise ModelError(
            f"memberships: expected weights that sum to 1, got {float(total[where])!r} "
            f"at z = {premise[where].tolist()}"
        )
