# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The contenders of the acceptance benchmark on simulated runs, and their errors.

Errors are those of the estimate at a sample, in design coordinates, after the correction unless the
sample was lost. PO and PIO hold a sample until the next one, so for them it is the estimate before
the sample. A lost sample loses its torque, too: ours accounts for that, the others hold the last.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.campaign.batches import observe
from tsobs_ros.campaign.comparison import THETAS
from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.baselines import GATE, extended_kalman
from tsobs_ros.estimation.estimator import CONSTANTS, Estimator, Rows
from tsobs_ros.estimation.records import Hypothesis
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.simulation.plant import Scenario, Trajectories
from tsobs_ros.simulation.signals import BiasStep

SCALE = np.array([0.226, 0.60, 3.55, 4.64])
"""Typical size of the motion in design coordinates; errors are divided by it."""

WINDOWS = {"settled": (45.0, 60.0), "full": (20.0, 60.0)}
"""Parts of a run [s]."""

STEP, CALM, HOLD = 30.0, (20.0, 30.0), 5.0
"""Time of the sensor's step, calm before it, and time that errors must stay small after it [s]."""

LOUD = 4.0
"""Errors beyond this many times their root mean square have not settled.

Without a step, 5 of 30 runs exceed three times it within nine seconds, and none four times.
"""

STEP_SIZE = 0.1
"""Divisor of the disturbance's error for that judgement [rad]."""


class Found(NamedTuple):
    """Estimates of a contender, at each sample of some runs.

    Attributes:
        estimates: Four states in design coordinates and the disturbance, shape (runs, samples, 5).
        bounds: 1σ of them.
        thetas: Relative changes of stiffness and gravity, shape (runs, samples, k).
        theta_bounds: 1σ of them.
        rows: All results of ours, as `campaign.batches.Observed.rows`.
        events: Counts of the supervision in each run.
    """

    estimates: Array
    bounds: Array
    thetas: Array | None = None
    theta_bounds: Array | None = None
    rows: Any = None
    events: list[dict[str, int]] | None = None


class Outcome(NamedTuple):
    """The results of one contender in a scenario, each run by itself.

    Shares refer to the samples of the full window.

    Attributes:
        errors: Normalised RMSE by window, shape (runs,).
        inside: Shares of errors within three bounds, of the states and the disturbance, (runs, 5).
        width: Root mean square of each bound over that of its error, shape (runs, 5).
        claimed: Share of samples whose bounds are claimed to hold, shape (runs,).
        broken: Share of them in which an error is beyond three bounds, 0 if there are none.
        honest: Share of samples with every error within three bounds, or with bounds that are not
            claimed to hold.
        foreign: Longest time with another hypothesis than the design's, from the start on [s].
        theta: RMS error of each parameter over the settled window, shape (runs, k).
        theta_inside: Share of valid parameters within three bounds, NaN if none is valid, (runs,).
        settled_after: Time after the step of the sensor until settled again [s], shape (runs,).
        events: Counts of the supervision in each run.
        tuning: θ of a PO or a PIO by window.
    """

    errors: dict[str, Array]
    inside: Array | None = None
    width: Array | None = None
    claimed: Array | None = None
    broken: Array | None = None
    honest: Array | None = None
    foreign: Array | None = None
    theta: Array | None = None
    theta_inside: Array | None = None
    settled_after: Array | None = None
    events: list[dict[str, int]] | None = None
    tuning: dict[str, float] | None = None


def true_theta(scenario: Scenario) -> Array:
    """Return the parameters to be learnt."""
    return np.array([scenario.mismatch.stiffness, scenario.mismatch.gravity_torque])


def filter_alone(design: Design, settings: ObserverSettings) -> Estimator:
    """Return the design's filter without other hypotheses and without a gate."""
    estimator = make_estimator(design, settings)
    estimator.model["supervised"], estimator.model["gate"] = 0, np.inf
    return estimator


def ours(
    design: Design,
    runs: Trajectories,
    mode: str = "certified",
    *,
    adapt: bool = True,
    alone: bool = False,
) -> Found:
    """Return the estimates of the node, or of the design's filter alone."""
    settings = ObserverSettings(gain_mode=mode, adapt=adapt)
    estimator = filter_alone(design, settings) if alone else make_estimator(design, settings)
    found = observe(design, runs, settings, estimator)
    to_design = design.arm_request.arm.from_physical
    parameters, bounds = found.rows["parameters"], found.rows["parameter_bound"]
    learns = parameters.shape[2] > 0
    return Found(
        *(
            np.concatenate([to_design(found.rows[state]), found.rows[disturbance]], axis=2)
            for state, disturbance in (
                ("state", "disturbance"),
                ("state_bound", "disturbance_bound"),
            )
        ),
        parameters if learns else None,
        bounds if learns else None,
        found.rows,
        list(found.events),
    )


def kalman(
    design: Design,
    runs: Trajectories,
    arm: ElasticJointArm | None = None,
    *,
    learns: bool = False,
    gated: bool = False,
    resets: bool = True,
) -> Found:
    """Return the estimates of an EKF.

    Args:
        design: Model, noise and start.
        runs: The measurements.
        arm: The filter's model; the nominal arm if None.
        learns: Whether stiffness and gravity are states.
        gated: Whether it has a gate.
        resets: Whether it opens its covariance after leaving out most samples for a while.
    """
    request = replace(design.arm_request, arm=arm or design.arm_request.arm)
    filter_ = extended_kalman(
        request.flow,
        request.measurement_covariance,
        request.initial_covariance,
        request.uncertainty_model if learns else None,
        gate=GATE if gated else np.inf,
    )
    if not resets:
        filter_.model["constants"][0, CONSTANTS["REJECTING"]] = 0.0
    rows = observe(design, runs, estimator=filter_).rows
    x, std, disturbance, disturbance_std, theta = (
        np.asarray(rows[name])
        for name in ("state", "state_bound", "disturbance", "disturbance_bound", "parameters")
    )
    to_design = design.arm_request.arm.from_physical
    return Found(
        np.concatenate([to_design(x), disturbance], axis=2),
        np.concatenate([to_design(std), disturbance_std], axis=2),
        theta if learns else None,
    )


