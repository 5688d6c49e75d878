# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Compiling before a node works: told in the log, and given up at a signal."""

import time
from collections.abc import Callable
from threading import Thread

from rclpy.node import Node

from tsobs_ros.compiled import compilations
from tsobs_ros.errors import InterruptionError
from tsobs_ros.nodes.runtime import COMPILER
from tsobs_ros.stop import signal_came

_POLL = 0.05


def compile_ahead(node: Node, work: Callable[[], object]) -> None:
    """Call compiled functions for the first time, so that none is compiled when it is needed.

    The compiler works in a thread, since nothing could interrupt it here for seconds. A signal
    leaves it behind, and ends the process without waiting for it.

    Args:
        node: Logs how long it took, unless all was in the cache.
        work: Calls each function with each combination of types.

    Raises:
        InterruptionError: A signal came.
    """
    failed: list[BaseException] = []

    def call() -> None:
        try:
            work()
        except BaseException as error:
            failed.append(error)

    began, before, told = time.monotonic(), compilations(), False
    thread = Thread(target=call, name=COMPILER, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(_POLL)
        if signal_came():
            raise InterruptionError("interrupted while compiling")
        if not told and compilations() > before:
            told = True
            node.get_logger().info("compiling, which later starts need not do")
    if failed:
        raise failed[0]
    if told:
        node.get_logger().info(f"compiled in {time.monotonic() - began:.1f} s")
