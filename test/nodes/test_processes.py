# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Processes end cleanly whatever ends them, at any time, and their shipped parameters fit."""

import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from staging import diagnostics, to_nanoseconds, values
from std_msgs.msg import Header

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.estimate_topics import TOPICS as OF_EVERY_OBSERVER
from tsobs_ros.resources import FIXED_DESIGN, config_path

PREAMBLE = """
import ctypes, os, signal, sys
import rclpy
from rclpy.node import Node
from tsobs_ros.nodes import runtime

class Worker(Node):
    finished = False

    def __init__(self):
        super().__init__("worker")
        self.timer = self.create_timer(0.02, self.tick)

    def tick(self):
        print("ticking", flush=True)
        self.timer.cancel()

    def close(self):
        print("closed worker", flush=True)

    def destroy_node(self):
        print("destroyed worker", flush=True)
        super().destroy_node()
"""
CLOSED, DESTROYED = "closed worker\n", "destroyed worker\n"
BUGGY = """
class Case(Worker):
    finished = {finished}
    def {where}(self):
        super().{where}()
        raise KeyError("bug")
sys.exit(runtime.run(Case))
"""
SIGNALLED = """
class Case(Worker):
    def close(self):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        super().close()
sys.exit(runtime.run(Case))
"""
HANGS = """
class Case(Worker):
    finished = True
    def destroy_node(self):
        ctypes.PyDLL(None).pause()  # for ever, in C, holding the GIL
runtime._TEARDOWN_TIMEOUT = 0.5
sys.exit(runtime.run(Case))
"""


@pytest.fixture
def script(ros_process: Any) -> Callable[[str], Any]:
    """Start a Python script made of the preamble and the given body."""
    return lambda body: ros_process([sys.executable, "-c", PREAMBLE + body])


