# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Processes end with the promised exit code: by signals at any time, without streams."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

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


@pytest.mark.parametrize("imported", ["numpy", "tsobs_ros.report"])
def test_two_signals_during_imports_end_a_command_with_code_1(
    ros_process: Any, imported: str, tmp_path: Path
) -> None:
    code = WITH_IMPORTS_SHOWN.format(output=str(tmp_path / "demo"))
    process = ros_process([sys.executable, "-c", code])
    process.wait_for_line(rf"^{imported}$")
    process.signal(signal.SIGINT)
    process.signal(signal.SIGTERM)
    finished = process.finish()
    assert (finished.exit_code, "Traceback" in finished.stderr) == (1, False), finished.stderr


@pytest.mark.parametrize("name", ["tsobs", "observer"])
def test_streams_that_are_full_or_closed_are_errors_and_others_take_any_text(name: str) -> None:
    if name == "tsobs":
        with Path("/dev/full").open("w") as full:
            code, _, err = ended([*COMMAND, name, "verify"], stdout=full)
        assert (code, err) == (1, "error: [Errno 28] No space left on device\n")
        reader, writer = os.pipe()
        os.close(reader)
        code, _, err = ended([*COMMAND, name, "verify", "--json"], stdout=writer)
        os.close(writer)
        assert (code, "Traceback" in err) == (1, False)
        ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii"}
        code, out, err = ended([*COMMAND, name, "estimate", "--help"], env=ascii_only)
        assert (code, err, r"\u2026/joint_measurements" in out) == (0, "", True)
    arguments = "verify nowhere.yaml" if name == "tsobs" else "--ros-args -p design:=nowhere.yaml"
    # Without a stderr, errors do not come to stdout.
    assert ended(["sh", "-c", f"exec {' '.join(COMMAND)} {name} {arguments} 2>&-"])[:2] == (1, "")


@pytest.mark.parametrize(
    ("call", "library", "advice"),
    [
        ("run('recorder')", "mcap", "pyyaml>=6.0"),
        ("run('recorder')", "rclpy", "source ROS 2 Jazzy, or "),
        ("tsobs()", "numpy", "'numpy>=1.26' 'pyyaml>=6.0'"),
    ],
)
def test_a_process_without_a_library_ends_with_the_command_that_installs_it(
    call: str, library: str, advice: str
) -> None:
    code = f"import sys; sys.modules[{library!r}] = None\n"
    code += f"from tsobs_ros import executables; sys.exit(executables.{call})"
    exit_code, out, error = ended([sys.executable, "-c", code])
    assert (exit_code, out) == (1, "")
    assert error.startswith(f"error: {library} is not installed: ")
    assert advice in error
    assert len(error.splitlines()) == 1


def test_a_name_that_no_bag_can_have_is_refused(tmp_path: Path) -> None:
    name = os.fsdecode(b"a\xff.csv")
    (tmp_path / name).write_text("t,q,tau\n1,0,0\n2,0,0\n")
    code, _, error = ended([*COMMAND, "tsobs", "estimate", name], cwd=tmp_path)
    assert (code, error.startswith("error: expected names in UTF-8: ")) == (1, True), error
    assert [each.name for each in tmp_path.iterdir()] == [name]
