# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Raw messages come with the bytes and infos that rclpy gives, and with their publisher."""

from typing import Any

import pytest
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from tsobs_ros.errors import NodeError
from tsobs_ros.nodes.draining import DrainedSubscription
from tsobs_ros.nodes.recorder.subscription import RawSubscription, Rcl, Received

QOS = QoSProfile(depth=1000)


def drain(ros: Any, subscription: Any, count: int) -> list[Any]:
    """Take so many messages, and make sure that there are no more."""
    taken: list[Any] = []

    def enough() -> bool:
        taken.extend(subscription.drain(count))
        return len(taken) >= count

    ros.spin_until(enough, what=f"{count} messages")
    assert subscription.drain(count) == []
    return taken


def test_it_takes_what_rclpy_takes(ros) -> None:
    sink, source = ros.node("sink"), ros.node("source")
    subscription = RawSubscription(sink, JointState, "joints", QOS)
    reference = DrainedSubscription(sink, JointState, "joints", QOS, raw=True)
    publisher = source.create_publisher(JointState, "joints", QOS)
    ros.spin_until(lambda: publisher.get_subscription_count() == 2, what="the matches")
    messages = [JointState(name=[f"joint_{k}" for k in range(n)]) for n in (0, 1, 500, 2)]
    for message in messages:
        publisher.publish(message)
    taken, expected = drain(ros, subscription, 4), drain(ros, reference, 4)

    assert [m.data for m in taken] == [m.message for m in expected]
    assert [deserialize_message(m.data, JointState) for m in taken] == messages
    assert [(m.source_ns, m.number) for m in taken] == [
        (m.info.source_ns, m.info.sequence) for m in expected
    ]
    assert all(m.source_ns <= m.received_ns for m in taken)
    (info,) = sink.get_publishers_info_by_topic("/joints")
    assert {m.publisher for m in taken} == {bytes(info.endpoint_gid)}


def test_publishers_are_told_apart(ros) -> None:
    subscription = RawSubscription(ros.node("sink"), String, "chatter", QOS)
    publishers = [ros.node(f"source_{k}").create_publisher(String, "chatter", QOS) for k in "ab"]
    ros.spin_until(lambda: subscription.publisher_count == 2, what="the matches")
    for index in range(30):
        publishers[index % 3 % 2].publish(String(data=str(index % 3 % 2)))
    by_publisher: dict[bytes, list[Received]] = {}
    for message in drain(ros, subscription, 30):
        by_publisher.setdefault(message.publisher, []).append(message)
    assert sorted(len(them) for them in by_publisher.values()) == [10, 20]
    for them in by_publisher.values():
        assert [m.number for m in them] == list(range(1, len(them) + 1))
        assert len({m.data for m in them}) == 1


def test_no_more_than_asked_for_is_taken(ros) -> None:
    subscription = RawSubscription(ros.node("sink"), String, "chatter", QOS)
    publisher = ros.node("source").create_publisher(String, "chatter", QOS)
    ros.spin_until(lambda: subscription.publisher_count == 1, what="the match")
    for index in range(5):
        publisher.publish(String(data=str(index)))
    assert publisher.wait_for_all_acked()
    numbers = [[m.number for m in subscription.drain(2)] for _ in range(3)]
    assert numbers == [[1, 2], [3, 4], [5]]


def test_what_the_middleware_refuses_is_an_error(ros) -> None:
    node = ros.node("sink")
    node.create_publisher(String, "chatter", 10)
    with pytest.raises(NodeError, match="chatter: cannot subscribe: Failed to create"):
        RawSubscription(node, JointState, "chatter", QOS)


@pytest.mark.parametrize("library", ["libno_such_rcl.so", "libc.so.6"])
def test_a_library_that_is_not_there_or_another_is_one_error(library: str) -> None:
    with pytest.raises(NodeError, match=f"recording needs {library} and librcutils.so"):
        Rcl(library)
