# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamps are exact and samples complete, whatever clock they follow and however late."""

from typing import Any

from rclpy.parameter import Parameter

from tsobs_ros.nodes.plant_simulator import create

PERIOD = 5_000_000
SECOND = 1_000_000_000


def test_duration_finishes_the_node_after_its_last_sample(listener: Any) -> None:
    node = listener.start(duration=0.5)
    assert not node.finished
    listener.wait_until(lambda: node.finished, "the end of the duration")
    last = listener.core(101)[-1].physical[0].item()
    listener.wait_until(
        lambda: bool(listener.states) and listener.states[-1].message.position[0] == last,
        "the last sample",
    )
    listener.reset()
    assert not node.finished
    listener.wait_until(lambda: node.finished, "the end after the reset")


def test_without_subscribers_it_starts_after_the_timeout(ros: Any) -> None:
    node = create(
        context=ros.context,
        parameter_overrides=[
            Parameter("wait_for_subscribers", value=2),
            Parameter("wait_timeout", value=0.3),
            Parameter("duration", value=0.1),
        ],
    )
    ros.add(node)
    ros.spin_until(lambda: node.finished, 20.0, "a run without subscribers")


def test_driven_clock_starts_at_one_second_and_leads_the_samples(listener: Any) -> None:
    listener.listen_to_clock()
    listener.start(publish_clock=True, real_time_factor=4.0, duration=2.0)
    final = SECOND + 400 * PERIOD
    listener.wait_until(
        lambda: bool(listener.clock) and listener.clock[-1] == final, "the last clock"
    )
    assert all((time - SECOND) % PERIOD == 0 for time in listener.clock)
    assert listener.clock == sorted(set(listener.clock))
    found = listener.places(listener.measurements, listener.core(401))
    assert [item.stamp for item in listener.measurements] == [SECOND + k * PERIOD for k in found]


def test_external_clock_is_followed_and_a_jump_back_restarts(listener: Any) -> None:
    listener.start_simulated()
    samples = listener.core(1000)

    def advance(first: int, count: int) -> list[Any]:
        """Publish the clock in steps of 12 ms, no multiple of the period; return what came."""
        already = len(listener.states)
        for now in range(first, first + count * 12_000_000, 12_000_000):
            listener.show(now)
        listener.wait_until(lambda: 0 <= now - listener.states[-1].stamp < PERIOD, "the last one")
        return listener.states[already:]

    assert not listener.states  # before there is a time
    listener.show_and_sample(50 * SECOND)
    advance(50 * SECOND, 80)
    came = listener.indices(listener.states, samples)
    assert came == list(range(190))
    assert [item.stamp for item in listener.states] == [50 * SECOND + k * PERIOD for k in came]

    again = advance(20 * SECOND, 20)
    assert listener.indices(again, samples) == list(range(46))
    assert [item.stamp for item in again] == [20 * SECOND + k * PERIOD for k in range(46)]
