# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Runs of the method's examples, the plant once and then every observer on its record.

Examples 1 and 2 run without noise, in five variants of the method's observer. Example 3 is the
nonlinear arm with a little process noise, u = sin t, and white measurement noise of 5 % of the
largest angle, in one run a seed; PO and PIO have the best θ of a grid, the paper's observer its
printed gains.
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
from tsobs_ros.paper.observer import (
    AugmentedEstimates,
    AugmentedObserver,
    paper_observer,
    runge_kutta,
)
from tsobs_ros.paper.synthesis import AdaptiveDesign, design_adaptive_observer
from tsobs_ros.series import NANOSECONDS
from tsobs_ros.simulation.plant import Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

PERIOD = 4e-3
"""Step of plant and observer [s]. Between samples y is taken as linear, which is off by
(T²/8)|ÿ| < 2e-5 for the fastest disturbance of the examples; the tests halve it and see."""

DURATION = 20.0
SETTLED = 10.0
"""Length of Examples 1 and 2, and the time from which their errors count [s]."""

UNCERTAINTIES = (0.0, 1.0)
"""λ of the two plants that are simulated together: without and with the printed ΔA."""

_NOISE_SEED = 20110022

THETAS = tuple(round(float(theta), 3) for theta in np.geomspace(0.5, 8.0, 13))
"""The grid of θ [1/s] of PO and PIO."""

WINDOW_START = 20.0
"""Time from which the errors of Example 3 count [s]."""

_SCALE = (0.226, 0.60, 3.55, 4.64)  # RMS of the states themselves, in design coordinates
_FIRST_SEED = 9000


class PlantRecord(NamedTuple):
    """Signals of the plants.

    Attributes:
        times: [s], shape (samples,).
        states: x, shape (samples, 2, n); the second axis is λ ∈ {0, 1}.
        disturbance: ω, shape (samples, p).
        outputs: y, shape (samples, 2, p).
        premises: z = y₁, shape (samples, 2, 1).
        weights: h, shape (samples, 2, r).
    """

    times: Array
    states: Array
    disturbance: Array
    outputs: Array
    premises: Array
    weights: Array


@dataclass(frozen=True)
class ExampleRun:
    """An example with its plants and their observers.

    Attributes:
        example: The example.
        design: The gains in use, from (37), re-checked.
        plant: The plants' signals.
        estimates: By variant, see `run_example`; the axes of each array begin (samples, 2).
    """

    example: PaperExample
    design: AdaptiveDesign
    plant: PlantRecord
    estimates: dict[str, AugmentedEstimates]

    def state_error(self, variant: str) -> Array:
        """Return x − x̂, shape (samples, 2, n)."""
        return np.asarray(self.plant.states - self.estimates[variant].x)

    def disturbance_error(self, variant: str) -> Array:
        """Return ω − ω̂, shape (samples, 2, p)."""
        truth = self.plant.disturbance[:, np.newaxis]
        return np.asarray(truth - self.estimates[variant].disturbance)

    def adaptation(self, variant: str) -> Array:
        """Return the largest ‖Ξ̂ᵢ‖ over the rules, shape (samples, 2)."""
        Xi = self.estimates[variant].Xi
        return np.asarray(np.linalg.norm(Xi, 2, axis=(-2, -1)).max(axis=-1))

    def lyapunov(self, variant: str) -> Array:
        """Return V = ēᵀPē + Σ tr(Ξ̂ᵢᵀΓᵢ⁻¹Ξ̂ᵢ), shape (samples, 2).

        It is the method's V if Ξᵢ = 0, which is so at λ = 0.
        """
        aug, estimates = self.design.augmentation, self.estimates[variant]
        # ē = x̄ − x̂̄ is T e_x on {C̄x̄ = 0} and e_y across it.
        error = self.state_error(variant) @ aug.blind_basis.T
        error[..., aug.state_count :] += estimates.innovation
        scaled = np.linalg.solve(self.design.Gamma, estimates.Xi)
        energy = np.sum(scaled * estimates.Xi, axis=(-3, -2, -1))
        return np.asarray(np.sum(error @ self.design.P * error, axis=-1) + energy)

    def settled_error(self, variant: str, uncertainty: int) -> Array:
        """Return the largest |x − x̂|, |ω − ω̂| from 10 s on, shape (n + p,).

        Args:
            variant: The observer.
            uncertainty: 0 for λ = 0, 1 for λ = 1.
        """
        joined = np.concatenate([self.state_error(variant), self.disturbance_error(variant)], -1)
        return np.asarray(np.abs(joined[self.plant.times >= SETTLED, uncertainty]).max(axis=0))

    def settled_rms(self, variant: str, uncertainty: int) -> Array:
        """Return the RMS of x − x̂ from 10 s on, shape (n,)."""
        error = self.state_error(variant)[self.plant.times >= SETTLED, uncertainty]
        return np.asarray(np.sqrt(np.mean(error**2, axis=0)))

    def difference(self, variant: str, since: float = 0.0) -> float:
        """Return the largest |x̂ − x̂'| of `fixed` and another variant from `since` [s] on."""
        difference = self.estimates["fixed"].x - self.estimates[variant].x
        return float(np.abs(difference[self.plant.times >= since]).max())


