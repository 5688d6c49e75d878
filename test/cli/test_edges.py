# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Edges of the command line: JSON that is JSON, folders that exist, signals to the demo."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import yaml

from tsobs_ros.cli.main import main
from tsobs_ros.resources import config_path


def strict(text):
    def refuse(c):
        raise ValueError(f"{c} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_verify_json_of_a_matrix_that_proves_nothing_is_json(tmp_path, capsys):
    data = yaml.safe_load(config_path("elastic_joint.design.yaml").read_text())
    data["certificate"]["P"][2][2] *= -1.0
    path = tmp_path / "t.yaml"
    path.write_text(yaml.safe_dump(data))
    assert main(["verify", "--json", str(path)]) == 1
    assert strict(capsys.readouterr().out)["holds"] is False


def test_demo_refuses_an_existing_folder(tmp_path, capsys):
    output = tmp_path / "demo"
    output.mkdir()
    (output / "report.png").write_text("precious")
    code = main(["demo", "--duration", "0.5", "--output", str(output)])
    assert (output / "report.png").read_text() == "precious"
    assert code == 1
    assert "exists already" in capsys.readouterr().err


def nodes(output):
    found = []
    for p in Path("/proc").glob("[0-9]*"):
        try:
            if f"ROS_LOG_DIR={output / 'log'}".encode() in (p / "environ").read_bytes():
                found.append(int(p.name))
        except OSError:
            pass
    return found


def test_sigterm_to_the_demo_leaves_no_nodes_behind(tmp_path):
    output = tmp_path / "demo"
    p = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "tsobs_ros.cli.main",
            "demo",
            "--duration",
            "60",
            "--output",
            str(output),
        ],
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    log, deadline = output / "log" / "plant_simulator.log", time.monotonic() + 60
    while not (log.exists() and "started" in log.read_text()):
        assert p.poll() is None
        assert time.monotonic() < deadline, "the plant did not start"
        time.sleep(0.05)
    p.send_signal(signal.SIGTERM)
    code = p.wait(60)
    left = nodes(output)
    for pid in left:
        os.kill(pid, signal.SIGINT)
    assert left == []
    assert code == 1


def test_a_ts_model_is_designed_and_verified(tmp_path, capsys):
    output = tmp_path / "ts.yaml"
    request = str(config_path("ts_example.request.yaml"))
    assert main(["design", request, "--output", str(output)]) == 0
    assert main(["verify", "--json", str(output)]) == 0
    assert main(["verify", "--exact", str(output)]) == 1
    assert "T-S models" in capsys.readouterr().err


def test_the_papers_procedure_designs_where_it_can(tmp_path, capsys):
    output = tmp_path / "paper.yaml"
    assert main(["design", "--method", "paper", "--example", "2", "--output", str(output)]) == 0
    assert "DOES NOT" not in capsys.readouterr().out
    assert main(["design", "--method", "paper", "--example", "3", "--output", "unused.yaml"]) == 1
    assert "eigenvalue 0+4.776j" in capsys.readouterr().err


def test_the_shipped_design_is_proved_in_exact_arithmetic(capsys):
    assert main(["verify", "--exact"]) == 0
    assert "proved in exact arithmetic" in capsys.readouterr().out
