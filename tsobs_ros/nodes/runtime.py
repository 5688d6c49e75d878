# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The process of a node: its arguments, and a clean end by a signal, a finished node or an error.

`run(create)` initialises rclpy, spins the node on a single-threaded executor, and tears everything
down in order. It is an ordinary rclpy node with three optional members:

* ``finished`` (bool property): the loop ends once it is true;
* ``ticker`` (Ticker or None): its ticks are made here, without the executor;
* ``close()``: called before the node is destroyed, which is the one step that may hang (see
  `limit_time_left`). Bags and whatever must not be lost are closed here.

Exit codes: 0 after a signal or a finished node, 1 after an expected error or malformed ROS
arguments, with one line ``error: …`` on stderr. Anything else is a bug and keeps its traceback.

rclpy's own signal handlers are not used: they shut the context down under a running callback,
which loses early SIGTERMs and sometimes raises inside take. The loop reads a flag instead.
"""

import argparse
import gc
import inspect
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import ModuleType

import rclpy
from rclpy.clock import Clock
from rclpy.exceptions import NameValidationException
from rclpy.executors import (
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from tsobs_ros.errors import TsobsError, complain, printable
from tsobs_ros.settings import in_yaml, settings_of
from tsobs_ros.stop import StopFlag

EXPECTED = (TsobsError, OSError, NameValidationException)
"""What a user can fix; the second comes of files, the last of a joint or a topic that ROS cannot
name."""

# A signal does not wake the executor: the longest time until an idle process notices one [s].
_SPIN_TIMEOUT = 0.2
# Period of services, parameters and slow timers while a node's ticks are made here [s].
_SERVE_PERIOD = 0.1
# Destroying two nodes and shutting the context down takes some 20 ms, .5 s on a loaded machine.
_TEARDOWN_TIMEOUT = 5.0


class Ticker:
    """Calls back at a fixed rate or when the callback asks for it, until its node is cleaned up.

    An rclpy timer costs two rebuilt wait sets a tick, which at 200 Hz is more than all that an
    observer does. So `run` makes a node's ticks itself: it sleeps until the next one on the
    monotonic clock, and serves everything else in between. In another executor, and under simulated
    time, which passes only in an executor, the tick is an ordinary timer.

    Args:
        node: Its ticks are an executor's as long as it follows simulated time.
        period: Time between ticks [s], the longest if the callback decides.
        callback: What to do; returns the time until the next tick [ns], or None for the period.
        executor_clock: The clock of an executor's ticks, if not the node's, which stands still
            while simulated time does.
    """

    def __init__(
        self,
        node: Node,
        period: float,
        callback: Callable[[], int | None],
        executor_clock: Clock | None = None,
    ) -> None:
        self._clock = node.get_clock()
        self._callback = callback
        self._period_ns = self._scheduled = round(period * 1e9)
        # On the monotonic clock [ns]; None as long as ticks are an executor's, as at first.
        self._due: int | None = None
        self._timer = node.create_timer(period, self._tick, clock=executor_clock)

    def skip_next(self) -> None:
        """Leave an executor's next tick out, as its work has just been done."""
        self._schedule(2 * self._period_ns)

    def run_for(self, seconds: float, stop: Callable[[], bool]) -> bool:
        """Tick and sleep for some time instead of the executor, until something stops it; return
        whether there are ticks that a sleep can make."""
        if self._clock.ros_time_is_active:
            if self._due is not None:
                self._due = None
                self._schedule(self._period_ns)
            return False
        now = time.monotonic_ns()
        end = now + round(seconds * 1e9)
        if self._due is None:
            self._timer.cancel()
            self._due = now
        while now < end and not stop():
            if now >= self._due:
                self._due = self._next(self._due)
            elif (left := min(self._due, end) - now) > 0:
                time.sleep(left * 1e-9)
            now = time.monotonic_ns()
        return True

    def _next(self, due: int) -> int:
        """Make the tick that is due, and return when the next one is [ns]."""
        wait, now = self._callback(), time.monotonic_ns()
        if wait is not None:
            return now + min(wait, self._period_ns)
        # On the grid of the first tick. One that is late by less than a period is made good;
        # what fell out before that, while the process was held up, is gone.
        return due + self._period_ns * max(1, (now - due) // self._period_ns)

    def _tick(self) -> None:
        wait = self._callback()
        if wait is not None or self._scheduled != self._period_ns:
            self._schedule(self._period_ns if wait is None else min(wait, self._period_ns))

    def _schedule(self, wait: int) -> None:
        self._timer.timer_period_ns = self._scheduled = max(wait, 1)
        self._timer.reset()


def check_arguments(module: ModuleType, arguments: Sequence[str]) -> None:
    """Print the help if it is asked for, and refuse what neither the node nor ROS understands.

    The node's module has the topics in its docstring and its parameters as `Parameters`.

    Raises:
        SystemExit: With 0 after the help, with 2 after an error.
    """
    name, listed = module.__name__.rpartition(".")[2], ["parameters:"]
    for each in settings_of(module.Parameters).values():
        facts = [each.kind, f"default {in_yaml(each.default)}", each.limits]
        facts += [] if each.live else ["read-only"]
        listed += [f"  {each.name} ({'; '.join(filter(None, facts))})", f"      {each.description}"]
    parser = argparse.ArgumentParser(
        prog=name,
        usage=f"{name} [--help] [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r OLD:=NEW] …]",
        description=inspect.getdoc(module),
        epilog="\n".join(listed),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    try:
        # ROS does not know --help, and it may come after --ros-args.
        own = ["--help"] if {"-h", "--help"} & {*arguments} else remove_ros_args(arguments)[1:]
    except RuntimeError as error:
        # rclpy does not export the type. What is malformed is for rclpy.init to report.
        if type(error).__name__ == "UnknownROSArgsError":
            parser.error(printable(f"unrecognized ROS arguments: {error}"))
        return
    parser.parse_args(list(map(printable, own)))


def run(create: Callable[[], Node], args: Sequence[str] | None = None) -> int:
    """Create a node, spin it until something ends the process, and return the exit code.

    The signals of `StopFlag` are caught meanwhile, which only the main thread may do.

    Args:
        create: Makes the node, on the default context.
        args: Command line including the program's name; `sys.argv` if None.
    """
    given = [*(sys.argv if args is None else args), *_log_arguments()]
    with StopFlag() as stop:
        try:
            rclpy.init(args=given, signal_handler_options=SignalHandlerOptions.NO)
        except RuntimeError as error:  # rcl could not parse the arguments or the parameter file
            return complain(error)
        node: Node | None = None
        exit_code = 0
        try:
            if not stop():
                node = create()
                _spin(node, stop)
        except (ExternalShutdownException, ShutdownException):
            pass  # the context was shut down from outside: a clean end
        except EXPECTED as error:
            exit_code = complain(error)
        finally:
            exit_code = _tear_down(node, exit_code)
    return exit_code


def _log_arguments() -> list[str]:
    """Return what lets a node do without a log file if ROS could not make its folder."""
    try:
        if not os.environ.get("ROS_LOG_DIR"):
            home = Path(os.environ.get("ROS_HOME") or Path(os.environ["HOME"], ".ros"))
            folder = home.expanduser() / "log"
            folder.mkdir(parents=True, exist_ok=True)
            if not os.access(folder, os.W_OK):
                raise PermissionError(folder)
    except (KeyError, OSError, RuntimeError):
        return ["--ros-args", "--disable-external-lib-logs"]
    return []


def limit_time_left(seconds: float) -> None:
    """End the process by SIGALRM if it still runs after some time [s]; 0 lifts the limit.

    Fast DDS 2.14 sometimes spins for ever while a participant is destroyed and holds the GIL, so
    that no Python code runs. The default action of a signal needs none; the process then ends by
    signal 14.
    """
    for stream in (sys.stdout, sys.stderr):  # a forced end runs no exit handlers
        with suppress(OSError):  # the terminal has gone
            stream.flush()
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGALRM])
    signal.setitimer(signal.ITIMER_REAL, seconds)


