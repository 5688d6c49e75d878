# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers on the same simulated scenarios, and the least errors that there can be."""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from tsobs_ros.campaign.batches import observe, recorded
from tsobs_ros.campaign.drawing import violated
from tsobs_ros.checks import check_names
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.cramer_rao import cramer_rao_std
from tsobs_ros.methods import METHODS, ObserverSettings
from tsobs_ros.model.disturbance import DisturbanceTerm, sum_of
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.replay.estimate import Observer, without_misfits
from tsobs_ros.report.comparison import aligned, number_text
from tsobs_ros.report.metrics import RunMetrics, measure
from tsobs_ros.report.quantities import JUMP
from tsobs_ros.simulation.plant import Scenario, Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import GaussMarkov, StuckSensor

DEFAULT_SCENARIOS = (
    "noise",
    "bias_step",
    "sinusoid",
    "drift",
    "dropouts",
    "stiff_bias_step",
    "stiff_many_outliers",
    "friction",
)
"""What `tsobs compare` simulates: as designed, each kind of fault of the sensor, wrong parameters,
and a force that the model lacks."""

HIGH_GAIN = ("high_gain", "proportional_integral")
THETAS = tuple(np.geomspace(0.7, 20.0, 12).tolist())
"""θ to choose the best from for observers of high gain [rad/s]."""

BOUND = "pcrb"
"""Name of the posterior Cramér–Rao bound."""

ABOUT = {
    **METHODS,
    BOUND: "least error of an estimator that is not biased by the sensor's offset, if it knows "
    "the arm, the rest of the disturbance and when it jumps (posterior Cramér–Rao bound)",
}
"""What each row of the table is."""

_BIASED = [
    "certified_fixed, ekf_plain, ekf: take the parameters for known, so that pcrb holds if they "
    "are right",
    "high_gain, proportional_integral: take an offset of the sensor for motion, so that no bound "
    "holds; their θ is the best one of the scenario's first run",
    "paper: uses no measurement of the arm, see docs/method.md",
]
"""Why the bound does not hold for observers."""

_OFFSET_STD = 0.3
"""1σ of the sensor's offset beforehand [rad], as of the default disturbance model."""

_UNBOUNDED = {
    "friction", "payload", "backlash", "torque disturbance", "torque error", "coloured noise",
    "bursts", "latency", "resolution",
}  # fmt: skip
"""What the bound's model lacks, as `violated` names it."""


def compare_scenarios(
    design: Design,
    scenarios: Sequence[str] = DEFAULT_SCENARIOS,
    seeds: int = 20,
    methods: Sequence[str] = tuple(METHODS),
    *,
    settings: ObserverSettings | None = None,
    duration: float | None = None,
    advance: Callable[[int], None] = lambda _: None,
) -> dict[str, Any]:
    """Run observers on simulated scenarios, on all cores; return plain data that JSON can hold.

    A scenario has the scores of each observer, and the least errors of a run as `BOUND`; `theta` of
    observers of high gain [rad/s]; and in `unbounded` why it has no bound, None if it has.

    The scenarios' arm is the design's; rate and noise are in proportion to its own. Seeds are 0, 1,
    …; methods that cannot observe the arm are left out, with a remark; runs are as long as the
    scenario's, unless a duration is given [s].

    Raises:
        ModelError: A name is unknown, no observer can observe the arm, or it has not the link
            angle as its only output.
    """
    check_names("scenario", scenarios, SCENARIOS)
    request = design.arm_request
    unfit = request.torque_sides or request.sensors[0].delay
    if request.output_names != ("link_angle",) or unfit:
        raise ModelError(
            "scenarios: expected a design with the link angle as its only output, without delay "
            f"and torque disturbance, got {', '.join(request.output_names)}"
        )
    settings = settings or ObserverSettings()
    each = [Observer(name, replace(settings, method=name), (design,)) for name in methods]
    observers, remarks = without_misfits(each)

    def compared(name: str) -> dict[str, Any]:
        scenario = fitted(SCENARIOS[name], design)
        runs = simulate(scenario, range(seeds), duration)
        found, thetas = dict[str, Any](), {}
        for one in observers:
            chosen = one.settings
            if one.name in HIGH_GAIN:
                chosen = _tuned(design, chosen, runs)
                thetas[one.name] = chosen.theta
            found[one.name] = scores(_measured(design, chosen, runs))
            advance(seeds)
        reason = why_unbounded(scenario)
        found |= {} if reason else {BOUND: _bound(scenario, runs)}
        return {**found, "theta": thetas, "unbounded": reason or None}

    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        rows = dict(zip(scenarios, pool.map(compared, scenarios), strict=True))
    names = [one.name for one in observers]
    names += [BOUND] * any(BOUND in row for row in rows.values())
    unbounded = {name: row["unbounded"] for name, row in rows.items() if row["unbounded"]}
    return {
        "seeds": seeds,
        "observers": {name: ABOUT[name] for name in names},
        "scenarios": rows,
        "notes": [
            "normalised RMSE of the four states over what counts as settled; root mean square "
            f"over {seeds} runs",
            *(f"no bound for {name}: it has {reason}" for name, reason in unbounded.items()),
            *_BIASED,
            *remarks,
        ],
    }


