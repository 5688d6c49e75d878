# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How regularly a node's timer fires and how long its work takes, over the last interval."""

import math
import time

from tsobs_ros.estimation.health import Level, Status

_WORTH_A_WARNING = 0.05


class TickMeter:
    """Measures ticks on the monotonic clock; `status` reads it out and starts a new interval.

    Attributes:
        missed: Ticks that fell out since the start, because one came a period late or more.
    """

    def __init__(self, rate: float) -> None:
        self._period_ns = 1e9 / rate
        self._rate = rate
        self.missed = 0
        self._begun: int | None = None
        self._first: int | None = None
        self._durations: list[int] = []
        self._missed_before = 0

    def begin(self) -> None:
        """Note that a tick begins."""
        now = time.monotonic_ns()
        if self._begun is not None:
            self.missed += max(0, round((now - self._begun) / self._period_ns) - 1)
        if self._first is None:
            self._first = now
        self._begun = now

    def end(self) -> None:
        """Note that the tick's work is done."""
        if self._begun is not None:
            self._durations.append(time.monotonic_ns() - self._begun)

    def pause(self) -> None:
        """Forget when the last tick was, so that a wanted pause does not count as missed."""
        self._begun = None

    def status(self) -> Status:
        """Return achieved rate, missed ticks and tick time of the interval, and begin a new one."""
        durations, self._durations = sorted(self._durations), []
        missed, self._missed_before = self.missed - self._missed_before, self.missed
        span = 0 if self._first is None else time.monotonic_ns() - self._first
        self._first = None
        values = {"wanted rate [Hz]": f"{self._rate:g}", "missed ticks": str(self.missed)}
        if not durations or not span:
            return Status("timing", Level.STALE, "no ticks", values)
        values["achieved rate [Hz]"] = f"{len(durations) * 1e9 / span:.1f}"
        values["tick time p50 [ms]"] = f"{_percentile(durations, 0.50) * 1e-6:.3f}"
        values["tick time p99 [ms]"] = f"{_percentile(durations, 0.99) * 1e-6:.3f}"
        late = missed > _WORTH_A_WARNING * (len(durations) + missed)
        level = Level.WARN if late else Level.OK
        return Status("timing", level, f"missed {missed} ticks" if missed else "on time", values)


def _percentile(ordered: list[int], fraction: float) -> int:
    return ordered[min(len(ordered) - 1, math.ceil(fraction * len(ordered)) - 1)]
