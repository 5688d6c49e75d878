# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs demo`: plant, observer, visualizer and recorder over DDS, then a report on their bag."""

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import Any

from tsobs_ros.bag.estimate_topics import (
    DESIGN,
    PARAMETER_TOPICS,
    TICKS,
    TOPICS,
    TRUE_DISTURBANCE,
    TRUE_STATES,
)
from tsobs_ros.cli.common import Commands, add_command, note, positive, show
from tsobs_ros.errors import NodeError
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.stop import PARENT, StopFlag, signal_came

MARKERS = "/visualizer/markers"
RECORDED_TOPICS = (
    "/joint_measurements",
    f"/{TRUE_STATES}",
    f"/{TRUE_DISTURBANCE}",
    *(f"/observer/{name}" for name in (*TOPICS, DESIGN, TICKS)),
    MARKERS,
    "/diagnostics",
)
ADAPTIVE_TOPICS = tuple(f"/observer/{name}" for name in PARAMETER_TOPICS)
"""Published only if the design calls parameters uncertain."""

_START_TIMEOUT = 60.0  # usually a second or two, longer on a busy machine
_STOP_TIMEOUT = 15.0
_POLL = 0.05
_MAX_DOMAIN = 232  # the ports of a higher one would be too high


def add_parser(commands: Commands) -> None:
    """Add the command `demo`."""
    text = "simulate, observe, draw, record and report, over ROS"
    add = add_command(commands, "demo", run, text).add_argument
    add("--output", type=Path, help="folder to make (default: demo/<date and time>)")
    add("--duration", type=positive, default=20.0, metavar="S")
    add("--seed", type=int, default=1)
    add("--bias", type=float, default=0.1, metavar="RAD", help="size of the sensor's bias step")
    add("--bias-at", type=positive, default=8.0, metavar="S")
    add("--design", type=Path, metavar="FILE", help="design of the observer")
    add(
        "--domain-id", type=int, metavar="N",
        help="ROS domain (default: a private one, so that nothing else is disturbed)",
    )  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """Run the nodes, then report on their bag."""
    from tqdm import tqdm

    from tsobs_ros.design.file import load_design
    from tsobs_ros.nodes.plant_simulator import Parameters
    from tsobs_ros.report import figures, page  # noqa: F401  # fail now, not after the run
    from tsobs_ros.report.bag_report import make_bag_report
    from tsobs_ros.settings import changed

    output = options.output or Path("demo") / datetime.now().strftime("%Y_%m_%d-%H_%M_%S")
    if options.domain_id is None:
        # Domains 1 to 101 do not use the ports of outgoing connections.
        options.domain_id = 1 + os.getpid() % 101
    if not 0 <= options.domain_id <= _MAX_DOMAIN:
        options.parser.error(f"--domain-id: expected 0 to {_MAX_DOMAIN}, got {options.domain_id}")
    plant = {
        "seed": options.seed,
        "duration": options.duration,
        "wait_for_subscribers": 2,
        "disturbance.kind": "bias_step" if options.bias else "none",
        "disturbance.bias_step.amplitude": options.bias,
        "disturbance.bias_step.start": options.bias_at,
    }
    # Refuse what the nodes would refuse, before there is a folder.
    changed(Parameters(), plant)
    load_design(options.design)
    note(
        f"plant, observer, visualizer and recorder on ROS_DOMAIN_ID={options.domain_id} for "
        f"{options.duration:g} s"
    )
    look = "{l_bar}{bar}| {n:.1f}/{total:.1f} s"
    with tqdm(total=options.duration, unit="s", bar_format=look) as bar:
        bag = _record(output, options, plant, bar)
    notes = {"seed of the simulator": str(options.seed)}
    show(*make_bag_report(bag, output, notes=notes), options.json)
    if not options.json:
        print(f"\nthe bag is {bag}: ros2 bag play, Foxglove and PlotJuggler open it")
    return 0


