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


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_has_its_test(path: Path) -> None:
    assert len(path.read_text("utf-8").splitlines()) <= 60
    assert f'run("{path.name}"' in Path(__file__).read_text("utf-8"), f"{path.name} is not run"


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
