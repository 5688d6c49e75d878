# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recorder under test: `recording.start(**parameters)`, `recording.publish(…)`, counts."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from tsobs_ros.nodes.recorder import Recorder, create


class Recording:
    """Starts recorders in the test's graph, and feeds them."""

    def __init__(self, ros: Any, folder: Path) -> None:
        self._ros = ros
        self._folder = folder

    def start(self, namespace: str | None = None, **parameters: Any) -> Recorder:
        """Start a recorder with parameters, to `tmp_path/bag` unless told otherwise."""
        values = {"output": str(self._folder / "bag"), **parameters}
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        return self._ros.add(
            create(context=self._ros.context, parameter_overrides=overrides, namespace=namespace)
        )

    def publish(self, recorder: Recorder, publisher: Any, messages: Sequence[Any]) -> None:
        """Publish once the recorder is matched, and wait until all is recorded."""
        spin_until = self._ros.spin_until
        spin_until(lambda: recorder.ready, what="the recorder's subscription")
        spin_until(lambda: publisher.get_subscription_count() > 0, what="the publisher's match")
        for message in messages:
            publisher.publish(message)
        topic = publisher.topic_name
        spin_until(lambda: self.count(recorder, topic) >= len(messages), what="the recording")

    @staticmethod
    def count(recorder: Recorder, topic: str) -> int:
        """Return how many messages of a topic are recorded."""
        statistics = recorder.statistics.topics.get(topic)
        return statistics.messages if statistics else 0

    @staticmethod
    def joint_states(count: int) -> list[JointState]:
        """Return messages that differ from each other."""
        return [JointState(name=[f"joint_{i}"], position=[float(i)]) for i in range(count)]


@pytest.fixture
def recording(ros: Any, tmp_path: Path) -> Recording:
    """Give what starts recorders in this test's graph."""
    return Recording(ros, tmp_path)
