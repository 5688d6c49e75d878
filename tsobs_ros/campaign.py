# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo campaigns: many runs simulated, observed and scored, on all cores."""

import math
import os
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled_nogil
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.baselines import KalmanFilter
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.records import NANOSECONDS
from tsobs_ros.estimation.state import CONDITIONS
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.methods import FILTERS, ObserverSettings, make_estimator, make_runner
from tsobs_ros.report.metrics import SAME_JUMP, SIGMAS, MetricsOptions
from tsobs_ros.simulation.plant import Scenario, Trajectories
from tsobs_ros.simulation.scenarios import simulate

Case = tuple[Scenario, Sequence[int]]
"""A scenario and the seeds of its runs."""


class Observed(NamedTuple):
    """Estimates of a batch of runs, at each sample from the samples up to it; NaN if there is none.

    Attributes:
        states: Estimated [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (runs, samples, 4).
        state_bounds: 1σ bound of each, NaN if the method has none, shape (runs, samples, 4).
        disturbances: Estimated disturbance of the sensor [rad], shape (runs, samples, 1).
        disturbance_bounds: 1σ bound of it [rad], shape (runs, samples, 1).
        parameters: Learnt changes θ of the model's parameters, shape (runs, samples, k).
        parameter_bounds: 1σ of each, shape (runs, samples, k).
        conditions: What the numbers are worth, by the names of `state.CONDITIONS`, each of shape
            (runs, samples).
        events: What the supervision counted in each run.
    """

    states: Array
    state_bounds: Array
    disturbances: Array
    disturbance_bounds: Array
    parameters: Array
    parameter_bounds: Array
    conditions: dict[str, Array]
    events: tuple[dict[str, int], ...]


class Scores(NamedTuple):
    """Errors of estimates over the settled parts of each run, by the measures of a report.

    The quantities are those of `report.metrics.QUANTITIES`. NaN stands for what is not known.

    Attributes:
        rmse: Root mean square errors, shape (runs, 5).
        bound: Root mean squares of the 1σ bounds, shape (runs, 5).
        inside: Shares of the errors inside `SIGMAS` times their bound, shape (runs, 5).
        normalised_rmse: Root mean square over the four states of RMSE / scale, shape (runs,).
    """

    rmse: Array
    bound: Array
    inside: Array
    normalised_rmse: Array


def run_all(
    design: Design,
    cases: Iterable[Case],
    settings: ObserverSettings | None = None,
    options: MetricsOptions | None = None,
    threads: int | None = None,
) -> Iterator[Scores]:
    """Simulate, observe and score many runs, on all cores; yield the scores of each case in order.

    They do not depend on the number of threads, nor on which runs are in one case. A thread takes
    one case at a time, and about 400 bytes of memory for each of its samples.

    Args:
        design: The design of an arm.
        cases: Best of a few runs each.
        settings: Method, gates and timeouts; the node's defaults if None.
        options: Which parts of a run are settled, and the scale; the defaults if None.
        threads: The number of cores if None.

    Raises:
        ModelError: The method cannot observe this arm, or a seed is negative.

    >>> import tsobs_ros as ts
    >>> from tsobs_ros.campaign import run_all
    >>> from tsobs_ros.simulation.scenarios import SCENARIOS
    >>> case = (SCENARIOS["noise"], range(4))
    >>> [float(max(s.normalised_rmse)) < 0.2 for s in run_all(ts.load_design(), [case])]
    [True]
    """
    estimator = _estimator(design, settings or ObserverSettings())
    count = threads or os.cpu_count() or 1

    def scores(case: Case) -> Scores:
        runs = simulate(*case)
        return score(runs, observe(design, runs, settings, estimator), options)

    with ThreadPoolExecutor(count) as pool:
        waiting: deque[Future[Scores]] = deque()
        for case in cases:
            waiting.append(pool.submit(scores, case))
            if len(waiting) > 2 * count:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def observe(
    design: Design,
    runs: Trajectories,
    settings: ObserverSettings | None = None,
    estimator: Estimator | None = None,
) -> Observed:
    """Observe a batch of runs by what the node runs; the bits are those of `ts.estimate`.

    Args:
        design: The design of an arm.
        runs: A batch of runs.
        settings: Method, gates and timeouts; the node's defaults if None.
        estimator: The observer, if it is made already.

    Raises:
        ModelError: The method cannot observe this arm.
    """
    settings = settings or ObserverSettings()
    tracker = _runner(design, settings, estimator)
    stamps = NANOSECONDS + np.round(runs.times * NANOSECONDS).astype(np.int64)
    rows, events = [], []
    for y, u in zip(runs.measurements, runs.torques, strict=True):
        tracker.reset()
        rows.append(tracker.follow(stamps, y, u))
        events.append(tracker.events)
    shape, layout = (len(rows), len(stamps)), tracker.estimator

    def field(name: str, width: int) -> Array:
        part = layout.row_parts[name]
        if part.stop == part.start:
            return np.full((*shape, width), np.nan)
        return np.stack([row[:, part] for row in rows])

    return Observed(
        field("state", 4),
        field("state_bound", 4),
        field("disturbance", 1),
        field("disturbance_bound", 1),
        field("parameters", 0),
        field("parameter_bound", 0),
        {
            name: np.stack([row[:, place] for row in rows])
            for place, name in enumerate(CONDITIONS, layout.row_width - len(CONDITIONS))
        },
        tuple(events),
    )


