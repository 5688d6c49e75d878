# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder is paused, resumed and split, and gives snapshots, by services."""

from collections.abc import Callable
from typing import Any

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger

from tsobs_ros.bag.metadata import read_metadata

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
Call = Callable[[str], str]


@pytest.fixture
def call(manage: Callable[[Any], Any]) -> Call:
    """Give what calls one of the recorder's services and returns its answer."""

    def call(service: str) -> str:
        response = manage("/recorder").call(Trigger, service, Trigger.Request())
        assert response.success == (service != "is_paused" or response.message == "paused")
        return str(response.message)

    return call


def test_what_comes_during_a_pause_is_left_out_but_for_what_is_latched(recording, call) -> None:
    recorder = recording.start(topics=["a", "map"], start_paused=True)
    assert call("is_paused") == "paused"
    recording.say(recorder, "a", "too early")
    assert call("resume") == "recording"
    recording.say(recorder, "a", "before")
    assert call("pause") == "paused"
    recording.say(recorder, "a", "during")
    recording.say(recorder, "map", "the map", qos=LATCHED)
    assert call("toggle_paused") == "recording"
    recording.say(recorder, "a", "after")
    assert call("toggle_paused") == "paused"
    recorder.close()
    assert recording.texts(recorder.path) == ["before", "the map", "after"]
    assert recorder.statistics.discarded == 3
    assert recorder.statistics.lost == 0


def test_a_bag_is_split_on_demand_and_each_file_has_what_is_latched(ros, recording, call) -> None:
    recorder = recording.start(topics=["a", "map"])
    for mapper, count in (("x", 1), ("y", 3)):
        publisher = ros.node(mapper).create_publisher(String, "map", LATCHED)
        ros.spin_until(lambda p=publisher: p.get_subscription_count() > 0, what="the match")
        for k in range(count):
            publisher.publish(String(data=f"{mapper}{k}"))
        publisher.wait_for_all_acked()
    ros.spin_until(lambda: recorder.statistics.messages == 4, what="both maps")
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


def test_a_snapshot_holds_the_last_messages_and_what_is_latched(recording, call) -> None:
    # A message counts as 256 bytes and its own, so that two of these fit into 1 MiB.
    large = ["x" * 400_000 + str(index) for index in range(5)]
    recorder = recording.start(topics=["a", "map"], snapshot_mode=True, snapshot_size=1)
    recording.say(recorder, "map", "the map", qos=LATCHED)
    recording.say(recorder, "a", *large)
    assert call("snapshot") == "3 messages"
    recording.say(recorder, "a", "between")
    assert call("snapshot") == "2 messages"
    recording.say(recorder, "a", "never asked for")
    recorder.close()
    written = ["the map", large[3], large[4], "the map", "between"]
    assert recording.texts(recorder.path) == written
