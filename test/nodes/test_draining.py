# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A drained subscription gives every message once, in order, without waking the executor."""

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from tsobs_ros.nodes.draining import Drained, DrainedSubscription

COUNT = 200


@pytest.fixture
def node(ros) -> Node:
    return ros.add(Node("drainer", context=ros.context))


def joint_state(index: int) -> JointState:
    return JointState(name=[f"joint_{index}"], position=[float(index)])


def publish_and_drain(
    ros, node: Node, subscription: DrainedSubscription, qos, *others: DrainedSubscription
) -> list[Drained]:
    publisher = node.create_publisher(JointState, "joints", qos)
    ros.spin_until(
        lambda: all(s.publisher_count == 1 for s in (subscription, *others)),
        timeout=10.0,
        what="the match",
    )
    for index in range(COUNT):
        publisher.publish(joint_state(index))
    drained: list[Drained] = []

    def complete() -> bool:
        drained.extend(subscription.drain())
        return len(drained) >= COUNT

    ros.spin_until(complete, timeout=10.0, what="the messages")
    return drained


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize("in_bulk", [True, False])
def test_messages_arrive_once_in_order_with_their_infos(
    ros, node: Node, raw: bool, in_bulk: bool
) -> None:
    """In bulk, and by callbacks for an rclpy that has no other way."""
    qos = QoSProfile(depth=COUNT)
    subscription = DrainedSubscription(node, JointState, "joints", qos, raw=raw, in_bulk=in_bulk)
    assert subscription.in_bulk == in_bulk
    before = node.get_clock().now().nanoseconds

    drained = publish_and_drain(ros, node, subscription, qos)

    after = node.get_clock().now().nanoseconds
    messages, infos = zip(*drained, strict=True)
    if raw:
        assert all(type(message) is bytes for message in messages)
        messages = [deserialize_message(message, JointState) for message in messages]
    assert list(messages) == [joint_state(i) for i in range(COUNT)]
    assert [info.sequence for info in infos] == list(range(1, COUNT + 1))
    assert all(before <= info.source_ns <= info.received_ns <= after for info in infos)
    assert subscription.drain() == []


def test_arrivals_are_drained_at_once_by_who_asks_for_it(ros, node: Node) -> None:
    qos = QoSProfile(depth=COUNT)
    drained: list[Drained] = []
    subscription = DrainedSubscription(
        node, JointState, "joints", qos, on_arrival=lambda: drained.extend(subscription.drain())
    )
    publisher = node.create_publisher(JointState, "joints", qos)
    ros.spin_until(lambda: subscription.publisher_count == 1, what="the match")
    for index in range(COUNT):
        publisher.publish(joint_state(index))
    ros.spin_until(lambda: len(drained) >= COUNT, what="the messages")
    assert [item.message for item in drained] == [joint_state(i) for i in range(COUNT)]


@pytest.mark.parametrize("in_bulk", [True, False])
def test_a_limit_leaves_the_rest_for_the_next_drain(ros, node: Node, in_bulk: bool) -> None:
    qos = QoSProfile(depth=10)
    subscription = DrainedSubscription(node, JointState, "joints", qos, in_bulk=in_bulk)
    publisher = node.create_publisher(JointState, "joints", qos)
    ros.spin_until(lambda: subscription.publisher_count == 1, timeout=10.0, what="the match")
    for index in range(3):
        publisher.publish(joint_state(index))

    drained: list[Drained] = []

    def first_two_arrived() -> bool:
        drained.extend(subscription.drain(limit=2 - len(drained)))
        return len(drained) == 2

    ros.spin_until(first_two_arrived, timeout=10.0, what="two messages")
    rest: list[Drained] = []

    def rest_arrived() -> bool:
        rest.extend(subscription.drain())
        return bool(rest)

    ros.spin_until(rest_arrived, timeout=10.0, what="the third message")
    assert [item.message for item in drained + rest] == [joint_state(i) for i in range(3)]


def test_a_full_queue_drops_its_oldest_messages(ros, node: Node) -> None:
    qos = QoSProfile(depth=COUNT)
    witness = DrainedSubscription(node, JointState, "joints", qos)
    shallow = DrainedSubscription(node, JointState, "joints", qos_profile_sensor_data)

    publish_and_drain(ros, node, witness, qos, shallow)

    kept = qos_profile_sensor_data.depth
    assert [item.message for item in shallow.drain()] == [
        joint_state(i) for i in range(COUNT - kept, COUNT)
    ]


class CountingExecutor(SingleThreadedExecutor):
    """Counts how often it builds a wait set, which it does once in every turn of its loop."""

    turns = 0

    def get_nodes(self) -> list[Node]:
        self.turns += 1
        return super().get_nodes()


def test_waiting_messages_do_not_wake_the_executor(ros, node: Node) -> None:
    qos = QoSProfile(depth=COUNT)
    subscription = DrainedSubscription(node, JointState, "joints", qos)
    witness = DrainedSubscription(node, JointState, "joints", qos)
    publish_and_drain(ros, node, witness, qos, subscription)
    ticks: list[int] = []
    timer = node.create_timer(0.02, lambda: ticks.append(len(ticks)))
    ros.executor.remove_node(node)
    executor = CountingExecutor(context=ros.context)
    executor.add_node(node)

    while len(ticks) < 10:
        executor.spin_once()

    executor.remove_node(node)
    executor.shutdown()
    node.destroy_timer(timer)
    # Woken by what waits, it would turn thousands of times between two ticks, not a few.
    assert executor.turns < 100
    assert len(subscription.drain()) == COUNT
