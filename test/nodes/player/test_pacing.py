# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Ticks come when they were asked for, whoever makes them; a gate opens once subscribers settle."""

from typing import Any

import pytest

from tsobs_ros.nodes.player.pacing import Pacer, SubscriberGate

S = 10**9


def test_an_executor_ticks_as_often_as_the_work_asks_for(ros: Any) -> None:
    waits = iter([0, 1_000_000, 10**18])
    ticks: list[int] = []

    def work() -> int:
        ticks.append(len(ticks))
        return next(waits, 0)

    pacer = Pacer(ros.node("paced"), work)
    ros.executor.spin_once(timeout_sec=0.0)
    assert not ticks
    assert not pacer.may_be_taken_over
    pacer.start()
    # Not even a wait for ever is longer than a twentieth of a second.
    ros.spin_until(lambda: len(ticks) >= 4, what="four ticks")

    pacer.stop()
    count = len(ticks)
    pacer.wake()
    ros.executor.spin_once(timeout_sec=0.1)
    assert len(ticks) == count


def test_whoever_takes_the_ticks_over_makes_them_alone(ros: Any) -> None:
    ticks: list[int] = []

    def work() -> int:
        ticks.append(len(ticks))
        return 7

    pacer = Pacer(ros.node("paced"), work)
    pacer.start()
    assert pacer.may_be_taken_over
    pacer.take_over()
    pacer.wake()
    ros.executor.spin_once(timeout_sec=0.1)
    assert not ticks
    assert pacer.run_if_due() == 7
    pacer.give_back()
    ros.spin_until(lambda: len(ticks) >= 3, what="ticks by the executor")


@pytest.mark.parametrize(
    ("wanted", "timeout", "looks", "expected"),
    [
        (0, 5.0, [], (True, False)),
        (1, 5.0, [(0, 1)], (False, False)),
        (1, 5.0, [(1, 1)], (False, False)),
        (1, 5.0, [(1, 1), (1, 1.2)], (True, False)),
        (1, 5.0, [(1, 1), (2, 1.1), (2, 1.2)], (False, False)),
        (1, 5.0, [(1, 1), (2, 1.1), (2, 1.3)], (True, False)),
        (2, 5.0, [(1, 1), (1, 4.9)], (False, False)),
        (2, 5.0, [(1, 1), (1, 5.0)], (True, True)),
        (1, 5.0, [(1, 5.0)], (True, False)),
        (2, 0.0, [(1, 1), (1, 1000)], (False, False)),
    ],
)
def test_the_gate_opens_when_subscribers_have_come_or_time_has_passed(
    wanted: int, timeout: float, looks: list[tuple[int, float]], expected: tuple[bool, bool]
) -> None:
    gate = SubscriberGate(wanted, timeout, now=100 * S)
    for there, at in looks:
        gate.look(there, 100 * S + round(at * S))

    assert (gate.is_open, gate.timed_out) == expected
