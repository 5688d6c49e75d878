# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures for ROS tests without launch files: isolated nodes, and executables as processes.

``ros`` gives a test its own rclpy context and domain, ``ros_process`` starts an executable of this
package, or any command, on that domain::

    process = ros_process("observer", parameters={"rate": 50.0})
    process.wait_for_line("certificate holds")
    process.signal(signal.SIGTERM)
    assert process.finish().exit_code == 0

Domains are claimed with file locks, so concurrent tests, xdist workers and whole test runs on one
machine never share one.
"""

import faulthandler
import fcntl
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import pytest
from hypothesis import HealthCheck, settings

from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

ROOT = Path(__file__).resolve().parent.parent

# The same examples in every run, and no verdict on how fast the machine is.
settings.register_profile(
    "tsobs_ros", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("tsobs_ros")

# Before any test module can import matplotlib or rclpy.
os.environ["MPLBACKEND"] = "Agg"
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
for _variable in ("ROS_LOCALHOST_ONLY", "ROS_DOMAIN_ID", "ROS_STATIC_PEERS"):
    os.environ.pop(_variable, None)

# Child processes inherit ignored signals: SIGINT from a job in the background, SIGHUP from nohup.
for _number, _default in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _default)

# 102 and above may collide with the ports Linux hands out for outgoing connections.
_DOMAINS = range(1, 102)
_TEARDOWN_LIMIT = 60.0


@pytest.fixture(scope="session")
def benchmark() -> Callable[[str], ModuleType]:
    """Imports a module of the benchmarks, which are no package and not installed."""

    def load(name: str) -> ModuleType:
        folder = str(ROOT / "benchmarks")
        sys.path.insert(0, folder)
        try:
            return import_module(name)
        finally:
            sys.path.remove(folder)

    return load


@pytest.fixture(scope="session")
def hostile() -> str:
    """A name that commands a terminal: escapes, other controls, lines of its own, a mirror."""
    return "x\x1b[2J\x9b1m\u202e\u2066\a\b\x7f\r\nFORGED:\u2028\u2029\t\x85\0y"


@pytest.fixture(scope="session")
def check_shown() -> Callable[[str], None]:
    """Checks that printed text has no command of a hostile name, and no line of it."""

    def check(printed: str) -> None:
        assert {c for c in printed if not c.isprintable()} <= {"\n"}
        assert not any(line.lstrip().startswith("FORGED") for line in printed.splitlines())

    return check


@pytest.fixture(scope="session")
def predicted() -> Callable[..., Any]:
    """Moves augmented states, with a covariance if given, by the core's steps of a flow."""
    import numpy as np

    from tsobs_ros.estimation.baselines import extended_kalman
    from tsobs_ros.estimation.state import likeliest

    def move(flow: Any, x: Any, u: Any, duration: float, covariance: Any = None) -> Any:
        n, p = flow.state_count, len(flow.output_matrix)
        estimator = extended_kalman(flow, np.eye(p), np.eye(n))
        before = estimator.initial()
        one = likeliest(before)
        one["x"], one["covariance"] = x, 0.0 if covariance is None else covariance
        after = likeliest(estimator.predict(before, u, duration))
        return after["x"] if covariance is None else (after["x"], after["covariance"])

    return move


@pytest.fixture(scope="session", autouse=True)
def ros_log_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keep ROS logs out of the home folder, which may be read-only."""
    folder = tmp_path_factory.mktemp("ros_log")
    os.environ["ROS_LOG_DIR"] = str(folder)
    return folder


@pytest.fixture(scope="session")
def design() -> Design:
    """The shipped design."""
    return load_design(config_path(SHIPPED_DESIGN))


@pytest.fixture
def domain_id() -> Iterator[int]:
    """A ROS domain that nobody else on this machine uses while the test runs."""
    folder = Path(tempfile.gettempdir()) / f"tsobs_ros_test_domains_{os.getuid()}"
    folder.mkdir(exist_ok=True)
    # Consecutive tests start at different domains: late packets of one must not reach the next.
    start = time.monotonic_ns() // 1_000_000
    for offset in range(len(_DOMAINS)):
        domain = _DOMAINS[(start + offset) % len(_DOMAINS)]
        with (folder / str(domain)).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield domain
            return
    pytest.fail(f"all ROS domains are taken, see {folder}")


class Ros:
    """A ROS graph of one test: context, executor and the nodes added to it."""

    def __init__(self, domain_id: int) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self.domain_id = domain_id
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
        self.environment = {
            **os.environ, "PYTHONPATH": path, "ROS_DOMAIN_ID": str(domain_id)
        }  # fmt: skip
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, domain_id=domain_id)
        self.executor = SingleThreadedExecutor(context=self.context)
        self._nodes: list[Any] = []

    def add(self, node: Any) -> Any:
        """Spin a node with the others and destroy it after the test; `close()` it before."""
        self.executor.add_node(node)
        self._nodes.append(node)
        return node

    def node(self, name: str, **options: Any) -> Any:
        """Make and add a plain node."""
        from rclpy.node import Node

        return self.add(Node(name, context=self.context, **options))

    def remove(self, node: Any) -> None:
        """Close and destroy a node before the test ends."""
        self._nodes.remove(node)
        self.executor.remove_node(node)
        getattr(node, "close", lambda: None)()
        node.destroy_node()

    def spin_until(
        self, predicate: Callable[[], bool], timeout: float = 10.0, what: str = "the condition"
    ) -> None:
        """Spin until the predicate holds; fail, naming what did not happen, after the timeout."""
        deadline = time.monotonic() + timeout
        while not predicate():
            remaining = deadline - time.monotonic()
            if remaining <= 0.0:
                raise AssertionError(f"{what} did not happen within {timeout:g} s")
            self.executor.spin_once(timeout_sec=min(0.05, remaining))

    def spin_for(self, seconds: float) -> None:
        """Spin for a time, in turns enough to take what waits even if the machine stood still."""
        end, turns = time.monotonic() + seconds, 0
        while time.monotonic() < end or turns < 50 * seconds:
            # Not what remains: after another timeout the executor starts its round again.
            self.executor.spin_once(timeout_sec=0.02)
            turns += 1

    def hear_out(self, kept: Sized) -> int:
        """Spin until nothing more has come for 0.2 s; return how much has."""
        arrived = -1
        while arrived != len(kept):
            arrived = len(kept)
            self.spin_for(0.2)
        return arrived

    def shutdown(self) -> None:
        """Tear everything down in order."""
        for node in [*self._nodes]:
            self.remove(node)
        self.executor.shutdown()
        self.context.try_shutdown()


@pytest.fixture
def ros(domain_id: int, ros_log_dir: Path) -> Iterator[Ros]:
    """A ROS graph of this test's own."""
    graph = Ros(domain_id)
    yield graph
    # Fast DDS can hang in here for ever, holding the GIL; better a lost worker than a stalled run.
    faulthandler.dump_traceback_later(_TEARDOWN_LIMIT, exit=True)
    try:
        graph.shutdown()
    finally:
        faulthandler.cancel_dump_traceback_later()