def received(runs: Trajectories) -> Array:
    """Return the known torques, shape (runs, samples, 1).

    A lost sample loses its torque, too; the torque before it is held.
    """
    there = np.isfinite(runs.measurements)
    places = np.maximum.accumulate(np.where(there, np.arange(there.shape[1])[:, np.newaxis], 0), 1)
    return np.take_along_axis(runs.torques, places, 1)


def high_gain(
    kind: Callable[[ElasticJointArm, float, float, float], Estimator],
    design: Design,
    runs: Trajectories,
) -> Outcome:
    """Return the outcome at the best θ of the grid, chosen for each window."""
    request = design.arm_request
    found: dict[str, list[Array]] = {name: [] for name in WINDOWS}
    for theta in THETAS:
        observer = kind(request.arm, theta, request.period, request.measurement_std)
        known = runs._replace(torques=received(runs))
        states = np.asarray(observe(design, known, estimator=observer).rows["state"])
        squares = _squares(request.arm.from_physical(states), runs)
        for name, window in WINDOWS.items():
            part = squares[:, is_inside(runs.times, window)]
            found[name].append(np.sqrt(part.mean(axis=1)))
    errors, tuning = {}, {}
    for name, each in found.items():
        best = int(np.mean(each, axis=1).argmin())
        errors[name], tuning[name] = each[best], THETAS[best]
    return Outcome(errors, tuning=tuning)


def outcome(scenario: Scenario, runs: Trajectories, found: Found) -> Outcome:
    """Return the outcome of estimates."""
    settled, full = (is_inside(runs.times, WINDOWS[name]) for name in ("settled", "full"))
    with np.errstate(all="ignore"):  # a filter that diverges is a result
        squares = _squares(found.estimates[..., :4], runs)
        wrong = found.estimates[..., 4] - runs.disturbances[..., 0]
        errors = {
            name: np.sqrt(squares[:, is_inside(runs.times, window)].mean(axis=1))
            for name, window in WINDOWS.items()
        }
        truth = np.concatenate([runs.states, runs.disturbances], axis=2)
        away, bounds = np.abs(found.estimates - truth)[:, full], found.bounds[:, full]
        kept = away <= SIGMAS * bounds
        width = np.sqrt((bounds**2).mean(axis=1) / (away**2).mean(axis=1))
    worth = {} if found.rows is None else _worth(found.rows, kept, full, runs.times)
    theta = theta_inside = after = None
    if found.thetas is not None:
        away = np.abs(found.thetas - true_theta(scenario))
        theta = np.sqrt((away[:, settled] ** 2).mean(axis=1))
        if found.theta_bounds is not None and found.rows is not None:
            valid = found.rows["parameters_valid"][:, full] > 0.0
            near = (away <= SIGMAS * found.theta_bounds)[:, full].all(axis=2)
            with np.errstate(invalid="ignore"):
                theta_inside = (near & valid).sum(axis=1) / valid.sum(axis=1)
    if any(isinstance(one, BiasStep) for one in scenario.outputs[0].disturbance):
        size = np.sqrt(0.8 * squares + 0.2 * (wrong / STEP_SIZE) ** 2)
        after = settled_after(runs.times, size)
    return Outcome(
        errors,
        inside=kept.mean(axis=1),
        width=width,
        theta=theta,
        theta_inside=theta_inside,
        settled_after=after,
        events=found.events,
        **worth,
    )


def _worth(
    rows: Rows, kept: NDArray[np.bool_], full: NDArray[np.bool_], times: Array
) -> dict[str, Array]:
    """Return the claims of an outcome, by the names of its fields."""
    claims, every = rows["claimed"][:, full] == 1.0, kept.all(axis=2)
    foreign = rows["hypothesis"] != Hypothesis.AS_DESIGNED
    longest = np.zeros(len(foreign))
    length = np.zeros(len(foreign))
    for sample in foreign.T:
        length = np.where(sample, length + 1.0, 0.0)
        longest = np.maximum(longest, length)
    return {
        "claimed": claims.mean(axis=1),
        "broken": (claims & ~every).sum(axis=1) / np.maximum(claims.sum(axis=1), 1),
        "honest": (every | ~claims).mean(axis=1),
        "foreign": longest * (times[1] - times[0]),
    }


def settled_after(times: Array, errors: Array) -> Array:
    """Return the time after the step at which each run's error (runs, samples) has settled [s].

    The error is the root mean square of the four normalised states and of the disturbance divided
    by 0.1 rad: the states alone hardly show a step that is found at once. It has settled when it
    stays below `LOUD` times its root mean square, over all runs in the calm before the step, for
    `HOLD` seconds. The time is infinite if it never does.
    """
    calm = (
        np.sqrt((errors[:, is_inside(times, CALM)] ** 2).mean()) if (times >= STEP).any() else 0.0
    )
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


def is_inside(times: Array, window: tuple[float, float]) -> NDArray[np.bool_]:
    """Return which times [s] are in a window, begin <= time < end."""
    return (times >= window[0]) & (times < window[1])
