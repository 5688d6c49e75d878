# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Runs of the method's examples, each with every observer on the same signals.

Examples 1 and 2 run without noise, in five variants of the method's observer. Example 3 is the
nonlinear arm with a little process noise, u = sin t, and white measurement noise of 5 % of the
largest angle, with one run per seed. PO and PIO have the best θ of a grid, the paper's observer has
its printed gains.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm
from tsobs_ros.estimation.baselines import extended_kalman, high_gain, proportional_integral
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.state import likeliest
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.model.arm import MOTOR_ANGLE, ElasticJointArm
from tsobs_ros.paper.augmentation import blend
from tsobs_ros.paper.examples import PaperExample, torque
from tsobs_ros.paper.observer import AdaptiveObserver, clip, paper_observer
from tsobs_ros.paper.synthesis import AdaptiveDesign, design_adaptive_observer
from tsobs_ros.series import stamps_of
from tsobs_ros.simulation.plant import Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

_PERIOD = 8e-3
"""Runge–Kutta step of the plants and observers, which are integrated together [s]."""

_DURATION, SETTLED = 20.0, 10.0
"""Length of Examples 1 and 2, and the time from which their errors count [s]."""

UNCERTAINTIES = np.array([0.0, 1.0])
"""λ of the two plants that are simulated together: without and with the printed ΔA."""

VARIANTS = ("adaptive", "fixed", "noise_fed", "model_only", "consistent")
"""adaptive: the method's observer with its adaptation, Ξ̂ᵢ projected on ‖Ξ̂ᵢ‖ ≤ ξᵢ.
fixed: the same without adaptation.
noise_fed: as fixed, but y is replaced by noise of standard deviation 1; only the premise z is still
    the plant's.
model_only: the model integrated from x̂(0) = 0 with no measurement except z.
consistent: as adaptive, but started at ω̂₀(0) = y(0), so that e_y(0) = 0."""

_NOISE_SEED, _FIRST_SEED = 20110022, 9000

_THETAS = tuple(round(float(theta), 3) for theta in np.geomspace(0.5, 8.0, 13))
"""The grid of θ [1/s] of PO and PIO."""

_ARM_DURATION, _ARM_SETTLED = 60.0, 20.0
"""Length of a run of Example 3, and the time from which its errors count [s]."""

_SCALE = (0.226, 0.60, 3.55, 4.64)  # RMS of the states themselves, in design coordinates


class Estimates(NamedTuple):
    """A variant's x̂, ω̂ by (29), e_y and Ξ̂ᵢ; each with axes (samples, 2, …), λ = 0 and 1."""

    x: Array
    disturbance: Array
    innovation: Array
    Xi: Array


@dataclass(frozen=True)
class ExampleRun:
    """An example with its two plants and their observers.

    Attributes:
        example: The example.
        design: The gains in use, from (37), re-checked.
        times: [s], shape (samples,).
        states: x, shape (samples, 2, n); the second axis is λ ∈ {0, 1}.
        disturbance: ω, shape (samples, p).
        outputs: y, shape (samples, 2, p); the first is the premise.
        estimates: Estimates by variant.
    """

    example: PaperExample
    design: AdaptiveDesign
    times: Array
    states: Array
    disturbance: Array
    outputs: Array
    estimates: dict[str, Estimates]

    def state_error(self, variant: str) -> Array:
        """Return x − x̂, shape (samples, 2, n)."""
        return np.asarray(self.states - self.estimates[variant].x)

    def adaptation(self, variant: str) -> Array:
        """Return the largest ‖Ξ̂ᵢ‖ over the rules, shape (samples, 2)."""
        Xi = self.estimates[variant].Xi
        return np.asarray(np.linalg.norm(Xi, 2, axis=(-2, -1)).max(axis=-1))

    def lyapunov(self, variant: str) -> Array:
        """Return V = ēᵀPē + Σ tr(Ξ̂ᵢᵀΓᵢ⁻¹Ξ̂ᵢ), shape (samples, 2).

        This is the method's V if Ξᵢ = 0, as at λ = 0.
        """
        aug, estimates = self.design.augmentation, self.estimates[variant]
        # ē = x̄ − x̂̄ is T e_x on {C̄x̄ = 0} and e_y across it.
        error = self.state_error(variant) @ aug.blind_basis.T
        error[..., aug.system.state_count :] += estimates.innovation
        scaled = np.linalg.solve(self.example.Gamma, estimates.Xi)
        energy = np.sum(scaled * estimates.Xi, axis=(-3, -2, -1))
        return np.asarray(np.sum(error @ self.design.P * error, axis=-1) + energy)

    def settled_error(self, variant: str, uncertainty: int) -> Array:
        """Return the largest |x − x̂|, |ω − ω̂| from 10 s on, shape (n + p,), at λ = 0 or 1."""
        omega = self.disturbance[:, np.newaxis] - self.estimates[variant].disturbance
        joined = np.concatenate([self.state_error(variant), omega], axis=-1)
        return np.asarray(np.abs(joined[self.times >= SETTLED, uncertainty]).max(axis=0))

    def settled_rms(self, variant: str, uncertainty: int) -> Array:
        """Return the RMS of x − x̂ from 10 s on, shape (n,), at λ = 0 or 1."""
        error = self.state_error(variant)[self.times >= SETTLED, uncertainty]
        return np.asarray(np.sqrt(np.mean(error**2, axis=0)))

    def difference(self, variant: str, since: float = 0.0) -> float:
        """Return the largest |x̂ − x̂'| between `fixed` and another variant from `since` [s] on."""
        difference = self.estimates["fixed"].x - self.estimates[variant].x
        return float(np.abs(difference[self.times >= since]).max())


