# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recorded measurements: what each message holds of each joint, and where time restarts."""

import numpy as np
import pytest

from tsobs_ros.bag.joint_series import JointSeries
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.design.signals import signals
from tsobs_ros.replay.source import Samples, restarts, samples_of

SECOND = 1_000_000_000
NAN = float("nan")
JOINTS = [signals(ArmRequest(), joint, alone=False) for joint in ("elbow", "wrist")]


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

    samples = samples_of(recorded, JOINTS, assume_zero_torque=False)
    assert samples.complete.tolist() == [[True, True], [True, False], [False, True], [False] * 2]
    assert samples.usable.tolist() == [True, True, True, False]
    silent = samples_of(recorded, JOINTS, assume_zero_torque=True)
    assert silent.complete[2].all()
    assert silent.u[2].tolist() == [[0.0], [4.0]]


def test_restarts_are_told_from_stragglers() -> None:
    first = [k * SECOND // 10 for k in range(1, 61)]

    assert restarts(first) == []
    assert restarts([*first, first[0], *(s + 6 * SECOND for s in first)]) == []
    assert restarts([*first, *first, *first]) == [60, 120]
    assert restarts([*first[:50], 0, *first[50:]]) == []  # a zero stamp is no time at all
    assert restarts([*first, *(s - SECOND // 2 for s in first[56:])]) == []  # merely late


@pytest.mark.parametrize(
    ("offset", "expected"),
    [
        (1_000, [1_001, 1_021, 1_011, 1_041]),
        (10**18, [1, 21, 21, 41]),  # another clock: only the order is known
    ],
)
def test_arrivals_are_log_times_where_those_are_of_the_same_clock(offset, expected) -> None:
    stamps = np.array([1, 21, 11, 41])
    one = np.ones((4, 1))
    numbers = one[..., np.newaxis]

    samples = Samples(stamps, stamps + offset, stamps, numbers, numbers, one > 0, one > 0)

    assert samples.arrivals.tolist() == expected
