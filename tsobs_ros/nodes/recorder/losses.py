# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recorder's account of what it has missed of a topic."""

from collections.abc import Callable, Iterable


class LossCounter:
    """Counts the numbers that are missing between two that arrived from the same publisher.

    The middleware gives the number of a message, but not its publisher. A gap is therefore a loss
    only while the topic has one publisher; with several, losses are unknown. The first number that
    arrives of a publisher shows how many messages it had sent before. What it sends after the last
    that arrives leaves no trace.

    >>> counter = LossCounter()
    >>> counter.add([7, 8, 11], lambda: frozenset({b"plant"}))
    >>> str(counter)
    '2 lost, 6 published before'

    Attributes:
        earlier: The number of messages that publishers sent before the first that arrived of each.
        lost: The number of messages known to be lost since then.
        is_exact: False once these may be too small: the topic has had several publishers at a
            time, or the middleware does not number messages.
    """

    def __init__(self) -> None:
        self.earlier = self.lost = 0
        self.is_exact = True
        # Numbers begin at 1, so the first one is never the next one.
        self._next = 0
        self._publishers: frozenset[bytes] = frozenset()
        self._gone = False

    def __str__(self) -> str:
        """Return the counts in words."""
        if self.is_exact:
            return f"{self.lost} lost, {self.earlier} published before"
        return f"at least {self.lost} lost" if self.lost else "losses unknown"

    def see(self, publishers: frozenset[bytes]) -> None:
        """Take in who publishes the topic now; its queue has been emptied since the last call."""
        self.is_exact &= len(publishers) <= 1
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
            current_publishers: Returns who publishes the topic now.
        """
        publishers: frozenset[bytes] | None = None  # asked for only if a number is not the next
        for number in numbers:
            if number == self._next:
                self._next += 1
            elif number is None:
                self.is_exact = False
            else:
                publishers = current_publishers() if publishers is None else publishers
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
            elif self.is_exact:
                self.earlier += number - 1
            self._publishers = frozenset() if unclear else publishers
        self._next = number + 1
