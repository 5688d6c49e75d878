# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The shipped scenarios and their Monte Carlo runs, by their statistics."""

from dataclasses import replace

import numpy as np
import pytest

from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate


def test_start_and_noise_have_the_stated_statistics() -> None:
    runs = simulate(SCENARIOS["noise"], range(2000), 0.05)
    start = runs.states[:, 0]
    # 2000 runs: 1σ of a mean is 2.2 % of the spread, of a standard deviation 1.6 %.
    spread = np.array([0.05, 0.1, 0.5, 0.5])
    np.testing.assert_allclose((start.mean(axis=0) - [0.3, 0, 2, 0]) / spread, 0.0, atol=0.09)
    np.testing.assert_allclose(start.std(axis=0), spread, rtol=0.065)
    np.testing.assert_allclose(np.corrcoef(start.T), np.eye(4), atol=0.09)
    noise = runs.measurements[..., 0] - runs.states[..., 0]
    assert noise.std() == pytest.approx(0.028, rel=0.02)
    assert not runs.disturbances.any()


def test_an_arm_is_held_where_it_is() -> None:
    runs = simulate(replace(SCENARIOS["held"], process_noise=ProcessNoise(0.0, 0.0)), [0], 10.0)
    assert runs.physical[0, -1] == pytest.approx([0.5, 0.0, 0.5 + np.sin(0.5), 0.0], abs=1e-9)
