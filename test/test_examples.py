# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The example scripts run as a user runs them, and come to the results they print."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
LOG = str(ROOT / "docs" / "examples" / "arm_log.csv")
NUMBER = r"([+-]?\d+\.\d+)"
PRINTED = {
    "simulate_and_observe": (rf"estimated at {NUMBER} rad(?s:.*)4001 measurements used", [0.1]),
    "own_arm": (r"(?s:.*: holds){5}", []),
    "own_executor": (r"[1-9]\d\d estimates received", []),
    "ts_system": (rf"gyroscope: {NUMBER} rad/s", [0.15]),
    "motor_encoder": (r"(?s:.*: holds){5}(?s:.*)\d N m is estimated to 0\.\d+ N m", []),
    "contact_torque": (rf": noticed after {NUMBER} s, .* at 14 s, true", [0.05]),
    "ts_node": (rf"gyroscope {NUMBER}", [0.15]),
}
"""What the examples print, and what its numbers are within 0.05."""


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
    found = re.search(pattern, run(f"{name}.py", folder=tmp_path, domain_id=domain_id))

    assert found is not None
    assert [float(each) for each in found.groups()] == pytest.approx(numbers, abs=0.05)
    for figure in tmp_path.glob("*.png"):
        assert figure.read_bytes().startswith(b"\x89PNG")


def test_a_log_becomes_a_bag_that_is_replayed(tmp_path: Path, domain_id: int) -> None:
    first = run("replay_a_bag.py", LOG, "new", folder=tmp_path, domain_id=domain_id)
    again = run("replay_a_bag.py", "new", folder=tmp_path, domain_id=domain_id)

    assert "elastic_joint: 600 estimates over 3.0 s" in first
    assert "600 messages on /observer/joint_states" in first
    assert "100.0% of the live estimates reproduced to the last bit" in again


def test_every_example_is_run() -> None:
    names = {path.stem for path in (ROOT / "examples").glob("*.py")}

    assert names == {*PRINTED, "replay_a_bag", "hidden_robot"}  # test_readme.py runs the last
