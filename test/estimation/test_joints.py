# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joints side by side: to the last bit what each one's tracker gives alone."""

from typing import Any

import numpy as np
import pytest

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.joints import JointTrackers
from tsobs_ros.estimation.records import Measurement, RejectReason
from tsobs_ros.estimation.supervised import SupervisedObserver
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

DESIGN = load_design(config_path("elastic_joint.design.yaml"))
JOINTS = 3
RUN = simulate(SCENARIOS["bias_step"], list(range(JOINTS)), 3.0)
PERIOD, BEGIN, END = 5_000_000, 10**11, 10**18


def trackers() -> list[Tracker[Any]]:
    options = TrackerOptions(x_max=DESIGN.request.x_max)
    return [Tracker(SupervisedObserver(DESIGN.observer()), options) for _ in range(JOINTS)]


def sample(joint: int, index: int) -> Measurement:
    return Measurement(
        BEGIN + index * PERIOD, RUN.measurements[joint, index], RUN.torques[joint, index]
    )


def bits(record: Any) -> Any:
    """Return a record with its arrays as bytes, so that equal means equal to the last bit."""
    if record is None or isinstance(record, RejectReason):
        return record
    return tuple(item.tobytes() if isinstance(item, np.ndarray) else item for item in record)


def test_each_joint_is_its_tracker_alone() -> None:
    joints, alone = JointTrackers(trackers()), trackers()
    for index in range(400):
        given = [sample(j, index) if (index + j) % 7 else None for j in range(JOINTS)]
        expected = [m and t.offer(m, END) for t, m in zip(alone, given, strict=True)]
        assert list(map(bits, joints.offer(given, END))) == list(map(bits, expected))
        stamp = BEGIN + index * PERIOD + PERIOD // 3
        expected_estimates = [t.estimate(stamp) for t in alone]
        assert list(map(bits, joints.estimate(stamp))) == list(map(bits, expected_estimates))
    assert [t.used for t in joints.trackers] == [t.used for t in alone]


def test_reset_forgets_every_joint() -> None:
    joints = JointTrackers(trackers())
    joints.offer([sample(j, 0) for j in range(JOINTS)], END)
    joints.reset()
    assert joints.estimate(BEGIN) == [None] * JOINTS


def test_as_many_measurements_as_joints_are_expected() -> None:
    with pytest.raises(ValueError, match="shorter"):
        JointTrackers(trackers()).offer([sample(0, 0)], END)
