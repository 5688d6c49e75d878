# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder is paused, resumed and split, and gives snapshots, by services."""

from collections.abc import Callable
from typing import Any

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from std_msgs.msg import String
from std_srvs.srv import Trigger

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.metadata import read_metadata

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

Call = Callable[[str], str]


@pytest.fixture
def call(ros) -> Call:
    """Give what calls one of the recorder's services and returns its answer."""
    node = ros.node("operator")

    def call(service: str) -> str:
        client = node.create_client(Trigger, f"/recorder/{service}")
        ros.spin_until(client.service_is_ready, what=f"the service {service}")
        future = client.call_async(Trigger.Request())
        ros.spin_until(future.done, what=f"the answer of {service}")
        response = future.result()
        assert response is not None
        assert response.success or service == "is_paused"
        assert service != "is_paused" or response.success == (response.message == "paused")
        return str(response.message)

    return call


@pytest.fixture
def say(ros, recording) -> Callable[..., None]:
    """Give what publishes texts once the recorder is matched, and waits for it to take them."""
    publishers: dict[str, Any] = {}

    def say(recorder: Any, topic: str, *texts: str, qos: Any = 100) -> None:
        if topic not in publishers:
            node = ros.node(f"source_of_{topic}")
            publishers[topic] = node.create_publisher(String, topic, qos)
        publisher = publishers[topic]
        ros.spin_until(lambda: publisher.get_subscription_count() > 0, what="the match")
        statistics = recorder.statistics
        taken = statistics.messages + statistics.discarded + len(texts)
        for text in texts:
            publisher.publish(String(data=text))

        def arrived() -> bool:
            now = recorder.statistics
            return now.messages + now.discarded >= taken

        ros.spin_until(arrived, what=f"the messages on {topic}")

    return say


def texts(path: Any) -> list[str]:
    return [deserialize_message(m.data, String).data for m in BagReader(path).messages()]


def test_what_comes_during_a_pause_is_left_out_but_for_what_is_latched(
    recording, call, say
) -> None:
    recorder = recording.start(topics=["a", "map"])
    say(recorder, "a", "before")
    assert call("pause") == "paused"
    assert call("is_paused") == "paused"
    say(recorder, "a", "during")
    say(recorder, "map", "the map", qos=LATCHED)
    assert call("toggle_paused") == "recording"
    say(recorder, "a", "after")
    assert call("toggle_paused") == "paused"
    assert call("resume") == "recording"
    recorder.close()
    assert texts(recorder.path) == ["before", "the map", "after"]
    assert recorder.statistics.discarded == 2
    assert recorder.statistics.lost == 0


def test_it_can_wait_to_begin(recording, call, say) -> None:
    recorder = recording.start(topics=["a"], start_paused=True)
    assert call("is_paused") == "paused"
    say(recorder, "a", "too early")
    call("resume")
    say(recorder, "a", "in time")
    recorder.close()
    assert texts(recorder.path) == ["in time"]


def test_a_bag_is_split_on_demand_and_each_file_has_what_is_latched(
    ros, recording, call, say
) -> None:
    recorder = recording.start(topics=["a", "map"])
    for mapper, count in (("x", 1), ("y", 3)):
        publisher = ros.node(mapper).create_publisher(String, "map", LATCHED)
        ros.spin_until(lambda p=publisher: p.get_subscription_count() > 0, what="the match")
        for k in range(count):
            publisher.publish(String(data=f"{mapper}{k}"))
        publisher.wait_for_all_acked()
    ros.spin_until(lambda: recorder.statistics.messages == 4, what="both maps")
    say(recorder, "a", "one")
    assert call("split_bagfile") == "2 files"
    assert call("split_bagfile") == "2 files"
    say(recorder, "a", "two")
    recorder.close()
    files = [texts(recorder.path / file.path) for file in read_metadata(recorder.path).files]
    assert files[0] == ["x0", "y0", "y1", "y2", "one"]
    assert {"x0", "y2"} < set(files[1])
    assert files[1][-2:] == ["y2", "two"]


def test_a_bag_is_split_by_size(ros, recording) -> None:
    recorder = recording.start(topics=["a"], max_bag_size=20_000, compression="none")
    publisher = ros.node("source").create_publisher(String, "a", 100)
    # Chunks are written when they are full, or flushed.
    recording.publish(recorder, publisher, [String(data="x" * 400_000)] * 6)
    recorder.close()
    assert len(read_metadata(recorder.path).files) == 3
    assert BagReader(recorder.path).message_count == 6


def test_a_bag_is_split_by_duration(ros, recording, say) -> None:
    recorder = recording.start(topics=["a"], max_bag_duration=0.001)
    for index in range(3):
        say(recorder, "a", str(index))
        ros.spin_for(0.002)
    recorder.close()
    assert len(read_metadata(recorder.path).files) == 3
    assert texts(recorder.path) == ["0", "1", "2"]


def test_a_snapshot_holds_the_last_messages_and_what_is_latched(recording, call, say) -> None:
    # A message counts as 256 bytes and its own, so that two of these fit into 1 MiB.
    large = ["x" * 400_000 + str(index) for index in range(5)]
    recorder = recording.start(topics=["a", "map"], snapshot_mode=True, snapshot_size=1)
    say(recorder, "map", "the map", qos=LATCHED)
    say(recorder, "a", *large)
    assert call("snapshot") == "3 messages"
    say(recorder, "a", "between")
    assert call("snapshot") == "2 messages"
    say(recorder, "a", "never asked for")
    recorder.close()
    assert texts(recorder.path) == ["the map", large[3], large[4], "the map", "between"]


def test_there_are_no_snapshots_where_everything_is_written(ros, recording) -> None:
    recorder = recording.start(topics=["a"])
    names = {name for name, _ in recorder.get_service_names_and_types_by_node("recorder", "/")}
    assert "/recorder/split_bagfile" in names
    assert "/recorder/snapshot" not in names
