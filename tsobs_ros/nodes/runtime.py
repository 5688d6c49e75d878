# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A process with nodes: its arguments, and a clean end by a signal, a finished node or an error.

`run(create)` initialises rclpy, spins what `create` returns on a single-threaded executor, and
tears everything down in order. Nodes are ordinary rclpy nodes with three optional members:

* ``finished`` (bool property): the loop ends once any node is;
* ``ticker`` (Ticker or None): its ticks are made here, without the executor;
* ``close()``: called before any node is destroyed, which is the one step that may hang (see
  `limit_time_left`). Bags and whatever must not be lost are closed here.

Exit codes: 0 after a signal or a finished node, 1 after an expected error or malformed ROS
arguments, with one line ``error: …`` on stderr. Anything else is a bug and keeps its traceback.

rclpy's own signal handlers are not used: they shut the context down under a running callback,
which loses early SIGTERMs and sometimes raises inside take. The loop reads a flag instead.
"""

import argparse
import gc
import inspect
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import ModuleType

import rclpy
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

from tsobs_ros.errors import TsobsError, printable
from tsobs_ros.nodes.ticker import Ticker
from tsobs_ros.settings import describe
from tsobs_ros.stop import StopFlag
from tsobs_ros.streams import Parser

EXPECTED = (TsobsError, OSError, NameValidationException)
"""What a user can mend; the second comes of files, the last of a joint or a topic that ROS cannot
name."""

# A signal does not wake the executor: the longest time until an idle process notices one [s].
_SPIN_TIMEOUT = 0.2
# Period of services, parameters and slow timers while a node's ticks are made here [s].
_SERVE_PERIOD = 0.1
# Destroying two nodes and shutting the context down takes some 20 ms, .5 s on a loaded machine.
_TEARDOWN_TIMEOUT = 5.0

_HELP = {"-h", "--help"}


def check_arguments(module: ModuleType, arguments: Sequence[str]) -> None:
    """Print the help if it is asked for, and refuse what neither the node nor ROS understands.

    Args:
        module: The node's module: its docstring describes the node and its topics, its
            `Parameters` are the dataclass of its parameters.
        arguments: Command line including the program's name.

    Raises:
        SystemExit: With 0 after the help, with 2 after an error.
    """
    name, listed = module.__name__.rpartition(".")[2], ["parameters:"]
    for setting, kind, default, accepted, description in describe(module.Parameters):
        facts = "; ".join(filter(None, (kind, f"default {default}", accepted)))
        listed += [f"  {setting} ({facts})", f"      {description}"]
    parser = Parser(
        prog=name,
        usage=f"{name} [--help] [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r OLD:=NEW] …]",
        description=inspect.getdoc(module),
        epilog="\n".join(listed),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    try:
        # ROS does not know --help, and it may come after --ros-args.
        own = ["--help"] if _HELP & {*arguments} else remove_ros_args(arguments)[1:]
    except RuntimeError as error:
        # rclpy does not export the type. What is malformed is for rclpy.init to report.
        if type(error).__name__ == "UnknownROSArgsError":
            parser.error(printable(f"unrecognized ROS arguments: {error}"))
        return
    parser.parse_args(list(map(printable, own)))


def run(
    create: Callable[[], Node | Sequence[Node]],
    args: Sequence[str] | None = None,
    stop: Callable[[], bool] | None = None,
) -> int:
    """Create nodes, spin them until something ends the process, and tear them down.

    Args:
        create: Makes the node, or several that share the executor, on the default context. Nodes
            are closed and destroyed in the order given.
        args: Command line including the program's name; `sys.argv` if None.
        stop: Returns whether to end; called before every wait of at most 0.2 s. If None, the
            signals of `StopFlag` are caught here, which only the main thread may do.

    Returns:
        The process's exit code.
    """
    if stop is None:
        with StopFlag() as flag:
            return run(create, args, flag)
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # rcl could not parse the arguments or the parameter file
        return _report(_without_source_lines(str(error)))
    nodes: list[Node] = []
    exit_code = 0
    try:
        if not stop():
            created = create()
            nodes += created if isinstance(created, Sequence) else [created]
            _spin(nodes, stop)
    except (ExternalShutdownException, ShutdownException):
        pass  # the context was shut down from outside: a clean end
    except EXPECTED as error:
        exit_code = _report(str(error))
    except BaseException:
        exit_code = 1
        raise
    finally:
        exit_code = _tear_down(nodes, exit_code)
    return exit_code


def limit_time_left(seconds: float) -> None:
    """End the process by SIGALRM if it still runs after some time [s]; 0 lifts the limit.

    Fast DDS 2.14 sometimes spins for ever while a participant is destroyed (two or three in a
    thousand processes when two nodes stop together) and holds the GIL, so that no Python code runs.
    The default action of a signal needs none; the process then ends by signal 14.
    """
    for stream in (sys.stdout, sys.stderr):  # a forced end runs no exit handlers
        with suppress(OSError):  # the terminal has gone
            stream.flush()
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGALRM])
    signal.setitimer(signal.ITIMER_REAL, seconds)


def _spin(nodes: Sequence[Node], stop: Callable[[], bool]) -> None:
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    # What lives until the end need not be looked through again and again.
    gc.collect()
    gc.freeze()
    try:
        while rclpy.ok() and not stop() and not any(getattr(n, "finished", False) for n in nodes):
            # Nodes make and drop their tickers as they are configured.
            tickers = [t for node in nodes if (t := getattr(node, "ticker", None)) is not None]
            if tickers and all(ticker.may_be_taken_over for ticker in tickers):
                _tick_for_a_while(tickers, stop)
                _run_what_is_ready(executor, stop)
            else:
                for ticker in tickers:
                    ticker.give_back()
                executor.spin_once(timeout_sec=_SPIN_TIMEOUT)
    finally:
        for node in nodes:
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


def _tick_for_a_while(tickers: Sequence[Ticker], stop: Callable[[], bool]) -> None:
    """Tick and sleep until the executor's turn comes."""
    until = time.monotonic() + _SERVE_PERIOD
    for ticker in tickers:
        ticker.take_over()
    while True:
        wait = min(ticker.run_if_due() for ticker in tickers) * 1e-9
        left = until - time.monotonic()
        if left <= 0.0 or stop():
            return
        time.sleep(min(wait, left))


def _tear_down(nodes: Sequence[Node], exit_code: int) -> int:
    """Close all nodes, then destroy them, whatever fails on the way."""
    for name in ("close", "destroy_node"):
        for node in nodes:
            try:
                getattr(node, name, lambda: None)()
            except EXPECTED as error:
                exit_code = _report(str(error))
            except Exception:  # a bug
                with suppress(OSError):
                    traceback.print_exc()
                exit_code = 1
        limit_time_left(_TEARDOWN_TIMEOUT)
    rclpy.try_shutdown()
    limit_time_left(0.0)
    return exit_code


def _without_source_lines(message: str) -> str:
    """Drop the "at …/parse.c:391" that rcl appends, and explain its least obvious refusal."""
    hint = ""
    if "should be of same type" in message:
        hint = "; write every number of the list with a decimal point"
    return re.sub(r",? at \S+:\d+", "", message) + hint


def _report(message: str) -> int:
    with suppress(OSError):
        print(f"error: {printable(' '.join(message.split()))}", file=sys.stderr, flush=True)
    return 1
