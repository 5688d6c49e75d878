# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a tracker keeps of the recent past, to rewind to: bounded in time and in number."""

from bisect import bisect_left, bisect_right
from typing import Any, NamedTuple

from tsobs_ros.estimation.records import Measurement


class Step(NamedTuple):
    """A measurement, the state after it, and what happened up to it since the last reset.

    The counts are kept with the steps, so that a rewind takes them back too.
    """

    measurement: Measurement
    state: Any
    gated: int
    restarts: int
    failures: int


class History:
    """Steps in the order of their stamps, and the one before them to begin a rewind from.

    Args:
        span: How far it reaches back from its newest step [ns].
        most: How many steps it holds at most; a burst of stamps must not take memory without
            bound, nor a rewind time.

    Attributes:
        last: The newest step, None before the first.
    """

    def __init__(self, span: int, most: int) -> None:
        self._span, self._most = span, most
        self.last: Step | None = None
        self._base: Step | None = None
        self._steps: list[Step] = []
        self._stamps: list[int] = []

    def __len__(self) -> int:
        return len(self._steps)

    def append(self, step: Step) -> None:
        """Add a step that is newer than all others."""
        self.last = step
        self._steps.append(step)
        self._stamps.append(step.measurement.stamp)

    def until(self, stamp: int) -> Step | None:
        """Return the newest step at a stamp [ns] or before it."""
        last = self.last
        if last is None or last.measurement.stamp <= stamp:
            return last
        place = bisect_right(self._stamps, stamp) - 1
        if place >= 0:
            return self._steps[place]
        base = self._base
        return base if base is not None and base.measurement.stamp <= stamp else None

    def reaches(self, stamp: int) -> bool:
        """Return whether a measurement with a stamp [ns] can still be put in its place."""
        if self._base is not None and stamp <= self._base.measurement.stamp:
            return False
        return self.last is None or stamp >= self.last.measurement.stamp - self._span

    def holds(self, stamp: int) -> bool:
        """Return whether there is a step with exactly this stamp [ns]."""
        place = bisect_left(self._stamps, stamp)
        return place < len(self._stamps) and self._stamps[place] == stamp

    def rewind(self, stamp: int) -> list[Measurement]:
        """Take out the steps after a stamp [ns]; return their measurements."""
        place = bisect_left(self._stamps, stamp)
        later = [step.measurement for step in self._steps[place:]]
        del self._stamps[place:], self._steps[place:]
        self.last = self._steps[-1] if self._steps else self._base
        return later

    def trim(self) -> int:
        """Forget what is out of reach; return how many were it for their number alone."""
        oldest = self._stamps[-1] - self._span
        if self._stamps[0] >= oldest and len(self._steps) <= self._most:
            return 0
        expired = bisect_left(self._stamps, oldest)
        forgotten = max(0, len(self._steps) - expired - self._most)
        keep_from = expired + forgotten
        self._base = self._steps[keep_from - 1]
        del self._stamps[:keep_from], self._steps[:keep_from]
        return forgotten
