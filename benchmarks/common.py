# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Shared code of the benchmarks: one thread, a ROS domain, a line on the machine, text or JSON."""

import argparse
import fcntl
import json
import os
import platform
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.errors import TsobsError
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

# 102 and above may collide with the ports Linux hands out for outgoing connections.
_DOMAINS = range(1, 102)
_claims: list[IO[str]] = []
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def use_one_thread() -> None:
    """Start the script again with BLAS on one thread, unless it already has one.

    The libraries read these variables when they are loaded, before any line of a script can set
    them.
    """
    if all(os.environ.get(name) == "1" for name in _THREADS):
        return
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    os.execv(sys.executable, [sys.executable, *sys.argv])


def parser(description: str | None, *, design: bool = True) -> argparse.ArgumentParser:
    """Return a parser with the options that benchmarks share; `design` for those that use one.

    From here on SIGTERM and SIGHUP end the benchmark as an exception does, with its processes.
    """
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:  # under nohup, SIGHUP stays ignored
            signal.signal(number, lambda number, _: sys.exit(128 + number))
    made = argparse.ArgumentParser(description=(description or "").partition("\n\n")[0])
    made.add_argument("--json", action="store_true", help="print JSON instead of text")
    if design:
        made.add_argument("--design", type=Path, metavar="FILE", help="default: the shipped design")
    return made


def at_least(least: float, kind: type[float] = float) -> Callable[[str], float]:
    """Return the type of an option that is a number, or an integer, of at least `least`."""

    def read(text: str) -> float:
        value = kind(text)
        if not least <= value < float("inf"):
            raise argparse.ArgumentTypeError(f"expected at least {least:g}, got {text}")
        return value

    read.__name__ = kind.__name__  # argparse names it if the text is not a number
    return read


def claim_domain() -> int:
    """Return a ROS domain that belongs to this process until it ends.

    No other process that claims domains by the same locks has it; the tests use these locks, too.
    """
    folder = Path(tempfile.gettempdir()) / f"tsobs_ros_test_domains_{os.getuid()}"
    folder.mkdir(exist_ok=True)
    for offset in range(len(_DOMAINS)):
        domain = _DOMAINS[(os.getpid() + offset) % len(_DOMAINS)]
        lock = (folder / str(domain)).open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
            continue
        _claims.append(lock)
        return domain
    sys.exit(f"all ROS domains are taken, see {folder}")


def join_ros(domain: int | None = None) -> Any:
    """Start rclpy in a domain, that of the environment if None, and return it.

    Its signal handlers are left out, because with them a script's own loop goes on after SIGTERM.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(args=[], domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    return rclpy


def design_of(options: argparse.Namespace) -> Design:
    """Return the design that a benchmark's options name, with its certificate checked."""
    try:
        return load_design(options.design or config_path(SHIPPED_DESIGN))
    except TsobsError as error:
        sys.exit(f"error: {error}")


def timed(action: Callable[[], object]) -> float:
    """Return the duration of an action [s]."""
    begun = time.perf_counter()
    action()
    return time.perf_counter() - begun


def machine() -> dict[str, Any]:
    """Return versions and the processor, on which the numbers depend."""
    import numpy as np

    model = platform.processor() or platform.machine()
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": names[0] if names else model,
        "cores": len(os.sched_getaffinity(0)),
        "load": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def show(results: Mapping[str, Any], text: str, as_json: bool) -> None:
    """Print the results and the machine on which they were measured."""
    here = machine()
    if as_json:
        print(json.dumps({"machine": here, **results}, indent=2, allow_nan=False))
        return
    print(text)
    print(
        f"\n{here['cpu']}, {here['cores']} cores, load {here['load']}, Python {here['python']}, "
        f"NumPy {here['numpy']}"
    )
