# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A drained subscription gives every message once, in order, without waking the executor."""

from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from tsobs_ros.nodes.wire import DrainedSubscription

COUNT = 200


class CountingExecutor(SingleThreadedExecutor):
    """Counts how often it builds a wait set, which it does once in every turn of its loop."""

    turns = 0

    def get_nodes(self) -> list[Node]:
        self.turns += 1
        return super().get_nodes()


def test_waiting_messages_do_not_wake_the_executor(ros: Any) -> None:
    node, qos = Node("drainer", context=ros.context), QoSProfile(depth=COUNT)
    executor = CountingExecutor(context=ros.context)
    executor.add_node(node)
    subscription = DrainedSubscription(node, JointState, "joints", qos)
    publisher, ticks = node.create_publisher(JointState, "joints", qos), list[None]()
    node.create_timer(0.02, lambda: ticks.append(None))
    while not subscription.publisher_count:
        executor.spin_once(timeout_sec=1.0)
    sent = [JointState(name=[f"joint_{index}"], position=[0.5 * index]) for index in range(COUNT)]
    for message in sent:
        publisher.publish(message)
    executor.turns, end = 0, len(ticks) + 10

    while len(ticks) < end:
        executor.spin_once()

    # Woken by what waits, it would turn thousands of times between two ticks, not a few.
    assert executor.turns < 100
    messages, infos = zip(*[*subscription.drain(limit=7), *subscription.drain()], strict=True)
    assert list(messages) == sent
    assert [info["publication_sequence_number"] for info in infos] == list(range(1, COUNT + 1))
    assert subscription.drain() == []
    executor.shutdown()
    node.destroy_node()
