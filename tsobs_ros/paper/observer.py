# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The adaptive observer of the method's Theorems 1 and 2, realised without ẏ.

Its (9), (30) and (17), (32), divided by E_L, with e_y = y − C̄x̂̄:

    x̂̄' = Σ hᵢ(z) [ A₁ᵢ x̂̄ + E_L⁻¹B̄ᵢ u + H₁ᵢ e_y + M Ξ̂ᵢ x̂̄ ] + E_L⁻¹N y + E_L⁻¹L ẏ
    Ξ̂ᵢ' = hᵢ(z) Γᵢ e_y x̂̄ᵀ ,   projected on ‖Ξ̂ᵢ‖ ≤ ξᵢ if bounds are given

The observer's own state is ξ = x̂̄ − E_L⁻¹L y, whose derivative has no ẏ. Between two samples a
classical Runge–Kutta step is taken with y, z and u linear in time (`advance`, if the next sample
is known) or held (`predict`, if it is not).

The projection keeps ‖Ξ‖ ≤ ξ without hurting the Lyapunov argument. For Ξ' = Γ Y with
V = tr(Ξ̃ᵀΓ⁻¹Ξ̃) the projected rate is Γ Y − Γ g ⟨g, ΓY⟩/⟨g, Γg⟩ if Ξ is on the bound and moves out;
g = u₁v₁ᵀ is the subgradient of the spectral norm. Because the ball is convex, ⟨g, Ξ̂ − Ξ⟩ ≥ 0 for
every Ξ in it, so the projection adds a term ≤ 0 to V'.

The observer's limits are the subject of docs/method.md; it is here to be compared.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.baselines import ComparisonObserver
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.paper.augmentation import Augmentation
from tsobs_ros.paper.examples import EXAMPLE_3_H, EXAMPLE_3_P, example_3

PAPER_WARNING = (
    "method paper: on this undamped arm the method's conditions are infeasible (modes ±4.776j and "
    "±1.481j are hidden by an arbitrary disturbance). Running the printed gains of its Example 3: "
    "the estimate is an open-loop simulation whose error does not decay; no bound is published"
)
"""Warning for users of the paper's observer, given once."""

_MAX_STEP = 1e-2  # s
_EDGE = 1e-9
_ASYMMETRY = 1e-12


class AugmentedState(NamedTuple):
    """The observer's whole state.

    Attributes:
        xi: ξ = x̂̄ − E_L⁻¹L y, shape (..., n + p).
        Xi: Uncertainty estimates Ξ̂ᵢ, shape (..., r, p, n + p).
        y: Last sample, shape (..., p).
        z: Premise variables at the last sample, shape (..., q).
    """

    xi: Array
    Xi: Array
    y: Array
    z: Array

    @property
    def x(self) -> Array:
        """State estimate x̂, shape (..., n): E_L⁻¹L = [0; I], so ξ has it in its first rows."""
        return np.asarray(self.xi[..., : self.xi.shape[-1] - self.y.shape[-1]])


class Estimate(NamedTuple):
    """An estimate: x̂, shape (..., n), and ω̂ by (29), shape (..., p)."""

    x: Array
    omega: Array


