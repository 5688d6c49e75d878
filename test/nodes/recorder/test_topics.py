# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder finds its topics, and tells what it has of them and what it lacks."""

from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.service_introspection import ServiceIntrospectionState
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from tsobs_ros.bag import BagReader


def test_a_latched_message_from_before_the_recording_is_recorded(ros, recording) -> None:
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = ros.node("source").create_publisher(String, "description", latched)
    publisher.publish(String(data="said before"))

    recorder = recording.start(topics=["description"])
    ros.spin_until(
        lambda: recording.count(recorder, "/description") == 1, what="the latched message"
    )


def test_publishers_of_different_reliability_are_both_recorded(ros, recording) -> None:
    node = ros.node("source")
    publishers = [
        node.create_publisher(String, "chatter", qos)
        for qos in (QoSProfile(depth=10), qos_profile_sensor_data)
    ]
    ros.spin_until(lambda: node.count_publishers("/chatter") == 2, what="both publishers")
    recorder = recording.start(topics=["chatter"])
    ros.spin_until(
        lambda: all(p.get_subscription_count() == 1 for p in publishers), what="both matches"
    )
    for index, publisher in enumerate(publishers):
        publisher.publish(String(data=str(index)))
    ros.spin_until(lambda: recording.count(recorder, "/chatter") == 2, what="both messages")
    assert not recorder.statistics.topics["/chatter"].loss_known


def test_a_publisher_that_comes_late_is_recorded(ros, recording) -> None:
    recorder = recording.start(topics=["early", "late"])
    node = ros.node("source")
    publish_early = node.create_publisher(String, "early", 10)
    ros.spin_until(lambda: "/early" in recorder.statistics.topics, what="the early topic")
    assert not recorder.ready

    late = node.create_publisher(String, "late", 10)
    recording.publish(recorder, late, [String(data="hello")])
    assert recorder.ready
    assert publish_early.get_subscription_count() == 1


def test_relative_names_are_in_the_recorders_namespace(ros, recording) -> None:
    recorder = recording.start(namespace="/arm", topics=["joints"])
    publisher = ros.node("source", namespace="/arm").create_publisher(JointState, "joints", 10)
    recording.publish(recorder, publisher, recording.joint_states(1))
    assert set(recorder.statistics.topics) == {"/arm/joints"}


@pytest.mark.parametrize("parameters", [{}, {"topics": ["*"]}, {"topics": ["x"], "all": True}])
def test_all_visible_topics_are_recorded(ros, recording, parameters) -> None:
    recorder = recording.start(**parameters)
    node = ros.node("source")
    node.create_publisher(String, "_hidden", 10)
    publisher = node.create_publisher(String, "visible", 10)
    ros.spin_until(lambda: "/visible" in recorder.statistics.topics, what="the topic")
    recording.publish(recorder, publisher, [String()])
    ros.spin_until(
        lambda: recording.count(recorder, "/diagnostics") > 0, what="its own diagnostics"
    )
    assert "/_hidden" not in recorder.statistics.topics


def test_an_unknown_type_does_not_stop_the_others(ros, recording, capfd) -> None:
    # The events of a service are a topic whose type no .msg file defines.
    recorder = recording.start(topics=["trigger/_service_event", "joints"])
    node = ros.node("source")
    service = node.create_service(Trigger, "trigger", lambda request, response: response)
    service.configure_introspection(
        node.get_clock(), QoSProfile(depth=10), ServiceIntrospectionState.METADATA
    )
    publisher = node.create_publisher(JointState, "joints", 10)
    ros.spin_until(lambda: "/joints" in recorder.statistics.topics, what="the known topic")
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, what="the match")
    for message in recording.joint_states(3):
        publisher.publish(message)
    ros.spin_until(lambda: recording.count(recorder, "/joints") == 3, what="the messages")
    assert not recorder.ready
    recorder.close()

    assert set(BagReader(recorder.path).topics) == {"/joints"}
    warnings = [line for line in capfd.readouterr().err.splitlines() if "not recording" in line]
    assert len(warnings) == 1
    assert "not recording /trigger/_service_event: 'std_srvs/srv/Trigger_Event'" in warnings[0]


def test_what_a_full_queue_drops_is_counted(ros, recording) -> None:
    recorder = recording.start(topics=["joints"], queue_depth=10)
    publisher = ros.node("source").create_publisher(JointState, "joints", 100)
    recording.publish(recorder, publisher, recording.joint_states(1))
    for message in recording.joint_states(60):
        publisher.publish(message)
    ros.spin_until(lambda: recording.count(recorder, "/joints") == 11, what="the last ten")
    assert recorder.statistics.topics["/joints"] == (11, 50, True)
    assert recorder.statistics.lost == 50


def test_statistics_count_every_message(ros, recording) -> None:
    recorder = recording.start(topics=["a", "b"])
    node = ros.node("source")
    a, b = (node.create_publisher(String, name, 10) for name in "ab")
    recording.publish(recorder, a, [String()] * 3)
    recording.publish(recorder, b, [String()] * 4)
    assert recorder.statistics.messages == 7
    assert recorder.statistics.lost == 0


def test_diagnostics_tell_counts_and_what_is_awaited(ros, recording) -> None:
    recorder = recording.start(topics=["joints"])
    node = ros.node("source")
    statuses: list[Any] = []
    node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda array: statuses.extend(array.status), 10
    )
    ros.spin_until(lambda: bool(statuses), what="diagnostics")
    assert statuses[0].name.startswith("recorder: ")
    assert statuses[0].level == DiagnosticStatus.WARN
    assert statuses[0].message == "waiting for /joints"

    publisher = node.create_publisher(JointState, "joints", 10)
    recording.publish(recorder, publisher, recording.joint_states(2))
    ros.spin_until(lambda: statuses[-1].message == "recording", what="the news")
    values = {item.key: item.value for item in statuses[-1].values}
    assert statuses[-1].level == DiagnosticStatus.OK
    assert (values["messages"], values["lost"]) == ("2", "0")


def test_a_late_publisher_that_cannot_be_heard_is_reported_once(ros, recording, capfd) -> None:
    recorder = recording.start(topics=["chatter"])
    node = ros.node("source")
    publisher = node.create_publisher(String, "chatter", 10)
    recording.publish(recorder, publisher, [String(data="heard")])

    unreliable = ros.node("weak").create_publisher(String, "chatter", qos_profile_sensor_data)
    errors: list[str] = []

    def reported() -> bool:
        errors.extend(capfd.readouterr().err.splitlines())
        return any("node weak" in line for line in errors)

    ros.spin_until(reported, what="the warning")
    unreliable.publish(String(data="not heard"))
    another = node.create_publisher(String, "chatter", 10)
    recording.publish(recorder, another, [String(data="heard")] * 2)
    recorder.close()

    errors.extend(capfd.readouterr().err.splitlines())
    (warning,) = [line for line in errors if "node weak" in line and "recorder" in line]
    assert "offers less reliability than the first publishers" in warning
