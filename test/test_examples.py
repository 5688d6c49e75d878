# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The example scripts run as a user runs them, and come to the results they print."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from std_msgs.msg import Float64MultiArray

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
LOG = str(ROOT / "docs" / "examples" / "arm_log.csv")
NUMBER = r"([+-]?\d+\.\d+)"
PRINTED = {
    "simulate_and_observe": (rf"estimated at {NUMBER} rad(?s:.*)4001 measurements used", [0.1]),
    "own_arm": (r"(?s:.*: holds){5}(?s:.*)\nobserver --ros-args -p design:=new/folder/my_arm", []),
    "own_executor": (r"[1-9]\d\d estimates received", []),
    "ts_system": (rf"gyroscope: {NUMBER} rad/s", [0.15]),
    "motor_encoder": (r"(?s:.*: holds){5}(?s:.*)\d N m is estimated to 0\.\d+ N m", []),
    "contact_torque": (rf": noticed after {NUMBER} s, .* at 14 s, true", [0.05]),
    "ts_node": (rf"gyroscope {NUMBER}", [0.15]),
}
"""What the examples print, and what its numbers are within 0.05."""
DRAWN = ("own_arm", "contact_torque")
"""Those with a figure, in a folder that may be new."""


def run(name: str, *arguments: str, folder: Path, domain_id: int) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error::RuntimeWarning", ROOT / "examples" / name, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "ROS_DOMAIN_ID": str(domain_id)},
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", PRINTED)
def test_an_example_comes_to_its_result(name: str, tmp_path: Path, domain_id: int) -> None:
    pattern, numbers = PRINTED[name]
    given = ["new/folder"] if name in DRAWN else []
    found = re.search(pattern, run(f"{name}.py", *given, folder=tmp_path, domain_id=domain_id))

    assert found is not None
    assert [float(each) for each in found.groups()] == pytest.approx(numbers, abs=0.05)
    figures = [*tmp_path.glob("new/folder/*.png")]
    assert bool(figures) == (name in DRAWN)
    assert all(figure.read_bytes().startswith(b"\x89PNG") for figure in figures)


def test_a_log_becomes_a_bag_that_is_replayed(tmp_path: Path, domain_id: int) -> None:
    first = run("replay_a_bag.py", LOG, "new", folder=tmp_path, domain_id=domain_id)
    again = run("replay_a_bag.py", "new", folder=tmp_path, domain_id=domain_id)

    assert "elastic_joint: 600 estimates over 3.0 s" in first
    assert "600 messages on /observer/joint_states" in first
    assert "100.0% of the live estimates reproduced to the last bit" in again


@pytest.mark.parametrize("name", ["replay_a_bag", "hidden_robot"])
def test_an_example_without_its_files_shows_its_usage(name: str) -> None:
    script = [sys.executable, ROOT / "examples" / f"{name}.py"]
    done = subprocess.run(script, capture_output=True, text=True, env={"PYTHONPATH": str(ROOT)})

    assert (done.returncode, done.stdout) == (1, "")
    assert f"\nUsage: python {name}.py " in done.stderr


class Controller:
    """The commands that an effort controller would get from play_motion.py, and that process."""

    def __init__(self, ros: Any, ros_process: Callable[..., Any], tmp_path: Path) -> None:
        self.ros, self._start, self._motion = ros, ros_process, tmp_path / "motion.csv"
        self.commands = list[float]()
        ros.node("controller").create_subscription(
            Float64MultiArray, "commands", lambda each: self.commands.extend(each.data), 1000
        )

    def play(self, seconds: float, *arguments: str) -> Any:
        """Start a motion whose torque rises from 0.01 to 0.02 N m, at 100 Hz."""
        time = np.arange(round(100 * seconds)) / 100
        lines = [f"{t:.2f},{0.01 + 0.01 * t / seconds:.9f}" for t in time]
        self._motion.write_text("\n".join(["time [s],torque [N m]", *lines, ""]))
        script = [sys.executable, str(ROOT / "examples" / "play_motion.py"), str(self._motion)]
        return self._start([*script, "--topic", "/commands", *arguments])


@pytest.fixture
def controller(ros: Any, ros_process: Callable[..., Any], tmp_path: Path) -> Controller:
    return Controller(ros, ros_process, tmp_path)


def test_a_motion_is_played_in_order_and_ends_with_no_torque(controller: Controller) -> None:
    process = controller.play(0.5, "--max-torque", "0.002", "--scale", "0.1")
    controller.ros.spin_until(lambda: 0.0 in controller.commands, 30.0)

    assert process.finish().stdout == "played 0.5 s, up to 0.00198 N m\n"
    *played, last = controller.commands
    assert last == 0.0
    assert played == sorted(played)
    assert played[0] >= 0.001
    assert len(set(played)) > 5


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_motion_that_is_interrupted_ends_with_no_torque(
    controller: Controller, number: int
) -> None:
    process = controller.play(60.0, "--max-torque", "1")
    controller.ros.spin_until(lambda: len(controller.commands) > 5, 30.0)
    process.signal(number)
    controller.ros.spin_until(lambda: controller.commands[-1] == 0.0, 30.0)

    done = process.finish()
    assert (done.exit_code, done.stderr) == (1, "stopped: the torque is 0\n")
    controller.ros.hear_out(controller.commands)
    assert controller.commands.count(0.0) == 1


def test_a_motion_beyond_the_limit_or_beside_another_one_is_not_played(
    controller: Controller,
) -> None:
    process = controller.play(0.5, "--max-torque", "0.015")
    assert process.finish().stderr == "error: 0.0198 N m is above --max-torque 0.015\n"

    controller.ros.node("other").create_publisher(Float64MultiArray, "commands", 1)
    process = controller.play(0.5, "--max-torque", "1")
    controller.ros.spin_for(1.0)
    assert process.finish().stderr == "error: /commands has another publisher\n"
    assert controller.commands == []


def test_every_example_is_run() -> None:
    names = {path.stem for path in (ROOT / "examples").glob("*.py")}

    # test_readme.py runs the last.
    assert names == {*PRINTED, "play_motion", "replay_a_bag", "hidden_robot"}
