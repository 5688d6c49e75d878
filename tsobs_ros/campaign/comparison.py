# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of observers on the same simulated scenarios."""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from tsobs_ros.campaign.batches import observe, recorded
from tsobs_ros.checks import check_names, positive
from tsobs_ros.design.record import Design
from tsobs_ros.errors import ModelError
from tsobs_ros.methods import METHODS, ObserverSettings
from tsobs_ros.replay.estimate import Observer, without_misfits
from tsobs_ros.report.comparison import aligned, number_text
from tsobs_ros.report.metrics import measure
from tsobs_ros.simulation.plant import Scenario, Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate
from tsobs_ros.simulation.sensor import Sensor

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
"""The scenarios of `tsobs compare`: the arm as designed, each kind of sensor fault, wrong
parameters, and a force that the model lacks."""

HIGH_GAIN = ("high_gain", "proportional_integral")
THETAS = tuple(np.geomspace(0.7, 20.0, 12).tolist())
"""Values of θ [rad/s], of which each high-gain observer takes the best."""


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

    A scenario has the errors of each observer, and `theta` of high-gain observers [rad/s].

    The scenarios have the design's arm, and rate and noise in proportion to the design's. Seeds are
    0, 1, …. Methods that cannot observe the arm are left out, with a remark. Runs are as long as
    those of the scenario, unless `duration` [s] is given.

    Raises:
        ModelError: A name is unknown, there are no seeds, no observer can observe the arm, or
            the link angle is not the design's only output.
    """
    positive("seeds", seeds)
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
        runs = simulate(_fitted(SCENARIOS[name], design), range(seeds), duration)
        found, thetas = dict[str, Any](), {}
        for one in observers:
            chosen = one.settings
            if one.name in HIGH_GAIN:
                chosen = _tuned(design, chosen, runs)
                thetas[one.name] = chosen.theta
            found[one.name] = _errors(design, chosen, runs)
            advance(seeds)
        return {**found, "theta": thetas}

    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        rows = dict(zip(scenarios, pool.map(compared, scenarios), strict=True))
    blank = [
        name
        for name, found in rows.items()
        if any(found[one.name]["normalised_rmse"] is None for one in observers)
    ]
    if blank:
        remarks.append(
            f"–: runs of {', '.join(blank)} are too short to settle, never settle, or have numbers "
            "that are not finite"
        )
    return {
        "seeds": seeds,
        "observers": {one.name: METHODS[one.name] for one in observers},
        "scenarios": rows,
        "notes": [
            "normalised RMSE of the four states over what counts as settled; root mean square "
            f"over {seeds} runs",
            "high_gain, proportional_integral: their θ is the best one of the scenario's first run",
            "paper: uses no measurement of the arm, see docs/method.md",
            *remarks,
        ],
    }


def render_scenarios(comparison: Mapping[str, Any]) -> str:
    """Return a comparison as text, a column for each scenario."""
    about, scenarios = comparison["observers"], comparison["scenarios"]
    table = [["", *scenarios]]
    for name in about:
        cells = (number_text(each[name]["normalised_rmse"]) for each in scenarios.values())
        table.append([name, *cells])
    width = max(map(len, about))
    described = [f"{name:<{width}}  {text}" for name, text in about.items()]
    lines = [*aligned(table, text_columns=1), "", *described, "", *comparison["notes"]]
    return "\n".join(lines)


def _errors(design: Design, settings: ObserverSettings, runs: Trajectories) -> dict[str, Any]:
    """Return an observer's errors in the runs of a scenario, as plain data."""
    observed = observe(design, runs, settings)
    each_run = range(len(runs.physical))
    measured = [measure(recorded(runs, run, observed.of(run))) for run in each_run]
    normalised = [one.normalised_rmse for one in measured]
    quantities = zip(*(one.quantities for one in measured), strict=True)
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


def _fitted(scenario: Scenario, design: Design) -> Scenario:
    """Return a scenario with a design's arm, and rate and noise in proportion to the design's."""
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


def _tuned(design: Design, settings: ObserverSettings, runs: Trajectories) -> ObserverSettings:
    """Return settings with the best θ of the first run."""
    first = Trajectories(runs.times, *(each[:1] for each in runs[1:]))

    def error(choice: ObserverSettings) -> float:
        found: float | None = _errors(design, choice, first)["normalised_rmse"]
        return math.inf if found is None else found

    return min((replace(settings, theta=theta) for theta in THETAS), key=error)
