# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the recorder writes is what was published, as independent readers see it."""

import contextlib
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.serialization import deserialize_message
from rclpy.service_introspection import ServiceIntrospectionState
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger

from tsobs_ros.bag import BagReader
from tsobs_ros.errors import BagReadError, BagWriteError, NodeError, ParameterError
from tsobs_ros.nodes.recorder import Recorder, create

StartRecorder = Callable[..., Recorder]


@pytest.fixture
def record(ros, tmp_path: Path) -> StartRecorder:
    """Start a recorder with parameters, to `tmp_path/bag` unless told otherwise."""

    def start(namespace: str | None = None, **parameters: Any) -> Recorder:
        values = {"output": str(tmp_path / "bag"), **parameters}
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        return ros.add(
            create(context=ros.context, parameter_overrides=overrides, namespace=namespace)
        )

    return start


def recorded(recorder: Recorder, topic: str) -> int:
    statistics = recorder.statistics.topics.get(topic)
    return statistics.messages if statistics else 0


def publish_recorded(ros, recorder: Recorder, publisher, messages: Sequence[Any]) -> None:
    """Publish to a recorder that is matched, and wait until all is recorded."""
    ros.spin_until(lambda: recorder.ready, what="the recorder's subscription")
    ros.spin_until(lambda: publisher.get_subscription_count() > 0, what="the publisher's match")
    for message in messages:
        publisher.publish(message)
    ros.spin_until(
        lambda: recorded(recorder, publisher.topic_name) >= len(messages), what="the recording"
    )


def joint_states(count: int) -> list[JointState]:
    return [JointState(name=[f"joint_{i}"], position=[float(i)]) for i in range(count)]


AWKWARD_MESSAGES: list[tuple[type, list[Any]]] = [
    (JointState, [JointState(), JointState(name=[""], effort=[float("inf")]), *joint_states(20)]),
    (String, [String(), String(data="Größe θ̂ ≤ 1 😀"), String(data="x" * 3_000_000)]),
    (Float64MultiArray, [Float64MultiArray(), Float64MultiArray(data=[0.5] * 200_000)]),
]


@pytest.fixture(params=AWKWARD_MESSAGES, ids=lambda param: param[0].__name__)
def published(request, ros, record: StartRecorder) -> tuple[Path, list[Any]]:
    """Give a closed bag and the messages that were published while it was recorded."""
    msg_type, messages = request.param
    recorder = record(topics=["topic"], compression="zstd")
    publisher = ros.node("source").create_publisher(msg_type, "topic", QoSProfile(depth=100))
    publish_recorded(ros, recorder, publisher, messages)
    recorder.close()
    return recorder.path, messages


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


def test_rosbags_reads_what_was_published(published: tuple[Path, list[Any]]) -> None:
    path, messages = published
    with AnyReader([path]) as reader:
        read = [
            reader.deserialize(data, connection.msgtype)
            for connection, _, data in reader.messages()
        ]
    assert [fields(m, p) for m, p in zip(read, messages, strict=True)] == [
        fields(p, p) for p in messages
    ]


