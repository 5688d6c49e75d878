# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A process that is killed takes nobody with it: the others say so, go on, and welcome it back."""

import itertools
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from tsobs_ros.bag import BagReader
from tsobs_ros.nodes.messages import to_nanoseconds

TIMEOUT = 30.0
SECOND = 1_000_000_000
MEASUREMENTS, ESTIMATES = TOPICS = ["joint_measurements", "observer/joint_states"]


class Watch:
    """What the processes say of themselves, and when the measurements and estimates are from."""

    def __init__(self, ros: Any, start: Callable[..., Any]) -> None:
        self._ros = ros
        self._start = start
        self.said: dict[str, list[str]] = {}
        self.counts: dict[str, dict[str, int]] = {}
        self.measured: list[int] = []
        self.estimated: list[int] = []
        node = ros.node("watch")
        qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
        for topic, stamps in zip(TOPICS, (self.measured, self.estimated), strict=True):
            node.create_subscription(JointState, topic, self._keeper(stamps), qos)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._listen, 10)

    @staticmethod
    def _keeper(stamps: list[int]) -> Callable[[JointState], None]:
        return lambda message: stamps.append(to_nanoseconds(message.header.stamp))

    def _listen(self, array: DiagnosticArray) -> None:
        for status in array.status:
            self.said.setdefault(status.name, []).append(status.message)
            if status.name == "recorder: topics":
                counts = {item.key: int(item.value.split()[0]) for item in status.values}
                self.counts[status.hardware_id] = counts

    def start(self, name: str, **parameters: Any) -> Any:
        """Start an executable."""
        return self._start(name, parameters=parameters)

    def hear(self, name: str, message: str) -> None:
        """Wait until a status says something from now on."""
        heard = len(self.said.get(name, []))
        self._ros.spin_until(
            lambda: message in self.said.get(name, [])[heard:], TIMEOUT, f"{name}: {message}"
        )

    def more(self, stamps: list[int], count: int = 20) -> None:
        """Wait for so many messages from now on."""
        wanted = len(stamps) + count
        self._ros.spin_until(lambda: len(stamps) >= wanted, TIMEOUT, f"{count} more messages")

    def hear_out(self) -> None:
        """Wait until nothing is on its way any more."""
        self._ros.hear_out(self.estimated)

    def recorded(self, bag: Path, *topics: str, more: int = 20) -> None:
        """Wait until a recorder says that it has so many more of each topic than it said last."""

        def count(topic: str) -> int:
            return self.counts.get(str(bag), {}).get(f"/{topic}", 0)

        wanted = {topic: count(topic) + more for topic in topics}
        self._ros.spin_until(
            lambda: all(count(topic) >= least for topic, least in wanted.items()),
            TIMEOUT,
            f"{more} more recorded messages of {', '.join(topics)}",
        )


@pytest.fixture
def watch(ros: Any, ros_process: Callable[..., Any]) -> Watch:
    """Watch the processes of this test's graph."""
    return Watch(ros, ros_process)


def kill(process: Any) -> None:
    process.signal(signal.SIGKILL)
    finished = process.finish(TIMEOUT)
    assert finished.exit_code == -signal.SIGKILL
    assert "Traceback" not in finished.stderr


def stop(number: int, *processes: Any) -> None:
    for process in processes:
        process.signal(number)
    for process in processes:
        finished = process.finish(TIMEOUT)
        assert (finished.exit_code, "Traceback" in finished.stderr) == (0, False), finished.stderr


def estimates(bag: Path) -> list[int]:
    """Return the stamps of the recorded estimates."""
    return [
        to_nanoseconds(deserialize_message(item.data, JointState).header.stamp)
        for item in BagReader(bag).messages()
        if item.topic == f"/{ESTIMATES}"
    ]


def test_without_its_plant_the_observer_coasts_falls_silent_and_tracks_the_next(
    watch: Watch,
) -> None:
    observer = watch.start("observer", stale_after=2.5)
    plant = watch.start("plant_simulator")
    watch.hear("observer: state", "TRACKING")
    watch.more(watch.measured)
    watch.more(watch.estimated)
    kill(plant)
    watch.hear("observer: state", "COASTING")
    watch.hear("observer: state", "STALE")
    watch.hear("observer: state", "STALE")  # by now, the last estimates have arrived, too
    silent = len(watch.estimated)
    assert watch.estimated[-1] > watch.measured[-1] + SECOND
    watch.hear("observer: state", "STALE")
    assert len(watch.estimated) == silent

    plant = watch.start("plant_simulator")
    watch.hear("observer: state", "TRACKING")
    watch.more(watch.estimated)
    assert all(a < b for a, b in itertools.pairwise(watch.estimated))
    stop(signal.SIGTERM, plant, observer)


def test_without_its_recorder_or_observer_the_rest_goes_on_and_takes_the_next_in(
    watch: Watch, tmp_path: Path
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    recorder = watch.start("recorder", output=str(first), topics=TOPICS, flush_period=0.1)
    observer = watch.start("observer")
    plant = watch.start("plant_simulator")
    watch.recorded(first, *TOPICS)

    kill(recorder)
    watch.more(watch.estimated)
    left = {path: path.read_bytes() for path in first.iterdir()}
    refused = watch.start("recorder", output=str(first), topics=TOPICS)
    recorder = watch.start("recorder", output=str(second), topics=TOPICS)
    finished = refused.finish(TIMEOUT)
    assert finished.exit_code == 1
    assert f"error: {first}: exists already" in finished.stderr
    assert {path: path.read_bytes() for path in first.iterdir()} == left
    watch.recorded(second, *TOPICS)

    kill(observer)
    watch.hear_out()
    last = watch.estimated[-1]
    watch.more(watch.measured)
    watch.recorded(second, MEASUREMENTS)
    observer = watch.start("observer")
    watch.more(watch.estimated)
    watch.recorded(second, *TOPICS)
    stop(signal.SIGINT, observer, recorder, plant)

    stamps = estimates(second)
    assert stamps[0] < last < stamps[-1]
    assert all(a < b for a, b in itertools.pairwise(stamps))
    assert BagReader(second).topics[f"/{MEASUREMENTS}"].count > 100
