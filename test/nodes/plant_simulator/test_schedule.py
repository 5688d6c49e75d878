# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamps stay exactly periodic, and scaled time runs at its pace."""

from fractions import Fraction

import pytest
from builtin_interfaces.msg import Time

from tsobs_ros.nodes.messages import set_stamp, to_nanoseconds, to_stamp
from tsobs_ros.nodes.plant_simulator.node import SampleSchedule, ScaledTime

SECOND = 1_000_000_000


@pytest.mark.parametrize("rate", [1.0, 200.0, 300.0, 333.3, 1000.0])
def test_stamps_do_not_accumulate_rounding(rate: float) -> None:
    schedule = SampleSchedule(rate)
    schedule.start(17)
    for k in range(2000):
        stamp = schedule.take(10**15)
        assert stamp is not None
        assert abs(stamp - 17 - k * SECOND / Fraction(rate)) <= Fraction(1, 2)


def test_samples_are_due_once_and_not_early() -> None:
    schedule = SampleSchedule(100.0)
    schedule.start(1000)
    assert schedule.take(999) is None
    assert schedule.take(1000) == 1000
    assert schedule.take(10_000_999) is None
    assert schedule.take(25_000_000) == 10_001_000
    assert schedule.take(25_000_000) == 20_001_000
    assert schedule.take(25_000_000) is None
    assert schedule.lag(25_000_000) == 25_000_000 - 30_001_000


def test_scaled_time_keeps_its_pace_and_can_be_held_back() -> None:
    time = ScaledTime(2.5)
    time.start(100, 1000)
    assert [time.at(100), time.at(104)] == [1000, 1010]
    time.hold_back(7)
    assert time.at(104) == 1003


@pytest.mark.parametrize("nanoseconds", [0, 1, 999_999_999, SECOND, 1_700_000_000_123_456_789])
def test_stamps_survive_the_round_trip(nanoseconds: int) -> None:
    message = Time(sec=5, nanosec=5)
    set_stamp(message, nanoseconds)
    assert to_nanoseconds(message) == nanoseconds
    assert to_stamp(nanoseconds) == message
