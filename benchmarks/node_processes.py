# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Processes around a node that is measured: the node itself, a sensor, a listener, a reference.

As a script, this file is one of the processes that are not installed: `sensor` publishes the
measurements of simulated arms from its own loop, on a grid of the system clock; `listener` takes
everything that the observer publishes, as a recorder does, and at the end prints the stamps of the
estimates, the times of their arrival, and the timing diagnostics; `bare-timer` is a node with only
an empty timer, spun by rclpy.
"""

import argparse
import atexit
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from common import join_ros

from tsobs_ros.bag.estimate_topics import STATES, TOPICS
from tsobs_ros.design.file import save_design
from tsobs_ros.design.record import Design

_START_TIMEOUT = 60.0
_STOP_TIMEOUT = 15.0
_DRAIN_PERIOD = 0.05
_DEPTH = 5000


@atexit.register
def _kill_children() -> None:
    """Leave no process behind, not even one whose start was interrupted by a signal."""
    for task in Path("/proc/self/task").iterdir():
        with suppress(FileNotFoundError):  # a thread that has ended meanwhile
            for child in (task / "children").read_text(encoding="ascii").split():
                os.kill(int(child), signal.SIGKILL)


class Process:
    """A process with its output in a file; it ends with this one at the latest.

    Args:
        name: Name for people and for the file.
        command: Arguments of the Python interpreter.
        folder: Folder for its output.
        domain: ROS domain.
    """

    def __init__(self, name: str, command: Sequence[str], folder: Path, domain: int) -> None:
        self.name = name
        self._log = folder / f"{name.replace(' ', '_')}.log"
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder),
            "PYTHONUNBUFFERED": "1",
        }
        with self._log.open("wb") as output:
            self._process = subprocess.Popen(
                [sys.executable, *command],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # a terminal's Ctrl-C goes to the benchmark alone
            )

    @property
    def output(self) -> str:
        """Everything it has printed."""
        return self._log.read_text(encoding="utf-8", errors="replace")

    def wait_for(self, pattern: str) -> None:
        """Wait until it has printed something, or end the benchmark."""
        deadline = time.monotonic() + _START_TIMEOUT
        while not re.search(pattern, self.output):
            if self._process.poll() is not None or time.monotonic() > deadline:
                sys.exit(f"{self.name} did not start:\n{self.output}")
            time.sleep(0.05)

    def cpu_seconds(self) -> float:
        """Return the user and system time it has used in all its threads [s]."""
        text = Path(f"/proc/{self._process.pid}/stat").read_text(encoding="ascii")
        # The name in brackets may contain anything, so fields count from the last bracket.
        fields = text.rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def resident_kib(self) -> int:
        """Return the memory that it keeps in RAM [KiB]."""
        status = Path(f"/proc/{self._process.pid}/status").read_text(encoding="ascii")
        return int(status.partition("VmRSS:")[2].split()[0])

    def stop(self) -> int:
        """End it as Ctrl-C does and return its exit code."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(_STOP_TIMEOUT)
            except subprocess.TimeoutExpired:
                self._process.kill()
        return self._process.wait()

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.wait()


def command_of(name: str, parameters: Mapping[str, Any]) -> list[str]:
    """Return the interpreter's arguments that run one of the package's nodes."""
    command = ["-m", "tsobs_ros.executables", name, "--ros-args"]
    for key, value in parameters.items():
        command += ["-p", f"{key}:={json.dumps(value)}"]
    return command


def executable(name: str, parameters: Mapping[str, Any], folder: Path, domain: int) -> Process:
    """Start one of the package's nodes."""
    return Process(name, command_of(name, parameters), folder, domain)


def helper(role: str, folder: Path, domain: int, *arguments: object) -> Process:
    """Start this script in one of its roles."""
    return Process(role, [__file__, role, *map(str, arguments)], folder, domain)


