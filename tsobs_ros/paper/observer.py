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
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, positive
from tsobs_ros.design.request import TSRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.baselines import open_estimator
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.model.arm import DIRECT, ElasticJointArm, TorquePath
from tsobs_ros.model.matrices import product
from tsobs_ros.paper.augmentation import Augmentation, blend
from tsobs_ros.paper.examples import EXAMPLE_3_H, example_3

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
_MIDPOINT = 1.0421906109874948
"""2 sinh(1/2): the inverse of what a step at that rate takes in of a difference between rules."""

_EDGE = 1e-9

Rates = Callable[[int, Array], Array]
"""The derivative of a state at a node; nodes are the ends and middles of steps."""


class AugmentedEstimates(NamedTuple):
    """The observer's estimates at each sample.

    Attributes:
        x_bar: x̂̄ = [x̂; ω̂₀], shape (samples, ..., n + p).
        disturbance: ω̂ by (29), shape (samples, ..., p).
        innovation: e_y = y − C̄x̂̄, shape (samples, ..., p).
        Xi: Uncertainty estimates Ξ̂ᵢ, shape (samples, ..., r, p, n + p).
    """

    x_bar: Array
    disturbance: Array
    innovation: Array
    Xi: Array

    @property
    def x(self) -> Array:
        """State estimate x̂, shape (samples, ..., n)."""
        return np.asarray(self.x_bar[..., : -self.disturbance.shape[-1]])


