# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder finds its topics, and reports what it has of them and what it lacks."""

import sys
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.serialization import deserialize_message
from rclpy.service_introspection import ServiceIntrospectionState
from sensor_msgs.msg import JointState
from staging import call, diagnostics, values
from std_msgs.msg import String
from std_srvs.srv import SetBool
from stereo_msgs.msg import DisparityImage

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.verification import verify


def test_latched_messages_from_before_and_late_publishers_are_recorded(ros, recording) -> None:
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node = ros.node("source", namespace="/arm")
    publisher = node.create_publisher(String, "description", latched)
    publisher.publish(String(data="said before"))
    recorder = recording.start(namespace="/arm", topics=["description", "late"])
    ros.spin_until(
        lambda: recording.count(recorder, "/arm/description") == 1, what="the latched message"
    )
    assert recorder.finder.missing

    late = node.create_publisher(String, "late", 10)
    recording.publish(recorder, late, [String(data="hello")])
    assert not recorder.finder.missing
    assert publisher.get_subscription_count() == 1


def test_an_unknown_type_does_not_stop_the_others(ros, recording, monkeypatch, capfd) -> None:
    node = ros.node("source")
    node.create_publisher(DisparityImage, "strange", 10)
    monkeypatch.setitem(sys.modules, "stereo_msgs.msg", None)
    recorder = recording.start(topics=["strange", "joints"])
    publisher = node.create_publisher(JointState, "joints", 10)
    recording.publish(recorder, publisher, recording.joint_states(3))
    assert recorder.finder.missing
    recorder.close()

    assert set(BagReader(recorder.path).topics) == {"/joints"}
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "not recording" in line]
    assert "not recording /strange: the Python module of stereo_msgs/msg/DisparityImage" in line


@pytest.fixture
def stranger(ros) -> Iterator[Any]:
    """Give a node that DDS takes for one of another process: there, types may differ."""
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=ros.domain_id)
    node = Node("stranger", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def test_types_that_differ_are_reported_until_they_agree(ros, recording, stranger, capfd) -> None:
    node = ros.node("source")
    publisher = node.create_publisher(String, "chatter", 10)
    odd = stranger.create_publisher(JointState, "chatter", 10)
    ros.spin_until(
        lambda: len(node.get_publishers_info_by_topic("/chatter")) == 2, what="both publishers"
    )
    recorder = recording.start(topics=["chatter"])
    log: list[str] = []

    def warnings(text: str) -> int:
        log.append(capfd.readouterr().err)
        return "".join(log).count(text)

    disagree, other = "publishers disagree about its type: sensor_msgs", "of node stranger: it is a"
    ros.spin_until(lambda: warnings(disagree) > 0, what="the first warning")
    stranger.destroy_publisher(odd)
    recording.publish(recorder, publisher, [String(data="heard")])
    stranger.create_publisher(JointState, "chatter", 10)
    ros.spin_until(lambda: warnings(other) > 0, what="the second warning")
    recording.publish(recorder, publisher, [String(data="heard")] * 2)
    assert (warnings(disagree), warnings(other)) == (1, 1)


def test_what_a_full_queue_drops_is_lost(ros, recording) -> None:
    recorder = recording.start(topics=["joints"], queue_depth=10)
    publisher = ros.node("source").create_publisher(JointState, "joints", 100)
    recording.publish(recorder, publisher, [JointState()])
    for message in recording.joint_states(60):
        publisher.publish(message)
    ros.spin_until(lambda: recording.count(recorder, "/joints") == 11, what="the last ten")
    assert (recorder.lost, recorder.loss_unknown) == (50, [])


def test_diagnostics_report_counts_and_what_is_awaited(ros, recording) -> None:
    recorder = recording.start(topics=["joints"])
    statuses = diagnostics(ros)
    ros.spin_until(lambda: bool(statuses), what="diagnostics")
    assert set(statuses) == {"recorder: recording", "recorder: topics"}
    waiting = statuses["recorder: recording"]
    assert (waiting.level, waiting.message) == (DiagnosticStatus.WARN, "waiting for /joints")

    publisher = ros.node("source").create_publisher(JointState, "joints", 10)
    recording.publish(recorder, publisher, recording.joint_states(2))
    ros.spin_until(lambda: statuses["recorder: recording"].message == "recording", what="the news")
    assert statuses["recorder: recording"].level == DiagnosticStatus.OK
    counts = values(statuses["recorder: recording"])
    assert (counts["messages"], counts["lost"]) == ("2", "0")
    ((topic, text),) = values(statuses["recorder: topics"]).items()
    assert topic == "/joints"
    assert text == "2 messages, 0 lost, 0 published before"


def test_a_late_publisher_that_offers_less_is_recorded_and_takes_nothing_from_others(
    ros, recording
) -> None:
    recorder = recording.start(topics=["chatter"])
    node = ros.node("source")
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    strong = node.create_publisher(String, "chatter", latched)
    recording.publish(recorder, strong, [String(data="first")])

    weak = ros.node("weak").create_publisher(String, "chatter", qos_profile_sensor_data)
    # The strong publisher is now heard twice.
    ros.spin_until(lambda: weak.get_subscription_count() == 1, what="the weak one's match")
    ros.spin_until(lambda: strong.get_subscription_count() == 2, what="the strong one's match")
    for index in range(20):
        strong.publish(String(data=f"strong {index}"))
        weak.publish(String(data=f"weak {index}"))
    ros.spin_until(lambda: recording.count(recorder, "/chatter") >= 41, what="the messages")
    recorder.close()

    assert recording.count(recorder, "/chatter") == 41
    assert recorder.loss_unknown == ["/chatter"]
    reader = BagReader(recorder.path)
    assert sorted(recording.texts(recorder.path)) == sorted(
        ["first"] + [f"{who} {index}" for who in ("strong", "weak") for index in range(20)]
    )
    (offer,) = reader.topics["/chatter"].qos_profiles
    assert (offer.reliability, offer.durability) == ("reliable", "transient_local")


def test_the_events_of_a_service_are_recorded_if_its_topic_is_listed(ros, recording) -> None:
    events = "/enable/_service_event"
    recorder = recording.start(topics=[events])
    node = ros.node("arm")
    service = node.create_service(SetBool, "enable", lambda _, response: response)
    qos = QoSProfile(depth=10)
    service.configure_introspection(node.get_clock(), qos, ServiceIntrospectionState.CONTENTS)
    ros.spin_until(lambda: not recorder.finder.missing, what="the events' match")
    call(ros, node, SetBool, "enable", SetBool.Request(data=True))
    ros.spin_until(lambda: recording.count(recorder, events) == 2, what="the events")
    recorder.close()
    assert verify(recorder.path).holds
    received, _ = BagReader(recorder.path).messages()
    event = deserialize_message(received.data, SetBool.Event)
    assert [each.data for each in event.request] == [True]
