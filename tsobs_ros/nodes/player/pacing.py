# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The start of a player and its ticks, which come when the work itself is next due.

`runtime.run` takes these ticks over as it does a `Ticker`'s: it sleeps until the next one, which is
some 60 µs late, while an rclpy timer costs 200 µs of executor each.
"""

from collections.abc import Callable

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

# Longest wait, after which a change is noticed without a call of `wake` [ns].
_MAX_WAIT = 50_000_000
# A best-effort subscriber receives nothing before it has matched the publisher too, and others may
# be discovered at the same time [ns].
_SETTLING = 200_000_000


class Pacer:
    """Calls back when the callback asked for it, from `start` until `stop`.

    Args:
        node: The node it belongs to; its clock does not matter, time is steady.
        callback: What to do; returns how long to wait before it is called again [ns].
    """

    def __init__(self, node: Node, callback: Callable[[], int]) -> None:
        self._callback = callback
        self._running = False
        self._taken_over = False
        self._timer = node.create_timer(
            _MAX_WAIT * 1e-9,
            self._tick,
            clock=Clock(clock_type=ClockType.STEADY_TIME),
            autostart=False,
        )
        self._timer.cancel()

    @property
    def may_be_taken_over(self) -> bool:
        """Whether there are ticks."""
        return self._running

    def start(self) -> None:
        """Start to tick, at once."""
        self._running = True
        self.wake()

    def stop(self) -> None:
        """Stop ticking, until the next `start`."""
        self._running = self._taken_over = False
        self._timer.cancel()

    def wake(self) -> None:
        """Tick at once, as the next due time has changed."""
        if self._running and not self._taken_over:
            self._schedule(0)

    def take_over(self) -> None:
        """Stop the timer; from now on `run_if_due` ticks."""
        if not self._taken_over:
            self._taken_over = True
            self._timer.cancel()

    def give_back(self) -> None:
        """Let the timer tick again."""
        if self._taken_over:
            self._taken_over = False
            self.wake()

    def run_if_due(self) -> int:
        """Do what is due, and return the time until more is [ns]."""
        return self._callback()

    def _tick(self) -> None:
        wait = self._callback()
        if self._running and not self._taken_over:
            self._schedule(wait)

    def _schedule(self, wait: int) -> None:
        self._timer.timer_period_ns = min(max(wait, 1), _MAX_WAIT)
        self._timer.reset()


class SubscriberGate:
    """Opens once enough subscribers are there and no more come, or after a timeout.

    Args:
        wanted: Subscribers to wait for; 0 opens at once.
        timeout: Longest wait [s]; 0: no limit.
        now: Steady time at the start [ns].

    Attributes:
        is_open: Whether it has opened; it stays open.
        timed_out: Whether it has opened without enough subscribers.
    """

    def __init__(self, wanted: int, timeout: float, now: int) -> None:
        self.is_open = wanted == 0
        self.timed_out = False
        self._wanted = wanted
        self._deadline = now + round(timeout * 1e9) if timeout else None
        self._there, self._since = 0, now

    def look(self, there: int, now: int) -> None:
        """Take in the number of subscribers at a steady time [ns]."""
        if there != self._there:
            self._there, self._since = there, now
        enough = there >= self._wanted
        over = self._deadline is not None and now >= self._deadline
        self.timed_out = over and not enough
        self.is_open = over or (enough and now - self._since >= _SETTLING)
