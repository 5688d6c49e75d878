# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Processes end with the promised exit code: by signals at any time, without streams."""

import os
import random
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tsobs_ros.stop import PARENT

COMMAND = [sys.executable, "-m", "tsobs_ros.executables"]
# Prints, line by line, as soon as its handlers are in place and when it is half-way through.
WITH_IMPORTS_SHOWN = """
import sys, tsobs_ros.stop
from tsobs_ros import executables
class Shown:
    def find_spec(self, name, path=None, target=None):
        if name in ("tsobs_ros.cli.main", "tsobs_ros.report", "numpy"):
            print(name, flush=True)
sys.meta_path.insert(0, Shown())
sys.argv = ["tsobs", "demo", "--output", {output!r}]
sys.exit(executables.tsobs())
"""


@pytest.mark.parametrize("seed", range(2))
def test_signals_during_imports_end_a_command_with_code_1(seed: int, tmp_path: Path) -> None:
    """The first comes during an import, the second within 50 ms."""
    chance = random.Random(seed)
    process = subprocess.Popen(
        [sys.executable, "-c", WITH_IMPORTS_SHOWN.format(output=str(tmp_path / "demo"))],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    for _ in range(1 + seed % 2):
        assert process.stdout.readline()
    process.send_signal(chance.choice([signal.SIGINT, signal.SIGTERM]))
    select.select([], [], [], chance.uniform(0.0, 0.05))  # the gap is what is tested
    process.send_signal(chance.choice([signal.SIGINT, signal.SIGTERM]))
    _, err = process.communicate(timeout=60)
    assert (process.returncode, "Traceback" in err) == (1, False), err


@pytest.mark.parametrize("name", ["tsobs", "observer"])
def test_help_that_cannot_be_printed_is_an_error(name: str) -> None:
    command = [*COMMAND, name, "--help"]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "error: [Errno 28] No space left on device\n")


@pytest.mark.parametrize("name", ["tsobs", "observer"])
def test_without_stderr_errors_do_not_come_to_stdout(name: str) -> None:
    arguments = "verify nowhere.yaml" if name == "tsobs" else "--ros-args -p design:=nowhere.yaml"
    command = f"exec {' '.join(COMMAND)} {name} {arguments} 2>&-"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")


@pytest.mark.parametrize(
    "command",
    ["estimate {log} --output {output}", "design --output {output}"],
)
@pytest.mark.parametrize(
    ("name", "reason"), [(b"self", "a loop of links"), (b"a\xff", "expected a name in UTF-8")]
)
def test_an_output_that_nothing_can_name_is_refused(
    command: str, name: bytes, reason: str, tmp_path: Path
) -> None:
    (tmp_path / "self").symlink_to("self")
    log = Path(__file__).parents[1] / "docs" / "examples" / "arm_log.csv"
    arguments = command.format(log=log, output=os.fsdecode(name)).split()
    done = subprocess.run(
        [*COMMAND, "tsobs", *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    shown = os.fsdecode(name).encode("unicode_escape").decode()
    assert (done.returncode, done.stderr) == (1, f"error: {shown}: {reason}\n")
    assert [each.name for each in tmp_path.iterdir()] == ["self"]


def test_a_node_does_not_outlive_the_process_that_needs_it(ros: Any, tmp_path: Path) -> None:
    log = tmp_path / "log"
    code = (
        "import os, subprocess\n"
        "reading, held = os.pipe()\n"
        f"node = subprocess.Popen({[*COMMAND, 'observer']!r}, stdout=open({str(log)!r}, 'w'),\n"
        f"    stderr=subprocess.STDOUT, env={{**os.environ, {PARENT!r}: str(reading)}},\n"
        "    pass_fds=[reading], start_new_session=True)\n"
        "print(node.pid, flush=True)\n"
        "node.wait()\n"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code], env=ros.environment, stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    node = int(parent.stdout.readline())
    deadline = time.monotonic() + 60.0

    def wait_for(done: Any, what: str) -> None:
        while not done():
            assert time.monotonic() < deadline, f"{what}: {log.read_text()}"
            ros.spin_for(0.05)

    wait_for(lambda: "WAITING" in log.read_text(), "the node's start")
    parent.kill()
    parent.communicate()
    ended = Path(f"/proc/{node}/stat")
    wait_for(lambda: not ended.exists() or ended.read_text().split()[2] == "Z", "the node's end")
