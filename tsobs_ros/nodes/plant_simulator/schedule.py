# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The times of samples: exactly periodic stamps, however late the process wakes up."""

from fractions import Fraction

from tsobs_ros.estimation.records import NANOSECONDS


class SampleSchedule:
    """The stamps t₀ + k/rate, each once, in order, when they are due; rate in Hz.

    Each k/rate is rounded to a nanosecond alone, so no error adds up.
    """

    def __init__(self, rate: float) -> None:
        self._period = NANOSECONDS / Fraction(rate)
        self.start(0)

    def start(self, now: int) -> None:
        """Make `now` [ns] the stamp of the next sample, and t₀."""
        self._anchor = now
        self._index = 0
        self.next_stamp = now

    def lag(self, now: int) -> int:
        """Return by how much [ns] the next sample is late; negative if it is not due yet."""
        return now - self.next_stamp

    def take(self, now: int) -> int | None:
        """Return the stamp [ns] of the next sample if it is due, and go on to the one after."""
        if now < self.next_stamp:
            return None
        stamp = self.next_stamp
        self._index += 1
        self.next_stamp = self._anchor + round(self._index * self._period)
        return stamp


class ScaledTime:
    """A time that passes by a factor faster than a steady one, and can be held back."""

    def __init__(self, factor: float) -> None:
        self._factor = factor
        self.start(0, 0)

    def start(self, steady: int, time: int) -> None:
        """Begin at `time` [ns] when the steady time is `steady` [ns]."""
        self._steady, self._time = steady, time

    def at(self, steady: int) -> int:
        """Return the time [ns] at a steady time [ns]."""
        return self._time + int((steady - self._steady) * self._factor)

    def hold_back(self, amount: int) -> None:
        """Turn the time back by an amount [ns] that was lost."""
        self._time -= amount