class Finished(NamedTuple):
    """How a process ended."""

    exit_code: int
    stdout: str
    stderr: str


class RosProcess(subprocess.Popen[bytes]):
    """A child process; its output goes to files in a folder of its own."""

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str], folder: Path
    ) -> None:
        self._streams = [folder / "stdout", folder / "stderr"]
        with self._streams[0].open("wb") as out, self._streams[1].open("wb") as err:
            super().__init__(
                command, stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True,
                env={**environment, "PYTHONUNBUFFERED": "1"},
            )  # fmt: skip

    signal = subprocess.Popen.send_signal

    @property
    def output(self) -> str:
        """Everything printed so far, on both streams."""
        return "".join(each.read_text("utf-8", "replace") for each in self._streams)

    def wait_for_line(self, pattern: str, timeout: float = 20.0) -> str:
        """Wait until a line of either stream matches the regular expression, and return it."""
        deadline = time.monotonic() + timeout
        while True:
            ended, late = self.poll() is not None, time.monotonic() > deadline
            for line in self.output.splitlines(keepends=True):
                if re.search(pattern, line) and (ended or line.endswith("\n")):
                    return line
            if ended or late:
                why = "it ended" if ended else f"{timeout:g} s passed"
                raise AssertionError(f"no line matches {pattern!r} ({why}):\n{self.output}")
            time.sleep(0.02)

    def finish(self, timeout: float = 20.0) -> Finished:
        """Wait for the process to end by itself."""
        try:
            self.wait(timeout)
        except subprocess.TimeoutExpired as error:
            raise AssertionError(f"{error}:\n{self.output}") from None
        out, err = (each.read_text("utf-8", "replace") for each in self._streams)
        return Finished(self.returncode, out, err)

    def kill(self) -> None:
        """End the process and its children at once."""
        if self.poll() is None:
            os.killpg(self.pid, signal.SIGKILL)
            self.wait()


COMMAND = [sys.executable, "-m", "tsobs_ros.executables"]


@pytest.fixture(scope="session")
def executables() -> list[str]:
    """A command that runs the executable whose name follows."""
    return COMMAND


@pytest.fixture
def ros_process(
    ros: Ros, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[..., RosProcess]]:
    """Start executables on this test's domain; whatever is left is killed after the test.

    `prefix` is a command that runs the executable, such as a shell that sets limits first.
    """
    started: list[RosProcess] = []

    def start(
        command: str | Sequence[str],
        *,
        parameters: Mapping[str, Any] | None = None,
        params_file: Path | None = None,
        remap: Mapping[str, str] | None = None,
        arguments: Sequence[str] = (),
        prefix: Sequence[str] = (),
    ) -> RosProcess:
        of_ros = [] if params_file is None else ["--params-file", str(params_file)]
        for name, value in (parameters or {}).items():
            of_ros += ["-p", f"{name}:={json.dumps(value)}"]  # JSON is YAML
        for old, new in (remap or {}).items():
            of_ros += ["-r", f"{old}:={new}"]
        base = [*COMMAND, command] if isinstance(command, str) else command
        process = RosProcess(
            [*prefix, *base, *arguments, *(["--ros-args", *of_ros] if of_ros else [])],
            ros.environment,
            tmp_path_factory.mktemp("process"),
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Yield a real headless Chromium, as Playwright's `Browser`; skip if there is none."""
    found = next(
        filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
    )
    if found is None:
        pytest.skip("no Chromium on the path: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield made
        made.close()
