# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The comparison observers in the tracker: same numbers as their own steps, and no bounds."""

from typing import Any

import numpy as np
import pytest

from tsobs_ros.errors import ModelError
from tsobs_ros.estimation import baselines
from tsobs_ros.estimation.baselines import HighGainObserver
from tsobs_ros.estimation.records import Innovation, Measurement
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.paper.observer import paper_observer
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

ARM = ElasticJointArm()
T = 0.005
RUN = simulate(SCENARIOS["noise"], [3], 20.0)


def follow(estimator: Any) -> tuple[Tracker[Any], np.ndarray[Any, Any]]:
    tracker: Tracker[Any] = Tracker(estimator, TrackerOptions(x_max=0.75))
    errors = []
    for k, y in enumerate(RUN.measurements[0]):
        stamp = 10**9 + 5_000_000 * k
        outcome = tracker.offer(Measurement(stamp, y, RUN.torques[0, k]), stamp)
        assert isinstance(outcome, Innovation)
        estimate = tracker.estimate(stamp)
        assert estimate is not None
        assert estimate.state_bound.size == estimate.disturbance_bound.size == 0
        assert not estimate.certified
        errors.append(estimate.state - ARM.to_physical(RUN.states[0, k]))
    return tracker, np.array(errors)


@pytest.mark.parametrize("make", [baselines.high_gain, baselines.proportional_integral])
def test_high_gain_observers_follow_the_arm(make: Any) -> None:
    tracker, errors = follow(make(ARM, 2.5, T, 0.028))
    assert tracker.used == len(RUN.times)
    assert np.sqrt((errors[2000:, 0] ** 2).mean()) < 0.02
    estimate = tracker.estimate(10**9 + 5_000_000 * (len(RUN.times) - 1))
    assert estimate is not None
    assert estimate.disturbance.size == 0


def test_the_tracker_takes_the_observers_own_steps() -> None:
    own, tracker = (
        HighGainObserver(ARM, 2.5),
        Tracker(baselines.high_gain(ARM, 2.5, T, 0.028), TrackerOptions(x_max=0.75)),
    )
    state = own.initial()
    for k in range(50):
        stamp = 10**9 + 5_000_000 * k
        tracker.offer(Measurement(stamp, RUN.measurements[0, k], RUN.torques[0, k]), stamp)
        state, _ = own.correct(state, RUN.measurements[0, k])
        estimate = tracker.estimate(stamp)
        assert estimate is not None
        assert (
            estimate.state == ARM.to_physical(own.predict(state, RUN.torques[0, k], 0.0).x)
        ).all()
        state = own.predict(state, RUN.torques[0, k], T)


def test_the_papers_observer_does_not_find_the_arm() -> None:
    _, errors = follow(paper_observer(ARM, T, 0.028))
    # It is an open-loop simulation from another start: the error neither decays nor grows.
    early, late = (
        np.sqrt((errors[part, 0] ** 2).mean()) for part in (slice(0, 2000), slice(2000, None))
    )
    assert late > 0.3 * early > 0.02


def test_the_papers_gains_are_for_its_own_arm() -> None:
    with pytest.raises(ModelError, match="Example 3"):
        paper_observer(ElasticJointArm(stiffness=11.0), T, 0.028)
