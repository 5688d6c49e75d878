# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Processes end cleanly whatever ends them; each case is a real process with a small node."""

import signal
import sys
from pathlib import Path
from textwrap import dedent

import pytest

ROOT = Path(__file__).resolve().parents[2]

PREAMBLE = f"""
import ctypes, os, signal, sys
sys.path.insert(0, {str(ROOT)!r})
from rclpy.node import Node
from tsobs_ros.errors import NodeError
from tsobs_ros.nodes import runtime
from tsobs_ros.nodes.managed import ManagedParameters as Parameters

class Worker(Node):
    def __init__(self, name="worker"):
        super().__init__(name)
        self.ticks = 0
        self.create_timer(0.02, self.tick)

    def tick(self):
        self.ticks += 1
        if self.ticks == 1:
            print("ticking", flush=True)

    def close(self):
        print(f"closed {{self.get_name()}}", flush=True)

    def destroy_node(self):
        print(f"destroyed {{self.get_name()}}", flush=True)
        super().destroy_node()
"""


@pytest.fixture
def script(ros_process, tmp_path):
    """Start a Python script made of the preamble and the given body."""

    def start(body: str, *arguments: str):
        path = tmp_path / "script.py"
        path.write_text(PREAMBLE + dedent(body))
        return ros_process([sys.executable, str(path), *arguments])

    return start


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_an_idle_process_and_a_second_changes_nothing(script, number: int) -> None:
    process = script(
        """
        class Slow(Worker):
            def close(self):
                os.kill(os.getpid(), signal.SIGINT)
                os.kill(os.getpid(), signal.SIGTERM)
                super().close()

        sys.exit(runtime.run(Slow))
        """
    )
    process.wait_for_line("ticking")
    process.signal(number)
    assert process.finish() == (0, "ticking\nclosed worker\ndestroyed worker\n", "")


CLOSED, DESTROYED = "closed worker\n", "destroyed worker\n"
ENDS = {
    "a finished node": (
        """
        class Case(Worker):
            @property
            def finished(self):
                return self.ticks >= 3
        """,
        (0, "ticking\n" + CLOSED + DESTROYED, ""),
    ),
    "a shutdown of the context": (
        """
        import rclpy
        class Case(Worker):
            def tick(self):
                rclpy.shutdown()
        """,
        (0, CLOSED + DESTROYED, ""),
    ),
    "a known error at the start": (
        """
        def Case():
            raise NodeError("no design:\\n  elastic_joint.yaml is missing")
        """,
        (1, "", "error: no design: elastic_joint.yaml is missing\n"),
    ),
    "a known error in a close": (
        """
        class Case(Worker):
            finished = True
            def close(self):
                raise NodeError("the bag cannot be closed")
        """,
        (1, DESTROYED, "error: the bag cannot be closed\n"),
    ),
}


@pytest.mark.parametrize("end", ENDS)
def test_every_end_closes_destroys_and_is_reported_in_a_line(script, end: str) -> None:
    body, expected = ENDS[end]

    assert script(dedent(body) + "sys.exit(runtime.run(Case))").finish() == expected


@pytest.mark.parametrize("where", ["tick", "close"])
def test_a_bug_keeps_its_traceback_and_costs_no_other_step(script, where: str) -> None:
    process = script(
        f"""
        class Buggy(Worker):
            finished = {where != "tick"}

            def {where}(self):
                getattr(super(), "{where}")()
                raise KeyError("bug")

        sys.exit(runtime.run(lambda: [Buggy("first"), Buggy("second")]))
        """
    )

    finished = process.finish()

    assert finished.exit_code == 1
    assert finished.stdout.splitlines()[-4:] == [
        "closed first",
        "closed second",
        "destroyed first",
        "destroyed second",
    ]
    assert finished.stderr.count("KeyError: 'bug'") == (1 if where == "tick" else 2)


def test_a_hanging_teardown_is_ended_by_a_signal(script) -> None:
    process = script(
        """
        class Hanging(Worker):
            finished = True

            def destroy_node(self):
                ctypes.PyDLL(None).pause()  # for ever, in C, holding the GIL

        runtime._TEARDOWN_TIMEOUT = 0.5
        sys.exit(runtime.run(Hanging))
        """
    )

    finished = process.finish()

    assert finished.exit_code == -signal.SIGALRM
    assert finished.stdout == "closed worker\n"
    assert "Traceback" not in finished.stderr


def test_a_signal_during_the_imports_ends_the_process_at_once(ros_process, tmp_path: Path) -> None:
    source = "os.kill(os.getpid(), signal.SIGTERM)\nprint('still importing')\ncreate = Worker\n"
    (tmp_path / "some_node.py").write_text(PREAMBLE + source)
    program = f"""if True:
        import sys; sys.path.insert(0, {str(ROOT)!r})
        import tsobs_ros.nodes; tsobs_ros.nodes.__path__.append({str(tmp_path)!r})
        from tsobs_ros.executables import run; sys.exit(run('some_node'))
    """
    assert ros_process([sys.executable, "-c", program]).finish() == (0, "", "")
