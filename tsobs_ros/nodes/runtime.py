# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Run nodes in a process that ends cleanly: Ctrl-C, SIGTERM, a finished node, an error.

`run(create)` initialises rclpy, spins what `create` returns on a single-threaded executor, and
tears everything down in order. Nodes are ordinary rclpy nodes; three optional members are honoured:

* ``finished`` (bool property): the loop ends once any node says so;
* ``ticker`` (Ticking or None): its ticks are made here, between two looks after everything else;
* ``close()``: called before any node is destroyed. Bags and whatever must not be lost are closed
  here, because destroying a participant is the one step that may hang (see `exit_guard`).

Exit codes: 0 after a signal or a finished node, 1 after a TsobsError or malformed ROS arguments,
with one line ``error: …`` on stderr. Anything else is a bug and keeps its traceback, after the
same teardown.

rclpy's own signal handlers are not used: they shut the context down under a running callback,
which loses early SIGTERMs and sometimes raises inside take. A flag that the loop reads is clean.
"""

import gc
import re
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.executors import (
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.signals import SignalHandlerOptions

from tsobs_ros.errors import TsobsError, printable
from tsobs_ros.nodes.exit_guard import exit_guard
from tsobs_ros.nodes.ticker import Ticking
from tsobs_ros.stop import StopFlag

# A signal wakes nobody: the longest an idle process takes to notice one.
_SPIN_TIMEOUT = 0.2
# How often services, parameters and slow timers get their turn where a node's ticks are made here.
_LOOK_AFTER_PERIOD = 0.1
# Destroying two nodes and shutting the context down takes some 20 ms, .5 s on a loaded machine.
_TEARDOWN_TIMEOUT = 5.0


@runtime_checkable
class RunnableNode(Protocol):
    """What `run` needs of a node; rclpy.node.Node has it. `finished` and `close` are optional."""

    def destroy_node(self) -> None:
        """Release the node's ROS entities."""


def run(
    create: Callable[[], RunnableNode | Sequence[RunnableNode]],
    args: Sequence[str] | None = None,
    stop: Callable[[], bool] | None = None,
) -> int:
    """Create nodes, spin them until something ends the process, and tear them down.

    Args:
        create: Makes the node, or several that share the executor, on the default context. Nodes
            are closed and destroyed in the order given.
        args: Command line including the program's name; `sys.argv` if None.
        stop: Says whether to end; asked before every wait of at most 0.2 s. If None, SIGINT and
            SIGTERM are caught here, which only the main thread may do.

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
    nodes: list[RunnableNode] = []
    exit_code = 0
    try:
        if not stop():
            created = create()
            nodes.extend(created if isinstance(created, Sequence) else [created])
            _spin(nodes, stop)
    except (ExternalShutdownException, ShutdownException):
        pass  # someone shut the context down: a clean end
    except (TsobsError, NameValidationException) as error:
        exit_code = _report(str(error))
    except BaseException:
        exit_code = 1
        raise
    finally:
        exit_code = _tear_down(nodes, exit_code)
    return exit_code


def _spin(nodes: Sequence[RunnableNode], stop: Callable[[], bool]) -> None:
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    # What lives until the end need not be looked through again and again.
    gc.collect()
    gc.freeze()
    try:
        while rclpy.ok() and not stop() and not any(_finished(node) for node in nodes):
            # Anew each time: nodes make and drop their tickers as they are configured.
            tickers = [t for node in nodes if (t := getattr(node, "ticker", None)) is not None]
            if tickers and all(ticker.may_be_taken_over for ticker in tickers):
                _tick_for_a_while(tickers, stop)
                _run_what_is_ready(executor)
            else:
                for ticker in tickers:
                    ticker.give_back()
                executor.spin_once(timeout_sec=_SPIN_TIMEOUT)
    finally:
        for node in nodes:
            executor.remove_node(node)
        executor.shutdown()


def _run_what_is_ready(executor: SingleThreadedExecutor) -> None:
    """Run all callbacks that are ready now; `spin_once` would run one in every second call."""
    try:
        while True:
            callback, _, _ = executor.wait_for_ready_callbacks(timeout_sec=0.0)
            callback()
            if (error := callback.exception()) is not None:
                raise error
    except TimeoutException:
        pass  # all have run


def _tick_for_a_while(tickers: Sequence[Ticking], stop: Callable[[], bool]) -> None:
    """Tick and sleep until the executor ought to be looked after."""
    until = time.monotonic() + _LOOK_AFTER_PERIOD
    for ticker in tickers:
        ticker.take_over()
    while True:
        wait = min(ticker.run_if_due() for ticker in tickers) * 1e-9
        left = until - time.monotonic()
        if left <= 0.0 or stop():
            return
        # One that also waits for messages can do so only where it is alone.
        (tickers[0].rest if len(tickers) == 1 else time.sleep)(min(wait, left))


def _finished(node: RunnableNode) -> bool:
    return bool(getattr(node, "finished", False))


def _tear_down(nodes: Sequence[RunnableNode], exit_code: int) -> int:
    """Close all nodes, then destroy them, whatever fails on the way."""
    for node in nodes:
        if (close := getattr(node, "close", None)) is not None:
            exit_code = _attempt(close, exit_code)
    with exit_guard(_TEARDOWN_TIMEOUT, exit_code):
        for node in nodes:
            exit_code = _attempt(node.destroy_node, exit_code)
        rclpy.try_shutdown()
    return exit_code


def _attempt(step: Callable[[], None], exit_code: int) -> int:
    """Take a step of the teardown, and return the exit code with it: no later step may be lost."""
    try:
        step()
    except TsobsError as error:
        return _report(str(error))
    except Exception:  # a bug
        traceback.print_exc()
        return 1
    return exit_code


def _without_source_lines(message: str) -> str:
    """Drop the "at …/parse.c:391" that rcl appends, and explain its least obvious refusal."""
    hint = ""
    if "should be of same type" in message:
        hint = "; write every number of the list with a decimal point"
    return re.sub(r",? at \S+:\d+", "", message) + hint


def _report(message: str) -> int:
    print(f"error: {printable(' '.join(message.split()))}", file=sys.stderr, flush=True)
    return 1
