# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers by name: run elsewhere as the node runs them."""

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.errors import ModelError
from tsobs_ros.methods import CERTIFIED, METHODS, ObserverSettings, make_tracker, warning
from tsobs_ros.resources import config_path


@pytest.fixture(scope="module")
def example_1() -> Design:
    return load_design(config_path("paper_example_1.design.yaml"))


@pytest.mark.parametrize("method", METHODS)
def test_a_system_is_observed_by_the_methods_that_fit(method: str, example_1: Design) -> None:
    """At rest with a disturbance on the second output; the others see no state move."""
    settings = ObserverSettings(method=method)
    if method not in (*CERTIFIED, "ekf", "paper"):
        with pytest.raises(ModelError, match=f"method {method}: expected a design for an arm"):
            make_tracker(example_1, settings)
        return
    time = np.arange(0.0, 4.0, example_1.request.period)
    y = np.zeros((len(time), 3))
    y[:, 1] = 0.2
    estimates = ts.estimate(example_1, time, y, np.zeros((len(time), 2)), settings=settings)
    assert np.abs(estimates.state[-1]).max() < 0.02
    np.testing.assert_allclose(estimates.disturbance[-1], [0.0, 0.2, 0.0], atol=0.02)
    assert estimates.in_domain.all()
    assert np.isnan(estimates.state_bound).all() == (method == "paper")


def test_what_a_method_does_not_do_on_a_system_is_warned_of(
    design: Design, example_1: Design
) -> None:
    assert "open-loop simulation of the T-S system" in warning(example_1, "paper")
    assert "undamped arm" in warning(design, "paper")
    assert "for motion of the arm" in warning(design, "high_gain")
    assert not warning(example_1, "certified")