class AugmentedObserver:
    """The adaptive T–S observer for one system or a batch of runs of it.

    Attributes:
        augmentation: The system in augmented form.
        H1: Gains H₁ᵢ = E_L⁻¹Hᵢ, shape (r, n + p, p).
        M: P⁻¹C̄ᵀ, shape (n + p, p).
        Gamma: Adaptation gains Γᵢ, shape (r, p, p), or one for all, shape (p, p); None for no
            adaptation.
        xi: Bounds ξᵢ to project Ξ̂ᵢ on, shape (r,); None for no projection.

    Raises:
        ModelError: A matrix has the wrong shape, or a Γᵢ is not symmetric positive definite.
    """

    def __init__(
        self,
        augmentation: Augmentation,
        H1: ArrayLike,
        M: ArrayLike,
        Gamma: ArrayLike | None = None,
        xi: ArrayLike | None = None,
    ) -> None:
        r, p = augmentation.rule_count, augmentation.output_count
        self.augmentation = augmentation
        self.H1 = as_matrix("H₁", H1, (r, augmentation.size, p))
        self.M = as_matrix("M", M, (augmentation.size, p))
        self.Gamma = None if Gamma is None else checked_gamma(Gamma, r, p)
        self.xi = None if xi is None else as_matrix("xi", xi, (r,))
        if self.xi is not None and (self.xi < 0.0).any():
            raise ModelError(f"xi: expected bounds of at least 0, got {self.xi.tolist()}")

    def initial(
        self, y: ArrayLike, estimate: ArrayLike | None = None, z: ArrayLike | None = None
    ) -> AugmentedState:
        """Return the state at the first sample.

        Args:
            y: First sample, shape (..., p); its leading axes are the batch.
            estimate: x̂̄(0), shape (..., n + p); zero if not given.
            z: Premise variables, shape (..., q); the first q outputs by default.
        """
        aug = self.augmentation
        sample = self._checked("y", y, aug.output_count)
        guess = np.zeros(aug.size) if estimate is None else np.asarray(estimate, dtype=np.float64)
        xi = guess - sample @ aug.L1.T
        shape = (*xi.shape[:-1], aug.rule_count, aug.output_count, aug.size)
        return AugmentedState(xi, np.zeros(shape), sample, self._premises(sample, z))

    def correct(
        self, state: AugmentedState, y: ArrayLike, z: ArrayLike | None = None
    ) -> tuple[AugmentedState, Array]:
        """Take a sample: the disturbance estimate moves with it, the state estimate does not.

        Args:
            state: Predicted to the sample's stamp.
            y: Sample, shape (..., p).
            z: Premise variables, shape (..., q); the first q outputs by default.

        Returns:
            The state, and the innovation e_y, shape (..., p).
        """
        sample = self._checked("y", y, self.augmentation.output_count)
        taken = state._replace(y=sample, z=self._premises(sample, z))
        return taken, self.innovation(taken)

    def predict(self, state: AugmentedState, u: ArrayLike, duration: float) -> AugmentedState:
        """Predict over `duration` [s] with the last sample, its premises and u (..., m) held."""
        return self.advance(state, u, u, state.y, duration, state.z)

    def advance(
        self,
        state: AugmentedState,
        u: ArrayLike,
        u_next: ArrayLike,
        y_next: ArrayLike,
        duration: float,
        z_next: ArrayLike | None = None,
    ) -> AugmentedState:
        """Predict to the next sample, everything between the two taken as linear in time.

        Args:
            state: At the last sample.
            u: Input at the last sample, shape (..., m).
            u_next: Input at the next one.
            y_next: The next sample, shape (..., p).
            duration: Time between them [s], at least 0.
            z_next: Premise variables there, shape (..., q); the first q outputs by default.
        """
        sample = self._checked("y", y_next, self.augmentation.output_count)
        start = (np.asarray(u, dtype=np.float64), state.y, state.z)
        end = (np.asarray(u_next, dtype=np.float64), sample, self._premises(sample, z_next))
        slopes = [b - a for a, b in zip(start, end, strict=True)]
        steps = max(1, math.ceil(duration / _MAX_STEP - 1e-9))
        weights = self.augmentation.system.rule_base.weights

        def signals(share: float) -> tuple[Array, Array, Array]:
            u, y, z = (a + share * slope for a, slope in zip(start, slopes, strict=True))
            return u, y, weights(z)

        xi, Xi, h = state.xi, state.Xi, duration / steps
        at = signals(0.0)
        for index in range(steps):
            middle, after = signals((index + 0.5) / steps), signals((index + 1.0) / steps)
            xi, Xi = self._runge_kutta(xi, Xi, (at, middle, after), h)
            at = after
        return AugmentedState(xi, Xi, end[1], end[2])

    def _derivative(
        self, xi: Array, Xi: Array, u: Array, y: Array, weights: Array
    ) -> tuple[Array, Array]:
        aug = self.augmentation
        x_bar = xi + y @ aug.L1.T
        innovation = y - x_bar @ aug.C_bar.T
        # Every rule's contribution in one product each, then the blend.
        rules = _each_rule(aug.A1, x_bar) + _each_rule(aug.B1, u) + _each_rule(self.H1, innovation)
        if self.Gamma is None:
            return _blend(weights, rules) + y @ aug.N1.T, np.zeros_like(Xi)
        rules = rules + (Xi @ x_bar[..., np.newaxis, :, np.newaxis])[..., 0] @ self.M.T
        gradient = np.einsum("...i,...p,...n->...ipn", weights, innovation, x_bar)
        if self.xi is None:
            return _blend(weights, rules) + y @ aug.N1.T, self.Gamma @ gradient
        return (
            _blend(weights, rules) + y @ aug.N1.T,
            projected_rate(Xi, gradient, self.Gamma, self.xi),
        )

    def augmented_estimate(self, state: AugmentedState) -> Array:
        """Return x̂̄ = [x̂; ω̂₀] = ξ + E_L⁻¹L y, shape (..., n + p)."""
        return np.asarray(state.xi + state.y @ self.augmentation.L1.T)

    def estimate(self, state: AugmentedState) -> Estimate:
        """Return x̂ and ω̂, the latter recovered by (29) if the Cᵢ differ."""
        aug, x_bar = self.augmentation, self.augmented_estimate(state)
        x, omega_0 = x_bar[..., : aug.state_count], x_bar[..., aug.state_count :]
        weights = aug.system.rule_base.weights(state.z)
        return Estimate(x, aug.recover_disturbance(x, omega_0, weights))

    def innovation(self, state: AugmentedState) -> Array:
        """Return e_y = y − C̄x̂̄, shape (..., p)."""
        return np.asarray(state.y - self.augmented_estimate(state) @ self.augmentation.C_bar.T)

    def _runge_kutta(
        self, xi: Array, Xi: Array, signals: Sequence[tuple[Array, Array, Array]], h: float
    ) -> tuple[Array, Array]:
        start, middle, end = signals
        a1, b1 = self._derivative(xi, Xi, *start)
        a2, b2 = self._derivative(xi + 0.5 * h * a1, Xi + 0.5 * h * b1, *middle)
        a3, b3 = self._derivative(xi + 0.5 * h * a2, Xi + 0.5 * h * b2, *middle)
        a4, b4 = self._derivative(xi + h * a3, Xi + h * b3, *end)
        moved = Xi + (h / 6.0) * (b1 + 2.0 * (b2 + b3) + b4)
        if self.Gamma is not None and self.xi is not None:
            moved = clipped(moved, self.xi)
        return xi + (h / 6.0) * (a1 + 2.0 * (a2 + a3) + a4), moved

    def _premises(self, y: Array, z: ArrayLike | None) -> Array:
        count = self.augmentation.system.rule_base.premise_count
        return self._checked("z", y[..., :count] if z is None else z, count)

    @staticmethod
    def _checked(name: str, value: ArrayLike, length: int) -> Array:
        array = np.asarray(value, dtype=np.float64)
        if array.ndim == 0 or array.shape[-1] != length:
            raise ModelError(f"{name}: expected shape (..., {length}), got {array.shape}")
        return array


