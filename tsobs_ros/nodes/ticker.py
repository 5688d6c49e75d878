# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A fixed-rate tick that costs little in `runtime.run`, and works in every executor.

An rclpy timer costs two rebuilt wait sets a tick, which at 200 Hz is more than all that an observer
does. So `runtime.run` takes a node's ticks over: it sleeps until the next one on the monotonic
clock, and serves everything else in between. In another executor, and under simulated time, which
passes only in an executor, the tick is an ordinary timer.
"""

import time
from collections.abc import Callable
from typing import Protocol

from rclpy.clock import Clock
from rclpy.node import Node


class Ticking(Protocol):
    """The ticks of a node, as `runtime.run` makes them in place of an executor."""

    @property
    def may_be_taken_over(self) -> bool:
        """Whether there are ticks, and a sleep can make them."""

    def take_over(self) -> None:
        """Stop the executor's ticks: the caller now calls `run_if_due`."""

    def give_back(self) -> None:
        """Let the executor tick again."""

    def run_if_due(self) -> int:
        """Tick if it is time, and return the time until the next tick [ns]."""


class Ticker:
    """Calls back at a fixed rate on the node's clock, from `start` until `stop`.

    Args:
        node: The node whose clock decides.
        period: Time between ticks [s].
        callback: What to do.
        executor_clock: The clock of an executor's ticks, if not the node's, which stands still
            while simulated time does.
    """

    def __init__(
        self,
        node: Node,
        period: float,
        callback: Callable[[], None],
        executor_clock: Clock | None = None,
    ) -> None:
        self._clock = node.get_clock()
        self._callback = callback
        self._period_ns = round(period * 1e9)
        self._running = False
        self._due: int | None = None
        self._timer = node.create_timer(period, self._tick, clock=executor_clock, autostart=False)

    @property
    def may_be_taken_over(self) -> bool:
        """Whether there are ticks, and they follow the wall clock, so that a sleep makes them."""
        return self._running and not self._clock.ros_time_is_active

    def start(self) -> None:
        """Start to tick."""
        self._running = True
        self._timer.reset()

    def stop(self) -> None:
        """Stop ticking, until the next `start`."""
        self._running, self._due = False, None
        self._timer.cancel()

    def skip_next(self) -> None:
        """Leave an executor's next tick out, as its work has just been done."""
        self._timer.timer_period_ns = 2 * self._period_ns
        self._timer.reset()

    def take_over(self) -> None:
        """Stop the timer; from now on `run_if_due` ticks."""
        if self._due is None:
            self._timer.cancel()
            self._due = time.monotonic_ns()

    def give_back(self) -> None:
        """Let the timer tick again."""
        if self._due is not None:
            self._due = None
            self._timer.reset()

    def run_if_due(self) -> int:
        """Tick if it is time, and return the time until the next tick [ns]."""
        now = time.monotonic_ns()
        assert self._due is not None, "ticks were not taken over"
        if now >= self._due:
            self._callback()
            now = time.monotonic_ns()
            if self._due is None:  # the tick was the last one
                return self._period_ns
            # On the grid of the first tick. One that is late by less than a period is made good;
            # what fell out before that, while the process was held up, is gone.
            self._due += self._period_ns * max(1, (now - self._due) // self._period_ns)
        return max(0, self._due - now)

    def _tick(self) -> None:
        if self._timer.timer_period_ns != self._period_ns:  # after a skipped one
            self._timer.timer_period_ns = self._period_ns
            self._timer.reset()
        self._callback()
