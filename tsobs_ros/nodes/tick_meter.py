# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How regularly a node's timer fires, on the node's clock, and how long its work takes."""

import math
import time

from tsobs_ros.estimation.health import Level, Status

_WORTH_A_WARNING = 0.05


class TickMeter:
    """Measures ticks; `status` reads it out and starts a new interval.

    Attributes:
        missed: Ticks that fell out since the start, because one came a period late or more.
    """

    def __init__(self, rate: float) -> None:
        self._period_ns = 1e9 / rate
        self._rate = rate
        self.missed = 0
        self._latest: int | None = None
        self._work_began: int | None = None
        self._periods: list[int] = []
        self._durations: list[int] = []
        self._missed_before = 0

    def begin(self, now: int) -> None:
        """Note that a tick begins at `now` on the node's clock [ns]."""
        self._work_began = time.monotonic_ns()
        if self._latest is not None:
            period = now - self._latest
            self._periods.append(period)
            self.missed += max(0, round(period / self._period_ns) - 1)
        self._latest = now

    def end(self) -> None:
        """Note that the tick's work is done."""
        if self._work_began is not None:
            self._durations.append(time.monotonic_ns() - self._work_began)
            self._work_began = None

    def restart(self) -> None:
        """Forget when the last tick was: the clock jumped, or a pause was wanted."""
        self._latest = None

    def status(self) -> Status:
        """Return achieved rate, missed ticks and tick time of the interval, and begin a new one."""
        durations, self._durations = sorted(self._durations), []
        periods, self._periods = self._periods, []
        missed, self._missed_before = self.missed - self._missed_before, self.missed
        values = {"wanted rate [Hz]": f"{self._rate:g}", "missed ticks": str(self.missed)}
        if not durations:
            return Status("timing", Level.STALE, "no ticks", values)
        if sum(periods) > 0:
            values["achieved rate [Hz]"] = f"{len(periods) * 1e9 / sum(periods):.1f}"
        values["tick time p50 [ms]"] = f"{_percentile(durations, 0.50) * 1e-6:.3f}"
        values["tick time p99 [ms]"] = f"{_percentile(durations, 0.99) * 1e-6:.3f}"
        late = missed > _WORTH_A_WARNING * (len(durations) + missed)
        level = Level.WARN if late else Level.OK
        return Status("timing", level, f"missed {missed} ticks" if missed else "on time", values)


def _percentile(ordered: list[int], fraction: float) -> int:
    return ordered[min(len(ordered) - 1, math.ceil(fraction * len(ordered)) - 1)]
