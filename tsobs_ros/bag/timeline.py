# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Time that is paced, paused and held back: of a bag being played, and of a simulated plant."""

import math
from fractions import Fraction

NEVER = 2**62
"""The deadline of what does not come [ns]."""


class Timeline:
    """Bag time as a function of steady time: a line through an anchor, or a halt, in ns."""

    def __init__(self, time: int, rate: float = 1.0) -> None:
        self.paused = True
        self._time, self._steady = time, 0
        self._rate = Fraction(rate)

    def at(self, steady: int) -> int:
        """Return the bag time at a steady time that is not before the anchor."""
        if self.paused or steady <= self._steady:
            return self._time
        return self._time + math.floor((steady - self._steady) * self._rate)

    def due(self, time: int) -> int:
        """Return the first steady time at which a running timeline has reached a bag time."""
        if self.paused:
            return NEVER
        return self._steady + math.ceil((time - self._time) / self._rate)

    def anchor(self, time: int, steady: int, rate: float | None = None) -> None:
        """Be at a bag time at a steady time, and change the rate from there on if one is given."""
        self._time, self._steady = time, steady
        if rate is not None:
            self._rate = Fraction(rate)

    def shift(self, amount: int) -> None:
        """Let everything be later by an amount of steady time [ns]."""
        self._steady += amount


class Ticks:
    """The deadlines k/rate after a start, each rounded to a nanosecond by itself.

    Attributes:
        due: The next one, in steady time [ns]; NEVER at a rate of 0.
    """

    def __init__(self, rate: float) -> None:
        self._rate = Fraction(rate)
        self.due = NEVER

    def start(self, steady: int) -> None:
        """Be due now, and from now on at the rate."""
        self._origin, self._index = steady, 0
        if self._rate:
            self.due = steady

    def take(self) -> int:
        """Return the deadline and go on to the next one."""
        due = self.due
        self._index += 1
        self.due = self._origin + math.floor(self._index * 1_000_000_000 / self._rate)
        return due

    def shift(self, amount: int) -> None:
        """Let everything be later by an amount of steady time [ns]."""
        if self.due != NEVER:
            self._origin += amount
            self.due += amount
