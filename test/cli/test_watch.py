# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs watch` of a real observer, in a pseudo-terminal and for programs."""

import fcntl
import json
import math
import os
import pty
import re
import signal
import struct
import subprocess
import termios
from collections.abc import Callable, Iterator
from io import StringIO
from typing import Any

import pytest

pytest.importorskip("rich")

from rclpy.parameter import Parameter
from rich.console import Console

from tsobs_ros.cli.picture import picture
from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.nodes import observer, plant_simulator
from tsobs_ros.nodes.watcher import Quantity, Snapshot

TIMEOUT = 60.0
# Colours, the cursor and modes; what follows [H is a picture.
ESCAPES = re.compile(r"\x1b\[[?\d;]*[A-GI-Za-z]")


class Terminal:
    """A pseudo-terminal with a command in it, read while the nodes of a test work."""

    def __init__(self, ros: Any, command: list[str], columns: int, rows: int) -> None:
        self._ros = ros
        self.printed = ""
        self._own, other = pty.openpty()
        self.resize(columns, rows)
        os.set_blocking(self._own, False)
        environment = {**ros.environment, "TERM": "xterm-256color"}
        for name in ("COLUMNS", "LINES", "NO_COLOR"):
            environment.pop(name, None)
        self.process = subprocess.Popen(
            command, stdin=other, stdout=other, stderr=other, env=environment,
            start_new_session=True,
        )  # fmt: skip
        os.close(other)

    def resize(self, columns: int, rows: int) -> None:
        size = struct.pack("HHHH", rows, columns, 0, 0)
        fcntl.ioctl(self._own, termios.TIOCSWINSZ, size)

    @property
    def pictures(self) -> list[str]:
        """The pictures that were drawn, without colours; the last may be a part of one."""
        return [ESCAPES.sub("", each) for each in self.printed.split("\x1b[H")[1:]]

    def wait_for(self, *patterns: str) -> str:
        """Wait until a picture from now on has them all, and return it."""
        before = len(self.pictures)
        found: list[str] = []

        def has_come() -> bool:
            self._read()
            whole = self.pictures[before:-1]
            found[:] = [p for p in whole if all(re.search(each, p) for each in patterns)]
            return bool(found)

        self._ros.spin_until(
            has_come, TIMEOUT, f"a picture with {patterns}: {self.printed[-2000:]}"
        )
        return found[-1]

    def finish(self) -> int:
        """Wait for the end and return the exit code."""

        def has_ended() -> bool:
            self._read()
            return self.process.poll() is not None

        self._ros.spin_until(has_ended, TIMEOUT, "the end")
        self._read()
        return int(self.process.returncode)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._own)

    def _read(self) -> None:
        try:
            while data := os.read(self._own, 65536):
                self.printed += data.decode(errors="replace")
        except (BlockingIOError, OSError):  # nothing more, or the other side was closed
            pass


@pytest.fixture
def arm(ros: Any) -> None:
    """An arm with a sensor that is wrong from the start, and its observer."""
    settings = {
        plant_simulator: {
            "rate": 200.0, "disturbance.kind": "bias_step", "disturbance.bias_step.amplitude": 0.3,
        },
        observer: {"rate": 50.0},
    }  # fmt: skip
    for module, values in settings.items():
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        ros.add(module.create(context=ros.context, parameter_overrides=overrides))


@pytest.fixture
def terminal(ros: Any) -> Iterator[Callable[..., Terminal]]:
    opened: list[Terminal] = []

    def start(command: list[str], columns: int, rows: int) -> Terminal:
        opened.append(Terminal(ros, command, columns, rows))
        return opened[-1]

    yield start
    for each in opened:
        each.close()