def test_mcap_reads_what_was_published(published: tuple[Path, list[Any]]) -> None:
    path, messages = published
    with (path / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        read = [item.decoded_message for item in reader.iter_decoded_messages()]
    assert [fields(m, p) for m, p in zip(read, messages, strict=True)] == [
        fields(p, p) for p in messages
    ]


def test_rclpy_reads_what_was_published(published: tuple[Path, list[Any]]) -> None:
    path, messages = published
    read = [deserialize_message(m.data, type(messages[0])) for m in BagReader(path).messages()]
    assert read == messages


def test_times_are_those_of_sending_and_receiving(ros, record: StartRecorder) -> None:
    recorder = record(topics=["joints"])
    node = ros.node("source")
    publisher = node.create_publisher(JointState, "joints", 100)
    before = node.get_clock().now().nanoseconds
    publish_recorded(ros, recorder, publisher, joint_states(50))
    after = node.get_clock().now().nanoseconds
    recorder.close()

    messages = list(BagReader(recorder.path).messages())
    assert all(before <= m.publish_time <= m.log_time <= after for m in messages)
    assert [m.publish_time for m in messages] == sorted(m.publish_time for m in messages)


def test_a_bag_says_with_which_qos_its_topics_were_offered(ros, record: StartRecorder) -> None:
    recorder = record(topics=["joints"])
    publisher = ros.node("source").create_publisher(JointState, "joints", qos_profile_sensor_data)
    publish_recorded(ros, recorder, publisher, joint_states(1))
    recorder.close()

    reader = BagReader(recorder.path)
    (offer,) = reader.topics["/joints"].qos_profiles
    assert (offer.reliability, offer.durability) == ("best_effort", "volatile")
    assert reader.metadata is not None
    assert reader.metadata.topics[0].offered_qos_profiles == (offer,)


def test_the_type_hash_is_the_one_discovery_announces(ros, record: StartRecorder) -> None:
    recorder = record(topics=["joints"])
    node = ros.node("source")
    publisher = node.create_publisher(JointState, "joints", 10)
    publish_recorded(ros, recorder, publisher, joint_states(1))
    (info,) = node.get_publishers_info_by_topic("/joints")
    recorder.close()

    assert BagReader(recorder.path).topics["/joints"].type_hash == str(info.topic_type_hash)


def test_a_latched_message_from_before_the_recording_is_recorded(
    ros, record: StartRecorder
) -> None:
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = ros.node("source").create_publisher(String, "description", latched)
    publisher.publish(String(data="said before"))

    recorder = record(topics=["description"])
    ros.spin_until(lambda: recorded(recorder, "/description") == 1, what="the latched message")


def test_publishers_of_different_reliability_are_both_recorded(ros, record: StartRecorder) -> None:
    node = ros.node("source")
    publishers = [
        node.create_publisher(String, "chatter", qos)
        for qos in (QoSProfile(depth=10), qos_profile_sensor_data)
    ]
    ros.spin_until(lambda: node.count_publishers("/chatter") == 2, what="both publishers")
    recorder = record(topics=["chatter"])
    ros.spin_until(
        lambda: all(p.get_subscription_count() == 1 for p in publishers), what="both matches"
    )
    for index, publisher in enumerate(publishers):
        publisher.publish(String(data=str(index)))
    ros.spin_until(lambda: recorded(recorder, "/chatter") == 2, what="both messages")
    assert not recorder.statistics.topics["/chatter"].loss_known


def test_a_publisher_that_comes_late_is_recorded(ros, record: StartRecorder) -> None:
    recorder = record(topics=["early", "late"])
    node = ros.node("source")
    publish_early = node.create_publisher(String, "early", 10)
    ros.spin_until(lambda: "/early" in recorder.statistics.topics, what="the early topic")
    assert not recorder.ready

    late = node.create_publisher(String, "late", 10)
    publish_recorded(ros, recorder, late, [String(data="hello")])
    assert recorder.ready
    assert publish_early.get_subscription_count() == 1


def test_relative_names_are_in_the_recorders_namespace(ros, record: StartRecorder) -> None:
    recorder = record(namespace="/arm", topics=["joints"])
    publisher = ros.node("source", namespace="/arm").create_publisher(JointState, "joints", 10)
    publish_recorded(ros, recorder, publisher, joint_states(1))
    assert set(recorder.statistics.topics) == {"/arm/joints"}


@pytest.mark.parametrize("parameters", [{}, {"topics": ["*"]}, {"topics": ["x"], "all": True}])
def test_all_visible_topics_are_recorded(ros, record: StartRecorder, parameters) -> None:
    recorder = record(**parameters)
    node = ros.node("source")
    node.create_publisher(String, "_hidden", 10)
    publisher = node.create_publisher(String, "visible", 10)
    ros.spin_until(lambda: "/visible" in recorder.statistics.topics, what="the topic")
    publish_recorded(ros, recorder, publisher, [String()])
    ros.spin_until(lambda: recorded(recorder, "/diagnostics") > 0, what="its own diagnostics")
    assert "/_hidden" not in recorder.statistics.topics


def test_an_unknown_type_does_not_stop_the_others(ros, record: StartRecorder, capfd) -> None:
    # The events of a service are a topic whose type no .msg file defines.
    recorder = record(topics=["trigger/_service_event", "joints"])
    node = ros.node("source")
    service = node.create_service(Trigger, "trigger", lambda request, response: response)
    service.configure_introspection(
        node.get_clock(), QoSProfile(depth=10), ServiceIntrospectionState.METADATA
    )
    publisher = node.create_publisher(JointState, "joints", 10)
    ros.spin_until(lambda: "/joints" in recorder.statistics.topics, what="the known topic")
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, what="the match")
    for message in joint_states(3):
        publisher.publish(message)
    ros.spin_until(lambda: recorded(recorder, "/joints") == 3, what="the messages")
    assert not recorder.ready
    recorder.close()

    assert set(BagReader(recorder.path).topics) == {"/joints"}
    warnings = [line for line in capfd.readouterr().err.splitlines() if "not recording" in line]
    assert len(warnings) == 1
    assert "not recording /trigger/_service_event: 'std_srvs/srv/Trigger_Event'" in warnings[0]


