# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recorder under test: `recording.start(**parameters)`, `recording.publish(…)`, counts."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from staging import start
from std_msgs.msg import String

from tsobs_ros.bag import BagReader
from tsobs_ros.nodes.recorder import Recorder


class Recording:
    """Starts recorders in the test's graph, and feeds them."""

    def __init__(self, ros: Any, folder: Path) -> None:
        self._ros = ros
        self._folder = folder
        self._publishers: dict[str, Any] = {}

    def start(self, namespace: str | None = None, **parameters: Any) -> Recorder:
        """Start a recorder with parameters, to `tmp_path/bag` unless they name another bag."""
        values = {"output": str(self._folder / "bag"), **parameters}
        return start(self._ros, "recorder", options={"namespace": namespace}, **values)

    def publish(self, recorder: Recorder, publisher: Any, messages: Sequence[Any]) -> None:
        """Publish once the publisher is matched, and wait until all is recorded or discarded."""
        topic = publisher.topic_name

        def taken() -> int:
            return self.count(recorder, topic) + recorder.recording.discarded

        self._ros.spin_until(lambda: publisher.get_subscription_count() > 0, what="the match")
        expected = taken() + len(messages)
        for message in messages:
            publisher.publish(message)
        self._ros.spin_until(lambda: taken() >= expected, what=f"the messages on {topic}")

    def say(self, recorder: Recorder, topic: str, *texts: str, qos: Any = 100) -> None:
        """Publish texts as `publish` does, from a node for this topic."""
        if topic not in self._publishers:
            node = self._ros.node(f"source_of_{topic}")
            self._publishers[topic] = node.create_publisher(String, topic, qos)
        self.publish(recorder, self._publishers[topic], [String(data=text) for text in texts])

    @staticmethod
    def count(recorder: Recorder, topic: str) -> int:
        """Return how many messages of a topic are recorded."""
        return recorder.recording.counts.get(topic, 0)

    @staticmethod
    def joint_states(count: int) -> list[JointState]:
        """Return messages that differ from each other."""
        return [JointState(name=[f"joint_{i}"], position=[float(i)]) for i in range(count)]

    @staticmethod
    def texts(path: Path) -> list[str]:
        """Return the texts of a bag of Strings."""
        return [deserialize_message(m.data, String).data for m in BagReader(path).messages()]


@pytest.fixture
def recording(ros: Any, tmp_path: Path) -> Recording:
    """Give what starts recorders in this test's graph."""
    return Recording(ros, tmp_path)
