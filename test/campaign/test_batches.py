# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Campaigns: what is observed and scored in bulk is what single runs give."""

import numpy as np
import pytest

from tsobs_ros.campaign.batches import CLAIMS, claimed, recorded
from tsobs_ros.estimation.records import Basis
from tsobs_ros.report.metrics import measure
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


def test_errors_are_a_reports_and_by_claim() -> None:
    runs, random = simulate(SCENARIO, [1, 2]), np.random.default_rng(4)
    shape = runs.states.shape[:2]
    truth = np.concatenate([runs.physical, runs.disturbances], axis=2)
    error, bounds = random.normal(0.0, 0.01, truth.shape), np.full(truth.shape, 0.01)
    worth = random.integers(0, (len(Basis), 2), (*shape, 2)).astype(float)
    fields = (("state", 4), ("disturbance", 1), ("state_bound", 4), ("disturbance_bound", 1))
    row_type = [*((name, float, (n,)) for name, n in fields), ("basis", float), ("claimed", float)]
    rows = np.concatenate([truth + error, bounds, worth], axis=2).view(row_type)[..., 0]
    run = recorded(runs, 1, {name: rows[name][1] for name, _ in fields})
    metrics = measure(run, settle_time=1.0)
    # The second jump and its chatter are one; what follows the last measurement does not count.
    last = runs.times[np.isfinite(runs.measurements[1, :, 0])].max()
    windows = [(1.0, 8.0), (9.0, 9.5), (10.5, last)]
    assert np.array(metrics.windows) == pytest.approx(np.array(windows))
    settled = np.any([(a <= runs.times) & (runs.times < b) for a, b in windows], axis=0)
    rmse = [one.rmse for one in metrics.quantities]
    np.testing.assert_allclose(rmse, np.sqrt(np.mean(error[1, settled] ** 2, axis=0)))
    found = claimed(run, rows[1])
    basis, is_claimed = worth[1, :, 0], worth[1, :, 1] == 1.0
    for name, bases in CLAIMS.items():
        there = np.isin(basis, bases)
        said = there | ~is_claimed if Basis.OUTSIDE in bases else there & is_claimed
        assert found[f"{name}_samples"] == said.sum()
        ratio = np.abs(error[1, said, 0]) / 0.01
        expected = (ratio <= 3.0).mean(), np.sqrt((ratio**2).mean()), ratio.max()
        numbers = [found[f"link_angle_{name}_{what}"] for what in ("inside", "ratio", "worst")]
        assert numbers == pytest.approx(expected)
