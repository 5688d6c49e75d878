# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The events of services, hidden and unpublished topics are recorded where they are asked for."""

from typing import Any

import pytest
from mcap.reader import make_reader
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.service_introspection import ServiceIntrospectionState
from rosbags.rosbag2 import Reader as RosbagsReader
from service_msgs.msg import ServiceEventInfo
from std_msgs.msg import String
from std_srvs.srv import SetBool

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.verification import verify

EVENTS = "/arm/enable/_service_event"


def call_an_introspected_service(ros: Any, recorder: Any) -> None:
    node = ros.node("arm", namespace="/arm")

    def answer(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = request.data, "it is"
        return response

    service = node.create_service(SetBool, "enable", answer)
    service.configure_introspection(
        node.get_clock(), QoSProfile(depth=10), ServiceIntrospectionState.CONTENTS
    )
    client = node.create_client(SetBool, "enable")
    ros.spin_until(client.service_is_ready, what="the service")
    ros.spin_until(lambda: EVENTS in recorder.statistics.topics, what="the events' topic")
    ros.spin_until(lambda: recorder.ready, what="the events' match")
    future = client.call_async(SetBool.Request(data=True))
    ros.spin_until(future.done, what="the answer")
    ros.spin_until(lambda: recorder.statistics.topics[EVENTS].messages == 2, what="the events")


@pytest.mark.parametrize("parameters", [{"services": ["/arm/enable"]}, {"all_services": True}])
def test_the_events_of_services_are_recorded(ros, recording, parameters: dict[str, Any]) -> None:
    recorder = recording.start(**parameters)
    call_an_introspected_service(ros, recorder)
    recorder.close()

    path = recorder.path
    found = verify(path)
    assert (found.errors, found.remarks) == ((), ())
    messages = list(BagReader(path).messages())
    received, sent = (deserialize_message(m.data, SetBool.Event) for m in messages)
    assert received.info.event_type == ServiceEventInfo.REQUEST_RECEIVED
    assert [request.data for request in received.request] == [True]
    assert sent.info.event_type == ServiceEventInfo.RESPONSE_SENT
    assert [(r.success, r.message) for r in sent.response] == [(True, "it is")]

    with RosbagsReader(path) as reader:
        (connection,) = reader.connections
        assert connection.msgtype == "std_srvs/srv/SetBool_Event"
        assert [bytes(data) for _, _, data in reader.messages()] == [m.data for m in messages]
    with (path / "bag_0.mcap").open("rb") as stream:
        ((schema, channel, _), _) = make_reader(stream, validate_crcs=True).iter_messages()
    assert schema.data.decode() == find_definition("std_srvs/srv/SetBool_Event").text
    assert channel.metadata["topic_type_hash"] == find_definition(schema.name).type_hash


def test_hidden_topics_are_found_where_asked_for(ros, recording) -> None:
    recorder = recording.start(all=True, include_hidden=True, exclude_topics=["/diagnostics"])
    publisher = ros.node("source").create_publisher(String, "_hidden", 10)
    ros.spin_until(lambda: "/_hidden" in recorder.statistics.topics, what="the topic")
    recording.publish(recorder, publisher, [String(data="seen")])
    assert "/diagnostics" not in recorder.statistics.topics


def test_a_listed_hidden_topic_needs_no_leave(ros, recording) -> None:
    recorder = recording.start(topics=["_hidden"])
    publisher = ros.node("source").create_publisher(String, "_hidden", 10)
    recording.publish(recorder, publisher, [String(data="seen")])
    recorder.close()
    assert BagReader(recorder.path).message_count == 1


def test_a_topic_without_publishers_is_recorded_where_asked_for(ros, recording) -> None:
    recorder = recording.start(regex="^/command$", include_unpublished=True)
    node = ros.node("listener")
    node.create_subscription(String, "command", lambda message: None, 10)
    ros.spin_until(lambda: "/command" in recorder.statistics.topics, what="the topic")
    publisher = node.create_publisher(String, "command", 10)
    ros.spin_until(lambda: publisher.get_subscription_count() == 2, what="the recorder's match")
    recording.publish(recorder, publisher, [String(data="go")])
    recorder.close()
    reader = BagReader(recorder.path)
    assert (reader.message_count, reader.topics["/command"].qos_profiles) == (1, ())
