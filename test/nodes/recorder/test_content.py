# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the recorder writes is what was published, as independent readers see it."""

from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

from tsobs_ros.bag import BagReader

AWKWARD_MESSAGES: list[tuple[type, list[Any]]] = [
    (
        JointState,
        [
            JointState(),
            JointState(name=[""], effort=[float("inf")]),
            JointState(name=["θ"], position=[0.1] * 7),
        ],
    ),
    (String, [String(), String(data="Größe θ̂ ≤ 1 😀"), String(data="x" * 3_000_000)]),
    (Float64MultiArray, [Float64MultiArray(), Float64MultiArray(data=[0.5] * 200_000)]),
]


def fields(message: Any, like: Any) -> Any:
    """Read a message of any library as nested plain values, by the fields of the ROS message."""
    if hasattr(like, "get_fields_and_field_types"):
        return {
            name: fields(getattr(message, name), getattr(like, name))
            for name in like.get_fields_and_field_types()
        }
    if isinstance(like, str | int | float):
        return message
    if len(message) == 0:
        return []
    return [fields(item, like[0]) for item in message]


@pytest.mark.parametrize(("msg_type", "messages"), AWKWARD_MESSAGES)
def test_every_reader_reads_what_was_published(
    ros, recording, msg_type: type, messages: list[Any]
) -> None:
    recorder = recording.start(topics=["topic"], compression="zstd")
    publisher = ros.node("source").create_publisher(msg_type, "topic", QoSProfile(depth=100))
    recording.publish(recorder, publisher, messages)
    recorder.close()
    path = recorder.path
    expected = [fields(message, message) for message in messages]
    with AnyReader([path]) as reader:
        read = [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages()]
    assert [fields(m, p) for m, p in zip(read, messages, strict=True)] == expected
    with (path / "bag_0.mcap").open("rb") as stream:
        made = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        read = [item.decoded_message for item in made.iter_decoded_messages()]
    assert [fields(m, p) for m, p in zip(read, messages, strict=True)] == expected
    assert [deserialize_message(m.data, msg_type) for m in BagReader(path).messages()] == messages


def test_times_qos_and_type_hash_are_those_of_the_publisher(ros, recording) -> None:
    recorder = recording.start(topics=["joints"])
    node = ros.node("source")
    qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = node.create_publisher(JointState, "joints", qos)
    ros.spin_until(lambda: recorder.ready, what="the recorder's match")
    before = node.get_clock().now().nanoseconds
    recording.publish(recorder, publisher, recording.joint_states(50))
    after = node.get_clock().now().nanoseconds
    (info,) = node.get_publishers_info_by_topic("/joints")
    recorder.close()

    reader = BagReader(recorder.path)
    messages = list(reader.messages())
    assert all(before <= m.publish_time <= m.log_time <= after for m in messages)
    assert [m.publish_time for m in messages] == sorted(m.publish_time for m in messages)
    assert reader.topics["/joints"].type_hash == str(info.topic_type_hash)
    (offer,) = reader.topics["/joints"].qos_profiles
    assert (offer.reliability, offer.durability) == ("best_effort", "volatile")
    assert reader.metadata is not None
    assert reader.metadata.topics[0].qos_profiles == (offer,)


def test_under_simulated_time_messages_wait_for_the_clock(ros, recording) -> None:
    recorder = recording.start(topics=["joints"], use_sim_time=True)
    node = ros.node("source")
    publisher = node.create_publisher(JointState, "joints", 10)
    clock = node.create_publisher(Clock, "/clock", 10)
    ros.spin_until(lambda: recorder.ready, what="the recorder's subscription")
    ros.spin_until(lambda: clock.get_subscription_count() == 1, what="the clock's match")
    for message in recording.joint_states(3):
        publisher.publish(message)
    diagnostics: list[Any] = []
    node.create_subscription(DiagnosticArray, "/diagnostics", diagnostics.append, 10)
    ros.spin_until(lambda: len(diagnostics) >= 1, what="a second of simulated standstill")
    assert recorder.statistics.messages == 0

    tick = Clock()
    tick.clock.sec = 12
    clock.publish(tick)
    ros.spin_until(lambda: recorder.statistics.messages == 3, what="the waiting messages")
    recorder.close()
    assert {m.log_time for m in BagReader(recorder.path).messages()} == {12 * 10**9}
