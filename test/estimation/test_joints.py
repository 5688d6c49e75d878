# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joints side by side: each is its own tracker, whatever happens to the others."""

from typing import Any

import numpy as np
import pytest

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.options import TorqueLimits
from tsobs_ros.estimation.records import Measurement
from tsobs_ros.estimation.tracker import JointTrackers
from tsobs_ros.methods import ObserverSettings, make_tracker
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

DESIGNS = [load_design(config_path(name)) for name in (FIXED_DESIGN, SHIPPED_DESIGN)]
RUN = simulate(SCENARIOS["bias_step"], [0, 1, 2], 3.0)
PERIOD, BEGIN, END = 5_000_000, 10**11, 10**18


def joints() -> JointTrackers:
    """Return joints of different designs, the last of which is tracked by another method."""
    trackers: list[Any] = [make_tracker(design, ObserverSettings()) for design in DESIGNS]
    return JointTrackers([*trackers, make_tracker(DESIGNS[0], ObserverSettings("high_gain"))])


def sample(joint: int, index: int) -> Measurement:
    y, u = RUN.measurements[joint, index], RUN.torques[joint, index]
    return Measurement(BEGIN + index * PERIOD, y, u)


def test_each_joint_is_its_tracker_alone() -> None:
    together, alone = joints(), joints().trackers
    for index in range(200):
        row = [None if index % (joint + 7) == 0 else sample(joint, index) for joint in range(3)]
        expected = [
            one and tracker.offer(one, END) for tracker, one in zip(alone, row, strict=True)
        ]
        assert repr(together.offer(row, END)) == repr(expected)
        stamp = BEGIN + index * PERIOD + 1_000_000
        assert repr(together.estimate(stamp)) == repr([one.estimate(stamp) for one in alone])
    assert [one.used for one in together.trackers] == [one.used for one in alone]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("torque", [1.7e308, -1e300, 1e160])
def test_numbers_beyond_all_bounds_are_the_business_of_one_joint(torque: float) -> None:
    """The second joint restarts, without a warning, and the others go on."""
    together = joints()
    for tracker in together.trackers:
        tracker.estimator.limit_torque(TorqueLimits.of(0.0, 0.0, 1.0))
    for index in (*range(60), *range(80, 120)):
        row = [sample(joint, index) for joint in range(3)]
        if index % 30 == 20:
            row[1] = row[1]._replace(u=np.array([torque]))
        together.offer(row, END)
        for later in (2_000_000, 40_000_000):
            together.estimate(row[0].stamp + later)
    failures = [tracker.failures for tracker in together.trackers]
    assert failures[0] == failures[2] == 0
    assert failures[1] > 0
    estimates = together.estimate(BEGIN + 119 * PERIOD)
    assert estimates[0] is not None
    assert estimates[2] is not None


def test_only_joints_that_are_wanted_are_estimated_and_a_reset_forgets_all() -> None:
    together = joints()
    together.offer([sample(0, 0), sample(1, 0), None], END)
    some = together.estimate(BEGIN, [True, False, True])
    assert [estimate is not None for estimate in some] == [True, False, False]
    with pytest.raises(ValueError, match="shorter"):
        together.offer([sample(0, 0)], END)
    with pytest.raises(ValueError, match="shorter"):
        together.estimate(BEGIN, [])
    together.reset()
    assert together.estimate(BEGIN) == [None] * 3
