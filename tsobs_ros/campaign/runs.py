# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parts of a campaign: some runs one after the other, and a column for each thing known of them."""

import json
import math
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros import __version__
from tsobs_ros.campaign.batches import claimed, observe, recorded
from tsobs_ros.campaign.definition import Campaign, parse_campaign
from tsobs_ros.campaign.drawing import Drawn, draw_group
from tsobs_ros.campaign.premises import violated
from tsobs_ros.design.file import load_design_file
from tsobs_ros.report.comparison import metrics_options
from tsobs_ros.report.metrics import MetricsOptions, RunMetrics, measure
from tsobs_ros.simulation.plant import Plant

PART = 100
"""Runs in a part: what is computed, sent and written at a time."""

DOMAIN = "domain"
"""The premise that the arm stays in the certificate's domain."""

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Of a table, by name, one entry a run."""


def carry_out(version: str, campaign: str, design: str, begin: int, end: int) -> Columns:
    """Return the columns of a part, as a worker that has the package and nothing else.

    Args:
        version: Expected of the package.
        campaign: Text of the campaign file.
        design: Text of the design file.
        begin: The first run.
        end: The run after the last.

    Raises:
        RuntimeError: This is another version of the package.
    """
    if version != __version__:
        raise RuntimeError(f"a worker has tsobs_ros {__version__}, expected {version}")
    return compute(_campaign(campaign, design), begin, end)


@lru_cache(maxsize=2)
def _campaign(campaign: str, design: str) -> Campaign:
    return Campaign(parse_campaign(campaign, "campaign"), load_design_file("design", design))


def compute(campaign: Campaign, begin: int, end: int) -> Columns:
    """Draw, simulate, observe and score the runs from a number up to another.

    A row depends on the campaign and the run's number alone, whatever runs are computed beside it.

    Raises:
        TsobsError: A scenario does not fit the design.
    """
    design, request = campaign.file.design, campaign.file.design.arm_request
    settle_time = campaign.entries.settle_time
    settled = MetricsOptions(start_settle_time=settle_time, jump_settle_time=settle_time)
    options = metrics_options(design, settled)
    learnt = campaign.settings.learnt(design)
    rows: list[dict[str, Any]] = []
    while begin + len(rows) < end:
        group = draw_group(campaign, begin + len(rows), end)
        scenario = group[0].scenario
        truth = Plant(scenario, [one.seed for one in group]).run(scenario.sample_count)
        observed = observe(design, truth, campaign.settings, campaign.estimator)
        for place, drawn in enumerate(group):
            run = recorded(truth, place, observed.of(place), request)
            estimates, events = observed.rows[place], observed.events[place]
            reach = float(np.abs(truth.physical[place, :, 0]).max())
            rows.append(
                {
                    **_of_drawn(drawn, campaign, reach),
                    **_of_metrics(measure(run, options)),
                    **claimed(run, estimates),
                    **_of_learnt(estimates[-1], learnt),
                    **{name.replace(" ", "_"): number for name, number in events.items()},
                }
            )
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _of_drawn(drawn: Drawn, campaign: Campaign, reach: float) -> dict[str, Any]:
    request = campaign.file.design.arm_request
    start = request.arm.to_physical(np.array(drawn.scenario.initial_state)).tolist()
    broken = violated(drawn.scenario, request) + (DOMAIN,) * (reach > request.max_angle)
    return {
        "run": drawn.run,
        "scenario": drawn.name,
        "seed": drawn.seed,
        "drawn": json.dumps(drawn.numbers),
        **{f"start_{name}": value for name, value in zip(request.state_names, start, strict=True)},
        **{f"true_{name}": value for name, value in drawn.theta.items()},
        "premises_hold": not broken,
        "violated": ", ".join(broken),
        "max_link_angle": reach,
    }


def _of_metrics(metrics: RunMetrics) -> dict[str, float]:
    found = {"normalised_rmse": metrics.normalised_rmse}
    for one in metrics.quantities:
        numbers = {"rmse": one.rmse, "bound": one.bound, "inside": one.inside}
        found |= {f"{one.key}_{what}": number for what, number in numbers.items()}
    return {name: math.nan if number is None else number for name, number in found.items()}


def _of_learnt(last: Any, names: tuple[str, ...]) -> dict[str, float | bool]:
    """Return what was learnt at the end of a run."""
    row: dict[str, float | bool] = {}
    for place, name in enumerate(names):
        row[f"learnt_{name}"] = float(last["parameters"][place])
        row[f"learnt_bound_{name}"] = float(last["parameter_bound"][place])
    return {**row, "learnt_valid": bool(last["parameters_valid"] == 1.0)} if names else row