@dataclass(frozen=True)
class AugmentedObserver:
    """The adaptive T–S observer for one system or a batch of runs of it.

    Attributes:
        augmentation: The system in augmented form.
        H1: Gains H₁ᵢ = E_L⁻¹Hᵢ, shape (r, n + p, p).
        M: P⁻¹C̄ᵀ, shape (n + p, p).
        Gamma: Adaptation gains Γᵢ ≻ 0, shape (r, p, p); None for no adaptation.
        xi: Bounds ξᵢ to project Ξ̂ᵢ on, shape (r,); infinite for no projection.
    """

    augmentation: Augmentation
    H1: Array
    M: Array
    Gamma: Array | None = None
    xi: Array | float = math.inf

    def follow(
        self,
        y: Array,
        u: Array,
        period: float,
        z: Array | None = None,
        estimate: ArrayLike = 0.0,
    ) -> AugmentedEstimates:
        """Return the estimates at every sample; between two, y, z and u are linear in time.

        Args:
            y: Samples, shape (samples, ..., p); the axes between are the batch.
            u: Inputs at the samples, shape (samples, m), the same for all of the batch.
            period: Time between two samples [s].
            z: Premise variables at the samples, shape (samples, ..., q); the first q outputs if
                None.
            estimate: x̂̄(0), shape (..., n + p) or one number for all.
        """
        aug = self.augmentation
        r, p, size = aug.rule_count, aug.output_count, aug.size
        count, *batch = y.shape[:-1]
        rule_base = aug.system.rule_base
        premises = y[..., : rule_base.coded[0].shape[1]] if z is None else z
        weights = rule_base.weights(premises)
        steps = max(1, math.ceil(period / _MAX_STEP - 1e-9))
        rates, offset = self._rates(
            _at_nodes(u, steps),
            _at_nodes(y, steps).reshape(-1, math.prod(batch), p, 1),
            rule_base.weights(_at_nodes(premises, steps)).reshape(-1, math.prod(batch), r, 1, 1),
        )
        # One matrix a run, whose rows are ξ and, with adaptation, those of all Ξ̂ᵢ.
        states = np.zeros((count, math.prod(batch), 1 if self.Gamma is None else 1 + r * p, size))
        guess = np.broadcast_to(estimate, (*batch, size)).reshape(-1, size)
        states[0, :, 0] = guess - offset[0, ..., 0]
        h = period / steps
        for k in range(1, count):
            now = states[k - 1]
            for node in range(2 * (k - 1) * steps, 2 * k * steps, 2):
                now = runge_kutta(rates, node, now, h)
                if self.Gamma is not None:
                    Xi = self._uncertainties(now)
                    Xi[...] = clip(Xi, self._bounds)
            states[k] = now
        states = states.reshape(count, *batch, -1, size)
        x_bar = states[..., 0, :] + y @ aug.L1.T
        Xi = np.zeros((count, *batch, r, p, size))
        if self.Gamma is not None:
            Xi = states[..., 1:, :].reshape(Xi.shape)
        x, omega_0 = np.split(x_bar, [aug.state_count], axis=-1)
        # ω = ω₀ − Σ hᵢ(Cᵢ − C) x, the (29) of the method.
        disturbance = omega_0 - blend(aug.system.rule_outputs - aug.C, weights, x)
        return AugmentedEstimates(x_bar, disturbance, y - x_bar @ aug.C_bar.T, Xi)

    def _rates(self, u: Array, y: Array, weights: Array) -> tuple[Rates, Array]:
        """Return the derivative of a state at a node, and E_L⁻¹L y, for signals at the nodes.

        x̂̄ = ξ + E_L⁻¹L y ,  e_y = y − C̄x̂̄ ,  ξ' = A x̂̄ + H e_y + d + M Σ hᵢ Ξ̂ᵢ x̂̄
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
            derivative = np.empty_like(state)
            derivative[:, 0] = xi_rate[..., 0]
            Xi_rate = project(Xi, own * outer, self.Gamma, self._bounds)
            self._uncertainties(derivative)[...] = Xi_rate
            return derivative

        return rates, offset

    @cached_property
    def _bounds(self) -> Array:
        return np.broadcast_to(self.xi, self.augmentation.rule_count)

    def _uncertainties(self, state: Array) -> Array:
        """Return a view of Ξ̂ᵢ, shape (runs, r, p, n + p)."""
        p = self.augmentation.output_count
        return state[:, 1:].reshape(len(state), -1, p, state.shape[-1])


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
    if not _reaches(value, edge):
        return rate
    left, singular, right = np.linalg.svd(value, full_matrices=False)
    u, v = left[..., :1], right[..., :1, :]
    u_row, turned = u.swapaxes(-2, -1), Gamma @ u
    outward, steepness = u_row @ rate @ v.swapaxes(-2, -1), u_row @ turned
    leaves = (singular[..., 0] >= edge)[..., np.newaxis, np.newaxis] & (outward > 0.0)
    projected = rate - np.where(leaves, outward / steepness, 0.0) * turned * v
    return np.where(limit[..., np.newaxis, np.newaxis] == 0.0, 0.0, projected)


def clip(value: Array, limit: Array) -> Array:
    """Return the nearest matrices with ‖Ξ‖ ≤ ξ, without what a step overshoots; see `project`."""
    if not _reaches(value, limit):
        return value
    left, singular, right = np.linalg.svd(value, full_matrices=False)
    excess = np.maximum(singular - limit[..., np.newaxis], 0.0)
    return np.asarray(value - left * excess[..., np.newaxis, :] @ right)


def _reaches(value: Array, limit: Array) -> bool:
    """Return whether Σ Ξᵢⱼ² ≥ ‖Ξ‖² of any matrix reaches ξ², as it rarely does."""
    return bool((np.einsum("...ab,...ab->...", value, value) >= limit * limit).any())


def runge_kutta(rates: Rates, node: int, state: Array, h: float) -> Array:
    """Return a state of any shape a classical Runge–Kutta step of `h` [s] from a node later."""
    first = rates(node, state)
    second = rates(node + 1, state + 0.5 * h * first)
    third = rates(node + 1, state + 0.5 * h * second)
    fourth = rates(node + 2, state + h * third)
    return state + (h / 6.0) * (first + 2.0 * (second + third) + fourth)


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
    aug = Augmentation(example_3().system)
    return _estimator(
        aug,
        aug.E_L_inverse @ EXAMPLE_3_H,
        period,
        scale=arm.to_physical(np.ones(aug.state_count)),
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
    _require_measured_premise(request)
    aug = Augmentation(request.model)
    return _estimator(
        aug,
        np.array([(INNOVATION_RATE - 1.0) * aug.L] * aug.rule_count),
        request.period,
        scale=np.ones(aug.state_count),
        measurement_covariance=request.measurement_covariance,
        scheduled=request.model.schedule.shape[1],
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
        mean = sum(mismatch[1:], start=mismatch[0]) / len(mismatch)
        F[:, size:, :n] = rate * (mean + _MIDPOINT * (mismatch - mean))
        F[:, size:, size:] = -rate * np.eye(p)
        C_bar, omega = np.pad(C_bar, ((0, 0), (0, p))), np.hstack([omega, -np.eye(p)])
    return open_estimator(
        F,
        Y,
        U,
        C_bar,
        period=positive("period", period),
        scale=scale,
        measurement_covariance=measurement_covariance,
        rule_base=aug.system.rule_base,
        D=product(aug.C_bar, aug.L1),
        disturbance=(omega, aug.L1[n:]),
        torque=torque,
    )