def test_what_a_full_queue_drops_is_counted(ros, record: StartRecorder) -> None:
    recorder = record(topics=["joints"], queue_depth=10)
    publisher = ros.node("source").create_publisher(JointState, "joints", 100)
    publish_recorded(ros, recorder, publisher, joint_states(1))
    for message in joint_states(60):
        publisher.publish(message)
    ros.spin_until(lambda: recorded(recorder, "/joints") == 11, what="the last ten")
    assert recorder.statistics.topics["/joints"] == (11, 50, True)
    assert recorder.statistics.lost == 50


def test_statistics_count_every_message(ros, record: StartRecorder) -> None:
    recorder = record(topics=["a", "b"])
    node = ros.node("source")
    a, b = (node.create_publisher(String, name, 10) for name in "ab")
    publish_recorded(ros, recorder, a, [String()] * 3)
    publish_recorded(ros, recorder, b, [String()] * 4)
    assert recorder.statistics.messages == 7
    assert recorder.statistics.lost == 0


def test_closing_records_what_has_arrived(ros, record: StartRecorder, capfd) -> None:
    recorder = record(topics=["joints"], drain_period=1.0)
    publisher = ros.node("source").create_publisher(JointState, "joints", 100)
    ros.spin_until(lambda: recorder.ready, what="the recorder's subscription")
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, what="the publisher's match")
    for message in joint_states(40):
        publisher.publish(message)
    assert publisher.wait_for_all_acked()

    recorder.close()
    recorder.close()

    assert BagReader(recorder.path).message_count == 40
    lines = capfd.readouterr().err
    assert lines.count(f"closed {recorder.path}: 40 messages of 1 topics, 0 lost") == 1
    assert lines.count(f"recording to {recorder.path}") == 1
    assert lines.count("recording /joints [sensor_msgs/msg/JointState]") == 1


def test_under_simulated_time_messages_wait_for_the_clock(ros, record: StartRecorder) -> None:
    recorder = record(topics=["joints"], use_sim_time=True)
    node = ros.node("source")
    publisher = node.create_publisher(JointState, "joints", 10)
    clock = node.create_publisher(Clock, "/clock", 10)
    ros.spin_until(lambda: recorder.ready, what="the recorder's subscription")
    ros.spin_until(lambda: clock.get_subscription_count() == 1, what="the clock's match")
    for message in joint_states(3):
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


