# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Counting the messages of a topic that never arrived, from gaps in the publisher's numbering."""

from collections.abc import Iterable


class LossCounter:
    """Counts gaps in the sequence numbers of one topic's publisher.

    The numbers are each publisher's own and arrive without its identity, so they tell nothing
    while a topic has several publishers: `complete` is then false for good, and nothing is counted
    until one is alone again.

    Attributes:
        lost: The messages known to be lost.
        complete: Whether nothing can have been lost uncounted since the first message.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.complete = True
        self._last: int | None = None
        self._publishers = 1

    def observe(self, sequences: Iterable[int | None], publishers: int) -> None:
        """Take the numbers of the messages that arrived since the last call.

        Args:
            sequences: The publication sequence numbers in order of arrival; None where the
                middleware gives none.
            publishers: How many publishers the subscription is matched with now.
        """
        if publishers > 1 or self._publishers > 1:
            # Also right after the others have left: their last messages are among these.
            self.complete = False
            self._last = None
        else:
            for sequence in sequences:
                self._count(sequence)
        self._publishers = publishers

    def _count(self, sequence: int | None) -> None:
        if sequence is None:
            self.complete = False
            return
        # A number that is not greater belongs to a new publisher, which took the old one's place.
        if self._last is not None and sequence > self._last:
            self.lost += sequence - self._last - 1
        self._last = sequence