def run_example(
    example: PaperExample, *, period: float = PERIOD, duration: float = DURATION
) -> ExampleRun:
    """Design the observer of Example 1 or 2 and run five variants of it with λ = 0 and 1.

    adaptive: the method's observer with its adaptation, Ξ̂ᵢ projected on ‖Ξ̂ᵢ‖ ≤ ξᵢ.
    fixed: the same without adaptation.
    noise_fed: as fixed, but y is replaced by white noise of standard deviation 1; only the
        premise z is still the plant's.
    model_only: the model integrated from x̂(0) = 0 with no measurement at all but z.
    consistent: as adaptive, but started at ω̂₀(0) = y(0), so that e_y(0) = 0.

    Args:
        example: Example 1 or 2.
        period: Step [s].
        duration: [s].
    """
    design = design_adaptive_observer(
        example.system, example.alpha, example.xi, Gamma=example.Gamma
    )
    plant = _simulate(example, period, duration)
    aug, fixed = design.augmentation, design.observer(adapt=False)
    model_only = AugmentedObserver(aug, np.zeros_like(fixed.H1), np.zeros_like(fixed.M))
    noise = np.random.default_rng(_NOISE_SEED).standard_normal(plant.outputs.shape)
    # ξ(0) = x̂̄(0) − E_L⁻¹L y(0): with a first sample of noise the observer would start elsewhere.
    noise[0] = plant.outputs[0]
    zero = np.zeros((len(UNCERTAINTIES), aug.size))
    fitting = np.hstack([zero[:, : aug.state_count], plant.outputs[0]])
    estimates: dict[str, AugmentedEstimates] = {}
    for observer, variants in (
        (
            design.observer(),
            {"adaptive": (plant.outputs, zero), "consistent": (plant.outputs, fitting)},
        ),
        (fixed, {"fixed": (plant.outputs, zero), "noise_fed": (noise, zero)}),
        (model_only, {"model_only": (plant.outputs, zero)}),
    ):
        fed, starts = zip(*variants.values(), strict=True)
        premises = np.stack([plant.premises] * len(variants), axis=1)
        y, start = np.stack(fed, axis=1), np.stack(starts)
        whole = observer.follow(y, torque(plant.times), period, premises, start)
        for place, name in enumerate(variants):
            estimates[name] = AugmentedEstimates(*(each[:, place] for each in whole))
    return ExampleRun(example, design, plant, estimates)


def _simulate(example: PaperExample, period: float, duration: float) -> PlantRecord:
    system, samples = example.system, round(duration / period) + 1
    # The ends and the middle of each step, so that the signals are exact within it.
    times = np.asarray(np.arange(2 * samples - 1) * (0.5 * period), dtype=np.float64)
    disturbance = np.asarray(example.disturbance(times))
    states = np.empty((samples, len(UNCERTAINTIES), system.state_count))
    states[0] = example.initial_state
    driven = np.einsum("rab,nb->nra", system.B, torque(times))[..., np.newaxis]
    A = system.A + np.multiply.outer(UNCERTAINTIES, example.delta_A)

    def rates(node: int, x: Array) -> Array:
        """Return x' of the plants, shape (plants, n), by the rules of Examples 1 and 2."""
        by_rule = (A @ x[:, np.newaxis, :, np.newaxis] + driven[node])[..., 0]
        z = x[:, :1] + disturbance[node, 0]
        second = np.minimum(z * z, 1.0)
        return np.asarray((1.0 - second) * by_rule[:, 0] + second * by_rule[:, 1])

    for k in range(1, samples):
        states[k] = runge_kutta(rates, 2 * (k - 1), states[k - 1], period)
    times, disturbance = times[::2], disturbance[::2]
    premises: Array = states[..., :1] + disturbance[:, np.newaxis, :1]
    weights = system.rule_base.weights(premises)
    outputs = blend(system.rule_outputs, weights, states) + disturbance[:, np.newaxis]
    return PlantRecord(times, states, disturbance, outputs, premises, weights)


class ObserverErrors(NamedTuple):
    """Errors of one observer, one row a run.

    Attributes:
        rmse: Of the four states in design coordinates, shape (runs, 4).
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


def compare_on_arm(design: Design, seeds: int = 20, *, duration: float = 60.0) -> ArmComparison:
    """Run every observer on the same noisy arm.

    Args:
        design: The certified design; its model and noise densities are the EKF's too.
        seeds: Number of runs.
        duration: Of a run [s], above `WINDOW_START`.
    """
    runs = simulate(SCENARIOS["noise"], range(_FIRST_SEED, _FIRST_SEED + seeds), duration)
    arm, asked = ElasticJointArm(), design.arm_request
    period = float(runs.times[1] - runs.times[0])
    known = (period, asked.measurement_std)
    stamps = NANOSECONDS + np.round(runs.times * NANOSECONDS).astype(np.int64)

    def errors(
        observer: Estimator, theta: float = math.nan, starts: Array | None = None
    ) -> ObserverErrors:
        tracker, physical = Tracker(observer, history=0.0, max_steps=1), []
        for run, samples in enumerate(zip(runs.measurements, runs.torques, strict=True)):
            if starts is not None:
                likeliest(observer.model["initial"])["x"] = starts[run]
            tracker.reset()
            physical.append(tracker.follow(stamps, *samples).state)
        estimates, settled = arm.from_physical(np.stack(physical)), runs.times >= WINDOW_START
        error = estimates[..., settled, :] - runs.states[:, settled]
        return ObserverErrors(np.sqrt(np.mean(error**2, axis=-2)), theta, estimates[0])

    def best(make: Callable[..., Estimator]) -> ObserverErrors:
        found = [errors(make(arm, theta, *known), theta) for theta in THETAS]
        return min(found, key=lambda one: float(one.motor_angle.mean()))

    def kalman(request: ArmRequest) -> ObserverErrors:
        covariances = request.measurement_covariance, request.initial_covariance
        return errors(extended_kalman(request.flow, *covariances, gate=math.inf))

    paper = paper_observer(arm, *known)
    # x̂̄(0) = 0 is ξ(0) = −E_L⁻¹L y(0), which is zero in all states but the disturbance's.
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