def _record(
    output: Path, options: argparse.Namespace, simulated: Mapping[str, object], bar: Any
) -> Path:
    """Run the nodes for the demo's duration, in a new folder, and return the closed bag."""
    try:
        output.mkdir(parents=True)
    except FileExistsError as error:
        raise NodeError(f"{output}: exists already; choose another --output") from error
    except OSError as error:
        raise NodeError(f"{output}: cannot make this folder: {error.strerror}") from error
    bag = output / "bag"
    topics = "[" + ", ".join(RECORDED_TOPICS + ADAPTIVE_TOPICS) + "]"
    # The flag outlasts the stack, so no signal interrupts the end of the nodes.
    with StopFlag(), ExitStack() as stack:

        def start(name: str, parameters: Mapping[str, object]) -> _Node:
            node = _Node(name, parameters, output / "log", options.domain_id)
            stack.callback(node.end)
            return node

        design = options.design or config_path(SHIPPED_DESIGN)
        observer = start("observer", {"design": design.resolve()})
        recorder = start("recorder", {"output": bag.resolve(), "topics": topics})
        nodes = [recorder, observer, start("visualizer", {})]
        own = [each for each in RECORDED_TOPICS if "/observer/" in each or each == MARKERS]
        _wait(lambda: all(f"{topic} [" in recorder.printed() for topic in own), nodes)
        plant = start("plant_simulator", simulated)
        _wait(lambda: "started" in plant.printed(), [*nodes, plant])
        started = time.monotonic()

        def has_finished() -> bool:
            bar.update(min(time.monotonic() - started, options.duration) - bar.n)
            return plant.poll() is not None

        _wait(has_finished, nodes, options.duration + _START_TIMEOUT)
        bar.update(options.duration - bar.n)
        # The recorder ends before observer and visualizer, and so takes all that they have sent.
        for node in (plant, *nodes):
            node.end()
            if node.returncode:
                raise node.failure()
        if signal_came():
            raise KeyboardInterrupt
    return bag


class _Node(subprocess.Popen[bytes]):
    """One node executable as a child process, with its output in a log file."""

    def __init__(
        self, name: str, parameters: Mapping[str, object], folder: Path, domain_id: int
    ) -> None:
        folder.mkdir(exist_ok=True)
        self.name, self.log = name, folder / f"{name}.log"
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder),
            "PYTHONUNBUFFERED": "1",
            PARENT: "0",  # a kill of the demo closes the pipe and thus ends the node
        }
        environment.pop("ROS_LOCALHOST_ONLY", None)
        settings = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
        with self.log.open("wb") as output:
            super().__init__(
                [sys.executable, "-m", "tsobs_ros.executables", name, "--ros-args", *settings],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment,
                # The terminal's Ctrl-C goes only to the demo, which ends its nodes in order.
                start_new_session=True,
            )

    def printed(self) -> str:
        return self.log.read_text(encoding="utf-8", errors="replace")

    def end(self) -> None:
        """End the process cleanly, by force only if that fails."""
        self.send_signal(signal.SIGINT)
        assert self.stdin is not None
        self.stdin.close()
        try:
            self.wait(_STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            self.kill()
            self.wait()

    def failure(self) -> NodeError:
        last = " | ".join(self.printed().strip().splitlines()[-5:]) or "no output"
        return NodeError(f"{self.name} ended with exit code {self.returncode}: {last}")


def _wait(
    done: Callable[[], bool], needed: Iterable[_Node], timeout: float = _START_TIMEOUT
) -> None:
    """Wait until `done`, as long as the needed nodes run."""
    deadline = time.monotonic() + timeout
    while not done():
        if signal_came():
            raise KeyboardInterrupt
        for node in needed:
            if node.poll() is not None:
                raise node.failure()
            if time.monotonic() > deadline:
                raise NodeError(f"no answer within {timeout:g} s; see {node.log.parent}")
        time.sleep(_POLL)
