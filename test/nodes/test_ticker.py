# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Ticks are the executor's or the runtime's, never both, and arrivals are served between them."""

from collections.abc import Callable
from typing import Any

import pytest
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from tsobs_ros.nodes.draining import DrainedSubscription
from tsobs_ros.nodes.ticker import Ticker

PERIOD = 0.005
MANY_PERIODS = 20


class Bench:
    """A ticker with arrivals, and somebody who sends them."""

    def __init__(self, ros: Any) -> None:
        self.ros = ros
        self.ticks = 0
        self.arrived: list[float] = []
        node = ros.node("ticking")
        self.subscription = DrainedSubscription(
            node, JointState, "joints", QoSProfile(depth=10), on_arrival=self._on_arrival
        )
        self.ticker = Ticker(node, PERIOD, self._on_tick, self.subscription)
        self._publisher = node.create_publisher(JointState, "joints", 10)
        ros.spin_until(lambda: self.subscription.publisher_count == 1, what="the match")

    def _on_tick(self) -> None:
        self.ticks += 1

    def _on_arrival(self) -> None:
        self.arrived += [each.message.position[0] for each in self.subscription.drain()]

    def send(self, value: float) -> None:
        self._publisher.publish(JointState(position=[value]))

    def run(self, done: Callable[[], bool]) -> None:
        """Do what the runtime does once it has taken the ticks over."""
        for _ in range(2000):
            if done():
                return
            self.ticker.rest(self.ticker.run_if_due() * 1e-9)
        raise AssertionError("it did not happen")


@pytest.fixture
def bench(ros: Any) -> Bench:
    return Bench(ros)


def test_before_the_start_nothing_ticks_and_nothing_arrives(bench: Bench) -> None:
    bench.send(1.0)
    other = bench.ros.node("other")
    turns = []
    other.create_timer(PERIOD, lambda: turns.append(None))
    bench.ros.spin_until(lambda: len(turns) > MANY_PERIODS)
    assert (bench.ticks, bench.arrived) == (0, [])
    assert not bench.ticker.may_be_taken_over


def test_an_executor_ticks_and_serves_arrivals(bench: Bench) -> None:
    bench.ticker.start()
    bench.send(1.0)
    bench.send(2.0)
    bench.ros.spin_until(lambda: bench.ticks > 3 and bench.arrived == [1.0, 2.0])


def test_taken_over_the_runtime_ticks_and_serves_and_the_executor_does_not(bench: Bench) -> None:
    bench.ticker.start()
    bench.ticker.take_over()
    bench.send(1.0)
    bench.run(lambda: bench.ticks > 3 and bench.arrived == [1.0])
    ticks = bench.ticks
    bench.send(2.0)
    for _ in range(10):
        bench.ros.executor.spin_once(timeout_sec=PERIOD)
    assert (bench.ticks, bench.arrived) == (ticks, [1.0])
    bench.ticker.give_back()
    bench.ros.spin_until(lambda: bench.ticks > ticks + 3 and bench.arrived == [1.0, 2.0])


def test_a_tick_that_is_to_be_skipped_is_however_often_that_is_said(bench: Bench) -> None:
    bench.ticker.start()
    bench.ticker.take_over()
    bench.ticker.run_if_due()
    for _ in range(5):
        bench.ticker.skip_next()
    # The next tick but one is less than two periods away, and not the fifth.
    assert PERIOD < bench.ticker.run_if_due() * 1e-9 <= 2 * PERIOD
    assert bench.ticks == 1


def test_a_stop_ends_the_ticks_until_the_next_start(bench: Bench) -> None:
    bench.ticker.start()
    bench.ticker.take_over()
    bench.run(lambda: bench.ticks == 1)
    bench.ticker.stop()
    bench.ticker.give_back()
    for _ in range(10):
        bench.ros.executor.spin_once(timeout_sec=PERIOD)
    assert bench.ticks == 1
    bench.ticker.start()
    bench.ros.spin_until(lambda: bench.ticks > 3)
