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
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, positive
from tsobs_ros.compiled import compiled, compiled_nogil
from tsobs_ros.design.request import TSRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.baselines import integrated_estimator
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.matrices import product
from tsobs_ros.paper.augmentation import Augmentation
from tsobs_ros.paper.examples import EXAMPLE_3_H, EXAMPLE_3_P, example_3
from tsobs_ros.paper.projection import clip, project
from tsobs_ros.paper.systems import TSSystem

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
        states = np.zeros((count, runs, 1 + r * p, size))
        states.reshape(count, *batch, 1 + r * p, size)[0, ..., 0, :] = guess - samples[0] @ aug.L1.T
        _integrate(
            self._equations(),
            _at_nodes(inputs, steps),
            _at_nodes(samples, steps).reshape(-1, runs, p),
            weights.reshape(-1, runs, r),
            period / steps,
            steps,
            states,
        )
        states = states.reshape(count, *batch, 1 + r * p, size)
        Xi = states[..., 1:, :].reshape(count, *batch, r, p, size)
        return AugmentedState(states[..., 0, :], Xi, samples, premises)

    def _equations(self) -> "_Equations":
        aug, p = self.augmentation, self.augmentation.output_count
        given = _Equations(
            aug.A1,
            aug.B1,
            self.H1,
            aug.N1,
            aug.L1,
            aug.C_bar,
            self.M,
            np.zeros((aug.rule_count, p, p)) if self.Gamma is None else self.Gamma,
            np.full(aug.rule_count, math.inf) if self.xi is None else self.xi,
        )
        return _Equations(*(np.array(each, order="C") for each in given))

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

    @staticmethod
    def _checked(name: str, value: ArrayLike, length: int) -> Array:
        array = np.asarray(value, dtype=np.float64)
        if array.ndim == 0 or array.shape[-1] != length:
            raise ModelError(f"{name}: expected shape (..., {length}), got {array.shape}")
        return array


def _at_nodes(signal: Array, steps: int) -> Array:
    """Return a signal at both ends and in the middle of every step, linear between its samples.

    Args:
        signal: Shape (samples, ...).
        steps: Number of steps between two samples.
    """
    shares = np.arange(2 * steps).reshape(-1, *[1] * (signal.ndim - 1)) / (2 * steps)
    between = signal[:-1, np.newaxis] + shares * np.diff(signal, axis=0)[:, np.newaxis]
    return np.concatenate([between.reshape(-1, *signal.shape[1:]), signal[-1:]])


class _Equations(NamedTuple):
    """The matrices of the observer's equations; Γ = 0 for no adaptation, ξ = ∞ for no bound."""

    A1: Array
    B1: Array
    H1: Array
    N1: Array
    L1: Array
    C_bar: Array
    M: Array
    Gamma: Array
    limits: Array


@compiled_nogil
def _integrate(
    equations: _Equations,
    u: Array,
    y: Array,
    weights: Array,
    h: float,
    steps: int,
    states: Array,
) -> None:
    """Fill the states of all runs after the first sample.

    Args:
        equations: Of the observer.
        u: Inputs at the ends and in the middle of each step, shape (nodes, m).
        y: Outputs there, shape (nodes, runs, p).
        weights: Rule weights there, shape (nodes, runs, r).
        h: Length of a step [s].
        steps: Number of steps between two samples.
        states: ξ and the rows of Ξ̂ᵢ of each run, shape (samples, runs, 1 + r p, n + p); those at
            the first sample are given.
    """
    samples, runs, rows, size = states.shape
    p = equations.C_bar.shape[0]
    slopes, at = np.empty((4, rows, size)), np.empty((rows, size))
    x_bar, innovation, squares = np.empty(size), np.empty(p), np.empty((2, p, p))
    for k in range(1, samples):
        for run in range(runs):
            now = states[k, run]
            for i in range(rows):
                for j in range(size):
                    now[i, j] = states[k - 1, run, i, j]
            for step in range(steps):
                for stage in range(4):
                    reach = h if stage == 3 else 0.5 * h
                    for i in range(rows):
                        for j in range(size):
                            at[i, j] = now[i, j]
                            if stage > 0:
                                at[i, j] += reach * slopes[stage - 1, i, j]
                    node = 2 * ((k - 1) * steps + step) + (stage + 1) // 2
                    _derivative(
                        equations,
                        at,
                        u[node],
                        y[node, run],
                        weights[node, run],
                        slopes[stage],
                        x_bar,
                        innovation,
                        squares,
                    )
                for i in range(rows):
                    for j in range(size):
                        middle = 2.0 * (slopes[1, i, j] + slopes[2, i, j])
                        now[i, j] += (h / 6.0) * (slopes[0, i, j] + middle + slopes[3, i, j])
                for rule in range(weights.shape[2]):
                    first = 1 + rule * p
                    limit = equations.limits[rule]
                    clip(now[first : first + p], limit, squares[0], squares[1])