def _estimator(design: Design, settings: ObserverSettings) -> Estimator | None:
    return None if settings.method in FILTERS else make_estimator(design, settings)


def _runner(
    design: Design, settings: ObserverSettings, estimator: Estimator | None
) -> Tracker | KalmanFilter:
    estimator = estimator or _estimator(design, settings)
    if estimator is None:
        return make_runner(design, settings)
    # Nothing is late.
    limits = TrackerOptions(
        design.arm_request.max_angle, history=0.0, restart_after=settings.stale_after, max_steps=1
    )
    return Tracker(estimator, limits)


def score(runs: Trajectories, observed: Observed, options: MetricsOptions | None = None) -> Scores:
    """Score estimates of a batch of runs.

    Args:
        runs: What is true.
        observed: Estimates at the same samples.
        options: Which parts of a run are settled, and the scale; the defaults if None.
    """
    options = options or MetricsOptions()
    kept = np.array(
        [
            options.start_settle_time,
            options.jump_settle_time,
            options.jump_threshold,
            SAME_JUMP,
            SIGMAS,
        ]
    )
    sums = np.zeros((len(runs.states), 5, 5))
    _add_up(
        kept,
        runs.times,
        runs.physical,
        runs.disturbances,
        runs.measurements,
        np.ascontiguousarray(observed.states),
        np.ascontiguousarray(observed.state_bounds),
        np.ascontiguousarray(observed.disturbances),
        np.ascontiguousarray(observed.disturbance_bounds),
        sums,
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        rmse = np.sqrt(sums[..., 0] / sums[..., 1])
        bound = np.sqrt(sums[..., 2] / sums[..., 3])
        inside = sums[..., 4] / sums[..., 3]
    relative = rmse[:, :4] / np.array(options.scale)
    return Scores(rmse, bound, inside, np.sqrt((relative * relative).sum(axis=1) / 4.0))


@compiled_nogil
def _add_up(
    kept: Array,
    times: Array,
    true_states: Array,
    true_disturbances: Array,
    measurements: Array,
    states: Array,
    state_bounds: Array,
    disturbances: Array,
    disturbance_bounds: Array,
    sums: Array,
) -> None:
    """Add up, for each run and quantity: error², errors, bound², bounds, errors inside."""
    after_start, after_jump, threshold, same_jump, sigmas = kept
    for run in range(sums.shape[0]):
        # The run ends with its last measurement, which does not count.
        last = times.shape[0] - 1
        while last > 0 and math.isnan(measurements[run, last, 0]):
            last -= 1
        settled, jumped = times[0] + after_start, -math.inf
        for sample in range(last):
            time, truth = times[sample], true_disturbances[run, sample, 0]
            if sample > 0 and abs(truth - true_disturbances[run, sample - 1, 0]) > threshold:
                # A fault that chatters is one event, which begins with its first jump.
                if time - jumped > same_jump:
                    settled = max(settled, time + after_jump)
                jumped = time
            if time < settled:
                continue
            for place in range(5):
                if place < 4:
                    error = states[run, sample, place] - true_states[run, sample, place]
                    bound = state_bounds[run, sample, place]
                else:
                    error = disturbances[run, sample, 0] - truth
                    bound = disturbance_bounds[run, sample, 0]
                if math.isfinite(error):
                    total = sums[run, place]
                    total[0] += error * error
                    total[1] += 1.0
                    if math.isfinite(bound):
                        total[2] += bound * bound
                        total[3] += 1.0
                        if abs(error) <= sigmas * bound:
                            total[4] += 1.0
