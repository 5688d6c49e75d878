# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A drained subscription gives every message once, in order, without waking the executor."""

from typing import Any

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from tsobs_ros.nodes.wire import DrainedSubscription

COUNT = 200


@pytest.fixture
def node(ros) -> Node:
    return ros.add(Node("drainer", context=ros.context))


def joint_state(index: int) -> JointState:
    return JointState(name=[f"joint_{index}"], position=[float(index)])


def publish(ros: Any, node: Node, qos: QoSProfile, subscription: DrainedSubscription) -> None:
    """Publish once they are matched; in one process the messages are in the queue at once."""
    publisher = node.create_publisher(JointState, "joints", qos)
    ros.spin_until(lambda: subscription.publisher_count == 1, what="the match")
    for index in range(COUNT):
        publisher.publish(joint_state(index))


class CountingExecutor(SingleThreadedExecutor):
    """Counts how often it builds a wait set, which it does once in every turn of its loop."""

    turns = 0

    def get_nodes(self) -> list[Node]:
        self.turns += 1
        return super().get_nodes()


def test_waiting_messages_do_not_wake_the_executor(ros: Any, node: Node) -> None:
    qos = QoSProfile(depth=COUNT)
    subscription = DrainedSubscription(node, JointState, "joints", qos)
    publish(ros, node, qos, subscription)
    ticks: list[int] = []
    node.create_timer(0.02, lambda: ticks.append(len(ticks)))
    ros.executor.remove_node(node)
    executor = CountingExecutor(context=ros.context)
    executor.add_node(node)

    while len(ticks) < 10:
        executor.spin_once()

    executor.remove_node(node)
    executor.shutdown()
    # Woken by what waits, it would turn thousands of times between two ticks, not a few.
    assert executor.turns < 100
    messages, infos = zip(*[*subscription.drain(limit=7), *subscription.drain()], strict=True)
    assert list(messages) == [joint_state(index) for index in range(COUNT)]
    assert [info["publication_sequence_number"] for info in infos] == list(range(1, COUNT + 1))
    assert subscription.drain() == []
