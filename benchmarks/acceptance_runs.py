# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The contenders of the acceptance benchmark on simulated runs, and the errors that they make.

Errors are those of the estimate at a sample, after its correction if it was not lost, in design
coordinates. PO and PIO hold a sample until the next one, so theirs is the estimate before it.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from acceptance_ekf import AugmentedFilter, knowing_filter
from numpy.typing import NDArray

from tsobs_ros import campaign
from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.estimator import Estimator, certified_estimator
from tsobs_ros.estimation.options import (
    TORQUE_RATE,
    CertifiedGain,
    GainMode,
    SupervisionOptions,
)
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.uncertainty import Uncertainty, arm_uncertainty
from tsobs_ros.simulation.plant import Scenario, Trajectories

SCALE = np.array([0.226, 0.60, 3.55, 4.64])
"""Typical size of the motion in design coordinates, by which errors are divided."""

WINDOWS = {"settled": (45.0, 60.0), "full": (20.0, 60.0)}
"""Parts of a run [s]."""

BOUNDS = {"stiffness": 0.4, "gravity": 0.4}
"""What the adaptive contenders are told to be uncertain."""

GRID = np.geomspace(0.7, 20.0, 12)
"""θ of the PO and the PIO [1/s]."""

STEP, CALM, HOLD = 30.0, (20.0, 30.0), 5.0
"""When the sensor steps, the calm before it, how long errors have to stay small after it [s]."""

LOUD = 4.0
"""Errors beyond so many times their root mean square have not settled.

Without a step, 5 of 30 runs pass three times it within nine seconds, and none four times.
"""

STEP_SIZE = 0.1
"""What the disturbance's error is divided by when that is judged [rad]."""


class Outcome(NamedTuple):
    """What one contender did in a scenario, each run by itself.

    Attributes:
        errors: Normalised RMSE by window, shape (runs,).
        theta: RMS error of each parameter over the settled window, shape (runs, k).
        settled_after: Time after the step of the sensor until settled again [s], shape (runs,).
        events: What the supervision counted in each run.
        tuning: θ of a PO or a PIO by window.
    """

    errors: dict[str, Array]
    theta: Array | None = None
    settled_after: Array | None = None
    events: list[dict[str, int]] | None = None
    tuning: dict[str, float] | None = None


def uncertainty_of(design: Design) -> Uncertainty:
    """Return what the adaptive contenders learn."""
    return arm_uncertainty(design.request.arm, BOUNDS)


def supervised(design: Design, mode: GainMode, adaptive: bool = True) -> Estimator:
    """Return the observer under test."""
    request = design.request
    observer = certified_estimator(
        request.flow,
        request.measurement_covariance,
        request.initial_covariance,
        CertifiedGain(design.K, design.covariance_bound),
        gain_mode=mode,
        torque_rate=TORQUE_RATE,
        uncertainty=uncertainty_of(design) if adaptive else None,
    )
    observer.supervise(SupervisionOptions())
    return observer


def true_theta(scenario: Scenario) -> Array:
    """Return the parameters to be learnt."""
    return np.array([scenario.mismatch.stiffness, scenario.mismatch.gravity_torque])


def observe(
    design: Design, make: Callable[[], Estimator], runs: Trajectories
) -> tuple[Array, Array | None, list[dict[str, int]]]:
    """Return estimates (runs, samples, 5), parameters (runs, samples, k) if any, and events.

    The fifth estimate is the disturbance.
    """
    found = campaign.observe(design, runs, estimator=make())
    states = design.arm_request.arm.from_physical(found.states)
    estimates = np.concatenate([states, found.disturbances], axis=2)
    learns = found.parameters.shape[2] > 0
    return estimates, found.parameters if learns else None, list(found.events)


def knowing(design: Design, scenario: Scenario, runs: Trajectories) -> Array:
    """Return the estimates of the EKF that knows the true arm."""
    found = knowing_filter(design, scenario.true_arm).observe(runs.measurements, runs.torques)
    return np.concatenate([scenario.arm.from_physical(found.state), found.disturbance], axis=2)


