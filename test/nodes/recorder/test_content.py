# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the recorder writes is what was published, and services pause and split it."""

from collections.abc import Callable
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from staging import diagnostics
from std_msgs.msg import String
from std_srvs.srv import Trigger

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.metadata import read_metadata


def test_other_libraries_read_what_was_published_when_and_by_whom(ros, recording) -> None:
    recorder = recording.start(topics=["joints", "words"], compression="zstd")
    node = ros.node("source")
    best_effort = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
    awkward = JointState(name=["θ"], position=[0.1] * 7, effort=[float("inf")])
    messages = [JointState(), awkward, String(data="Größe θ̂ ≤ 1 😀"), String(data="x" * 300_000)]
    joints = node.create_publisher(JointState, "joints", best_effort)
    words = node.create_publisher(String, "words", 100)
    ros.spin_until(lambda: not recorder.finder.missing, what="the recorder's match")
    before = node.get_clock().now().nanoseconds
    recording.publish(recorder, joints, messages[:2])
    recording.publish(recorder, words, messages[2:])
    after = node.get_clock().now().nanoseconds
    (info,) = node.get_publishers_info_by_topic("/joints")
    recorder.close()

    with AnyReader([recorder.path]) as other:
        rosbags = [other.deserialize(data, c.msgtype) for c, _, data in other.messages()]
    with (recorder.path / "bag_0.mcap").open("rb") as stream:
        made = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        mcap = [item.decoded_message for item in made.iter_decoded_messages()]
    for read in (rosbags, mcap):
        *states, short, long = read
        assert [[*each.name, *each.position, *each.effort] for each in states] == [
            [*each.name, *each.position, *each.effort] for each in messages[:2]
        ]
        assert [short.data, long.data] == [each.data for each in messages[2:]]

    reader = BagReader(recorder.path)
    times = [time for m in reader.messages() for time in (m.publish_time, m.log_time)]
    assert [before, *times, after] == sorted([before, *times, after])
    assert reader.topics["/joints"].type_hash == str(info.topic_type_hash)
    (offer,) = reader.topics["/joints"].qos_profiles
    assert (offer.reliability, offer.durability) == ("best_effort", "volatile")
    written = [each.topic_metadata for each in reader.metadata.topics_with_message_count]
    assert {each.name: each.offered_qos_profiles for each in written}["/joints"] == (offer,)


def test_under_simulated_time_messages_wait_for_the_clock(ros, recording) -> None:
    recorder = recording.start(topics=["joints"], use_sim_time=True)
    node = ros.node("source")
    publisher = node.create_publisher(JointState, "joints", 10)
    clock = node.create_publisher(Clock, "/clock", 10)
    ros.spin_until(lambda: not recorder.finder.missing, what="the recorder's subscription")
    ros.spin_until(lambda: clock.get_subscription_count() == 1, what="the clock's match")
    for message in recording.joint_states(3):
        publisher.publish(message)
    statuses = diagnostics(ros)
    ros.spin_until(lambda: bool(statuses), what="a second of simulated standstill")
    assert statuses["recorder: recording"].message == "waiting for /clock"
    assert recorder.messages == 0

    tick = Clock()
    tick.clock.sec = 12
    clock.publish(tick)
    ros.spin_until(lambda: recorder.messages == 3, what="the waiting messages")
    recorder.close()
    assert {m.log_time for m in BagReader(recorder.path).messages()} == {12 * 10**9}


def test_what_no_clock_has_a_time_for_is_told(ros, recording, capfd) -> None:
    recorder = recording.start(topics=["joints"], use_sim_time=True)
    publisher = ros.node("source").create_publisher(JointState, "joints", 10)
    ros.spin_until(lambda: not recorder.finder.missing, what="the recorder's subscription")
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, what="the publisher's match")
    for message in recording.joint_states(3):
        publisher.publish(message)
    assert publisher.wait_for_all_acked()
    recorder.close()
    printed = capfd.readouterr().err
    assert printed.count(": waiting for /clock\n") == 1
    assert ": not recorded without a /clock: 3 messages\n" in printed


LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
def call(manage: Callable[[Any], Any]) -> Callable[[str], str]:
    """Give what calls one of the recorder's services and returns its answer."""
    return lambda service: str(manage("/recorder").call(Trigger, service).message)


def test_what_comes_during_a_pause_is_left_out_but_for_what_is_latched(recording, call) -> None:
    recorder = recording.start(topics=["a", "map"])
    recording.say(recorder, "a", "before")
    assert call("pause") == "paused"
    recording.say(recorder, "a", "during")
    recording.say(recorder, "map", "the map", qos=LATCHED)
    assert call("resume") == "recording"
    recording.say(recorder, "a", "after")
    recorder.close()
    assert recording.texts(recorder.path) == ["before", "the map", "after"]
    assert recorder.recording.discarded == 1
    assert recorder.lost == 0


def test_a_bag_is_split_on_demand_and_each_file_has_what_is_latched(ros, recording, call) -> None:
    recorder = recording.start(topics=["a", "map"])
    for mapper, count in (("x", 1), ("y", 3)):
        publisher = ros.node(mapper).create_publisher(String, "map", LATCHED)
        ros.spin_until(lambda p=publisher: p.get_subscription_count() > 0, what="the match")
        for k in range(count):
            publisher.publish(String(data=f"{mapper}{k}"))
        publisher.wait_for_all_acked()
    ros.spin_until(lambda: recorder.messages == 4, what="both maps")
    recording.say(recorder, "a", "one")
    assert call("split_bagfile") == "2 files"
    assert call("split_bagfile") == "2 files"
    recording.say(recorder, "a", "two")
    recorder.close()
    files = [
        recording.texts(recorder.path / file.path) for file in read_metadata(recorder.path).files
    ]
    assert files[0] == ["x0", "y0", "y1", "y2", "one"]
    assert {"x0", "y2"} < set(files[1])
    assert files[1][-2:] == ["y2", "two"]


@pytest.mark.parametrize("limit", [{"max_bag_size": 20_000}, {"max_bag_duration": 0.001}])
def test_a_bag_is_split_by_size_and_by_duration(ros, recording, limit: dict[str, Any]) -> None:
    recorder = recording.start(topics=["a"], compression="none", **limit)
    # Of two, as chunks are written when they are full.
    said = [f"{index}".ljust(400_000) for index in range(6)]
    for pair in zip(said[::2], said[1::2], strict=True):
        recording.say(recorder, "a", *pair)
        ros.spin_for(0.002)
    recorder.close()
    assert len(read_metadata(recorder.path).files) >= 3
    assert recording.texts(recorder.path) == said
