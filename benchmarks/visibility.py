# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Visibility of a wrong model to a sensor: the likelihood ratio of the right model.

The right model is a Kalman filter with the true arm; its torque is shifted by the delay of the
sensor. The other model has the nominal arm and learns stiffness and gravity, by the design's own
recursion. Both start alike. The log likelihood ratio is summed from 10 s on, when the parameters
are learnt. No test distinguishes the models better than this ratio (Neyman and Pearson), so no test
can detect reliably a fault for which the ratio stays at a few nats.
"""

from collections.abc import Iterator
from dataclasses import replace
from multiprocessing import Pool

import numpy as np
from acceptance_runs import filter_alone
from common import design_of, parser, show, use_one_thread
from pages import head, options_of, row

from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.series import Stamps, stamps_of
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

CASES = (
    "noise", "stiff", "late_10ms", "late_20ms", "light_link", "heavy_link", "light_motor",
    "heavy_motor",
)  # fmt: skip
"""Scenarios whose only model error is in the arm or in the stamps."""

_LEARNT = 10.0
"""Time at which the sum begins [s]."""


def log_likelihood(design: Design, stamps: Stamps, y: Array, u: Array) -> float:
    """Return the log likelihood of a run's samples by the design's filter, with Riccati gains."""
    estimator = filter_alone(design, ObserverSettings(gain_mode="riccati"))
    tracker = Tracker(estimator, history=0.0, max_steps=1)
    got = tracker.offer_many(stamps, y, u, int(stamps[-1]))
    counted = (stamps >= stamps[0] + _LEARNT * 1e9) & np.isfinite(got.innovations[:, 0])
    std = got.expected_std[counted, 0]
    ratio = got.innovations[counted, 0] / std
    return float(-(0.5 * ratio * ratio + np.log(std)).sum())


def _work(job: tuple[str, Design, tuple[int, ...]]) -> tuple[str, list[float]]:
    """Return the log likelihood ratio of the right model for each run."""
    name, design, seeds = job
    scenario = SCENARIOS[name]
    runs = simulate(scenario, seeds)
    right = synthesise(replace(design.arm_request, arm=scenario.true_arm, uncertainty={}))
    late = round(scenario.outputs[0].sensor.latency * scenario.rate)
    stamps, found = stamps_of(runs.times), []
    for y, u in zip(runs.measurements, runs.torques, strict=True):
        earlier = np.concatenate([np.repeat(u[:1], late, axis=0), u[: len(u) - late]])
        given = log_likelihood(right, stamps, y, earlier[: len(y)])
        found.append(given - log_likelihood(design, stamps, y, u[: len(y)]))
    return name, found


def _table(results: dict[str, list[float]]) -> Iterator[str]:
    yield from head("scenario", "log likelihood ratio of the right model [nat]", "least", "most")
    for name, each in results.items():
        yield row(name, *(f"{value:.1f}" for value in (np.mean(each), min(each), max(each))))


def main() -> None:
    """Measure and print."""
    options = options_of(parser(__doc__), CASES)
    design = design_of(options)
    jobs = [(name, design, tuple(options.seeds)) for name in options.scenarios]
    with Pool(options.processes) as pool:
        results = dict(pool.imap(_work, jobs))
    show(results, "\n".join(_table(results)), options.json)


if __name__ == "__main__":
    use_one_thread()
    main()
