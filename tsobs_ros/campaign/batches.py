# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Batches of simulated runs: their estimates, and the scores of these estimates."""

import json
import math
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.campaign.definition import Campaign
from tsobs_ros.campaign.drawing import draw_group, violated
from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.estimation.estimator import Estimator, Rows
from tsobs_ros.estimation.records import Basis
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.model.arm import SIDES
from tsobs_ros.report.metrics import SIGMAS, measure
from tsobs_ros.report.run import ESTIMATED, RecordedRun
from tsobs_ros.series import Series, stamps_of
from tsobs_ros.simulation.plant import Plant, Trajectories

CLAIMS = ("certified", "learnt", "covariance", "none")
"""The claim of a bound by its basis: the certificate's bound, the certificate's except for the
learnt parameters, or a covariance; "none" if no bound is claimed."""

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Columns of a table by name, with one entry per run."""


class Observed(NamedTuple):
    """Estimates of a batch of runs, at each sample from the samples up to it; NaN if there is none.

    Attributes:
        rows: Records of `Estimator.row_type`, shape (runs, samples).
        events: The counts of the supervision in each run.
    """

    rows: Rows
    events: tuple[dict[str, int], ...]

    def of(self, run: int) -> dict[str, Array]:
        """Return the estimates of a run, by the names in `ESTIMATED`."""
        return {name: np.asarray(self.rows[name][run]) for name in ESTIMATED}


def observe(
    design: Design,
    runs: Trajectories,
    settings: ObserverSettings | None = None,
    estimator: Estimator | None = None,
) -> Observed:
    """Observe a batch of runs as the node does; the result is bit for bit that of `ts.estimate`.

    The settings are by default the node's; `estimator` is one to use instead of a new one.

    Raises:
        ModelError: The method cannot observe this arm.
    """
    settings = settings or ObserverSettings()
    tracker = Tracker(
        estimator or make_estimator(design, settings),
        x_max=design.arm_request.max_angle,
        history=0.0,  # nothing is late
        restart_after=settings.stale_after,
        max_steps=1,
    )
    rows, events, stamps = [], [], stamps_of(runs.times)
    for y, u in zip(runs.measurements, runs.torques, strict=True):
        tracker.reset()
        rows.append(tracker.follow(stamps, y, u))
        events.append(tracker.events)
    return Observed(np.stack(rows), tuple(events))


def recorded(
    runs: Trajectories, run: int, estimates: Mapping[str, Array], request: ArmRequest | None = None
) -> RecordedRun:
    """Return one run of a batch as if it had been recorded, with estimates by their names.

    The default request has one encoder on the link and no torque disturbance.
    """
    request = request or ArmRequest()
    sides = request.torque_sides
    stamps = stamps_of(runs.times)
    there = np.flatnonzero(np.isfinite(runs.measurements[run]).any(axis=1))
    measured = np.hstack([runs.measurements[run], runs.torques[run]])
    torques = runs.torque_disturbances[run][:, [SIDES.index(side) for side in sides]]
    parts = {
        "true_state": runs.physical[run],
        "true_disturbance": runs.disturbances[run],
        "true_torque_disturbance": torques,
        **estimates,
    }
    # A method without bounds has no columns of bounds.
    series = {name: Series(stamps, values) for name, values in parts.items() if values.shape[1]}
    series["measurements"] = Series(stamps[there], measured[there])
    return RecordedRun("run", "run", series, request=request)


def claimed(run: RecordedRun, rows: Rows) -> dict[str, int | float]:
    """Return statistics of the errors by the claim of their bounds, whether settled or not.

    For each of `CLAIMS`, these are the number of samples and, for each quantity, the share of
    errors inside `SIGMAS` times their bound, and the root mean square and the maximum of
    error / bound, NaN without samples.
    """
    # The first two claims have the codes of their bases. The basis is NaN without an estimate.
    basis = rows["basis"]
    said = np.minimum(basis, 2.0)
    is_bad = (rows["claimed"] == 0.0) | np.isin(basis, (Basis.CONTRADICTED, Basis.OUTSIDE))
    said[np.isfinite(basis) & is_bad] = 3.0
    found: dict[str, int | float] = {
        f"{name}_samples": int((said == claim).sum()) for claim, name in enumerate(CLAIMS)
    }
    for quantity in run.quantities:
        one = run.of(quantity)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.abs(one.error) / one.bounds
        for claim, name in enumerate(CLAIMS):
            own = ratio[np.isfinite(ratio) & (said == claim)]
            numbers = [math.nan] * 3
            if len(own):
                numbers = [np.mean(own <= SIGMAS), np.sqrt(np.mean(own * own)), own.max()]
            for what, number in zip(("inside", "ratio", "worst"), numbers, strict=True):
                found[f"{quantity.key}_{name}_{what}"] = float(number)
    return found


def compute(
    campaign: Campaign, begin: int, end: int, stopped: Callable[[], bool] = lambda: False
) -> Columns:
    """Draw, simulate, observe and score the runs from `begin` up to, but not including, `end`.

    A row depends only on the campaign and the run's number, not on runs computed together with it.

    Raises:
        CancelledError: `stopped` became true before the end.
        TsobsError: A scenario does not fit the design.
    """
    design, request = campaign.design, campaign.design.arm_request
    learnt = campaign.settings.learnt(design)
    rows: list[dict[str, Any]] = []
    while begin + len(rows) < end:
        if stopped():
            raise CancelledError
        group = draw_group(campaign, begin + len(rows), end)
        scenario = group[0].scenario
        truth = Plant(scenario, [one.seed for one in group]).run(scenario.sample_count)
        observed = observe(design, truth, campaign.settings, campaign.estimator)
        start = request.arm.to_physical(np.array(scenario.initial_state)).tolist()
        for place, drawn in enumerate(group):
            run = recorded(truth, place, observed.of(place), request)
            metrics = measure(run, settle_time=campaign.entries.settle_time)
            reach = float(np.abs(truth.physical[place, :, 0]).max())
            broken = violated(scenario, request) + ("domain",) * (reach > request.max_angle)
            # Nothing is proved about, and nothing known of, a motion that is not finite.
            broken += ("divergence",) * (not np.isfinite(truth.physical[place]).all())
            row: dict[str, Any] = {"run": drawn.run, "scenario": drawn.name, "seed": drawn.seed}
            row["drawn"] = json.dumps(drawn.numbers)
            row |= {f"start_{name}": x for name, x in zip(request.state_names, start, strict=True)}
            row |= {f"true_{name}": x for name, x in drawn.theta.items()}
            row |= {"premises_hold": not broken, "violated": ", ".join(broken)}
            row |= {"max_link_angle": reach, "normalised_rmse": metrics.normalised_rmse}
            for one in metrics.quantities:
                names = [f"{one.quantity.key}_{what}" for what in ("rmse", "bound", "inside")]
                row |= zip(names, (one.rmse, one.bound, one.inside), strict=True)
            row = {name: math.nan if x is None else x for name, x in row.items()}
            row |= claimed(run, observed.rows[place])
            last = observed.rows[place][-1]
            for at, name in enumerate(learnt):
                row[f"learnt_{name}"] = float(last["parameters"][at])
                row[f"learnt_bound_{name}"] = float(last["parameter_bound"][at])
            if learnt:
                row["learnt_valid"] = bool(last["parameters_valid"] == 1.0)
            row |= {k.replace(" ", "_"): count for k, count in observed.events[place].items()}
            rows.append(row)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}
