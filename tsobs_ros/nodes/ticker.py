# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Ticks that cost little in `runtime.run`, and work in every executor.

An rclpy timer costs two rebuilt wait sets a tick, which at 200 Hz is more than all that an observer
does. So `runtime.run` takes a node's ticks over: it sleeps until the next one on the monotonic
clock, and serves everything else in between. In another executor, and under simulated time, which
passes only in an executor, the tick is an ordinary timer.
"""

import time
from collections.abc import Callable

from rclpy.clock import Clock
from rclpy.node import Node


class Ticker:
    """Calls back at a fixed rate or when the callback asks for it, from `start` until `stop`.

    Args:
        node: The node. Its ticks are an executor's as long as it follows simulated time.
        period: Time between ticks [s], the longest if the callback decides.
        callback: What to do; returns the time until the next tick [ns], or None for the period.
        executor_clock: The clock of an executor's ticks, if not the node's, which stands still
            while simulated time does.

    Attributes:
        running: Whether there are ticks.
    """

    def __init__(
        self,
        node: Node,
        period: float,
        callback: Callable[[], int | None],
        executor_clock: Clock | None = None,
    ) -> None:
        self.running = False
        self._clock = node.get_clock()
        self._callback = callback
        self._period_ns = self._scheduled = round(period * 1e9)
        self._due: int | None = None
        self._timer = node.create_timer(period, self._tick, clock=executor_clock, autostart=False)

    @property
    def may_be_taken_over(self) -> bool:
        """Whether there are ticks, and a sleep can make them."""
        return self.running and not self._clock.ros_time_is_active

    def start(self) -> None:
        """Start to tick."""
        self.running = True
        if self._due is None:
            self._schedule(self._period_ns)

    def stop(self) -> None:
        """Stop ticking, until the next `start`."""
        self.running, self._due = False, None
        self._timer.cancel()

    def skip_next(self) -> None:
        """Leave an executor's next tick out, as its work has just been done."""
        self._schedule(2 * self._period_ns)

    def take_over(self) -> None:
        """Stop the executor's ticks: the caller now calls `run_if_due`."""
        if self._due is None:
            self._timer.cancel()
            self._due = time.monotonic_ns()

    def give_back(self) -> None:
        """Let the executor tick again."""
        if self._due is not None:
            self._due = None
            self._schedule(self._period_ns)

    def run_if_due(self) -> int:
        """Tick if it is time, and return the time until the next tick [ns]; stopped, a period."""
        now = time.monotonic_ns()
        if self._due is not None and now >= self._due:
            wait = self._callback()
            now = time.monotonic_ns()
            if self._due is not None and wait is not None:
                self._due = now + min(wait, self._period_ns)
            elif self._due is not None:
                # On the grid of the first tick. One that is late by less than a period is made
                # good; what fell out before that, while the process was held up, is gone.
                self._due += self._period_ns * max(1, (now - self._due) // self._period_ns)
        return self._period_ns if self._due is None else max(0, self._due - now)

    def _tick(self) -> None:
        wait = self._callback()
        if self.running and (wait is not None or self._scheduled != self._period_ns):
            self._schedule(self._period_ns if wait is None else min(wait, self._period_ns))

    def _schedule(self, wait: int) -> None:
        self._timer.timer_period_ns = self._scheduled = max(wait, 1)
        self._timer.reset()
