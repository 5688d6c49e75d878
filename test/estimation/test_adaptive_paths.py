# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The adaptive step has a quick way for one output: the same numbers as the general way."""

import numpy as np

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.adaptive import AdaptiveObserver
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

DESIGN = load_design(config_path("elastic_joint_adaptive.design.yaml"))
T = 0.005


def general_way() -> AdaptiveObserver:
    """Return an observer that takes the way of several outputs, whatever their number."""
    observer = AdaptiveObserver(DESIGN.observer(), DESIGN.request.uncertainty_model)
    observer.regression = None
    return observer


def test_one_output_takes_a_quick_way_to_the_same_numbers() -> None:
    run = simulate(SCENARIOS["stiff"], [4], 15.0)
    quick = AdaptiveObserver(DESIGN.observer(), DESIGN.request.uncertainty_model)
    general = general_way()
    states = [quick.initial(), general.initial()]
    for y, u in zip(run.measurements[0], run.torques[0], strict=True):
        for place, observer in enumerate((quick, general)):
            corrected, _ = observer.correct(states[place], y)
            states[place] = observer.predict(corrected, u, T)
    one, other = states
    assert one.observer.certified
    assert np.abs(one.theta).max() > 0.1
    for a, b in (
        (one.observer.x, other.observer.x),
        (one.theta, other.theta),
        (one.gamma, other.gamma),
        (one.upsilon, other.upsilon),
        (one.gram, other.gram),
    ):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9)
