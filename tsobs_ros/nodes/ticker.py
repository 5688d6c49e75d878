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

from rclpy.node import Node


class Ticker:
    """Calls back at a fixed rate on the node's clock.

    Args:
        node: The node whose clock decides.
        period: Time between ticks [s].
        callback: What to do.
    """

    def __init__(self, node: Node, period: float, callback: Callable[[], None]) -> None:
        self._clock = node.get_clock()
        self._callback = callback
        self._period_ns = round(period * 1e9)
        self._due: int | None = None
        self._timer = node.create_timer(period, callback)

    @property
    def may_be_taken_over(self) -> bool:
        """Whether the ticks follow the wall clock, so that a sleep can make them."""
        return not self._clock.ros_time_is_active

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
        """Tick if it is time, and return how long the next tick is away [ns]."""
        now = time.monotonic_ns()
        assert self._due is not None, "ticks were not taken over"
        if now >= self._due:
            self._callback()
            now = time.monotonic_ns()
            # On the grid of the first tick; what fell out while the process was held up is gone.
            self._due += self._period_ns * max(1, -((self._due - now) // self._period_ns))
        return max(0, self._due - now)
