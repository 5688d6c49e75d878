# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Counting the messages of a topic that never arrived, from gaps in its publishers' numbering."""

from bisect import bisect_right

# Of one publisher: where there are more, the oldest gaps are taken to stay.
_MAX_OPEN_GAPS = 1000
# Of one topic: where there are more, those that have fallen silent are forgotten.
_MAX_PUBLISHERS = 1000


class LossCounter:
    """Tells new messages from repeated ones, and counts those that are missing.

    Each publisher numbers its messages one by one, and a message comes with its number and its
    publisher. What is missing is therefore known exactly: the numbers from the first to the last
    that arrived from a publisher, less those that arrived. They may come in any order and several
    times, as they do by way of several subscriptions; every message is new once, and a late one is
    no longer missing.

    What a publisher sent before the first message that arrived, or after the last, leaves no gap.

    Attributes:
        complete: Whether every message had a number, so that `lost` is exact.
    """

    def __init__(self) -> None:
        self.complete = True
        self._publishers: dict[bytes, _Numbering] = {}
        self._lost_of_forgotten = 0
        self._publishers_at_review = _MAX_PUBLISHERS

    @property
    def lost(self) -> int:
        """The number of messages that are missing."""
        return self._lost_of_forgotten + sum(self.lost_by_publisher.values())

    @property
    def lost_by_publisher(self) -> dict[bytes, int]:
        """The number of missing messages of each publisher; without those long silent."""
        return {publisher: numbers.lost for publisher, numbers in self._publishers.items()}

    def is_new(self, publisher: bytes, number: int | None) -> bool:
        """Take a message into account, and return whether it had not arrived before.

        Args:
            publisher: Whose it is; any bytes that identify the publisher for ever.
            number: Its publisher's number for it; None where the middleware gives none, in which
                case every message is new.
        """
        numbering = self._publishers.get(publisher)
        if numbering is not None and number == numbering.next:  # as nearly all are
            numbering.next += 1
            numbering.arrived += 1
            return True
        if number is None:
            self.complete = False
            return True
        if numbering is None:
            self._publishers[publisher] = _Numbering(number)
            self._forget_the_silent()
            return True
        return numbering.take(number)

    def _forget_the_silent(self) -> None:
        if len(self._publishers) <= self._publishers_at_review:
            return
        for publisher, numbering in list(self._publishers.items()):
            if numbering.arrived == numbering.arrived_at_review:
                self._lost_of_forgotten += numbering.lost
                del self._publishers[publisher]
            numbering.arrived_at_review = numbering.arrived
        self._publishers_at_review = len(self._publishers) + _MAX_PUBLISHERS


class _Numbering:
    """Which numbers of one publisher arrived: all from `first` to before `next` but the gaps."""

    __slots__ = ("arrived", "arrived_at_review", "ends", "first", "next", "starts")

    def __init__(self, number: int) -> None:
        self.first = number
        self.next = number + 1
        self.arrived = 1
        self.arrived_at_review = 0
        # The gaps' first numbers, and the numbers after their last ones; ascending.
        self.starts: list[int] = []
        self.ends: list[int] = []

    @property
    def lost(self) -> int:
        return self.next - self.first - self.arrived

    def take(self, number: int) -> bool:
        """Take a number into account; return whether it is new."""
        if number >= self.next:
            self._add_gap(len(self.starts), self.next, number)
            self.next = number + 1
        elif number < self.first:
            self._add_gap(0, number + 1, self.first)
            self.first = number
        elif not self._fill(number):
            return False
        self.arrived += 1
        return True

    def _add_gap(self, index: int, start: int, end: int) -> None:
        if start < end:
            self.starts.insert(index, start)
            self.ends.insert(index, end)
        if len(self.starts) > _MAX_OPEN_GAPS:
            del self.starts[0], self.ends[0]

    def _fill(self, number: int) -> bool:
        index = bisect_right(self.starts, number) - 1
        if index < 0 or number >= self.ends[index]:
            return False
        start, end = self.starts.pop(index), self.ends.pop(index)
        self._add_gap(index, number + 1, end)
        self._add_gap(index, start, number)
        return True
