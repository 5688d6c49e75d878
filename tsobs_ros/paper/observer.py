# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The adaptive observer of the method's Theorems 1 and 2, realised without ẏ.

Its (9), (30) and (17), (32), divided by E_L, with e_y = y − C̄x̂̄:

    x̂̄' = Σ hᵢ(z) [ A₁ᵢ x̂̄ + E_L⁻¹B̄ᵢ u + H₁ᵢ e_y + M Ξ̂ᵢ x̂̄ ] + E_L⁻¹N y + E_L⁻¹L ẏ
    Ξ̂ᵢ' = hᵢ(z) Γᵢ e_y x̂̄ᵀ ,   projected on ‖Ξ̂ᵢ‖ ≤ ξᵢ if bounds are given

The observer's own state is ξ = x̂̄ − E_L⁻¹L y, whose derivative has no ẏ. Between two samples
classical Runge–Kutta steps are taken with y, z and u linear in time.

The observer's limits are the subject of docs/method.md; it is here to be compared.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, Flags, as_matrix, positive
from tsobs_ros.design.request import TSRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.baselines import integrated_estimator
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.matrices import product
from tsobs_ros.model.torque_path import DIRECT, TorquePath
from tsobs_ros.paper.augmentation import Augmentation
from tsobs_ros.paper.examples import EXAMPLE_3_H, EXAMPLE_3_P, example_3

PAPER_WARNING = (
    "method paper: on this undamped arm the method's conditions are infeasible (modes ±4.776j and "
    "±1.481j are hidden by an arbitrary disturbance). Running the printed gains of its Example 3: "
    "the estimate is an open-loop simulation whose error does not decay; no bound is published"
)
"""Warning for users of the paper's observer of an arm, given once."""

SYSTEM_WARNING = (
    "method paper: the estimate is an open-loop simulation of the T-S system, which gets the "
    "measurements only by its premise; an error decays as the system itself does, and no bound is "
    "published"
)
"""Warning for users of the paper's observer of a T–S system, given once."""

INNOVATION_RATE = 20.0
"""Default of the decay asked of the innovation [1/s]. The slower it is, the longer the adaptive law
integrates what is left of the observer's own start, and the further Ξ̂ wanders from the truth."""

_MAX_STEP = 1e-2  # s
_EDGE = 1e-9


Rates = Callable[[int, Array], Array]
"""The derivative of a state at a node; nodes are the ends and middles of steps."""


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


