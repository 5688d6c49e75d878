# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A bag being recorded: synced to the disk, with the latched messages in every file.

A map or a transform is published once and meant for all who come later. A file that starts an hour
into a recording makes sense only with it.
"""

from collections import Counter
from operator import attrgetter
from pathlib import Path
from threading import Event, Thread
from typing import Any, NamedTuple

from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.errors import BagWriteError

# Of one topic, whose latched messages are kept: each start of a node leaves one behind.
_MAX_PUBLISHERS = 64


class BufferedMessage(NamedTuple):
    """A message as it goes to the bag; times in ns since the epoch."""

    topic: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int


class Latch(NamedTuple):
    """A latched message's publisher.

    Attributes:
        number: The publisher's count of its messages; None if the middleware gives none.
        publishers: The number of latched publishers the topic has had so far.
    """

    number: int | None
    publishers: int


class Recording(BagWriter):
    """Writes and counts messages as they arrive; another thread syncs the disk.

    Args:
        path: The bag's folder, which must not exist.
        sync_period: Pause between two syncs of the disk [s].
        options: Those of `BagWriter`.

    Attributes:
        counts: The messages recorded, by topic.
        bytes: The bytes of these messages.
        discarded: The number of messages left out in pauses, which the caller counts.

    Raises:
        BagWriteError: As `BagWriter`; or the disk has failed to sync.
    """

    def __init__(self, path: Path, *, sync_period: float = 5.0, **options: Any) -> None:
        super().__init__(path, **options)
        self._is_limited = True
        self.counts: Counter[str] = Counter()
        self.bytes = self.discarded = 0
        self._latched, self._repeating = LatchedMessages(), False
        self._sync_failure: BagWriteError | None = None
        self._stopping = Event()
        # A disk may take seconds over it.
        self._syncing = Thread(target=self._sync_often, args=(sync_period,), daemon=True)
        self._syncing.start()

    def _sync_often(self, period: float) -> None:
        while not self._stopping.wait(period):
            try:
                self.sync()
            except BagWriteError as error:
                self._sync_failure = error
                return

    def record(self, message: BufferedMessage, latch: Latch | None = None) -> None:
        """Write a message of a registered topic, with its publisher's latch if it is latched."""
        if latch is not None:
            self._latched.keep(message, latch)
        self.counts[message.topic] += 1
        self.bytes += len(message.data)
        self.write(*message)

    def flush(self) -> None:
        """Hand everything written so far to the operating system: it survives a kill."""
        super().flush()
        if self._sync_failure is not None:
            raise self._sync_failure

    def close(self) -> None:
        """Finish the bag; safe to call twice."""
        self._stopping.set()
        self._syncing.join()
        super().close()

    def _make_room(self, log_time_ns: int) -> None:
        super()._make_room(log_time_ns)
        is_first = self._file.message_count == 0 and self._finished_files
        if is_first and not self._repeating:
            self._repeating = True  # the messages come here, too
            for message in self._latched.before(log_time_ns):
                self.write(*message)
            self._repeating = False


class LatchedMessages:
    """Keeps the last message of each latched publisher, without knowing whose each one is.

    Message n of a publisher takes the place of its message n - 1. If several publishers have sent
    that one, none is dropped before as many have sent message n: an outdated message too many is
    kept rather than one too few.
    """

    def __init__(self) -> None:
        # The messages of a topic, with their publishers' counts of them.
        self._topics: dict[str, list[tuple[BufferedMessage, int | None]]] = {}

    def keep(self, message: BufferedMessage, latch: Latch) -> None:
        """Keep a message, and drop what it replaces."""
        number = latch.number
        kept = self._topics.setdefault(message.topic, [])
        kept.append((message, number))
        surplus = len(kept) - min(latch.publishers, _MAX_PUBLISHERS)
        if surplus <= 0:
            return
        if number is None or latch.publishers == 1:
            del kept[:surplus]
            return
        numbers = [other for _, other in kept]
        if numbers.count(number - 1) <= numbers.count(number):
            kept[:] = [each for each in kept if each[1] != number - 1]
        del kept[: max(0, len(kept) - _MAX_PUBLISHERS)]

    def before(self, log_time_ns: int) -> list[BufferedMessage]:
        """Return what was logged before a time [ns] with that log time, by publication."""
        kept = (message for each in self._topics.values() for message, _ in each)
        found = [m._replace(log_time_ns=log_time_ns) for m in kept if m.log_time_ns < log_time_ns]
        return sorted(found, key=attrgetter("publish_time_ns"))
