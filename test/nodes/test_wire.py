# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A drained subscription gives every message once, in order, without waking the executor."""

from typing import Any

from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from tsobs_ros.nodes.wire import DrainedSubscription

COUNT = 200


def test_waiting_messages_do_not_wake_the_executor(ros: Any) -> None:
    node, qos = ros.node("drainer"), QoSProfile(depth=COUNT)
    subscription = DrainedSubscription(node, JointState, "joints", qos)
    publisher, ticks = node.create_publisher(JointState, "joints", qos), list[None]()
    ros.spin_until(lambda: subscription.subscription.get_publisher_count() == 1, what="matching")
    sent = [JointState(name=[f"joint_{index}"], position=[0.5 * index]) for index in range(COUNT)]
    for message in sent:
        publisher.publish(message)
    node.create_timer(0.02, lambda: ticks.append(None))
    turns = 0
    while len(ticks) < 10:
        ros.executor.spin_once()
        turns += 1

    # Woken by what waits, it would turn thousands of times between two ticks, not a few.
    assert turns < 100
    messages, infos = zip(*[*subscription.drain(limit=7), *subscription.drain()], strict=True)
    assert list(messages) == sent
    assert [info["publication_sequence_number"] for info in infos] == list(range(1, COUNT + 1))
    assert subscription.drain() == []


def test_messages_that_an_executor_has_taken_are_discarded_with_the_rest(ros: Any) -> None:
    node, qos = ros.node("drainer"), QoSProfile(depth=COUNT)
    arrivals = list[None]()
    subscription = DrainedSubscription(
        node, JointState, "joints", qos, on_arrival=lambda: arrivals.append(None)
    )
    publisher = node.create_publisher(JointState, "joints", qos)
    ros.spin_until(lambda: subscription.subscription.get_publisher_count() == 1, what="matching")
    for _ in range(COUNT):
        publisher.publish(JointState())
    ros.spin_until(lambda: len(arrivals) == COUNT, what="the arrival of all")
    for _ in range(COUNT):
        publisher.publish(JointState())
    publisher.wait_for_all_acked(Duration(seconds=10))

    subscription.discard()
    assert subscription.drain() == []