class AugmentedObserver:
    """The adaptive T–S observer for one system or a batch of runs of it.

    Attributes:
        augmentation: The system in augmented form.
        H1: Gains H₁ᵢ = E_L⁻¹Hᵢ, shape (r, n + p, p).
        M: P⁻¹C̄ᵀ, shape (n + p, p).
        Gamma: Adaptation gains Γᵢ ≻ 0, shape (r, p, p); None for no adaptation.
        xi: Bounds ξᵢ to project Ξ̂ᵢ on, shape (r,); None for no projection.

    Raises:
        ModelError: A matrix has the wrong shape, or a bound is negative.
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
        self.Gamma = None if Gamma is None else as_matrix("Γ", Gamma, (r, p, p))
        self.xi = None if xi is None else as_matrix("xi", xi, (r,))
        if self.xi is not None and (self.xi < 0.0).any():
            raise ModelError(f"xi: expected bounds of at least 0, got {self.xi.tolist()}")

    def follow(
        self,
        y: ArrayLike,
        u: ArrayLike,
        period: float,
        z: ArrayLike | None = None,
        estimate: ArrayLike | None = None,
    ) -> AugmentedState:
        """Return the states at every sample; between two, y, z and u are linear in time.

        Args:
            y: Samples, shape (samples, ..., p); the axes between are the batch.
            u: Inputs at the samples, shape (samples, m), the same for all of the batch.
            period: Time between two samples [s].
            z: Premise variables at the samples, shape (samples, ..., q); the first q outputs by
                default.
            estimate: x̂̄(0), shape (..., n + p); zero if not given.

        Raises:
            ModelError: A shape is wrong, the period is not above zero, or no rule fires at some z.
        """
        aug = self.augmentation
        r, p, size, m = aug.rule_count, aug.output_count, aug.size, aug.B1.shape[-1]
        samples = self._checked("y", y, p)
        count, *batch = samples.shape[:-1]
        q = aug.system.rule_base.premise_count
        premises = self._checked("z", samples[..., :q] if z is None else z, q)
        inputs = as_matrix("u", u, (count, m))
        steps = max(1, math.ceil(positive("period", period) / _MAX_STEP - 1e-9))
        weights = aug.system.rule_base.weights(_at_nodes(premises, steps))
        guess = np.zeros(size) if estimate is None else np.asarray(estimate, dtype=np.float64)
        runs = math.prod(batch)
        rows = 1 if self.Gamma is None else 1 + r * p
        rates, offset = self._rates(
            _at_nodes(inputs, steps),
            _at_nodes(samples, steps).reshape(-1, runs, p, 1),
            weights.reshape(-1, runs, r, 1, 1),
        )
        states = np.zeros((count, runs, rows, size))
        states[0, :, 0] = (
            np.broadcast_to(guess, (*batch, size)).reshape(-1, size) - offset[0, ..., 0]
        )
        h = period / steps
        for k in range(1, count):
            now = states[k - 1]
            for node in range(2 * (k - 1) * steps, 2 * k * steps, 2):
                now = runge_kutta(rates, node, now, h)
                if self.Gamma is not None and self.xi is not None:
                    Xi = self._uncertainties(now)
                    Xi[...] = clip(Xi, self.xi)
            states[k] = now
        whole = states.reshape(count, *batch, rows, size)
        Xi = np.zeros((count, *batch, r, p, size))
        if self.Gamma is not None:
            Xi = whole[..., 1:, :].reshape(Xi.shape)
        return AugmentedState(whole[..., 0, :], Xi, samples, premises)

    def _rates(
        self, u: Array, y: Array, weights: Array
    ) -> tuple[Callable[[int, Array], Array], Array]:
        """Return the derivative of a state at a node, and E_L⁻¹L y, for signals at the nodes.

            x̂̄ = ξ + E_L⁻¹L y ,  e_y = y − C̄x̂̄ ,  ξ' = A x̂̄ + H e_y + d + M Σ hᵢ Ξ̂ᵢ x̂̄

        A state is one matrix a run, whose rows are ξ and, with adaptation, those of all Ξ̂ᵢ.
        """
        # Columns, as a product with all samples at once has other last bits for another batch.
        aug, h = self.augmentation, weights[..., 0, 0]
        offset = aug.L1 @ y
        A = np.einsum("nkr,rab->nkab", h, aug.A1)
        H = np.einsum("nkr,rab->nkab", h, self.H1)
        driven = np.einsum("nkr,nra->nka", h, np.einsum("rab,nb->nra", aug.B1, u))
        drive = driven[..., np.newaxis] + aug.N1 @ y

        def rates(node: int, state: Array) -> Array:
            x_bar = state[:, 0, :, np.newaxis] + offset[node]
            innovation = y[node] - aug.C_bar @ x_bar
            xi_rate = A[node] @ x_bar + H[node] @ innovation + drive[node]
            if self.Gamma is None:
                return np.asarray(xi_rate.swapaxes(1, 2))
            own, Xi = weights[node], self._uncertainties(state)
            xi_rate += self.M @ (own * (Xi @ x_bar[:, np.newaxis])).sum(axis=1)
            outer = self.Gamma @ innovation[:, np.newaxis] * x_bar.swapaxes(1, 2)[:, np.newaxis]
            Xi_rate = own * outer
            if self.xi is not None:
                Xi_rate = project(Xi, Xi_rate, self.Gamma, self.xi)
            derivative = np.empty_like(state)
            derivative[:, 0], self._uncertainties(derivative)[...] = xi_rate[..., 0], Xi_rate
            return derivative

        return rates, offset

    def _uncertainties(self, state: Array) -> Array:
        """Return a view of Ξ̂ᵢ, shape (runs, r, p, n + p)."""
        p = self.augmentation.output_count
        return state[:, 1:].reshape(len(state), -1, p, state.shape[-1])

    def augmented_estimate(self, state: AugmentedState) -> Array:
        """Return x̂̄ = [x̂; ω̂₀] = ξ + E_L⁻¹L y, shape (..., n + p)."""
        return np.asarray(state.xi + state.y @ self.augmentation.L1.T)

    def estimate(self, state: AugmentedState) -> tuple[Array, Array]:
        """Return x̂, shape (..., n), and ω̂ by (29), shape (..., p)."""
        aug, x_bar = self.augmentation, self.augmented_estimate(state)
        x, omega_0 = x_bar[..., : aug.state_count], x_bar[..., aug.state_count :]
        weights = aug.system.rule_base.weights(state.z)
        return x, aug.recover_disturbance(x, omega_0, weights)

    def innovation(self, state: AugmentedState) -> Array:
        """Return e_y = y − C̄x̂̄, shape (..., p)."""
        return np.asarray(state.y - self.augmented_estimate(state) @ self.augmentation.C_bar.T)

    @staticmethod
    def _checked(name: str, value: ArrayLike, length: int) -> Array:
        array = np.asarray(value, dtype=np.float64)
        if array.ndim == 0 or array.shape[-1] != length:
            raise ModelError(f"{name}: expected shape (..., {length}), got {array.shape}")
        return array


def _at_nodes(signal: Array, steps: int) -> Array:
    """Return a signal at both ends and in the middle of every step, linear between its samples."""
    shares = np.arange(2 * steps).reshape(-1, *[1] * (signal.ndim - 1)) / (2 * steps)
    between = signal[:-1, np.newaxis] + shares * np.diff(signal, axis=0)[:, np.newaxis]
    return np.concatenate([between.reshape(-1, *signal.shape[1:]), signal[-1:]])


def project(value: Array, rate: Array, Gamma: Array, limit: Array) -> Array:
    """Return rates Γ Y without what leads out of ‖Ξ‖ ≤ ξ where Ξ is on that bound.

    It is Γ Y − Γ g ⟨g, ΓY⟩/⟨g, Γg⟩, with the subgradient g = u₁v₁ᵀ of the spectral norm. Because
    the ball is convex, ⟨g, Ξ̂ − Ξ⟩ ≥ 0 for every Ξ in it, so this adds a term ≤ 0 to V'.

    Args:
        value: Ξ, shape (..., p, q).
        rate: Γ Y, of the same shape.
        Gamma: Γ ≻ 0, shape (p, p), or with axes before that fit those of Ξ.
        limit: ξ ≥ 0, one a matrix; infinite for no bound. Its shape fits the axes before p and q.
    """
    edge = limit * (1.0 - _EDGE)
    near = _beyond(value, edge)
    if not near.any():
        return rate
    left, singular, right = np.linalg.svd(value[near], full_matrices=False)
    u, v, rates = left[..., :1], right[..., :1, :], rate[near]
    turned = np.broadcast_to(Gamma, (*near.shape, *Gamma.shape[-2:]))[near] @ u
    u_row = u.swapaxes(-2, -1)
    outward, steepness = u_row @ rates @ v.swapaxes(-2, -1), u_row @ turned
    leaving = singular[:, :1] >= np.broadcast_to(edge, near.shape)[near][:, np.newaxis]
    share = np.where(leaving[..., np.newaxis] & (outward > 0.0), outward / steepness, 0.0)
    rates -= share * turned * v
    rates[np.broadcast_to(limit, near.shape)[near] == 0.0] = 0.0
    projected = rate.copy()
    projected[near] = rates
    return projected


def clip(value: Array, limit: Array) -> Array:
    """Return the nearest matrices with ‖Ξ‖ ≤ ξ, without what a step overshoots; see `project`."""
    over = _beyond(value, limit)
    if not over.any():
        return value
    left, singular, right = np.linalg.svd(value[over], full_matrices=False)
    excess = np.maximum(singular - np.broadcast_to(limit, over.shape)[over][:, np.newaxis], 0.0)
    clipped = value.copy()
    clipped[over] -= left * excess[:, np.newaxis] @ right
    return clipped


def _beyond(value: Array, limit: Array) -> Flags:
    """Return where Σ Ξᵢⱼ² ≥ ‖Ξ‖² reaches ξ², as few matrices do; false if a number is NaN."""
    squares = np.einsum("...ab,...ab->...", value, value)
    return np.asarray((squares >= limit * limit) & np.isfinite(value).all(axis=(-2, -1)))


def runge_kutta(rates: Rates, node: int, state: Array, h: float) -> Array:
    """Return a state a classical Runge–Kutta step later.

    Args:
        rates: The derivative.
        node: Where the step begins.
        state: There, any shape.
        h: Length of the step [s].
    """
    first = rates(node, state)
    second = rates(node + 1, state + 0.5 * h * first)
    third = rates(node + 1, state + 0.5 * h * second)
    fourth = rates(node + 2, state + h * third)
    return state + (h / 6.0) * (first + 2.0 * (second + third) + fourth)


def printed_observer() -> AugmentedObserver:
    """Return the method's observer with the gains that it prints for Example 3."""
    augmentation = Augmentation(example_3().system)
    M = np.linalg.solve(EXAMPLE_3_P, augmentation.C_bar.T)
    return AugmentedObserver(augmentation, augmentation.E_L_inverse @ EXAMPLE_3_H, M)