def _spin(node: Node, stop: Callable[[], bool]) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    # What lives until the end need not be looked through again and again.
    gc.collect()
    gc.freeze()
    try:
        while rclpy.ok() and not stop() and not getattr(node, "finished", False):
            # A node makes and drops its ticker as it is configured.
            ticker: Ticker | None = getattr(node, "ticker", None)
            if ticker is not None and ticker.run_for(_SERVE_PERIOD, stop):
                _run_what_is_ready(executor, stop)
            else:
                executor.spin_once(timeout_sec=_SPIN_TIMEOUT)
    finally:
        executor.remove_node(node)
        executor.shutdown()


def _run_what_is_ready(executor: SingleThreadedExecutor, stop: Callable[[], bool]) -> None:
    """Run all callbacks that are ready now; `spin_once` would run one in every second call."""
    until = time.monotonic() + _SERVE_PERIOD
    try:
        while not stop() and time.monotonic() < until:
            callback, _, _ = executor.wait_for_ready_callbacks(timeout_sec=0.0)
            callback()
            if (error := callback.exception()) is not None:
                raise error
    except TimeoutException:
        pass  # all have run


def _tear_down(node: Node | None, exit_code: int) -> int:
    """Close the node, then destroy it, whatever fails on the way."""
    for name in ("close", "destroy_node"):
        try:
            getattr(node, name, lambda: None)()
        except EXPECTED as error:
            exit_code = complain(error)
        except Exception:  # a bug
            with suppress(OSError):
                traceback.print_exc()
            exit_code = 1
        limit_time_left(_TEARDOWN_TIMEOUT)
    rclpy.try_shutdown()
    limit_time_left(0.0)
    return exit_code
