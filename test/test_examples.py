# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The example scripts run as a user runs them, and come to the results they print."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tsobs_ros.bag import BagReader

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def run(name: str, *arguments: object, folder: Path, **environment: str) -> str:
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    done = subprocess.run(
        [sys.executable, "-W", "error::RuntimeWarning", ROOT / "examples" / name, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path, **environment},
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_simulate_and_observe(tmp_path: Path) -> None:
    out = run("simulate_and_observe.py", folder=tmp_path)

    assert float(re.search(r"estimated at (\S+) rad", out)[1]) == pytest.approx(0.1, abs=0.02)
    rows = re.findall(r"^(?:link|motor).* (\d\.\d+) +(\d\.\d+)$", out, re.MULTILINE)
    assert len(rows) == 4
    assert all(float(rmse) < 2.0 * float(bound) for rmse, bound in rows)
    assert "4001 measurements used, rejected: none" in out


def test_own_arm(tmp_path: Path) -> None:
    pytest.importorskip("cvxpy")
    pytest.importorskip("matplotlib")

    out = run("own_arm.py", folder=tmp_path)

    assert out.count(": holds") == 5
    assert (tmp_path / "my_arm.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "my_arm.design.yaml").is_file()


def test_replay_a_bag(tmp_path: Path) -> None:
    log = ROOT / "docs" / "examples" / "arm_log.csv"

    first = run("replay_a_bag.py", log, "new", folder=tmp_path)
    again = run("replay_a_bag.py", "new", folder=tmp_path)

    assert "elastic_joint: 600 estimates over 3.0 s" in first
    assert "600 messages on /observer/joint_states" in first
    assert "100.0% of the live estimates reproduced to the last bit" in again
    assert BagReader(tmp_path / "new").topics["/joint_measurements"].count == 600


def test_own_executor(tmp_path: Path, domain_id: int) -> None:
    pytest.importorskip("rclpy")

    out = run("own_executor.py", folder=tmp_path, ROS_DOMAIN_ID=str(domain_id))

    assert int(re.search(r"(\d+) estimates received", out)[1]) > 100


def test_ts_system(tmp_path: Path) -> None:
    pytest.importorskip("cvxpy")

    out = run("ts_system.py", folder=tmp_path)

    assert float(re.search(r"gyroscope: (\S+) rad/s", out)[1]) == pytest.approx(0.15, abs=0.01)
    for rmse, sensor in re.findall(r"RMSE (\S+) rad.*alone (\S+) rad", out):
        assert float(rmse) < 0.5 * float(sensor)


def test_motor_encoder(tmp_path: Path) -> None:
    pytest.importorskip("cvxpy")

    out = run("motor_encoder.py", folder=tmp_path)

    assert out.count(": holds") == 5
    rows = re.findall(r"^(?:link|motor) \w+ +(\d\.\d+) +(\d\.\d+) +(\d\.\d+)$", out, re.MULTILINE)
    assert len(rows) == 4
    assert all(float(rmse) < float(bound) for rmse, bound, _ in rows)
    assert all(float(inside) >= 0.97 for *_, inside in rows)
    assert float(re.search(r"would be (\S+) rad off", out)[1]) > 10.0 * float(rows[0][0])
    size, rmse = re.search(r"friction of (\S+) N m is estimated to (\S+) N m", out).groups()
    assert float(rmse) < 0.5 * float(size)


def test_contact_torque(tmp_path: Path) -> None:
    pytest.importorskip("cvxpy")
    pytest.importorskip("matplotlib")

    out = run("contact_torque.py", folder=tmp_path)

    found = re.findall(
        r": noticed after (\S+) s, (\S+) at 14 s, true (\S+)\n.* (\d\.\d+)$", out, re.M
    )
    contact, bias = [[float(number) for number in each] for each in found]
    for after, guess, true, inside in (contact, bias):
        assert 0.0 < after <= 0.1
        assert guess == pytest.approx(true, rel=0.35)
        assert inside >= 0.97
    assert (tmp_path / "contact_torque.png").read_bytes().startswith(b"\x89PNG")


def test_ts_node(tmp_path: Path, domain_id: int) -> None:
    pytest.importorskip("rclpy")
    pytest.importorskip("cvxpy")

    out = run("ts_node.py", folder=tmp_path, ROS_DOMAIN_ID=str(domain_id))

    angle, truth = (re.search(rf"{topic}/joint_states: angle (\S+), rate", out)[1]
                    for topic in ("observer", "ground_truth"))  # fmt: skip
    assert float(angle) == pytest.approx(float(truth), abs=0.05)
    assert float(re.search(r"gyroscope (\S+)", out)[1]) == pytest.approx(0.15, abs=0.05)
