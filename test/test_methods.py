# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers by name: run elsewhere as the node runs them."""

import pytest

from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.errors import ModelError
from tsobs_ros.methods import METHODS, ObserverSettings, make_estimator, make_tracker
from tsobs_ros.nodes.observer.parameters import ObserverParameters
from tsobs_ros.resources import SHIPPED_DESIGN, config_path


def test_the_defaults_are_those_of_the_node() -> None:
    settings, parameters = ObserverSettings(), ObserverParameters()

    assert settings.supervision == parameters.supervision
    assert settings.gain_mode.value == parameters.gain_mode
    for name in ("method", "theta", "settle_time", "adapt", "history", "future_tolerance",
                 "stale_after", "assume_zero_torque"):  # fmt: skip
        assert getattr(settings, name) == getattr(parameters, name), name


@pytest.mark.parametrize("method", METHODS)
def test_the_certified_observer_learns_and_an_ekf_may(method: str) -> None:
    design = load_design(config_path(SHIPPED_DESIGN))
    learnt = ObserverSettings(method=method).learnt(design)

    learns = method in ("certified", "ekf_augmented")
    assert learnt == (tuple(design.request.uncertainty) if learns else ())
    fixed = ObserverSettings(method=method, adapt=False).learnt(design)
    assert fixed == (learnt if method == "ekf_augmented" else ())


def test_trackers_may_share_an_observer(design: Design) -> None:
    settings = ObserverSettings(history=1.5)
    estimator = make_estimator(design, settings)

    tracker = make_tracker(design, settings, estimator)

    assert tracker.estimator is estimator
    assert tracker.options.history == 1.5
    assert tracker.options.x_max == design.request.x_max


def test_an_unknown_method_is_refused_with_those_there_are() -> None:
    with pytest.raises(ModelError, match=r"expected one of certified, ekf, .*, got 'kalman'"):
        ObserverSettings(method="kalman")
