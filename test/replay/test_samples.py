# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recorded measurements: what each message holds of each joint, and where time restarts."""

import numpy as np

from tsobs_ros.bag.joint_series import JointSeries, RawMessages
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.design.signals import signals
from tsobs_ros.replay.source import restarts, samples_of

SECOND = 1_000_000_000
NAN = float("nan")
JOINTS = [signals(ArmRequest(), joint, alone=False) for joint in ("elbow", "wrist")]

NO_BYTES = RawMessages(np.zeros(0, np.int64), np.zeros(0, np.int64), [])


def series(values: list[list[list[float]]], named: list[list[bool]]) -> JointSeries:
    """Return messages about two joints; what is not a number was left out of its message."""
    times = np.arange(1, len(values) + 1) * SECOND
    array, names = np.array(values), np.array(named)
    y, u = array[..., :1], array[..., 1:]
    places = np.concatenate([y, u, u], axis=1)
    return JointSeries(times, times, times, places, np.hstack([names] * 3), ~np.isnan(places), ())


def test_a_sample_needs_an_angle_and_a_torque_of_its_joint() -> None:
    recorded = series(
        [
            [[1.0, 2.0], [3.0, 4.0]],
            [[1.0, 2.0], [NAN, NAN]],
            [[1.0, NAN], [3.0, 4.0]],
            [[NAN, NAN], [NAN, NAN]],
        ],
        [[True, True], [True, False], [True, True], [False, False]],
    )

    samples = samples_of(recorded, NO_BYTES, JOINTS, assume_zero_torque=False)
    assert samples.complete.tolist() == [[True, True], [True, False], [False, True], [False] * 2]
    silent = samples_of(recorded, NO_BYTES, JOINTS, assume_zero_torque=True)
    assert silent.complete[2].all()
    assert silent.u[2].tolist() == [[0.0], [4.0]]


def test_restarts_are_told_from_stragglers() -> None:
    first = [k * SECOND // 10 for k in range(1, 61)]

    assert restarts(first) == []
    assert restarts([*first, first[0], *(s + 6 * SECOND for s in first)]) == []
    assert restarts([*first, *first, *first]) == [60, 120]
    assert restarts([*first[:50], 0, *first[50:]]) == []  # a zero stamp is no time at all
    assert restarts([*first, *(s - SECOND // 2 for s in first[56:])]) == []  # merely late
