# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The node executables as processes: clean ends at any time, one line where something is wrong."""

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from tsobs_ros.bag import BagReader
from tsobs_ros.nodes.messages import to_nanoseconds
from tsobs_ros.resources import config_path

SHIPPED = config_path("elastic_joint.design.yaml")
TIMEOUT = 60.0
Process = Callable[..., Any]


def start(ros_process: Process, name: str, folder: Path, **parameters: Any) -> Any:
    if name == "recorder":
        parameters = {"output": str(folder / "bag"), "topics": ["observer/joint_states"],
                      **parameters}  # fmt: skip
    return ros_process(name, parameters=parameters)


def errors(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith(("error", "[ERROR]", "[FATAL]"))]


def check_clean(finished: Any) -> None:
    assert finished.exit_code == 0, finished.stderr
    assert "Traceback" not in finished.stderr + finished.stdout
    assert errors(finished.stderr) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_three_working_processes_end_cleanly(
    ros: Any, ros_process: Process, tmp_path: Path, number: int
) -> None:
    received: list[JointState] = []
    recorded = [0]

    def count(array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name == "recorder: recording":
                recorded[0] = int({v.key: v.value for v in status.values}["messages"])

    node = ros.node("listener")
    node.create_subscription(JointState, "observer/joint_states", received.append, 1000)
    node.create_subscription(DiagnosticArray, "/diagnostics", count, 10)
    processes = [
        start(ros_process, name, tmp_path) for name in ("recorder", "observer", "plant_simulator")
    ]
    ros.spin_until(lambda: recorded[0] >= 100, TIMEOUT, "a hundred estimates in the bag")
    before = len(received)
    ros.spin_until(lambda: len(received) >= before + 50, TIMEOUT, "fifty more estimates")

    for process in processes:
        process.signal(number)
    for process in processes:
        check_clean(process.finish(TIMEOUT))

    reader = BagReader(tmp_path / "bag")
    stored = [deserialize_message(item.data, JointState) for item in reader.messages()]
    assert reader.topics["/observer/joint_states"].count == len(stored) >= 100
    by_stamp = {to_nanoseconds(message.header.stamp): message for message in stored}
    assert list(by_stamp) == sorted(by_stamp)
    assert len(by_stamp) == len(stored)
    # Not the very last: they may have reached this process first.
    for message in received[before : before + 40]:
        assert by_stamp[to_nanoseconds(message.header.stamp)] == message


def test_a_lifecycle_manager_drives_a_process_and_its_shutdown_ends_it(
    ros: Any, ros_process: Process, manage: Callable[[Any], Any]
) -> None:
    process = ros_process("observer", parameters={"autostart": False})
    plant = ros_process("plant_simulator")
    received: list[JointState] = []
    ros.node("listener").create_subscription(
        JointState, "observer/joint_states", received.append, 10
    )
    manager = manage("/observer")
    assert manager.state == "unconfigured"
    for _ in range(2):
        assert manager.change("configure", "activate")
        before = len(received)
        ros.spin_until(lambda n=before: len(received) > n + 20, TIMEOUT, "estimates")
        assert manager.change("deactivate", "cleanup")
    assert manager.change("configure", "activate", "shutdown")
    check_clean(process.finish(TIMEOUT))
    plant.signal(signal.SIGINT)
    check_clean(plant.finish(TIMEOUT))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", ["observer", "plant_simulator", "recorder", "player"])
# What a process has mapped tells how far its start-up is: imports, or the middleware's start.
@pytest.mark.parametrize("library", ["_rclpy_pybind11", "libfastrtps"])
def test_a_signal_during_the_start_ends_cleanly(
    ros_process: Process, tmp_path: Path, small_bag: Path, library: str, name: str, number: int
) -> None:
    parameters = {"bag": str(small_bag), "loop": True} if name == "player" else {}
    process = start(ros_process, name, tmp_path, **parameters)
    maps = Path("/proc", str(process.pid), "maps")
    deadline = time.monotonic() + TIMEOUT
    while library not in maps.read_text():
        assert time.monotonic() < deadline, f"{library} has not been loaded"
    process.signal(number)

    check_clean(process.finish(TIMEOUT))
    if name == "recorder" and (tmp_path / "bag").exists():
        assert BagReader(tmp_path / "bag").message_count == 0


def tampered(path: Path) -> Path:
    data = yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))
    data["gain"]["K"][0] *= 20.0
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


def existing(path: Path) -> Path:
    path.mkdir()
    return path


CASES: list[tuple[str, str, Callable[[Path], Any], list[str]]] = [
    ("observer", "design", lambda f: str(f / "none.yaml"), ["none.yaml: no such design file"]),
    (
        "observer",
        "design",
        lambda f: str(tampered(f / "edited.yaml")),
        ["edited.yaml: the certificate does not hold", "covariance decrease at slopes (1, 1)"],
    ),
    ("observer", "rate", lambda _: -1.0, ["rate", "at least"]),
    ("recorder", "output", lambda f: str(existing(f / "taken")), ["taken: exists already"]),
    ("plant_simulator", "joint", lambda _: "", ["joint"]),
]


@pytest.mark.parametrize(("name", "parameter", "make", "named"), CASES)
def test_what_cannot_work_is_one_line_and_exit_code_1(
    ros_process: Process, tmp_path: Path, name: str, parameter: str, make: Any, named: list[str]
) -> None:
    value = make(tmp_path)
    finished = start(ros_process, name, tmp_path, **{parameter: value}).finish(TIMEOUT)
    assert finished.exit_code == 1
    assert "Traceback" not in finished.stderr
    (line,) = errors(finished.stderr)
    assert line.startswith("error: ")
    for text in named:
        assert text in line
    if parameter == "output":
        assert list((tmp_path / "taken").iterdir()) == []
