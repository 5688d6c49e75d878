# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The demo: plant, observer and recorder as processes over DDS, then a report of their bag."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from tsobs_ros.bag.messages.estimate_topics import PARAMETER_TOPICS, TOPICS
from tsobs_ros.errors import NodeError

RECORDED_TOPICS = (
    "/joint_measurements",
    "/ground_truth/joint_states",
    "/ground_truth/disturbance",
    *(f"/observer/{name}" for name in TOPICS),
    "/diagnostics",
)
ADAPTIVE_TOPICS = tuple(f"/observer/{name}" for name in PARAMETER_TOPICS)
"""Published only where the design calls parameters uncertain."""

_START_TIMEOUT = 30.0
_STOP_TIMEOUT = 15.0
_POLL = 0.05


@dataclass(frozen=True)
class DemoOptions:
    """What the demo simulates.

    Attributes:
        duration: Simulated time, which is real time [s].
        seed: Seed of all noise.
        bias: Size of the sensor's bias step [rad].
        bias_at: When it comes [s].
        stiffness: Relative change of the true stiffness.
        gravity: Relative change of the true gravity torque.
        domain_id: ROS domain of the three processes.
        design: Design file of the observer; None for the shipped one.
    """

    duration: float = 20.0
    seed: int = 1
    bias: float = 0.1
    bias_at: float = 8.0
    stiffness: float = 0.0
    gravity: float = 0.0
    domain_id: int = 0
    design: Path | None = None


class _NodeProcess:
    """One node executable as a child process, its output in a log file."""

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, object],
        environment: Mapping[str, str],
        log: Path,
    ) -> None:
        self.name = name
        self.log = log
        arguments = [sys.executable, "-m", "tsobs_ros.executables", name, "--ros-args"]
        for key, value in parameters.items():
            arguments += ["-p", f"{key}:={value}"]
        with log.open("wb") as output:
            self._process = subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=dict(environment),
                # The terminal's Ctrl-C goes to the demo alone, which ends its nodes in order.
                start_new_session=True,
            )

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def has_printed(self, *patterns: str) -> bool:
        text = self.log.read_text(encoding="utf-8", errors="replace")
        return all(re.search(pattern, text) for pattern in patterns)

    def stop(self) -> None:
        """End the process cleanly, by force only if it does not listen."""
        if self.running:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(_STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def require_success(self) -> None:
        """Raise `NodeError` with the end of its log unless it ended with exit code 0."""
        if self._process.poll():
            last = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-5:]
            raise NodeError(
                f"{self.name} ended with exit code {self._process.returncode}: "
                + " | ".join(last or ["no output"])
            )


def run_demo(output: Path, options: DemoOptions, show_progress: Callable[[float], None]) -> Path:
    """Run the three nodes for the demo's duration and return the closed bag.

    Args:
        output: Folder for the bag and the logs; made here, must not exist.
        options: What to simulate.
        show_progress: Called with the seconds simulated so far.

    Returns:
        The bag's folder.

    Raises:
        NodeError: The folder exists, or a node did not start, failed or did not end.
    """
    try:
        output.mkdir(parents=True)
        (output / "log").mkdir()
    except FileExistsError as error:
        raise NodeError(f"{output}: exists already; choose another --output") from error
    except OSError as error:
        raise NodeError(f"{output}: cannot be made: {error.strerror}") from error
    bag = output / "bag"
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(options.domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(output / "log"),
        "PYTHONUNBUFFERED": "1",
    }
    environment.pop("ROS_LOCALHOST_ONLY", None)

    def start(name: str, parameters: Mapping[str, object]) -> _NodeProcess:
        process = _NodeProcess(name, parameters, environment, output / "log" / f"{name}.log")
        stack.callback(process.stop)
        return process

    with ExitStack() as stack:
        topics = "[" + ", ".join(RECORDED_TOPICS + ADAPTIVE_TOPICS) + "]"
        design = {"design": options.design.resolve()} if options.design else {}
        observer = start("observer", design)
        recorder = start("recorder", {"output": bag.resolve(), "topics": topics})
        own = [re.escape(topic) + r" \[" for topic in RECORDED_TOPICS if "/observer/" in topic]
        _wait(lambda: recorder.has_printed(*own), [observer, recorder], "the recorder to be ready")
        plant = start(
            "plant_simulator",
            {
                "seed": options.seed,
                "duration": options.duration,
                "wait_for_subscribers": 2,
                "disturbance.kind": "bias_step" if options.bias else "none",
                "disturbance.bias_step.amplitude": options.bias,
                "disturbance.bias_step.start": options.bias_at,
                "mismatch.stiffness": options.stiffness,
                "mismatch.gravity_torque": options.gravity,
            },
        )
        nodes = [observer, recorder, plant]
        _wait(lambda: plant.has_printed("started"), nodes, "the plant to start")
        _follow(plant, [observer, recorder], options.duration, show_progress)
        # The recorder first, so that it still takes what the others have sent.
        for process in (recorder, observer, plant):
            process.stop()
            process.require_success()
    return bag


def _wait(ready: Callable[[], bool], needed: Sequence[_NodeProcess], what: str) -> None:
    deadline = time.monotonic() + _START_TIMEOUT
    while not ready():
        for process in needed:
            _require_running(process)
        if time.monotonic() > deadline:
            logs = needed[0].log.parent
            raise NodeError(f"waited {_START_TIMEOUT:g} s in vain for {what}; see {logs}")
        time.sleep(_POLL)


def _follow(
    plant: _NodeProcess,
    others: Sequence[_NodeProcess],
    duration: float,
    show_progress: Callable[[float], None],
) -> None:
    """Watch the processes until the plant has finished its run."""
    begun = time.monotonic()
    while plant.running:
        for process in others:
            _require_running(process)
        elapsed = time.monotonic() - begun
        if elapsed > duration + _START_TIMEOUT:
            raise NodeError(f"the plant did not finish {duration:g} s; see {plant.log}")
        show_progress(min(elapsed, duration))
        time.sleep(_POLL)
    plant.require_success()
    show_progress(duration)


def _require_running(process: _NodeProcess) -> None:
    if not process.running:
        process.require_success()
        raise NodeError(f"{process.name} ended early; see {process.log}")
