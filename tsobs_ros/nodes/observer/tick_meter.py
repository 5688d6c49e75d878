# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How regularly a node ticks, on its clock, how long its work takes, and what that waits for."""

import math
import time

from tsobs_ros.estimation.health import Level, Status

_WORTH_A_WARNING = 0.05
# The clock has jumped when it went on by more than this [ns], so much faster than time passes.
_JUMP = 1_000_000_000
_FASTEST = 100
_ROUNDING = 1e-3


class TickMeter:
    """Measures ticks; `status` reads it out and starts a new interval.

    Attributes:
        missed: Ticks that fell out since the start, because one came a period late or more.
        jumps: Jumps of the clock ahead, which make no ticks fall out.
    """

    def __init__(self, rate: float) -> None:
        self._period_ns = 1e9 / rate
        self._rate = rate
        self.missed = 0
        self.jumps = 0
        self._latest: int | None = None
        self._latest_was_tick = True
        self._late = 0.0
        self._began = 0
        self._work_began: int | None = None
        self._periods: list[int] = []
        self._durations: list[int] = []
        self._latencies: list[int] = []
        self._missed_before = 0

    def begin(self, now: int, *, tick: bool = True) -> None:
        """Note that work begins.

        Args:
            now: Time on the node's clock [ns].
            tick: Whether it is a tick's; ticks are missed only between two of them.
        """
        steady = time.monotonic_ns()
        if self._latest is not None:
            period = now - self._latest
            if period > _JUMP and period > _FASTEST * (steady - self._began):
                self.jumps += 1
            else:
                self._periods.append(period)
                if tick and self._latest_was_tick:
                    self._note_lateness(period)
        self._latest, self._latest_was_tick = now, tick
        self._began = self._work_began = steady

    def _note_lateness(self, period: int) -> None:
        """Count whole periods that fell out; what a late tick lacks, the next one may make good."""
        self._late = max(0.0, self._late + period / self._period_ns - 1.0)
        missed = int(self._late + _ROUNDING)
        self.missed += missed
        self._late -= missed

    def end(self) -> None:
        """Note that the work is done."""
        if self._work_began is not None:
            self._durations.append(time.monotonic_ns() - self._work_began)
            self._work_began = None

    def answered(self, latency: int) -> None:
        """Note how long after its arrival the first output that uses an input was sent [ns]."""
        self._latencies.append(latency)

    def restart(self) -> None:
        """Forget when the last tick was: the clock jumped, or a pause was wanted."""
        self._latest = None
        self._late = 0.0

    def status(self) -> Status:
        """Return achieved rate, missed ticks, tick time and latency since the last call."""
        durations, self._durations = sorted(self._durations), []
        periods, self._periods = self._periods, []
        latencies, self._latencies = sorted(self._latencies), []
        missed, self._missed_before = self.missed - self._missed_before, self.missed
        values = {"wanted rate [Hz]": f"{self._rate:g}", "missed ticks": str(self.missed)}
        if self.jumps:
            values["clock jumps ahead"] = str(self.jumps)
        if not durations:
            return Status("timing", Level.STALE, "no ticks", values)
        if sum(periods) > 0:
            values["achieved rate [Hz]"] = f"{len(periods) * 1e9 / sum(periods):.1f}"
        for name, times in (("tick time", durations), ("latency", latencies)):
            if times:
                values[f"{name} p50 [ms]"] = f"{_percentile(times, 0.50) * 1e-6:.3f}"
                values[f"{name} p99 [ms]"] = f"{_percentile(times, 0.99) * 1e-6:.3f}"
        late = missed > _WORTH_A_WARNING * (len(durations) + missed)
        level = Level.WARN if late else Level.OK
        return Status("timing", level, f"missed {missed} ticks" if missed else "on time", values)


def _percentile(ordered: list[int], fraction: float) -> int:
    return ordered[min(len(ordered) - 1, math.ceil(fraction * len(ordered)) - 1)]
