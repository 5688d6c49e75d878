# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Processes end cleanly whatever ends them, at any time, and their shipped parameters fit."""

import re
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest
import yaml
from staging import diagnostics, values

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.estimate_topics import TOPICS as OF_EVERY_OBSERVER
from tsobs_ros.resources import FIXED_DESIGN, config_path

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


CLOSED, DESTROYED = "closed worker\n", "destroyed worker\n"
BOTH = "closed first\nclosed second\ndestroyed first\ndestroyed second\n"
BUGGY = """
class Buggy(Worker):
    finished = {finished}
    def {where}(self):
        super().{where}()
        raise KeyError("bug")

Case = lambda: [Buggy("first"), Buggy("second")]
"""
SIGNALLED = """
class Case(Worker):
    def close(self):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        super().close()
"""
ENDS: dict[str, tuple[str, tuple[int, str, str]]] = {
    # A second signal changes nothing.
    "SIGINT": (SIGNALLED, (0, "ticking\n" + CLOSED + DESTROYED, "")),
    "SIGHUP": (SIGNALLED, (0, "ticking\n" + CLOSED + DESTROYED, "")),
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
    # Each bug has its traceback, and costs no other step.
    "a bug": (BUGGY.format(where="tick", finished=False), (1, "ticking\n" + BOTH, "bug")),
    "bugs at the end": (BUGGY.format(where="close", finished=True), (1, BOTH, "bug bug")),
    "a teardown that hangs": (
        """
        class Case(Worker):
            finished = True
            def destroy_node(self):
                ctypes.PyDLL(None).pause()  # for ever, in C, holding the GIL

        runtime._TEARDOWN_TIMEOUT = 0.5
        """,
        (-signal.SIGALRM, CLOSED, ""),
    ),
}


@pytest.mark.parametrize("end", ENDS)
def test_every_end_closes_destroys_and_is_reported_in_a_line(script, end: str) -> None:
    body, (exit_code, out, err) = ENDS[end]
    process = script(dedent(body) + "sys.exit(runtime.run(Case))")
    if end.startswith("SIG"):
        process.wait_for_line("ticking")
        process.signal(signal.Signals[end])
    finished = process.finish()

    assert (finished.exit_code, finished.stdout) == (exit_code, out)
    if "bug" in end:
        assert " ".join(re.findall(r"^KeyError: '(bug)'$", finished.stderr, re.MULTILINE)) == err
    else:
        assert finished.stderr == err


def test_a_signal_during_the_imports_ends_the_process_at_once(ros_process, tmp_path: Path) -> None:
    source = "os.kill(os.getpid(), signal.SIGTERM)\nprint('still importing')\ncreate = Worker\n"
    (tmp_path / "some_node.py").write_text(PREAMBLE + source)
    program = f"""if True:
        import sys; sys.path.insert(0, {str(ROOT)!r})
        import tsobs_ros.nodes; tsobs_ros.nodes.__path__.append({str(tmp_path)!r})
        from tsobs_ros.executables import run; sys.exit(run('some_node'))
    """
    assert ros_process([sys.executable, "-c", program]).finish() == (0, "", "")


TIMEOUT = 60.0
MEASUREMENTS, _ = TOPICS = ["joint_measurements", "observer/joint_states"]
Process = Callable[..., Any]


def errors(text: str) -> list[str]:
    lines = [line for line in text.splitlines() if " STALE: " not in line]
    return [line for line in lines if line.startswith(("error", "[ERROR]", "[FATAL]"))]


def check_clean(finished: Any) -> None:
    assert finished.exit_code == 0, finished.stderr
    assert "Traceback" not in finished.stderr + finished.stdout
    assert errors(finished.stderr) == []


def end(signals: dict[Any, int]) -> None:
    for process, number in signals.items():
        process.signal(number)
    for process in signals:
        check_clean(process.finish(TIMEOUT))


