# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The parts of a campaign, and where they are computed: threads or a Dask cluster."""

import json
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros import __version__
from tsobs_ros.campaign.batches import claimed, observe, recorded
from tsobs_ros.campaign.definition import Campaign, CampaignError, parse_campaign
from tsobs_ros.campaign.drawing import Drawn, draw_group
from tsobs_ros.campaign.premises import violated
from tsobs_ros.design.file import load_design_file
from tsobs_ros.report.metrics import RunMetrics, innovation_std, measure
from tsobs_ros.simulation.plant import Plant

DOMAIN = "domain"
"""The premise that the arm stays in the certificate's domain."""

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Of a table, by name, one entry per run."""

Part: TypeAlias = tuple[int, int]
"""A part's first run, and the run after its last."""

_CONNECT_TIMEOUT = 30


def on_threads(
    campaign: Campaign, parts: Sequence[Part], count: int
) -> Iterator[tuple[Part, Columns]]:
    """Yield the columns of parts, computed by some threads, in the order of the parts.

    Raises:
        TsobsError: A scenario does not fit the design.
    """
    pool = ThreadPoolExecutor(count)
    try:
        yield from zip(parts, pool.map(lambda part: compute(campaign, *part), parts), strict=True)
    finally:
        pool.shutdown(cancel_futures=True)


def on_cluster(
    campaign: Campaign, parts: Sequence[Part], scheduler: str
) -> Iterator[tuple[Part, Columns]]:
    """Yield the columns of parts as the workers of a Dask scheduler have computed them.

    Raises:
        CampaignError: The cluster cannot do it.
        TsobsError: A scenario does not fit the design.
    """
    # Slow to import, and for clusters only.
    import distributed

    dask: Any = distributed  # without types
    try:
        client = dask.Client(scheduler, timeout=_CONNECT_TIMEOUT)
    except (OSError, ValueError) as error:
        raise CampaignError(f"scheduler {scheduler}: cannot be reached: {error}") from error
    texts = __version__, campaign.text("design"), campaign.file.text
    try:
        with client:
            futures = {
                client.submit(_carry_out, *texts, *part, pure=False, retries=0): part
                for part in parts
            }
            for future in dask.as_completed(futures):
                try:
                    columns = future.result()
                except dask.KilledWorker as error:
                    raise CampaignError(
                        f"scheduler {scheduler}: workers died again and again at runs from "
                        f"{futures[future][0]}: {error}"
                    ) from error
                yield futures[future], columns
                future.release()
    except (CancelledError, OSError) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise CampaignError(
            f"scheduler {scheduler}: the connection was lost: {reason}; the same command goes on "
            "with the runs that are missing"
        ) from error


def _carry_out(version: str, campaign: str, design: str, begin: int, end: int) -> Columns:
    """Return the columns of a part, as a worker that has the package and the texts of files."""
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
    expected = innovation_std(design)
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
                    **_of_metrics(measure(run, expected, settle_time)),
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
