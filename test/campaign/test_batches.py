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
from tsobs_ros.report.metrics import MetricsOptions
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.plant import Scenario
from tsobs_ros.simulation.scenarios import simulate
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep

SCENARIO = Scenario(
    duration=20.0,
    disturbance=(BiasStep(0.1, 8.0), BiasStep(0.2, 9.5), BiasStep(-0.1, 9.55)),
    sensor=Sensor(outlier_probability=0.01, dropout_interval=6.5, dropout_duration=0.6),
)
"""The second jump chatters, and the last samples are lost."""


def test_scores_are_a_reports_and_by_claim() -> None:
    runs, random = simulate(SCENARIO, [1, 2]), np.random.default_rng(4)
    shape = runs.states.shape[:2]
    truth = np.concatenate([runs.physical, runs.disturbances], axis=2)
    error, bounds = random.normal(0.0, 0.01, truth.shape), np.full(truth.shape, 0.01)
    error[0, :100] = np.nan
    worth = random.integers(0, (10, 2), (*shape, 2)).astype(float)
    fields = (("state", 4), ("disturbance", 1), ("state_bound", 4), ("disturbance_bound", 1))
    row_type = [*((name, float, (n,)) for name, n in fields), ("basis", float), ("claimed", float)]
    rows = np.concatenate([truth + error, bounds, worth], axis=2).view(row_type)[..., 0]
    observed = Observed(rows, ({},) * 2)
    scores = score(runs, observed, MetricsOptions(start_settle_time=3.0, jump_settle_time=1.0))
    # The second jump and its chatter are one; what follows the last measurement does not count.
    measured = np.isfinite(runs.measurements[1, :, 0])
    settled = (runs.times >= 3.0) & (runs.times < runs.times[measured].max())
    settled &= (
        (runs.times < 8.0) | (runs.times >= 10.5) | ((runs.times >= 9.0) & (runs.times < 9.5))
    )
    np.testing.assert_allclose(scores.rmse[1], np.sqrt(np.mean(error[1, settled] ** 2, axis=0)))
    np.testing.assert_allclose(scores.bound, 0.01)
    basis, claimed = worth[..., 0], worth[..., 1] == 1.0
    for number, bases in enumerate(CLAIMS.values()):
        there = np.isin(basis, bases)
        said = there | ~claimed if Basis.OUTSIDE in bases else there & claimed
        assert (scores.claimed[:, number] == said.sum(axis=1)).all()
        ratio = np.abs(error[1, said[1]]) / 0.01
        expected = (ratio <= 3.0).mean(axis=0), np.sqrt((ratio**2).mean(axis=0)), ratio.max(axis=0)
        np.testing.assert_allclose(scores.claims[1, number].T, expected)


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