def test_the_shipped_parameters_fit_together_and_the_recorder_awaits_nothing_for_ever(
    ros: Any, ros_process: Process, tmp_path: Path
) -> None:
    bag, statuses = tmp_path / "bag", diagnostics(ros)
    parameters = {"recorder": {"output": str(bag)}}
    processes = {
        name: ros_process(
            name, params_file=config_path(f"{name}.yaml"), parameters=parameters.get(name)
        )
        for name in ("recorder", "observer", "plant_simulator")
    }

    def records_all() -> bool:
        if not statuses.keys() >= {"recorder: recording", "recorder: topics"}:
            return False
        counts = values(statuses["recorder: topics"])
        there = all(int(counts.get(f"/{each}", "0").split()[0]) >= 20 for each in TOPICS)
        return there and statuses["recorder: recording"].message == "recording"

    ros.spin_until(records_all, TIMEOUT, "20 messages of each topic")
    player = ros_process(
        "player", params_file=config_path("player.yaml"), parameters={"bag": str(bag)}
    )
    assert f"error: {bag}/bag_0.mcap: the file has no end" in player.finish(TIMEOUT).stderr
    end(dict.fromkeys(processes.values(), signal.SIGTERM))

    # A busy machine may make the others warn of late samples or a slow plant.
    assert "[WARN]" not in processes["recorder"].output
    for process in processes.values():
        assert "ignored unknown parameters" not in process.output
    recorded = BagReader(bag).topics
    assert {f"/observer/{name}" for name in OF_EVERY_OBSERVER} <= recorded.keys()
    assert {"/diagnostics", "/ground_truth/joint_states", f"/{MEASUREMENTS}"} <= recorded.keys()


def test_a_lifecycle_manager_drives_a_process_and_its_shutdown_ends_it(
    ros_process: Process, manage: Callable[[Any], Any]
) -> None:
    process = ros_process("observer", parameters={"autostart": False})
    manager = manage("/observer")
    assert manager.state == "unconfigured"
    assert manager.change("configure", "activate", "deactivate", "activate")
    assert manager.state == "active"
    assert manager.change("shutdown")
    check_clean(process.finish(TIMEOUT))


# What a process has mapped shows how far its start-up is: imports, or the middleware's start.
@pytest.mark.parametrize(
    ("name", "library", "number"),
    [
        ("observer", "_rclpy_pybind11", signal.SIGINT),
        ("recorder", "libfastrtps", signal.SIGINT),
        ("player", "_rclpy_pybind11", signal.SIGTERM),
    ],
)
def test_a_signal_during_the_start_ends_cleanly(
    ros_process: Process, tmp_path: Path, small_bag: Path, name: str, library: str, number: int
) -> None:
    bag = tmp_path / "bag"
    parameters: dict[str, dict[str, Any]] = {
        "player": {"bag": str(small_bag), "loop": True},
        "recorder": {"output": str(bag), "topics": TOPICS},
    }
    process = ros_process(name, parameters=parameters.get(name, {}))
    maps = Path("/proc", str(process.pid), "maps")
    deadline = time.monotonic() + TIMEOUT
    while library not in maps.read_text():
        assert time.monotonic() < deadline, f"{library} has not been loaded"
    process.signal(number)
    check_clean(process.finish(TIMEOUT))
    if bag.exists():
        assert BagReader(bag).message_count == 0


def tampered(path: Path) -> Path:
    data = yaml.safe_load(config_path(FIXED_DESIGN).read_text(encoding="utf-8"))
    data["gain"]["K"][0] *= 20.0
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


def test_what_cannot_work_is_one_line_and_exit_code_1(ros_process: Process, tmp_path: Path) -> None:
    design = str(tampered(tmp_path / "edited.yaml"))
    finished = ros_process("observer", parameters={"design": design}).finish(TIMEOUT)
    assert finished.exit_code == 1
    assert "Traceback" not in finished.stderr
    (line,) = errors(finished.stderr)
    assert line.startswith("error: ")
    assert "edited.yaml: the certificate does not hold" in line
