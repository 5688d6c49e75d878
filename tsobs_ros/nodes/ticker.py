# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A fixed-rate tick that costs little where the runtime spins the node, and works everywhere.

An rclpy timer costs two rebuilt wait sets a tick, which at 200 Hz is more than all that an observer
does. So `runtime.run` takes a node's ticks over: it sleeps until the next one on the monotonic
clock, and looks after services and parameters in between. In an executor of somebody else's, and
under simulated time, which only an executor makes pass, the tick is an ordinary timer.
"""

import time
from collections.abc import Callable
from typing import Protocol

from rclpy.clock import Clock
from rclpy.node import Node

from tsobs_ros.nodes.draining import DrainedSubscription


class Ticking(Protocol):
    """What `runtime.run` needs of ticks to make them in an executor's place."""

    @property
    def may_be_taken_over(self) -> bool:
        """Whether there are ticks, and a sleep can make them."""

    def take_over(self) -> None:
        """Leave the ticks to whoever calls `run_if_due`."""

    def give_back(self) -> None:
        """Leave the ticks to the executor again."""

    def run_if_due(self) -> int:
        """Tick if it is time, and return how long the next tick is away [ns]."""

    def rest(self, seconds: float) -> None:
        """Sleep so long, or less."""


class Ticker:
    """Calls back at a fixed rate on the node's clock, from `start` until `stop`.

    Args:
        node: The node whose clock decides.
        period: Time between ticks [s].
        callback: What to do.
        arrivals: A subscription with `on_arrival`, which is served between the ticks too.
        executor_clock: What an executor's ticks follow, if not the node's clock, which stands
            still while simulated time does.
    """

    def __init__(
        self,
        node: Node,
        period: float,
        callback: Callable[[], None],
        arrivals: DrainedSubscription | None = None,
        executor_clock: Clock | None = None,
    ) -> None:
        self._clock = node.get_clock()
        self._callback = callback
        self._arrivals = arrivals
        self._period_ns = round(period * 1e9)
        self._running = False
        self._due: int | None = None
        self._skip = False
        self._timer = node.create_timer(period, self._tick, clock=executor_clock, autostart=False)
        self._wake_executor(False)

    @property
    def may_be_taken_over(self) -> bool:
        """Whether there are ticks, and they follow the wall clock, so that a sleep makes them."""
        return self._running and not self._clock.ros_time_is_active

    def now(self) -> int:
        """Return the time on the node's clock [ns]; where ticks are taken over, at no cost."""
        if self._due is not None:
            return time.time_ns()
        return int(self._clock.now().nanoseconds)

    def start(self) -> None:
        """Begin to tick."""
        self._running = True
        self._wake_executor(True)

    def stop(self) -> None:
        """Stop ticking, until the next `start`."""
        self._running = self._skip = False
        self._due = None
        self._wake_executor(False)

    def skip_next(self) -> None:
        """Leave the next tick out: what it would have done has just been done."""
        if self._due is None:
            self._skip = True
        else:
            past = (time.monotonic_ns() - self._due) // self._period_ns
            self._due += (past + 2) * self._period_ns

    def take_over(self) -> None:
        """Stop the timer; from now on `run_if_due` ticks and `rest` waits."""
        if self._due is None:
            self._wake_executor(False)
            self._due = time.monotonic_ns()

    def give_back(self) -> None:
        """Let the timer tick again."""
        if self._due is not None:
            self._due = None
            self._wake_executor(self._running)

    def run_if_due(self) -> int:
        """Tick if it is time, and return how long the next tick is away [ns]."""
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

    def rest(self, seconds: float) -> None:
        """Sleep, or less if there are arrivals, which are served."""
        if self._arrivals is None:
            time.sleep(seconds)
        else:
            self._arrivals.serve(seconds)

    def _tick(self) -> None:
        """Tick from an executor's timer."""
        if self._skip:
            self._skip = False
        else:
            self._callback()

    def _wake_executor(self, wanted: bool) -> None:
        """Decide whether an executor makes the ticks, and looks for arrivals."""
        if wanted:
            self._timer.reset()
        else:
            self._timer.cancel()
        if self._arrivals is not None:
            self._arrivals.wakes_executor = wanted