def design_for(design: Design, rate: float, folder: Path) -> Path:
    """Return the file of a design, made again for the sensor's rate if it is for another.

    At another rate the design's gain has no proof, and the observer always uses Riccati gains.
    """
    path = folder / "made.design.yaml"
    if design.request.rate != rate:
        from tsobs_ros.design.synthesis import synthesise

        design = synthesise(replace(design.request, rate=rate))
    save_design(design, path)
    return path


def joint_names(count: int) -> list[str]:
    """Return names of joints; for a single one, the default name."""
    return ["elastic_joint"] if count == 1 else [f"joint_{k + 1}" for k in range(count)]


def hear(node: Any) -> dict[str, Any]:
    """Subscribe to all topics of an observer, which otherwise would not publish them."""
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState

    from tsobs_ros.nodes.wire import DrainedSubscription

    qos = QoSProfile(depth=_DEPTH)
    return {
        topic: DrainedSubscription(node, JointState, f"observer/{topic}", qos, raw=True)
        for topic in TOPICS
    }


def _sensor(rate: float, joints: int) -> None:
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import JointState

    from tsobs_ros.bag.joint_states import JointStateEncoder
    from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

    encode = JointStateEncoder(joint_names(joints))
    run = simulate(SCENARIOS["noise"], list(range(joints)), 20.0)
    angles, torques = run.measurements[:, :, 0].T, run.torques[:, :, 0].T
    node = join_ros().create_node("sensor")
    publisher = node.create_publisher(JointState, "joint_measurements", qos_profile_sensor_data)
    while publisher.get_subscription_count() < 1:
        time.sleep(0.05)
    print("started")
    period = round(1e9 / rate)
    stamp, begin = time.time_ns(), time.time_ns()
    while True:
        # The simulated run goes to and fro, at the 200 Hz it was simulated with.
        place = (stamp - begin) * 200 // 10**9 % (2 * len(angles) - 2)
        index = min(place, 2 * len(angles) - 2 - place)
        publisher.publish(encode(stamp, angles[index].tolist(), (), torques[index].tolist()))
        stamp += period
        time.sleep(max(0, stamp - time.time_ns()) * 1e-9)


def _listener() -> None:
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.qos import QoSProfile

    from tsobs_ros.bag.joint_states import JointStateDecoder
    from tsobs_ros.nodes.wire import DrainedSubscription

    node = join_ros().create_node("listener")
    taken, decode = hear(node), JointStateDecoder()
    diagnostics = DrainedSubscription(node, DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
    while not all(each.subscription.get_publisher_count() for each in taken.values()):
        time.sleep(0.05)
    print("started")
    estimates: list[tuple[int, int]] = []
    timing: list[dict[str, str]] = []
    try:
        while True:
            time.sleep(_DRAIN_PERIOD)
            for topic, each in taken.items():
                drained = each.drain()
                if topic == STATES:
                    estimates += [
                        (decode(data).stamp, info["received_timestamp"]) for data, info in drained
                    ]
            timing += [
                {item.key: item.value for item in status.values}
                for array, _ in diagnostics.drain()
                for status in array.status
                if status.name == "observer: timing"
            ]
    except KeyboardInterrupt:
        print(json.dumps({"estimates": estimates, "timing": timing}))


def _bare_timer(rate: float) -> None:
    rclpy = join_ros()
    node = rclpy.create_node("bare_timer")
    node.create_timer(1.0 / rate, lambda: None)
    print("started")
    rclpy.spin(node)


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("role", choices=("sensor", "listener", "bare-timer"))
    parser.add_argument("rate", type=float, nargs="?", default=200.0)
    parser.add_argument("joints", type=int, nargs="?", default=1)
    options = parser.parse_args()
    try:
        if options.role == "sensor":
            _sensor(options.rate, options.joints)
        elif options.role == "listener":
            _listener()
        else:
            _bare_timer(options.rate)
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    _main()
