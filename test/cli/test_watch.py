# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs watch` of a real observer, in a pseudo-terminal and for programs."""

import json
import os
import pty
import re
import signal
import subprocess
from collections.abc import Callable
from contextlib import suppress
from io import StringIO
from typing import Any

import pytest

pytest.importorskip("rich")

from rich.console import Console
from staging import start

from tsobs_ros.cli.main import main
from tsobs_ros.cli.picture import picture
from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.nodes.watcher import View

TIMEOUT = 180.0
# Colours, the cursor and modes; what follows [H is a picture.
ESCAPES = re.compile(r"\x1b\[[?\d;]*[A-GI-Za-z]")


@pytest.fixture
def arm(ros: Any) -> None:
    """An arm with a sensor that is wrong from the start, and its observer."""
    fault = {"disturbance__kind": "bias_step", "disturbance__bias_step__amplitude": 0.3}
    start(ros, "plant_simulator", rate=200.0, **fault)
    start(ros, "observer", rate=50.0)


def test_a_terminal_shows_an_observer_until_it_is_interrupted(
    arm: None, ros: Any, executables: list[str]
) -> None:
    own, other = pty.openpty()
    os.set_blocking(own, False)
    size = {"COLUMNS": "100", "LINES": "40", "TERM": "xterm-256color"}
    process = subprocess.Popen(
        [*executables, "tsobs", "watch"], stdin=other, stdout=other, stderr=other,
        start_new_session=True, env={**ros.environment, **size},
    )  # fmt: skip
    os.close(other)
    printed = ""

    def shown() -> list[str]:
        """Return the lines of the newest whole picture of a fault while all else is well."""
        nonlocal printed
        with suppress(OSError):  # nothing more, or the other side was closed
            while data := os.read(own, 65536):
                printed += data.decode(errors="replace")
        pictures = [ESCAPES.sub("", each) for each in printed.split("\x1b[H")[1:-1]]
        fault = r"WARN +sensor fault +bias; magnitude \[rad\] 0\.\d+; for \d"
        wanted = "TRACKING", r"OK +certificate ", fault
        found = [each for each in pictures if all(re.search(one, each) for one in wanted)]
        return [line.rstrip() for line in found[-1].split("\r\n")] if found else []

    try:
        ros.spin_until(lambda: bool(shown()), TIMEOUT, "a picture with the fault")
        lines = shown()
        process.send_signal(signal.SIGINT)
        ros.spin_until(lambda: process.poll() is not None, TIMEOUT, "the end")
        shown()
    finally:
        process.kill()
        process.wait()
        os.close(own)
    assert lines[0] == "/observer  TRACKING"
    number, bound = r"[+-]\d+\.\d{4}", r"\d\.\d{4}"
    row = rf"elastic_joint_(link|motor)( +{number} +{bound} +{number}!?){{2}}"
    assert sum(bool(re.fullmatch(row, line)) for line in lines) == 2, lines
    assert any(re.match(r"OK +certificate ", line) for line in lines), lines
    assert (process.returncode, "Traceback" in printed) == (0, False)
    # The screen from before, with its cursor.
    assert "\x1b[?1049l" in printed
    assert printed.rindex("\x1b[?25h") > printed.rindex("\x1b[?25l")


def test_a_program_gets_one_view(arm: None, ros: Any, ros_process: Any) -> None:
    process = ros_process("tsobs", arguments=["watch", "--json", "--timeout", "60"])
    ros.spin_until(lambda: process.output.rstrip().endswith("\n}"), TIMEOUT, "the view")
    finished = process.finish()

    assert (finished.exit_code, finished.stderr) == (0, "")
    found = json.loads(finished.stdout)
    assert found["observer"] == "/observer"
    estimates = found["tables"]["estimate"]
    assert set(estimates) == {"elastic_joint_link", "elastic_joint_motor"}
    angle = estimates["elastic_joint_link"]["position"]
    assert abs(angle["value"] - angle["truth"]) < 1.0
    assert found["statuses"]["measurements"]["values"]["rejected: gated"].isdigit()


def test_an_observer_that_is_not_there_is_an_error(
    domain_id: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id))
    assert main(["watch", "--once", "--timeout", "0.5", "--observer", "/left/observer"]) == 1

    err = capsys.readouterr().err
    assert err.startswith("error: no observer /left/observer within 0.5 s; ")


def test_names_and_texts_are_shown_and_not_obeyed(
    hostile: str, check_shown: Callable[[str], None]
) -> None:
    """An entry a state, no velocity, no bound, a doubtful text: as a T-S system may have."""
    rows = {
        hostile: {"position": {"value": 1e9}},
        "[red]x[/red]": {"position": {"value": 0.5, "bound": 0.01, "truth": 0.1}},
    }
    statuses = {
        "state": Status("state", Level.STALE, hostile, {}),
        "sensor fault": Status("sensor fault", Level.ERROR, hostile, {"magnitude": hostile}),
        hostile: Status(hostile, Level.WARN, hostile, {hostile: hostile}),
    }
    console = Console(file=StringIO(), width=200)
    console.print(picture(View(hostile, 7.2, {"estimate": rows}, statuses)))
    text = console.file.getvalue()

    check_shown(text)
    assert "no estimate for 7 s" in text
    assert re.search(r"^\[red\]x\[/red\] +\+0\.5000 +0\.0100 +\+0\.4000!", text, re.MULTILINE)
    assert "+1.000e+09" in text
    assert "ERROR" in text
