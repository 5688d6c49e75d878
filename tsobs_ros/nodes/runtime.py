# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The process of a node: its arguments, and its clean end by a signal, a finished node or an error.

`run(create)` initialises rclpy, spins the node on a single-threaded executor, and tears everything
down in order. It is an ordinary rclpy node with three optional members:

* ``finished`` (bool property): the loop ends once it is true;
* ``ticker`` (Ticker or None): its ticks are made here, without the executor;
* ``close()``: called before the node is destroyed, which is the one step that may hang (see
  `limit_time_left`). Bags and everything else that must not be lost are closed here.

Exit codes: 0 after a signal or a finished node, 1 after an expected error or malformed ROS
arguments, with one line ``error: …`` on stderr. Anything else is a bug and keeps its traceback.

rclpy's own signal handlers are not used: they shut the context down under a running callback,
which loses early SIGTERMs and sometimes raises inside `take`. The loop reads a flag instead.
"""

import argparse
import gc
import inspect
import math
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
"""Errors that a user can fix; OSError comes from files, NameValidationException from a joint or
topic whose name ROS does not accept."""

# Longest time until an idle process notices a signal, which does not wake the executor [s].
_SPIN_TIMEOUT = 0.2
# Period of serving services, parameters and slow timers while the ticks are made here [s].
_SERVE_PERIOD = 0.1
# Destroying two nodes and shutting down takes about 20 ms, on a loaded machine 0.5 s.
_TEARDOWN_TIMEOUT = 5.0


class Ticker:
    """Calls back at a fixed rate or when the callback asks for it, until its node is cleaned up.

    An rclpy timer rebuilds the wait set twice per tick, which at 200 Hz costs more than all the
    work of an observer. So `run` makes a node's ticks itself: it sleeps on the monotonic clock
    until the next tick, and serves everything else in between. In another executor, or under
    simulated time, which passes only in an executor, the tick is an ordinary timer. If messages are
    wanted as soon as they arrive, `run` looks for them: a look takes a tenth of an executor's wait.

    Args:
        node: The node; while it follows simulated time, an executor makes the ticks.
        period: Time between ticks [s], the longest one if the callback returns a time.
        callback: The work of a tick; returns the time until the next one [ns], None for the period.
        executor_clock: The clock of ticks in an executor; None for the node's, which stands still
            while simulated time does.
        look: Called between the ticks that `run` makes, None for never.
        look_period: Time between two looks [s].
    """

    def __init__(
        self,
        node: Node,
        period: float,
        callback: Callable[[], int | None],
        executor_clock: Clock | None = None,
        look: Callable[[], None] | None = None,
        look_period: float = math.inf,
    ) -> None:
        self._clock = node.get_clock()
        self._callback, self._look, self._look_period = callback, look, look_period
        self._period_ns = self._scheduled = round(period * 1e9)
        # Next tick on the monotonic clock [ns]; None while an executor makes ticks, as at first.
        self._due: int | None = None
        self._timer = node.create_timer(period, self._tick, clock=executor_clock)

    def skip_next(self) -> None:
        """Skip the next tick, as its work has just been done."""
        if self._due is None:
            self._schedule(2 * self._period_ns)
        else:
            self._due = time.monotonic_ns() + 2 * self._period_ns

    def run_for(self, seconds: float, stop: Callable[[], bool]) -> bool:
        """Tick and sleep for some time in place of the executor, or until `stop` is true; return
        false at once under simulated time, whose ticks an executor makes."""
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
            else:
                time.sleep(min((min(self._due, end) - now) * 1e-9, self._look_period))
                if self._look is not None:
                    self._look()
            now = time.monotonic_ns()
        return True

    def _next(self, due: int) -> int:
        """Make the tick that is due, and return the time of the next one [ns]."""
        wait, now = self._callback(), time.monotonic_ns()
        if wait is not None:
            return now + min(wait, self._period_ns)
        # Ticks stay on the grid of the first one. If the process was held up, only the latest of
        # the missed ticks is made up for.
        return due + self._period_ns * max(1, (now - due) // self._period_ns)

    def _tick(self) -> None:
        wait = self._callback()
        if wait is not None or self._scheduled != self._period_ns:
            self._schedule(self._period_ns if wait is None else min(wait, self._period_ns))

    def _schedule(self, wait: int) -> None:
        # 0 is due at once, also while simulated time stands still.
        self._timer.timer_period_ns = self._scheduled = max(wait, 0)
        self._timer.reset()


def check_arguments(module: ModuleType, arguments: Sequence[str]) -> None:
    """Print the help on request, and refuse arguments that neither the node nor ROS understands.

    The node's module has the topics in its docstring, and its parameters as `Parameters`.

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
        # ROS has no --help, and --help may come after --ros-args.
        own = ["--help"] if {"-h", "--help"} & {*arguments} else remove_ros_args(arguments)[1:]
    except UnicodeEncodeError as error:
        parser.error(printable(f"expected arguments in UTF-8, got {error.object!r}"))
    except RuntimeError as error:
        # rclpy does not export the type. Malformed arguments are left for rclpy.init to report.
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
        except RuntimeError as error:
            # rclpy does not export the type. Bad variables of the environment stop the first node.
            if node is not None or type(error).__name__ != "RCLError":
                raise
            exit_code = complain(error)
        finally:
            exit_code = _tear_down(node, exit_code)
    return exit_code


def _log_arguments() -> list[str]:
    """Return arguments that switch the log file off if ROS could not write to its folder."""
    try:
        if not os.environ.get("ROS_LOG_DIR"):
            own = os.environ.get("HOME") or os.devnull  # in which there is no folder
            home = Path(os.environ.get("ROS_HOME") or Path(own, ".ros"))
            folder = home.expanduser() / "log"
            folder.mkdir(parents=True, exist_ok=True)
            if not os.access(folder, os.W_OK):
                raise PermissionError(folder)
    except (OSError, RuntimeError):
        return ["--ros-args", "--disable-external-lib-logs"]
    return []


def limit_time_left(seconds: float) -> None:
    """End the process by SIGALRM if it still runs after some time [s]; 0 lifts the limit.

    Fast DDS 2.14 sometimes spins for ever while it destroys a participant and holds the GIL, so no
    Python code runs. The default action of SIGALRM needs no Python code; the process then ends by
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
    # The garbage collector need not look through these lasting objects again and again.
    gc.collect()
    gc.freeze()
    try:
        while rclpy.ok() and not stop() and not getattr(node, "finished", False):
            # A node makes its ticker when it is configured, and drops it at the clean-up.
            ticker: Ticker | None = getattr(node, "ticker", None)
            if ticker is not None and ticker.run_for(_SERVE_PERIOD, stop):
                _run_what_is_ready(executor, stop)
            else:
                executor.spin_once(timeout_sec=_SPIN_TIMEOUT)
    finally:
        executor.remove_node(node)
        executor.shutdown()


def _run_what_is_ready(executor: SingleThreadedExecutor, stop: Callable[[], bool]) -> None:
    """Run all callbacks that are ready now; `spin_once` would run one per two calls."""
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
    """Close the node, then destroy it, even if a step fails."""
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