def paper_observer(
    arm: ElasticJointArm,
    period: float,
    measurement_std: float,
    torque: TorquePath = DIRECT,
) -> Estimator:
    """Return the method's observer for the arm of its Example 3, with the gains that it prints.

    Args:
        arm: The arm.
        period: Nominal sampling period [s].
        measurement_std: 1σ of a sample [rad], the only known part of an innovation's size.
        torque: How torques reach the motor.

    Raises:
        ModelError: The arm is another one; the method prints gains for this one only.
    """
    if arm != ElasticJointArm():
        raise ModelError(
            "method paper: expected the arm of the method's Example 3, for which it prints gains, "
            f"got {arm}"
        )
    observer = printed_observer()
    return _estimator(
        observer.augmentation,
        observer.H1,
        period,
        scale=arm.to_physical(np.ones(observer.augmentation.state_count)),
        measurement_covariance=np.array([[positive("measurement_std", measurement_std) ** 2]]),
        torque=torque,
    )


def paper_system_observer(request: TSRequest) -> Estimator:
    """Return the method's observer for a T–S system, started at ω̂₀(0) = y(0) − C x̂(0).

    From this start e_y and Ξ̂ᵢ stay zero (Proposition 1 of docs/method.md), so neither the gains nor
    the adaptive law enter the estimate. The gains are those of the proof of Proposition 2, for
    which no solver is needed.

    Args:
        request: Of the design; its disturbance model, noise and vertices are not used.

    Raises:
        ModelError: The premise is not what the method measures, the first outputs.
    """
    model = request.model
    _require_measured_premise(request)
    aug = Augmentation(model)
    r, p, n = aug.rule_count, aug.output_count, aug.state_count
    H1 = np.zeros((r, aug.size, p))
    H1[:, n:] = (INNOVATION_RATE - 1.0) * np.eye(p)
    return _estimator(
        aug,
        H1,
        request.period,
        scale=np.ones(n),
        measurement_covariance=request.measurement_covariance,
        scheduled=model.schedule.shape[1],
    )


