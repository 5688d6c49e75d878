# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The count of a topic's lost messages, from gaps in its publisher's numbering.

The middleware gives the number of a message, but not its publisher. A gap is therefore a loss only
while the topic has one publisher; with several, losses are unknown.
"""

from collections.abc import Callable, Iterable


class LossCounter:
    """Counts the numbers that are missing between two that arrived from the same publisher.

    What a publisher sent before its first or after its last message that arrived leaves no gap.

    >>> counter = LossCounter()
    >>> counter.add([7, 8, 11], lambda: frozenset({b"plant"}))
    >>> counter.lost, counter.is_exact
    (2, True)

    Attributes:
        lost: The number of messages known to be lost.
        is_exact: False once `lost` may be too small: the topic has had several publishers at a
            time, or the middleware does not number messages.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.is_exact = True
        # Numbers begin at 1, so the first one is never the next one.
        self._next = 0
        self._publishers: frozenset[bytes] = frozenset()
        self._gone = False

    def see(self, publishers: frozenset[bytes]) -> None:
        """Take in who publishes the topic now; its queue has been emptied since the last call."""
        if len(publishers) > 1:
            self.is_exact = False
        gone = not publishers & self._publishers
        if gone and self._gone:
            self._next = 0  # all that it sent has been counted
        self._gone = gone

    def add(
        self, numbers: Iterable[int | None], current_publishers: Callable[[], frozenset[bytes]]
    ) -> None:
        """Take in the numbers of new messages, in order of arrival.

        Args:
            numbers: Each publisher's count of its messages, from 1; None from a middleware that
                does not number them.
            current_publishers: Returns who publishes the topic now; called only if a number is
                not the next one.
        """
        publishers: frozenset[bytes] | None = None
        for number in numbers:
            if number == self._next:
                self._next += 1
            elif number is None:
                self.is_exact = False
            else:
                if publishers is None:
                    publishers = current_publishers()
                self._jump(number, publishers)

    def _jump(self, number: int, publishers: frozenset[bytes]) -> None:
        if self._next and len(self._publishers) == 1 and publishers <= self._publishers:
            if number < self._next:
                self.is_exact = False  # another publisher, which came and went between two looks
                return
            self.lost += number - self._next
        else:
            # Another publisher; unless its numbers start lower, this one may be the old one's last.
            unclear = bool(self._publishers) and 0 < self._next < number
            if len(publishers) > 1 or unclear:
                self.is_exact = False
            self._publishers = frozenset() if unclear else publishers
        self._next = number + 1