def run_example(example: PaperExample) -> ExampleRun:
    """Design the observer of Example 1 or 2 and run its `VARIANTS` with λ = 0 and 1."""
    design = design_adaptive_observer(example.system, example.alpha, example.xi)
    aug, system = design.augmentation, example.system
    n, p, size = system.state_count, len(aug.C), len(aug.L)
    A = system.A + np.multiply.outer(UNCERTAINTIES, example.delta_A)
    count = round(_DURATION / _PERIOD) + 1
    # The ends and the middle of each step.
    nodes: Array = np.arange(2 * count - 1) * np.float64(0.5 * _PERIOD)
    omega, u = example.disturbance(nodes), torque(nodes)

    def chosen(*names: str) -> Array:
        return np.isin(VARIANTS, names).astype(float).reshape(-1, 1, 1, 1, 1)

    measured = 1.0 - chosen("model_only")
    observer = AdaptiveObserver(
        aug,
        measured * design.H1,
        measured[:, 0] * design.M,
        chosen("adaptive", "consistent") * example.Gamma,
        example.xi,
    )
    noise = np.random.default_rng(_NOISE_SEED).standard_normal((count, p))
    is_noise = chosen("noise_fed")[..., 0, 0] > 0.0

    def read(x: Array, omega: Array) -> tuple[Array, Array]:
        """Return the measurements and the weights by z = y₁, the same for both rules."""
        h = system.rule_base.weights(x[..., :1] + omega[..., :1])
        return blend(system.rule_outputs, h, x) + omega, h

    def split(state: Array) -> tuple[Array, Array, Array]:
        x, xi, Xi = np.split(state, [n, n + size], axis=-1)
        return x, xi, Xi.reshape(*Xi.shape[:-1], -1, p, size)

    def rates(node: int, state: Array) -> Array:
        """Return the derivative of plants and observers."""
        x, xi, Xi = split(state)
        y, h = read(x, omega[node])
        drawn = 0.5 * (noise[node // 2] + noise[(node + 1) // 2])
        own, learnt = observer.rates(xi, Xi, np.where(is_noise, drawn, y), u[node], h)
        moved = blend(A, h, x) + blend(system.B, h, u[node])
        return np.concatenate([moved, own, learnt.reshape(*own.shape[:-1], -1)], axis=-1)

    states = np.zeros((count, len(VARIANTS), 2, n + size + len(A[0]) * p * size))
    states[0, ..., :n] = example.initial_state
    start = noise[0] = read(states[0, 0, 0, :n], omega[0])[0]
    # ξ(0) = x̂̄(0) − E_L⁻¹L y(0).
    states[0, ..., n : n + size] = -aug.L1 @ start
    states[0, ..., 2 * n : n + size] += chosen("consistent")[..., 0, 0] * start
    for k in range(count - 1):
        now = states[k]
        first = rates(2 * k, now)
        second = rates(2 * k + 1, now + 0.5 * _PERIOD * first)
        third = rates(2 * k + 1, now + 0.5 * _PERIOD * second)
        fourth = rates(2 * k + 2, now + _PERIOD * third)
        states[k + 1] = now + (_PERIOD / 6.0) * (first + 2.0 * (second + third) + fourth)
        Xi = split(states[k + 1])[2]
        states[k + 1, ..., n + size :] = clip(Xi, example.xi).reshape(*now.shape[:-1], -1)
    x, xi, Xi = split(states)
    times, omega = nodes[::2], omega[::2]
    y, h = read(x, omega[:, np.newaxis, np.newaxis])
    x_bar, omega_hat, innovation = observer.estimates(xi, y, h)
    whole = (x_bar[..., :n], omega_hat, innovation, Xi)
    estimates = {
        name: Estimates(*(each[:, place] for each in whole)) for place, name in enumerate(VARIANTS)
    }
    return ExampleRun(example, design, times, x[:, 0], omega, y[:, 0], estimates)


class ObserverErrors(NamedTuple):
    """Errors of one observer, one row per run.

    Attributes:
        rmse: RMSE of the four states in design coordinates, shape (runs, 4).
        theta: Its θ [1/s]; NaN if it has none.
        example: x̂ of the first run, shape (samples, 4).
    """

    rmse: Array
    theta: float
    example: Array

    @property
    def motor_angle(self) -> Array:
        """RMSE of x₃ by run, shape (runs,)."""
        return np.asarray(self.rmse[:, MOTOR_ANGLE])

    @property
    def normalised(self) -> Array:
        """RMS over the states of RMSE over the states' own RMS, by run, shape (runs,)."""
        return np.asarray(np.sqrt(np.mean((self.rmse / np.array(_SCALE)) ** 2, axis=1)))


class ArmComparison(NamedTuple):
    """All observers on the same runs of Example 3.

    Attributes:
        trajectories: The runs.
        observers: PO, PIO, paper (the paper's), ours, EKF (with our disturbance states) and
            EKF clean (with none), in this order.
    """

    trajectories: Trajectories
    observers: dict[str, ObserverErrors]

    @property
    def motor_angle(self) -> dict[str, float]:
        """Mean RMSE of x₃ by observer."""
        return {name: float(one.motor_angle.mean()) for name, one in self.observers.items()}


def compare_on_arm(design: Design, seeds: int) -> ArmComparison:
    """Run every observer on the same noisy arm, once per seed.

    The EKF uses the model and noise densities of the certified design, too.
    """
    runs = simulate(SCENARIOS["noise"], range(_FIRST_SEED, _FIRST_SEED + seeds), _ARM_DURATION)
    arm, asked = ElasticJointArm(), design.arm_request
    period = float(runs.times[1] - runs.times[0])
    known = (period, float(asked.output_std[0]))
    stamps = stamps_of(runs.times)

    def errors(
        observer: Estimator, theta: float = math.nan, starts: Array | None = None
    ) -> ObserverErrors:
        tracker, physical = Tracker(observer, history=0.0, max_steps=1), []
        for run, samples in enumerate(zip(runs.measurements, runs.torques, strict=True)):
            if starts is not None:
                likeliest(observer.model["initial"])["x"] = starts[run]
            tracker.reset()
            physical.append(tracker.follow(stamps, *samples).state)
        estimates, settled = arm.from_physical(np.stack(physical)), runs.times >= _ARM_SETTLED
        error = estimates[..., settled, :] - runs.states[:, settled]
        return ObserverErrors(np.sqrt(np.mean(error**2, axis=-2)), theta, estimates[0])

    def best(make: Callable[..., Estimator]) -> ObserverErrors:
        found = [errors(make(arm, theta, *known), theta) for theta in _THETAS]
        return min(found, key=lambda one: float(one.motor_angle.mean()))

    def kalman(request: ArmRequest) -> ObserverErrors:
        covariances = request.measurement_covariance, request.initial_covariance
        return errors(extended_kalman(request.flow, *covariances, gate=math.inf))

    paper = paper_observer(arm, *known)
    # x̂̄(0) = 0 means ξ(0) = −E_L⁻¹L y(0), which is zero except in the disturbance's state.
    xi = np.hstack([np.zeros((seeds, arm.output_matrix.shape[1])), -runs.measurements[:, 0]])
    observers = {
        "PO": best(high_gain),
        "PIO": best(proportional_integral),
        "paper": errors(paper, starts=xi),
        "ours": errors(design.observer()),
        "EKF": kalman(asked),
        "EKF clean": kalman(replace(asked, disturbance=(DisturbanceTerm("clean"),))),
    }
    return ArmComparison(runs, observers)