def _require_measured_premise(request: TSRequest) -> None:
    """Refuse premises other than the first outputs, measured or scheduled by their names."""
    model, names = request.model, request.output_names
    scheduled = request.input_names[model.input_count :]
    for j, (of_state, of_signals) in enumerate(zip(model.premise, model.schedule, strict=True)):
        output = names[j] if j < len(names) else None
        measured = not of_signals.any() and output is not None and (of_state == model.C[j]).all()
        signals = {name: share for name, share in zip(scheduled, of_signals, strict=True) if share}
        if not measured and (of_state.any() or signals != {output: 1.0}):
            expected = "one an output" if output is None else f"the output {output}"
            raise ModelError(
                f"method paper: expected premise {j + 1} to be {expected}, or a scheduled signal "
                "of its name, as the method measures its premises; got another one"
            )


def _estimator(
    aug: Augmentation,
    H1: Array,
    period: float,
    *,
    scale: Array,
    measurement_covariance: Array,
    scheduled: int = 0,
    torque: TorquePath = DIRECT,
) -> Estimator:
    """Return the observer without adaptation; its premises are the first outputs.

    (29) takes Σ hᵢ(Cᵢ − C)x̂ from ω̂₀. If the Cᵢ differ, p states more follow that sum within a
    period, as weights enter derivatives only. `scheduled` signals after the inputs are not used.
    """
    n, p, size = aug.state_count, aug.output_count, aug.size
    F = np.array([A - product(H, aug.C_bar) for A, H in zip(aug.A1, H1, strict=True)])
    Y = np.array([product(f, aug.L1) + H + aug.N1 for f, H in zip(F, H1, strict=True)])
    U = np.concatenate([aug.B1, np.zeros((len(F), size, scheduled))], axis=2)
    C_bar, omega = aug.C_bar, np.eye(p, size, n)
    mismatch = aug.system.rule_outputs - aug.C
    if mismatch.any():
        rate = 1.0 / positive("period", period)
        F, Y, U = (np.pad(each, ((0, 0), (0, p), (0, 0))) for each in (F, Y, U))
        F = np.pad(F, ((0, 0), (0, 0), (0, p)))
        F[:, size:, :n], F[:, size:, size:] = rate * mismatch, -rate * np.eye(p)
        C_bar, omega = np.pad(C_bar, ((0, 0), (0, p))), np.hstack([omega, -np.eye(p)])
    return integrated_estimator(
        F,
        Y,
        U,
        C_bar,
        period=positive("period", period),
        max_step=_MAX_STEP,
        scale=scale,
        measurement_covariance=measurement_covariance,
        rule_base=aug.system.rule_base,
        D=product(aug.C_bar, aug.L1),
        disturbance=(omega, aug.L1[n:]),
        torque=torque,
    )
