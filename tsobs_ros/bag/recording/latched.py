# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The last messages of latched publishers, which every part of a recording needs.

A map or a transform is published once and meant for all who come later. A file that begins an hour
into a recording, a snapshot of the last minute and what follows a pause make sense only with it.
"""

from collections import deque
from typing import NamedTuple

# Of one topic: nodes that are started again and again leave one behind each time.
_MAX_PUBLISHERS = 64


class LatchedMessage(NamedTuple):
    """A message as it goes to the bag, but for the time at which it is logged.

    Attributes:
        topic: The full topic name.
        data: The message in CDR.
        publish_time_ns: When it was published, ns since the epoch.
        log_time_ns: When it was logged, ns since the epoch; None if it has not been.
    """

    topic: str
    data: bytes
    publish_time_ns: int
    log_time_ns: int | None


class LatchedMessages:
    """Keeps the last messages of each publisher of each latched topic.

    Args:
        depth: How many of each publisher.
    """

    def __init__(self, depth: int) -> None:
        self._depth = depth
        self._topics: dict[str, dict[bytes, deque[LatchedMessage]]] = {}

    def keep(self, publisher: bytes, message: LatchedMessage) -> None:
        """Keep a message in the place of its publisher's oldest."""
        publishers = self._topics.setdefault(message.topic, {})
        if publisher not in publishers:
            if len(publishers) == _MAX_PUBLISHERS:
                del publishers[next(iter(publishers))]
            publishers[publisher] = deque(maxlen=self._depth)
        publishers[publisher].append(message)

    def before(self, log_time_ns: int) -> list[LatchedMessage]:
        """Return what was logged before a time, or has not been, in order of publication."""
        return sorted(
            (m for m in self._all() if m.log_time_ns is None or m.log_time_ns < log_time_ns),
            key=lambda message: message.publish_time_ns,
        )

    def take_unlogged(self, log_time_ns: int) -> list[LatchedMessage]:
        """Return what has not been logged, in order of publication; it will be at this time."""
        unlogged = [m for m in self.before(0) if m.log_time_ns is None]
        for publishers in self._topics.values():
            for publisher, messages in publishers.items():
                publishers[publisher] = deque(
                    (
                        m._replace(log_time_ns=log_time_ns) if m.log_time_ns is None else m
                        for m in messages
                    ),
                    maxlen=self._depth,
                )
        return unlogged

    def _all(self) -> list[LatchedMessage]:
        return [
            message
            for publishers in self._topics.values()
            for messages in publishers.values()
            for message in messages
        ]
