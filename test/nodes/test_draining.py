# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A drained subscription gives every message once, in order, without waking the executor."""

from typing import Any

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from tsobs_ros.nodes.draining import DrainedSubscription

COUNT = 200


@pytest.fixture
def node(ros) -> Node:
    return ros.add(Node("drainer", context=ros.context))


def joint_state(index: int) -> JointState:
    return JointState(name=[f"joint_{index}"], position=[float(index)])


def publish(ros: Any, node: Node, qos: QoSProfile, *subscriptions: DrainedSubscription) -> None:
    """Publish once all are matched; in one process the messages are in their queues at once."""
    publisher = node.create_publisher(JointState, "joints", qos)
    ros.spin_until(lambda: all(s.publisher_count == 1 for s in subscriptions), what="the match")
    for index in range(COUNT):
        publisher.publish(joint_state(index))


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize("way", ["in bulk", "by callbacks", "on arrival"])
def test_messages_arrive_once_in_order_with_their_infos(
    ros: Any, node: Node, raw: bool, way: str
) -> None:
    """In bulk; by callbacks if an rclpy has no other way; and as soon as they have come."""
    qos = QoSProfile(depth=COUNT)
    drained: list[Any] = []

    def drain() -> None:
        some = subscription.drain(limit=7)
        assert len(some) <= 7
        drained.extend([*some, *subscription.drain()])

    subscription = DrainedSubscription(
        node, JointState, "joints", qos, raw=raw,
        on_arrival=drain if way == "on arrival" else None, in_bulk=way == "in bulk",
    )  # fmt: skip
    assert subscription.in_bulk == (way == "in bulk")
    before = node.get_clock().now().nanoseconds
    publish(ros, node, qos, subscription)

    def complete() -> bool:
        if way != "on arrival":
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


def test_a_full_queue_drops_its_oldest_messages(ros: Any, node: Node) -> None:
    qos = QoSProfile(depth=COUNT)
    witness = DrainedSubscription(node, JointState, "joints", qos)
    shallow = DrainedSubscription(node, JointState, "joints", qos_profile_sensor_data)
    publish(ros, node, qos, witness, shallow)
    arrived: list[Any] = []

    def complete() -> bool:
        arrived.extend(witness.drain())
        return len(arrived) == COUNT

    ros.spin_until(complete, what="the messages")
    kept = qos_profile_sensor_data.depth
    assert [message for message, _ in shallow.drain()] == [
        joint_state(i) for i in range(COUNT - kept, COUNT)
    ]


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