@pytest.mark.parametrize(("where", "finished"), [("tick", False), ("close", True)])
def test_a_bug_has_its_traceback_and_costs_no_other_step(
    script: Any, where: str, finished: bool
) -> None:
    done = script(BUGGY.format(where=where, finished=finished)).finish()
    assert done.exit_code == 1
    assert done.stdout.endswith(CLOSED + DESTROYED)
    assert done.stderr.count("Traceback") == 1
    assert done.stderr.endswith("KeyError: 'bug'\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_it_and_more_change_nothing(script: Any, number: signal.Signals) -> None:
    process = script(SIGNALLED)
    process.wait_for_line("ticking")
    process.signal(number)
    assert process.finish() == (0, "ticking\n" + CLOSED + DESTROYED, "")


def test_a_teardown_that_hangs_is_ended_after_all_is_closed(script: Any) -> None:
    assert script(HANGS).finish() == (-signal.SIGALRM, CLOSED, "")


TIMEOUT = 60.0
TOPICS = ["joint_measurements", "observer/joint_states"]
Process = Callable[..., Any]


def errors(text: str) -> list[str]:
    lines = [line for line in text.splitlines() if " STALE: " not in line]
    return [line for line in lines if line.startswith(("error", "[ERROR]", "[FATAL]"))]


def check_clean(finished: Any) -> None:
    assert finished.exit_code == 0, finished.stderr
    assert "Traceback" not in finished.stderr + finished.stdout
    assert errors(finished.stderr) == []


def test_the_shipped_parameters_fit_together_and_the_recorder_awaits_nothing_for_ever(
    ros: Any, ros_process: Process, tmp_path: Path
) -> None:
    bag, statuses = tmp_path / "bag", diagnostics(ros)
    parameters = {"recorder": {"output": str(bag)}}
    processes = {
        name: ros_process(
            name, params_file=config_path(f"{name}.yaml"), parameters=parameters.get(name)
        )
        for name in ("recorder", "observer", "plant_simulator")
    }

    def records_all() -> bool:
        if not statuses.keys() >= {"recorder: recording", "recorder: topics"}:
            return False
        counts = values(statuses["recorder: topics"])
        there = all(int(counts.get(f"/{each}", "0").split()[0]) >= 20 for each in TOPICS)
        # A busy machine may make it warn of losses.
        return there and not statuses["recorder: recording"].message.startswith("waiting")

    ros.spin_until(records_all, TIMEOUT, "20 messages of each topic")
    for each in processes.values():
        each.signal(signal.SIGTERM)
    for each in processes.values():
        check_clean(each.finish(TIMEOUT))

    assert "not recording" not in processes["recorder"].output
    for process in processes.values():
        assert "ignored unknown parameter" not in process.output
    recorded = BagReader(bag).topics
    assert {f"/observer/{name}" for name in OF_EVERY_OBSERVER} <= recorded.keys()
    assert {"/diagnostics", "/ground_truth/joint_states", "/joint_measurements"} <= recorded.keys()


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


def test_a_process_answers_measurements_long_before_its_next_tick(
    ros: Any, ros_process: Process
) -> None:
    own, stamps = ros.node("own"), list[int]()
    sensor = own.create_publisher(JointState, "joint_measurements", qos_profile_sensor_data)
    own.create_subscription(
        JointState,
        "observer/joint_states",
        lambda each: stamps.append(to_nanoseconds(each.header.stamp)),
        10,
    )
    ros_process("observer", parameters={"rate": 0.1, "publish_on": "measurement"})
    ros.spin_until(lambda: sensor.get_subscription_count() == 1, TIMEOUT, "the observer's start")

    def is_answered(seconds: float) -> bool:
        """Send a measurement, and return whether an estimate comes within some time."""
        now, before = own.get_clock().now(), len(stamps)
        header = Header(stamp=now.to_msg())
        sensor.publish(
            JointState(header=header, name=["elastic_joint"], position=[0.1], effort=[0.0])
        )
        end = time.monotonic() + seconds
        while len(stamps) == before and time.monotonic() < end:
            ros.executor.spin_once(timeout_sec=0.05)
        return len(stamps) > before

    # The observer finds its listener a little later.
    assert any(is_answered(1.0) for _ in range(int(TIMEOUT)))
    assert all(is_answered(9.0) for _ in range(3))
    assert stamps == sorted(stamps)


# What a process has mapped shows how far its start-up is: imports, or the middleware's start.
@pytest.mark.parametrize(
    ("name", "library", "number"),
    [("observer", "_rclpy_pybind11", signal.SIGTERM), ("recorder", "libfastrtps", signal.SIGINT)],
)
def test_a_signal_during_the_start_ends_cleanly(
    ros_process: Process, tmp_path: Path, name: str, library: str, number: int
) -> None:
    bag = tmp_path / "bag"
    parameters = {"output": str(bag), "topics": TOPICS} if name == "recorder" else {}
    process = ros_process(name, parameters=parameters)
    maps = Path("/proc", str(process.pid), "maps")
    deadline = time.monotonic() + TIMEOUT
    while library not in maps.read_text():
        assert time.monotonic() < deadline, f"{library} has not been loaded"
    process.signal(number)
    check_clean(process.finish(TIMEOUT))
    if bag.exists():
        assert BagReader(bag).message_count == 0


def test_what_cannot_work_is_one_line_and_exit_code_1(ros_process: Process, tmp_path: Path) -> None:
    data = yaml.safe_load(config_path(FIXED_DESIGN).read_text(encoding="utf-8"))
    data["gain"]["K"][0] *= 20.0
    (tmp_path / "edited.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
    given = {"design": str(tmp_path / "edited.yaml")}
    finished = ros_process("observer", parameters=given).finish(TIMEOUT)
    assert finished.exit_code == 1
    assert "Traceback" not in finished.stderr
    (line,) = errors(finished.stderr)
    assert line.startswith("error: ")
    assert "edited.yaml: the certificate does not hold" in line


def test_what_ros_refuses_of_the_environment_is_a_line(ros_process: Process) -> None:
    prefix = ["env", "ROS_STATIC_PEERS=256.256.256.256"]
    finished = ros_process("visualizer", prefix=prefix).finish(TIMEOUT)
    assert finished.exit_code == 1
    assert "Traceback" not in finished.stderr
    (line,) = errors(finished.stderr)
    assert "Unable to resolve peer 256.256.256.256" in line


@pytest.mark.parametrize("home", ["home", ""])
def test_a_node_needs_no_folder_for_logs(ros_process: Process, tmp_path: Path, home: str) -> None:
    file = tmp_path / "home"
    file.write_text("a file, below which nobody makes a folder")
    prefix = ["env", "-u", "ROS_HOME", "-u", "ROS_LOG_DIR", f"HOME={home and file}"]
    process = ros_process("plant_simulator", parameters={"duration": 0.1}, prefix=prefix)
    finished = process.finish(TIMEOUT)
    assert finished.exit_code == 0, finished.stderr
    assert "started" in finished.stdout + finished.stderr
