# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Campaigns: what is observed and scored in bulk is what single runs give."""

import numpy as np
import pytest

from tsobs_ros.campaign import Observed, score
from tsobs_ros.report.metrics import QUANTITIES, MetricsOptions, measure
from tsobs_ros.report.run import RecordedRun, Series
from tsobs_ros.simulation.plant import Scenario, Trajectories
from tsobs_ros.simulation.scenarios import simulate
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep

SCENARIO = Scenario(
    duration=20.0,
    disturbance=(BiasStep(0.1, 8.0), BiasStep(0.2, 9.5), BiasStep(-0.1, 9.55)),
    sensor=Sensor(outlier_probability=0.01, dropout_interval=6.5, dropout_duration=0.6),
)
"""The second jump chatters, and the last samples are lost."""


def recorded(runs: Trajectories, observed: Observed, run: int) -> RecordedRun:
    stamps = 1_000_000_000 + np.round(runs.times * 1e9).astype(np.int64)
    there = np.isfinite(runs.measurements[run, :, 0])
    return RecordedRun(
        name="run",
        joint="elastic_joint",
        measurements=Series(
            stamps[there], np.hstack([runs.measurements[run], runs.torques[run]])[there]
        ),
        stamps=stamps,
        states=observed.states[run],
        state_bounds=observed.state_bounds[run],
        disturbance=observed.disturbances[run, :, 0],
        disturbance_bounds=observed.disturbance_bounds[run, :, 0],
        truth=Series(stamps, runs.physical[run]),
        true_disturbance=Series(stamps, runs.disturbances[run]),
    )


def test_scores_are_those_of_a_report() -> None:
    runs, random = simulate(SCENARIO, [1, 2, 3]), np.random.default_rng(4)
    shape = runs.states.shape[:2]
    bounds = random.uniform(0.01, 0.03, (*shape, 5))
    truth = np.concatenate([runs.physical, runs.disturbances], axis=2)
    estimates = truth + random.normal(0.0, 0.01, truth.shape)
    estimates[0, 2000:2100], bounds[1, 3000:3100] = np.nan, np.inf
    estimates[2, :, 3] = np.nan
    observed = Observed(estimates[..., :4], bounds[..., :4], estimates[..., 4:], bounds[..., 4:])
    options = MetricsOptions(start_settle_time=3.0, jump_settle_time=1.0)
    scores = score(runs, observed, options)
    for run in range(3):
        expected = measure(recorded(runs, observed, run), options)
        for place, (key, _, _) in enumerate(QUANTITIES):
            one = expected[key]
            for found, value in (
                (scores.rmse, one.rmse),
                (scores.bound, one.bound),
                (scores.inside, one.inside),
            ):
                if value is None or (found is scores.bound and one.rmse is None):
                    assert np.isnan(found[run, place])
                else:
                    assert found[run, place] == pytest.approx(value, rel=1e-12)
        if expected.normalised_rmse is None:
            assert np.isnan(scores.normalised_rmse[run])
        else:
            assert scores.normalised_rmse[run] == pytest.approx(expected.normalised_rmse, rel=1e-12)
