# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Campaigns: what is observed and scored in bulk is what single runs give."""

from dataclasses import replace

import numpy as np
import pytest

from tsobs_ros.campaign.batches import CLAIMS, Observed, observe, score
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.records import Basis, Measurement
from tsobs_ros.methods import ObserverSettings, make_tracker
from tsobs_ros.report.metrics import MetricsOptions, measure
from tsobs_ros.report.quantities import QUANTITIES
from tsobs_ros.report.run import RecordedRun, Series
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
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
        disturbance=observed.disturbances[run],
        disturbance_bounds=observed.disturbance_bounds[run],
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
    worth = random.integers(0, (10, 2), (*shape, 2)).astype(float)
    fields = (("state", 4), ("disturbance", 1), ("state_bound", 4), ("disturbance_bound", 1))
    row_type = [*((name, float, (n,)) for name, n in fields), ("basis", float), ("claimed", float)]
    rows = np.concatenate([estimates, bounds, worth], axis=2).view(row_type)[..., 0]
    observed = Observed(rows, ({},) * 3)
    options = MetricsOptions(start_settle_time=3.0, jump_settle_time=1.0)
    scores = score(runs, observed, options)
    basis, claimed = worth[..., 0], worth[..., 1] == 1.0
    for number, bases in enumerate(CLAIMS.values()):
        there = np.isin(basis, bases)
        said = there | ~claimed if Basis.OUTSIDE in bases else there & claimed
        assert (scores.claimed[:, number] == said.sum(axis=1)).all()
    for run in range(3):
        expected = measure(recorded(runs, observed, run), options)
        for place, (key, *_) in enumerate(QUANTITIES):
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


@pytest.mark.parametrize("method", ["certified", "high_gain"])
def test_what_is_observed_is_what_a_tracker_estimates(method: str) -> None:
    learning = load_design(config_path(SHIPPED_DESIGN))
    # A dropout is longer than what is bridged, and the first samples are lost.
    sensor = Sensor(outlier_probability=0.01, dropout_interval=8.0, dropout_duration=5.6)
    runs = simulate(replace(SCENARIO, sensor=sensor), [5, 6])
    runs.measurements[0, :10] = np.nan
    settings = ObserverSettings(method=method)
    observed = observe(learning, runs, settings)
    stamps = 1_000_000_000 + np.round(runs.times * 1e9).astype(np.int64)
    for run in range(2):
        tracker = make_tracker(learning, settings)
        for sample, stamp in enumerate(stamps.tolist()):
            y, u = runs.measurements[run, sample], runs.torques[run, sample]
            tracker.offer(Measurement(stamp, y, u), stamp)
            one = tracker.estimate(stamp)
            for found, expected in (
                (observed.states, one and one.state),
                (observed.state_bounds, one and one.state_bound),
                (observed.disturbances, one and one.disturbance),
                (observed.disturbance_bounds, one and one.disturbance_bound),
                (observed.parameters, one and one.parameters),
                (observed.parameter_bounds, one and one.parameter_bound),
            ):
                if expected is None or not len(expected):
                    assert np.isnan(found[run, sample]).all()
                else:
                    assert found[run, sample].tolist() == expected.tolist()
        assert observed.events[run] == tracker.events
    assert np.isnan(observed.states).any()


def test_samples_that_are_followed_ascend(design: Design) -> None:
    tracker = make_tracker(design)
    samples = np.zeros((3, 1))
    with pytest.raises(ModelError, match="stamps: expected them to ascend from 0 ns on"):
        tracker.follow([5, 5, 7], samples, samples)