def test_a_terminal_shows_an_observer_until_it_is_interrupted(
    arm: None, terminal: Callable[..., Terminal], tsobs: list[str]
) -> None:
    shown = terminal([*tsobs, "watch"], 100, 30)

    shown.wait_for(r"elastic_joint +[+-]\d\.\d{4} .* WARN bias 0\.\d+ for \d")
    picture = shown.wait_for(r"^/observer  TRACKING", r"truth \d")

    lines = [line.rstrip() for line in picture.split("\r\n")]
    assert lines[0] == "/observer  TRACKING"
    assert re.fullmatch(r"messages a second: measurements \d.*, estimates \d.*", lines[1])
    assert "position [rad]" in picture
    row = r"{} +([+-]\d+\.\d{{4}}) (\d\.\d{{4}}) ([+-]\d\.\d{{4}}) .*"
    for name in ("elastic_joint_link", "elastic_joint_motor"):
        assert any(re.fullmatch(row.format(name), line) for line in lines), picture
    for concern in ("measurements", "timing", "certificate"):
        assert any(re.match(rf"(OK|WARN) +{concern} ", line) for line in lines), picture
    assert len(lines) <= 30

    shown.resize(60, 12)
    shown.process.send_signal(signal.SIGWINCH)
    small = shown.wait_for(r"^(?:[^\n]{0,61}\n){11}[^\n]{0,60}$")
    assert small.startswith("/observer  TRACKING")

    shown.process.send_signal(signal.SIGINT)
    assert shown.finish() == 0
    # The screen from before, with its cursor.
    assert "\x1b[?1049l" in shown.printed
    assert shown.printed.rindex("\x1b[?25h") > shown.printed.rindex("\x1b[?25l")
    assert "Traceback" not in shown.printed


def test_a_program_gets_one_snapshot(arm: None, ros: Any, ros_process: Any) -> None:
    process = ros_process("tsobs", arguments=["watch", "--json", "--timeout", "60"])
    ros.spin_until(lambda: process.output.rstrip().endswith("\n}"), TIMEOUT, "the snapshot")
    finished = process.finish()

    assert (finished.exit_code, finished.stderr) == (0, "")
    found = json.loads(finished.stdout)
    assert found["observer"] == "/observer"
    assert found["in_radians"]
    assert set(found["positions"]) == {"elastic_joint_link", "elastic_joint_motor"}
    link = found["positions"]["elastic_joint_link"]
    assert abs(link["value"] - link["truth"]) < 1.0
    assert found["statuses"]["measurements"]["values"]["rejected: gated"].isdigit()
    # The observer's rate, of a busy machine as of another: arrivals are counted as they came.
    assert 1.0 < found["rates"]["joint_states"] < 100.0


def test_an_observer_that_is_not_there_is_an_error(ros_process: Any) -> None:
    arguments = ["watch", "--once", "--timeout", "0.5", "--observer", "/left/observer"]
    finished = ros_process("tsobs", arguments=arguments).finish()

    assert finished.exit_code == 1
    assert finished.stderr.startswith("error: no observer /left/observer within 0.5 s; ")


def test_names_and_texts_are_shown_and_not_obeyed(
    hostile: str, check_shown: Callable[[str], None]
) -> None:
    """An entry a state, no velocity, no bound, a doubtful text: as a T-S system may have."""
    markup = "[red]x[/red]"
    unknown = Quantity(math.nan)
    snapshot = Snapshot(
        observer=hostile, age=7.2, in_radians=False,
        positions={hostile: Quantity(1e9), markup: Quantity(0.5, 0.01, 0.1)}, velocities={},
        disturbances={hostile: unknown}, disturbance_rates={}, innovations={hostile: math.inf},
        torques={hostile: Quantity(1.0, 2.0, 3.0)}, parameters={hostile: unknown},
        health={f"{hostile}/noise_scale": 1.0}, problem=hostile, rates={hostile: 1.0},
        statuses={
            "state": Status("state", Level.STALE, hostile, {}),
            "sensor fault": Status("sensor fault", Level.ERROR, hostile, {"magnitude": hostile}),
            hostile: Status(hostile, Level.WARN, hostile, {hostile: hostile}),
        },
    )  # fmt: skip
    console = Console(file=StringIO(), width=200)
    console.print(picture(snapshot))
    text = console.file.getvalue()

    check_shown(text)
    assert "no estimate for 7 s" in text
    assert re.search(r"^\[red\]x\[/red\] +\+0\.5000 0\.0100 \+0\.4000!", text, re.MULTILINE)
    assert "+1.000e+09" in text
    assert "ERROR" in text
