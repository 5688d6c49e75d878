# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Processes end with the promised exit code: by signals at any time, without streams."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tsobs_ros.stop import PARENT

COMMAND = [sys.executable, "-m", "tsobs_ros.executables"]
# Prints as soon as its handlers are in place and when it is half-way through.
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


def ended(command: list[str], **options: Any) -> tuple[int, str, str]:
    """Run a command; return its exit code and what it has printed."""
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    done = subprocess.run(command, text=True, check=False, **streams)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("imports", [1, 2])
def test_two_signals_during_imports_end_a_command_with_code_1(imports: int, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", WITH_IMPORTS_SHOWN.format(output=str(tmp_path / "demo"))],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    for _ in range(imports):
        assert process.stdout.readline()
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, "Traceback" in err) == (1, False), err


@pytest.mark.parametrize("name", ["tsobs", "observer"])
def test_streams_that_are_full_or_closed_are_errors(name: str) -> None:
    with Path("/dev/full").open("w") as full:
        code, _, err = ended([*COMMAND, name, "--help"], stdout=full)
    assert (code, err) == (1, "error: [Errno 28] No space left on device\n")
    arguments = "verify nowhere.yaml" if name == "tsobs" else "--ros-args -p design:=nowhere.yaml"
    # Without a stderr, errors do not come to stdout.
    assert ended(["sh", "-c", f"exec {' '.join(COMMAND)} {name} {arguments} 2>&-"])[:2] == (1, "")


@pytest.mark.parametrize(
    ("name", "reason"), [(b"self", "a loop of links"), (b"a\xff", "expected a name in UTF-8")]
)
def test_an_output_that_nothing_can_name_is_refused(
    name: bytes, reason: str, tmp_path: Path
) -> None:
    (tmp_path / "self").symlink_to("self")
    arguments = ["tsobs", "design", "--output", os.fsdecode(name)]
    shown = os.fsdecode(name).encode("unicode_escape").decode()
    expected = (1, "", f"error: {shown}: {reason}\n")
    assert ended([*COMMAND, *arguments], cwd=tmp_path) == expected
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
    state = Path(f"/proc/{node}/stat")
    wait_for(lambda: not state.exists() or state.read_text().split()[2] == "Z", "the node's end")
