# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The executables as processes: clean ends at any time."""

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.estimate_topics import TOPICS as OF_EVERY_OBSERVER
from tsobs_ros.resources import FIXED_DESIGN, config_path

TIMEOUT = 60.0
MEASUREMENTS, _ = TOPICS = ["joint_measurements", "observer/joint_states"]
Process = Callable[..., Any]


class Watch:
    """The statuses of processes."""

    def __init__(self, ros: Any) -> None:
        self._ros = ros
        self.messages: dict[str, list[str]] = {}
        self.counts: dict[str, dict[str, int]] = {}
        node = ros.node("watch")
        node.create_subscription(DiagnosticArray, "/diagnostics", self._keep_statuses, 10)

    def _keep_statuses(self, array: DiagnosticArray) -> None:
        for status in array.status:
            self.messages.setdefault(status.name, []).append(status.message)
            if status.name == "recorder: topics":
                counts = {item.key: int(item.value.split()[0]) for item in status.values}
                self.counts[status.hardware_id] = counts

    def wait_for_status(self, name: str, message: str) -> None:
        """Wait until a status has a message from now on."""
        before = len(self.messages.get(name, []))
        self._ros.spin_until(
            lambda: message in self.messages.get(name, [])[before:], TIMEOUT, f"{name}: {message}"
        )

    def wait_for_records(self, bag: Path, *topics: str, more: int = 20) -> None:
        """Wait until a recorder's status counts so many messages of each topic."""

        def all_there() -> bool:
            counts = self.counts.get(str(bag), {})
            return all(counts.get(f"/{topic}", 0) >= more for topic in topics)

        self._ros.spin_until(all_there, TIMEOUT, f"{more} messages of {', '.join(topics)}")


@pytest.fixture
def watch(ros: Any) -> Watch:
    """Watch the processes of this test's graph."""
    return Watch(ros)


def errors(text: str) -> list[str]:
    lines = [line for line in text.splitlines() if " STALE: " not in line]
    return [line for line in lines if line.startswith(("error", "[ERROR]", "[FATAL]"))]


def check_clean(finished: Any) -> None:
    assert finished.exit_code == 0, finished.stderr
    assert "Traceback" not in finished.stderr + finished.stdout
    assert errors(finished.stderr) == []


def end(signals: dict[Any, int]) -> None:
    for process, number in signals.items():
        process.signal(number)
    for process in signals:
        check_clean(process.finish(TIMEOUT))


def test_the_shipped_parameters_fit_together_and_the_recorder_awaits_nothing_for_ever(
    watch: Watch, ros_process: Process, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    parameters = {"recorder": {"output": str(bag)}}
    processes = {
        name: ros_process(
            name, params_file=config_path(f"{name}.yaml"), parameters=parameters.get(name)
        )
        for name in ("recorder", "observer", "plant_simulator")
    }
    watch.wait_for_status("recorder: recording", "recording")
    watch.wait_for_records(bag, *TOPICS)
    player = ros_process(
        "player", params_file=config_path("player.yaml"), parameters={"bag": str(bag)}
    )
    assert f"error: {bag}/bag_0.mcap: the file has no end" in player.finish(TIMEOUT).stderr
    end(dict.fromkeys(processes.values(), signal.SIGTERM))

    # A busy machine may make the others warn of late samples or a slow plant.
    assert "[WARN]" not in processes["recorder"].output
    for process in processes.values():
        assert "ignored unknown parameters" not in process.output
    recorded = BagReader(bag).topics
    assert {f"/observer/{name}" for name in OF_EVERY_OBSERVER} <= recorded.keys()
    assert {"/diagnostics", "/ground_truth/joint_states", f"/{MEASUREMENTS}"} <= recorded.keys()


def test_a_lifecycle_manager_drives_a_process_and_its_shutdown_ends_it(
    ros_process: Process, manage: Callable[[Any], Any]
) -> None:
    process = ros_process("observer", parameters={"autostart": False})
    manager = manage("/observer")
    assert manager.state == "unconfigured"
    assert manager.change("configure", "activate", "deactivate", "activate")
    assert manager.state == "active"
    assert manager.change("shutdown")
    check_clean(process.finish(TIMEOUT))


# What a process has mapped shows how far its start-up is: imports, or the middleware's start.
@pytest.mark.parametrize(
    ("name", "library", "number"),
    [
        ("observer", "_rclpy_pybind11", signal.SIGINT),
        ("recorder", "libfastrtps", signal.SIGINT),
        ("player", "_rclpy_pybind11", signal.SIGTERM),
    ],
)
def test_a_signal_during_the_start_ends_cleanly(
    ros_process: Process, tmp_path: Path, small_bag: Path, name: str, library: str, number: int
) -> None:
    bag = tmp_path / "bag"
    parameters: dict[str, dict[str, Any]] = {
        "player": {"bag": str(small_bag), "loop": True},
        "recorder": {"output": str(bag), "topics": TOPICS},
    }
    process = ros_process(name, parameters=parameters.get(name, {}))
    maps = Path("/proc", str(process.pid), "maps")
    deadline = time.monotonic() + TIMEOUT
    while library not in maps.read_text():
        assert time.monotonic() < deadline, f"{library} has not been loaded"
    process.signal(number)
    check_clean(process.finish(TIMEOUT))
    if bag.exists():
        assert BagReader(bag).message_count == 0


def tampered(path: Path) -> Path:
    data = yaml.safe_load(config_path(FIXED_DESIGN).read_text(encoding="utf-8"))
    data["gain"]["K"][0] *= 20.0
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


def test_what_cannot_work_is_one_line_and_exit_code_1(ros_process: Process, tmp_path: Path) -> None:
    design = str(tampered(tmp_path / "edited.yaml"))
    finished = ros_process("observer", parameters={"design": design}).finish(TIMEOUT)
    assert finished.exit_code == 1
    assert "Traceback" not in finished.stderr
    (line,) = errors(finished.stderr)
    assert line.startswith("error: ")
    assert "edited.yaml: the certificate does not hold" in line
