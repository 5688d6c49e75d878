# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A drained subscription gives every message once, in order, without waking the executor."""

from typing import Any

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from tsobs_ros.nodes.draining import DrainedSubscription

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


@pytest.mark.parametrize(("raw", "at_once"), [(False, False), (True, False), (True, True)])
def test_messages_arrive_once_in_order_with_their_infos(
    ros: Any, node: Node, raw: bool, at_once: bool
) -> None:
    qos = QoSProfile(depth=COUNT)
    drained: list[Any] = []

    def drain() -> None:
        some = subscription.drain(limit=7)
        assert len(some) <= 7
        drained.extend([*some, *subscription.drain()])

    subscription = DrainedSubscription(
        node, JointState, "joints", qos, raw=raw,
        on_arrival=drain if at_once else None,
    )  # fmt: skip
    before = node.get_clock().now().nanoseconds
    publish(ros, node, qos, subscription)

    def complete() -> bool:
        if not at_once:
            drain()
        return len(drained) >= COUNT

    ros.spin_until(complete, what="the messages")
    after = node.get_clock().now().nanoseconds
    messages, infos = zip(*drained, strict=True)
    if raw:
        assert all(type(message) is bytes for message in messages)
        messages = [deserialize_message(message, JointState) for message in messages]
    assert list(messages) == [joint_state(i) for i in range(COUNT)]
    assert [info["publication_sequence_number"] for info in infos] == list(range(1, COUNT + 1))
    for info in infos:
        assert before <= info["source_timestamp"] <= info["received_timestamp"] <= after
    assert subscription.drain() == []


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
    assert len(subscription.drain()) == COUNT
