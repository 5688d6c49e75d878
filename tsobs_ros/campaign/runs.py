# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parts of a campaign: some runs one after the other, and a column for each thing known of them."""

import json
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros import __version__
from tsobs_ros.campaign.batches import CLAIMS, BatchObserver, Observed, Scores, score
from tsobs_ros.campaign.definition import Campaign, parse_campaign
from tsobs_ros.campaign.drawing import Drawn, draw_group
from tsobs_ros.campaign.premises import violated
from tsobs_ros.design.file import load_design_file
from tsobs_ros.report.comparison import metrics_options
from tsobs_ros.report.metrics import MetricsOptions
from tsobs_ros.report.quantities import Quantity, quantities_of
from tsobs_ros.simulation.plant import Plant

PART = 100
"""Runs in a part: what is computed, sent and written at a time."""

DOMAIN = "domain"
"""The premise that the arm stays in the certificate's domain."""

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Of a table, by name, one entry a run."""


class Order(NamedTuple):
    """A part for a worker that has the package and nothing else.

    Attributes:
        campaign: Text of the campaign file.
        design: Text of the design file.
        version: Of the package.
        begin: The first run.
        end: The run after the last.
    """

    campaign: str
    design: str
    version: str
    begin: int
    end: int


def order(campaign: Campaign, begin: int, end: int) -> Order:
    """Return the order of a part of a campaign."""
    return Order(campaign.text("design"), campaign.file.text, __version__, begin, end)


def carry_out(task: Order) -> Columns:
    """Return the columns of a part.

    Raises:
        RuntimeError: This is another version of the package.
    """
    if task.version != __version__:
        raise RuntimeError(f"a worker has tsobs_ros {__version__}, expected {task.version}")
    return compute(_campaign(task.campaign, task.design), task.begin, task.end)


@lru_cache(maxsize=2)
def _campaign(campaign: str, design: str) -> Campaign:
    file = load_design_file("design", design)
    return Campaign(parse_campaign(campaign, "campaign"), file)


def compute(campaign: Campaign, begin: int, end: int) -> Columns:
    """Draw, simulate, observe and score the runs from a number up to another.

    A row depends on the campaign and the run's number alone, whatever runs are computed beside it.

    Raises:
        TsobsError: A scenario does not fit the design.
    """
    design, request = campaign.file.design, campaign.file.design.arm_request
    observer = BatchObserver(design, campaign.settings, campaign.estimator)
    settle_time = campaign.entries.settle_time
    settled = MetricsOptions(start_settle_time=settle_time, jump_settle_time=settle_time)
    quantities, options = quantities_of(request), metrics_options(design, settled)
    rows: list[dict[str, Any]] = []
    while begin + len(rows) < end:
        group = draw_group(campaign, begin + len(rows), end)
        scenario = group[0].scenario
        truth = Plant(scenario, [one.seed for one in group]).run(scenario.sample_count)
        observed = observer(truth)
        scores = score(truth, observed, options, quantities, request.torque_sides)
        for place, drawn in enumerate(group):
            rows.append(
                {
                    **_of_drawn(drawn, campaign),
                    **_of_scores(scores, place, quantities, drawn, campaign),
                    **_of_estimates(observed, place, campaign),
                }
            )
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _of_drawn(drawn: Drawn, campaign: Campaign) -> dict[str, Any]:
    request = campaign.file.design.arm_request
    start = request.arm.to_physical(np.array(drawn.scenario.initial_state)).tolist()
    return {
        "run": drawn.run,
        "scenario": drawn.name,
        "seed": drawn.seed,
        "drawn": json.dumps(drawn.numbers),
        **{f"start_{name}": value for name, value in zip(request.state_names, start, strict=True)},
        **{f"true_{name}": value for name, value in drawn.theta.items()},
    }


def _of_scores(
    scores: Scores,
    run: int,
    quantities: tuple[Quantity, ...],
    drawn: Drawn,
    campaign: Campaign,
) -> dict[str, Any]:
    request = campaign.file.design.arm_request
    reach = float(scores.reach[run])
    broken = violated(drawn.scenario, request) + (DOMAIN,) * (reach > request.max_angle)
    row: dict[str, Any] = {
        "premises_hold": not broken,
        "violated": ", ".join(broken),
        "max_link_angle": reach,
        "normalised_rmse": float(scores.normalised_rmse[run]),
    }
    for place, quantity in enumerate(quantities):
        for name in ("rmse", "bound", "inside"):
            row[f"{quantity.key}_{name}"] = float(getattr(scores, name)[run, place])
    for claim, name in enumerate(CLAIMS):
        row[f"{name}_samples"] = int(scores.claimed[run, claim])
        for place, quantity in enumerate(quantities):
            inside, ratio, worst = scores.claims[run, claim, place].tolist()
            numbers = {"inside": inside, "ratio": ratio, "worst": worst}
            row |= {f"{quantity.key}_{name}_{what}": number for what, number in numbers.items()}
    return row


def _of_estimates(observed: Observed, run: int, campaign: Campaign) -> dict[str, Any]:
    """Return what was learnt at the end of a run, and what was counted."""
    names = campaign.settings.learnt(campaign.file.design)
    row: dict[str, Any] = {}
    for field, what in (("parameters", "learnt"), ("parameter_bound", "learnt_bound")):
        last = observed.field(field)[run, -1] if names else ()
        row |= {f"{what}_{name}": float(each) for name, each in zip(names, last, strict=True)}
    if names:
        row["learnt_valid"] = bool(observed.field("parameters_valid")[run, -1] == 1.0)
    return row | {name.replace(" ", "_"): n for name, n in observed.events[run].items()}