def augmented(design: Design, runs: Trajectories) -> tuple[Array, Array]:
    """Return the estimates and parameters of the EKF that has them as states."""
    ekf = AugmentedFilter(design, uncertainty_of(design))
    state = ekf.initial(runs.states.shape[:1])
    n, H = ekf.flow.state_count, ekf.flow.disturbance.H[0]
    estimates = _room(runs)
    thetas = np.empty((*runs.states.shape[:2], ekf.uncertainty.count))
    with np.errstate(all="ignore"):  # a filter that diverges is a result
        for sample in range(estimates.shape[1]):
            y = runs.measurements[:, sample]
            if np.isfinite(y).all():
                state = ekf.correct(state, y)
            estimates[:, sample, :4], thetas[:, sample] = state.x[:, :4], state.x[:, n:]
            estimates[:, sample, 4] = state.x[:, 4:n] @ H
            state = ekf.predict(state, runs.torques[:, sample])
    return estimates, thetas


def high_gain(
    kind: Callable[[ElasticJointArm, float, float, float], Estimator],
    design: Design,
    runs: Trajectories,
) -> Outcome:
    """Return the outcome at the best θ of the grid, chosen for each window."""
    request = design.arm_request
    found: dict[str, list[Array]] = {name: [] for name in WINDOWS}
    for theta in GRID.tolist():
        observer = kind(request.arm, theta, request.period, request.measurement_std)
        states = observer.observe(runs.measurements, runs.torques).state
        squares = _squares(request.arm.from_physical(states), runs)
        for name, window in WINDOWS.items():
            part = squares[:, _inside(runs.times, window)]
            found[name].append(np.sqrt(part.mean(axis=1)))
    errors, tuning = {}, {}
    for name, each in found.items():
        best = int(np.mean(each, axis=1).argmin())
        errors[name], tuning[name] = each[best], float(GRID[best])
    return Outcome(errors, tuning=tuning)


def outcome(
    scenario: Scenario,
    runs: Trajectories,
    estimates: Array,
    thetas: Array | None = None,
    events: list[dict[str, int]] | None = None,
) -> Outcome:
    """Return the errors of estimates (runs, samples, 5)."""
    with np.errstate(all="ignore"):
        squares = _squares(estimates[..., :4], runs)
        disturbed = ((estimates[..., 4] - runs.disturbances[..., 0]) / STEP_SIZE) ** 2
        errors = {
            name: np.sqrt(squares[:, _inside(runs.times, window)].mean(axis=1))
            for name, window in WINDOWS.items()
        }
    theta = None
    if thetas is not None:
        wrong = (thetas - true_theta(scenario))[:, _inside(runs.times, WINDOWS["settled"])]
        theta = np.sqrt((wrong**2).mean(axis=1))
    steps = any(one.kind == "bias_step" for one in scenario.disturbance)
    after = settled_after(runs.times, np.sqrt(0.8 * squares + 0.2 * disturbed)) if steps else None
    return Outcome(errors, theta, after, events)


def settled_after(times: Array, errors: Array) -> Array:
    """Return when each run's error (runs, samples) has settled after the step [s].

    The error is the root mean square over the four states, normalised, and the disturbance, by
    0.1 rad: the states alone hardly notice a step that is found at once. It has settled when it
    stays, for `HOLD` seconds, below `LOUD` times its root mean square over all runs in the calm
    before the step. Infinite if it never does.
    """
    calm = np.sqrt((errors[:, _inside(times, CALM)] ** 2).mean()) if (times >= STEP).any() else 0.0
    after = times >= STEP
    result = np.full(len(errors), np.inf)
    for run, error in enumerate(errors[:, after]):
        loud = times[after][~(error < LOUD * calm)]
        begins = np.concatenate([[STEP], loud])
        ends = np.concatenate([loud, [times[-1]]])
        quiet = np.flatnonzero(ends - begins >= HOLD)
        if len(quiet):
            result[run] = begins[quiet[0]] - STEP
    return result


def _squares(states: Array, runs: Trajectories) -> Array:
    """Return the mean of the four squared errors of a sample, shape (runs, samples)."""
    return np.asarray((((states - runs.states) / SCALE) ** 2).mean(axis=2))


def _room(runs: Trajectories) -> Array:
    return np.empty((*runs.states.shape[:2], 5))


def _inside(times: Array, window: tuple[float, float]) -> NDArray[np.bool_]:
    return (times >= window[0]) & (times < window[1])