def test_diagnostics_tell_counts_and_what_is_awaited(ros, record: StartRecorder) -> None:
    recorder = record(topics=["joints"])
    node = ros.node("source")
    statuses: list[Any] = []
    node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda array: statuses.extend(array.status), 10
    )
    ros.spin_until(lambda: bool(statuses), what="diagnostics")
    assert statuses[0].name.startswith("recorder: ")
    assert statuses[0].level == DiagnosticStatus.WARN
    assert statuses[0].message == "waiting for /joints"

    publish_recorded(
        ros, recorder, node.create_publisher(JointState, "joints", 10), joint_states(2)
    )
    statuses.clear()
    ros.spin_until(lambda: bool(statuses), what="diagnostics")
    values = {item.key: item.value for item in statuses[0].values}
    assert statuses[0].level == DiagnosticStatus.OK
    assert (values["messages"], values["lost"]) == ("2", "0")


def test_an_existing_folder_is_refused(record: StartRecorder, tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    with pytest.raises(BagWriteError, match="bag: exists already"):
        record()
    assert list((tmp_path / "bag").iterdir()) == []


def test_an_unnamed_bag_gets_a_dated_name(record: StartRecorder, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = record(output="").path
    assert path.parent == tmp_path
    assert path.match("rosbag2_[0-9][0-9][0-9][0-9]_[0-9][0-9]_[0-9][0-9]-*")


def test_a_wrong_compression_is_refused(record: StartRecorder) -> None:
    with pytest.raises(ParameterError, match="compression"):
        record(compression="zip")


def test_a_disk_that_is_too_full_is_refused(record: StartRecorder, tmp_path: Path) -> None:
    with pytest.raises(NodeError, match="MiB of disk space are free"):
        record(minimum_free_disk=10**9)
    assert not (tmp_path / "bag").exists()


def test_a_disk_that_gets_too_full_ends_the_recording(ros, record: StartRecorder) -> None:
    recorder = record(topics=["joints"], flush_period=0.05)
    publisher = ros.node("source").create_publisher(JointState, "joints", 10)
    publish_recorded(ros, recorder, publisher, joint_states(5))
    recorder.set_parameters([Parameter("minimum_free_disk", value=10**9)])

    ros.spin_until(lambda: recorder.finished, what="the end of the recording")
    assert BagReader(recorder.path).message_count == 5


def stored_messages(path: Path) -> list[bytes]:
    """Read a file that may have no end, in file order, as recovery tools do."""
    stored = []
    with path.open("rb") as stream, contextlib.suppress(EndOfFile):
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Message):
                stored.append(record.data)
    return stored


def test_what_was_flushed_survives_a_kill(ros, ros_process, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    process = ros_process(
        "recorder", parameters={"output": str(bag), "topics": ["joints"], "flush_period": 0.2}
    )
    publisher = ros.node("source").create_publisher(JointState, "joints", 200)
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, 20.0, what="the match")
    messages = joint_states(150)
    for message in messages:
        publisher.publish(message)
    # Far less than a chunk, and nothing follows: only the timer can have flushed it.
    file = bag / "bag_0.mcap"
    ros.spin_until(lambda: len(stored_messages(file)) == len(messages), what="the flush")
    publisher.publish(JointState())

    process.signal(signal.SIGKILL)
    assert process.finish().exit_code == -signal.SIGKILL

    stored = [deserialize_message(data, JointState) for data in stored_messages(file)]
    assert stored[: len(messages)] == messages
    with pytest.raises(BagReadError, match=r"bag_0\.mcap: the file has no end"):
        BagReader(bag)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_closes_the_bag(ros, ros_process, tmp_path: Path, number: int) -> None:
    bag = tmp_path / "bag"
    process = ros_process("recorder", parameters={"output": str(bag), "topics": ["joints"]})
    publisher = ros.node("source").create_publisher(JointState, "joints", 200)
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, 20.0, what="the match")
    messages = joint_states(150)
    for message in messages:
        publisher.publish(message)
    assert publisher.wait_for_all_acked()

    process.signal(number)
    finished = process.finish()

    assert finished.exit_code == 0
    assert "Traceback" not in finished.stderr
    read = [deserialize_message(m.data, JointState) for m in BagReader(bag).messages()]
    assert read == messages