def _each_rule(matrices: Array, vector: Array) -> Array:
    """Return Mᵢ v for every rule: (r, a, b) and (..., b) to (..., r, a)."""
    return np.asarray((matrices @ vector[..., np.newaxis, :, np.newaxis])[..., 0])


def _blend(weights: Array, rules: Array) -> Array:
    """Return Σ hᵢ vᵢ: (..., r) and (..., r, a) to (..., a)."""
    return np.asarray((weights[..., np.newaxis, :] @ rules)[..., 0, :])


def projected_rate(value: Array, gradient: Array, Gamma: Array, limit: Array) -> Array:
    """Return Γ Y, without its part that leads out of ‖Ξ‖ ≤ ξ if Ξ is on that bound.

    Args:
        value: Ξ, shape (..., p, q).
        gradient: Y, shape (..., p, q).
        Gamma: Γ ≻ 0, shape (..., p, p).
        limit: ξ ≥ 0, shape (...).
    """
    rate = Gamma @ gradient
    left, singular, right = np.linalg.svd(value, full_matrices=False)
    normal = left[..., :, :1] @ right[..., :1, :]
    outward = np.sum(normal * rate, axis=(-1, -2))
    steep = Gamma @ normal
    blocked = (singular[..., 0] >= limit * (1.0 - _EDGE)) & (outward > 0.0)
    # ⟨g, Γg⟩ is at least the smallest eigenvalue of Γ, since g has unit norm.
    excess = np.where(blocked, outward / np.sum(normal * steep, axis=(-1, -2)), 0.0)
    return np.asarray(rate - excess[..., np.newaxis, np.newaxis] * steep)


