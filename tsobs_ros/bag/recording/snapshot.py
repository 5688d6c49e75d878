# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The last seconds of a recording, held in memory until somebody wants them on the disk."""

from collections import deque
from typing import NamedTuple

# What a message takes beyond its bytes: the objects that hold it.
_OVERHEAD = 256


class BufferedMessage(NamedTuple):
    """A message as it goes to the bag."""

    topic: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int


class SnapshotBuffer:
    """Holds the newest messages, as many as fit into a time and into memory.

    Args:
        max_duration_ns: How much older than the newest a message may be, ns of log time.
        max_size: The memory they may take, bytes.

    Attributes:
        size: The memory they take, bytes, near enough.
        refused: How many messages were larger than all the memory, and are lost.
    """

    def __init__(self, max_duration_ns: int, max_size: int) -> None:
        self.size = 0
        self.refused = 0
        self._max_duration_ns = max_duration_ns
        self._max_size = max_size
        self._messages: deque[BufferedMessage] = deque()

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self._messages)

    @property
    def duration_ns(self) -> int:
        """The log time from the oldest to the newest message, ns; 0 where time went back."""
        if not self._messages:
            return 0
        return max(0, self._messages[-1].log_time_ns - self._messages[0].log_time_ns)

    def add(self, message: BufferedMessage) -> None:
        """Add the newest message, and drop those that are too old or too many by now."""
        size = len(message.data) + _OVERHEAD
        if size > self._max_size:
            self.refused += 1
            return
        messages = self._messages
        messages.append(message)
        self.size += size
        oldest_ns = message.log_time_ns - self._max_duration_ns
        while self.size > self._max_size or messages[0].log_time_ns < oldest_ns:
            self.size -= len(messages.popleft().data) + _OVERHEAD

    def take(self) -> deque[BufferedMessage]:
        """Return the messages, oldest first, and hold none any more."""
        messages, self._messages = self._messages, deque()
        self.size = 0
        return messages