def render_scenarios(comparison: Mapping[str, Any]) -> str:
    """Return a comparison as text, a column for each scenario."""
    about, scenarios = comparison["observers"], comparison["scenarios"]
    table = [["", *scenarios]]
    for name in about:
        cells = (each.get(name, {}).get("normalised_rmse") for each in scenarios.values())
        table.append([name, *map(number_text, cells)])
    width = max(map(len, about))
    described = [f"{name:<{width}}  {text}" for name, text in about.items()]
    lines = [*aligned(table, text_columns=1), "", *described, "", *comparison["notes"]]
    return "\n".join(lines)


def scores(runs: Sequence[RunMetrics]) -> dict[str, Any]:
    """Return an observer's errors in the runs of a scenario, as plain data."""
    normalised = [run.normalised_rmse for run in runs]
    quantities = zip(*(run.quantities for run in runs), strict=True)
    rmse = {each[0].quantity.key: _root_mean([one.rmse for one in each]) for each in quantities}
    return {
        "normalised_rmse": _root_mean(normalised),
        "rmse": rmse,
        "normalised_rmse_of_runs": normalised,
    }


def _root_mean(values: Sequence[float | None]) -> float | None:
    """Return the root mean square; infinite if a run diverged, None if no run has a value."""
    if all(value is None for value in values):
        return None
    with np.errstate(over="ignore"):
        return math.sqrt(np.mean([np.inf if one is None else np.square(one) for one in values]))


def fitted(scenario: Scenario, design: Design) -> Scenario:
    """Return a scenario with the arm of a design, and rate and noise in proportion to its own."""
    request, (output,) = design.arm_request, scenario.outputs
    noise = output.sensor.noise_std * float(request.output_std[0]) / Sensor().noise_std
    return replace(
        scenario,
        arm=request.arm,
        rate=request.rate * scenario.rate / Scenario().rate,
        process_noise=request.process_noise,
        outputs=(replace(output, sensor=replace(output.sensor, noise_std=noise)),),
        torque=request.torque,
    )


def _measured(design: Design, settings: ObserverSettings, runs: Trajectories) -> list[RunMetrics]:
    observed = observe(design, runs, settings)
    places = range(len(runs.physical))
    return [measure(recorded(runs, run, observed.of(run))) for run in places]


def _tuned(design: Design, settings: ObserverSettings, runs: Trajectories) -> ObserverSettings:
    """Return settings with the best θ of the first run."""
    some = Trajectories(runs.times, *(each[:1] for each in runs[1:]))
    choices = [replace(settings, theta=theta) for theta in THETAS]

    def error(choice: ObserverSettings) -> float:
        (run,) = _measured(design, choice, some)
        return math.inf if run.normalised_rmse is None else run.normalised_rmse

    return min(choices, key=error)


def why_unbounded(scenario: Scenario) -> str:
    """Return why a scenario has no Cramér–Rao bound, empty if it has one."""
    found = [name for name in violated(scenario, ArmRequest(uncertainty={})) if name in _UNBOUNDED]
    stuck = any(isinstance(each, StuckSensor) for each in scenario.outputs[0].disturbance)
    return ", ".join([*found, *["a stuck sensor"] * stuck])


def _bound(scenario: Scenario, runs: Trajectories) -> dict[str, Any]:
    """Return the Cramér–Rao bound with known parameters."""
    arm = scenario.true_arm
    drifts = [each for each in scenario.outputs[0].disturbance if isinstance(each, GaussMarkov)]
    terms = [
        DisturbanceTerm("gauss_markov", {"std": each.std, "time_constant": each.time_constant})
        for each in drifts[:1]
    ]
    flow = ArmFlow(arm, sum_of(terms), scenario.process_noise, 1.0 / scenario.rate)
    to_arm = arm.from_physical(scenario.arm.to_physical(np.ones(4)))
    # A drift leaves zero at its start.
    start = np.concatenate([np.array(scenario.initial_spread) * to_arm, [1e-9] * len(drifts)])
    steps = np.abs(np.diff(runs.disturbances[0, :, 0]))
    jumps = (1 + np.flatnonzero(steps > JUMP)).tolist()
    # An estimator that knew which samples are outliers would use all others.
    sensor = scenario.outputs[0].sensor
    share = np.isfinite(runs.measurements[..., 0]).mean(axis=0) * (1.0 - sensor.outlier_probability)
    if degrees := sensor.noise_degrees:  # Fisher information of Student's t
        share *= (degrees + 1.0) / (degrees + 3.0)
    std = cramer_rao_std(
        flow,
        arm.from_physical(runs.physical),
        share / sensor.noise_std**2,
        initial_std=start,
        offset_std=_OFFSET_STD,
        jumps=jumps,
    )
    # As errors of one run, so that they are averaged over the same samples.
    least = {
        "state": runs.physical[0] + std[:, :4],
        "disturbance": runs.disturbances[0] + std[:, 4:5],
    }
    return scores([measure(recorded(runs, 0, least))])