def clipped(value: Array, limit: Array) -> Array:
    """Return the nearest matrix with ‖Ξ‖ ≤ ξ: singular values cut at ξ.

    It removes what a step of finite length overshoots by.

    Args:
        value: Ξ, shape (..., p, q).
        limit: ξ ≥ 0, shape (...).
    """
    left, singular, right = np.linalg.svd(value, full_matrices=False)
    cut = np.minimum(singular, np.asarray(limit)[..., np.newaxis])
    return np.asarray((left * cut[..., np.newaxis, :]) @ right)


def checked_gamma(Gamma: ArrayLike, rules: int, outputs: int) -> Array:
    """Return Γᵢ as an array of shape (rules, outputs, outputs).

    Raises:
        ModelError: A shape is wrong, or a Γᵢ is not symmetric or not positive definite; the
            text names the rule.
    """
    given = np.asarray(Gamma, dtype=np.float64)
    if given.ndim == 2:
        given = np.repeat(given[np.newaxis], rules, axis=0)
    checked = as_matrix("Γ", given, (rules, outputs, outputs))
    for rule, matrix in enumerate(checked, 1):
        asymmetry = float(np.abs(matrix - matrix.T).max())
        if asymmetry > _ASYMMETRY * float(np.abs(matrix).max()):
            raise ModelError(
                f"Γ of rule {rule}: expected a symmetric matrix, got {matrix.tolist()}, "
                f"unsymmetric by {asymmetry:.3g}"
            )
        smallest = float(np.linalg.eigvalsh(matrix)[0])
        if smallest <= 0.0:
            raise ModelError(
                f"Γ of rule {rule}: expected a positive definite matrix, got smallest "
                f"eigenvalue {smallest:.6g}"
            )
    return checked


def printed_observer() -> AugmentedObserver:
    """Return the method's observer with the gains that it prints for Example 3."""
    augmentation = Augmentation(example_3().system)
    M = np.linalg.solve(EXAMPLE_3_P, augmentation.C_bar.T)
    return AugmentedObserver(augmentation, augmentation.E_L_inverse @ EXAMPLE_3_H, M)


def paper_observer(
    arm: ElasticJointArm, period: float, measurement_std: float
) -> ComparisonObserver:
    """Return the method's observer for the arm of its Example 3.

    Raises:
        ModelError: The arm is another one; the method prints gains for this one only.
    """
    if arm != ElasticJointArm():
        raise ModelError(
            "method paper: expected the arm of the method's Example 3, for which it prints gains, "
            f"got {arm}"
        )
    inner = printed_observer()
    start = inner.initial(np.zeros(1))
    return ComparisonObserver(
        inner, start, arm, period, measurement_std, lambda state: inner.estimate(state).omega
    )
