# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Time that can be paced, paused and held back, for playing a bag and for simulating a plant."""

NEVER = 2**62
"""The deadline of an event that does not come [ns]."""


class Timeline:
    """Bag time as a function of steady time, in ns: a line through an anchor, or a halt."""

    def __init__(self, time: int, rate: float = 1.0) -> None:
        self.paused = True
        self._time, self._steady = time, 0
        self._rate = rate.as_integer_ratio()

    def at(self, steady: int) -> int:
        """Return the bag time at a steady time that is not before the anchor."""
        if self.paused or steady <= self._steady:
            return self._time
        numerator, denominator = self._rate
        return self._time + (steady - self._steady) * numerator // denominator

    def due(self, time: int) -> int:
        """Return the first steady time at which a running timeline has reached a bag time."""
        if self.paused:
            return NEVER
        numerator, denominator = self._rate
        return self._steady - (self._time - time) * denominator // numerator

    def anchor(self, time: int, steady: int, rate: float | None = None) -> None:
        """Set the bag time at a steady time, and the rate from there on if one is given."""
        self._time, self._steady = time, steady
        if rate is not None:
            self._rate = rate.as_integer_ratio()

    def shift(self, amount: int) -> None:
        """Delay everything by an amount of steady time [ns]."""
        self._steady += amount


class Ticks:
    """The deadlines k/rate after a start, each rounded down to a nanosecond on its own.

    Attributes:
        due: The next deadline, in steady time [ns]; NEVER at a rate of 0.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate.as_integer_ratio()
        self.due = NEVER

    def start(self, steady: int) -> None:
        """Make a deadline due now, and further ones at the rate."""
        self._origin, self._index = steady, 0
        if self._rate[0]:
            self.due = steady

    def take(self) -> int:
        """Return the deadline and go on to the next one."""
        due = self.due
        self._index += 1
        numerator, denominator = self._rate
        self.due = self._origin + self._index * 1_000_000_000 * denominator // numerator
        return due

    def shift(self, amount: int) -> None:
        """Delay everything by an amount of steady time [ns]."""
        if self.due != NEVER:
            self._origin += amount
            self.due += amount