@compiled
def _derivative(
    equations: _Equations,
    state: Array,
    u: Array,
    y: Array,
    weights: Array,
    rates: Array,
    x_bar: Array,
    innovation: Array,
    squares: Array,
) -> None:
    """Write the derivative of a state; x̂̄ (n + p,), e_y (p,) and squares (2, p, p) are scratch."""
    p, size = equations.C_bar.shape
    for i in range(size):
        x_bar[i] = state[0, i]
        rates[0, i] = 0.0
        for a in range(p):
            x_bar[i] += equations.L1[i, a] * y[a]
            rates[0, i] += equations.N1[i, a] * y[a]
    for a in range(p):
        innovation[a] = y[a]
        for j in range(size):
            innovation[a] -= equations.C_bar[a, j] * x_bar[j]
    for rule in range(weights.shape[0]):
        weight, first = weights[rule], 1 + rule * p
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += equations.A1[rule, i, j] * x_bar[j]
            for j in range(u.shape[0]):
                total += equations.B1[rule, i, j] * u[j]
            rates[0, i] += weight * total
        for a in range(p):
            change = turned = 0.0
            for j in range(size):
                change += state[first + a, j] * x_bar[j]
            for i in range(size):
                effect = equations.H1[rule, i, a] * innovation[a] + equations.M[i, a] * change
                rates[0, i] += weight * effect
            for b in range(p):
                turned += equations.Gamma[rule, a, b] * innovation[b]
            for j in range(size):
                rates[first + a, j] = weight * turned * x_bar[j]
        project(
            state[first : first + p],
            rates[first : first + p],
            equations.Gamma[rule],
            equations.limits[rule],
            squares[0],
            squares[1],
        )


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


def paper_observer(arm: ElasticJointArm, period: float, measurement_std: float) -> Estimator:
    """Return the method's observer for the arm of its Example 3, with the gains that it prints.

    Args:
        arm: The arm.
        period: Nominal sampling period [s].
        measurement_std: 1σ of a sample [rad], the only known part of an innovation's size.

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
    system = TSSystem(model.A, model.B, model.rule_outputs, model.rule_base)
    aug = Augmentation(system)
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
) -> Estimator:
    """Return the observer without adaptation; its premises are the first outputs.

    (29) takes Σ hᵢ(Cᵢ − C)x̂ from ω̂₀. If the Cᵢ differ, p states more follow that sum within a
    period, as weights enter derivatives only.

    Args:
        aug: The system in augmented form.
        H1: Gains H₁ᵢ, shape (r, n + p, p).
        period: Nominal sampling period [s].
        scale: Physical units of the states, shape (n,).
        measurement_covariance: Of a sample, shape (p, p).
        scheduled: Number of signals after the inputs, which are not used.
    """
    n, p, size = aug.state_count, aug.output_count, aug.size
    F = np.array([A - product(H, aug.C_bar) for A, H in zip(aug.A1, H1, strict=True)])
    Y = np.array([product(f, aug.L1) + H + aug.N1 for f, H in zip(F, H1, strict=True)])
    U = np.concatenate([aug.B1, np.zeros((len(F), size, scheduled))], axis=2)
    C_bar, omega = aug.C_bar, np.eye(p, size, n)
    mismatch = aug.system.C - aug.C
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
    )
