# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A bag being recorded: it is synced to the disk, and has the latched messages in every file.

A map or a transform is published once, also for all later subscribers. A file that starts an hour
into a recording makes sense only with such messages.
"""

from collections import Counter
from operator import attrgetter
from pathlib import Path
from threading import Event, Thread
from typing import Any, NamedTuple

from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.errors import BagWriteError

# Per topic, for latched messages: each start of a node leaves a further publisher behind.
_MAX_PUBLISHERS = 64


class Received(NamedTuple):
    """A message as it arrived; times in ns since the epoch.

    Attributes:
        number: Its number in the publisher's own count; None if the middleware gives none.
        latched: The number of latched publishers the topic has had so far; 0 if it is not latched.
    """

    topic: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int
    number: int | None = None
    latched: int = 0


class Recording(BagWriter):
    """Writes and counts messages as they arrive; another thread syncs the disk periodically.

    Attributes:
        counts: The messages recorded, by topic.
        bytes: The total size of these messages.
        discarded: The number of messages left out in pauses, which the caller counts.

    Raises:
        BagWriteError: As `BagWriter`; or the disk has failed to sync.
    """

    def __init__(self, path: Path, *, sync_period: float = 5.0, **options: Any) -> None:
        super().__init__(path, **options)
        self.counts: Counter[str] = Counter()
        self.bytes = self.discarded = 0
        self._latched = LatchedMessages()
        self._sync_failure: BagWriteError | None = None
        self._stopping = Event()
        # A sync of the disk may take seconds, hence the thread.
        self._syncing = Thread(target=self._sync_often, args=(sync_period,), daemon=True)
        self._syncing.start()

    def _sync_often(self, period: float) -> None:
        while not self._stopping.wait(period):
            try:
                self.sync()
            except BagWriteError as error:
                self._sync_failure = error
                return

    def record(self, message: Received) -> None:
        """Write a message of a registered topic, at the start of a file after the latched messages.

        Every file but the first repeats the latched messages, with the log time of its start.
        """
        if message.latched:
            self._latched.keep(message)
        self._make_room(message.log_time_ns)
        if self.file_count > 1 and not self._file.message_count:
            for each in self._latched.others(message):
                self.write(each.topic, each.data, message.log_time_ns, each.publish_time_ns)
        self.counts[message.topic] += 1
        self.bytes += len(message.data)
        self.write(*message[:4])

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


class LatchedMessages:
    """Keeps the last message of each latched publisher, without knowing which one sent which.

    Message n of a publisher replaces its message n - 1. If several publishers have sent a message
    n - 1, these are dropped only once as many publishers have sent a message n: it is better to
    keep an outdated message than to drop a current one.
    """

    def __init__(self) -> None:
        self._topics: dict[str, list[Received]] = {}

    def keep(self, message: Received) -> None:
        """Keep a message, and drop those that it replaces."""
        number, kept = message.number, self._topics.setdefault(message.topic, [])
        kept.append(message)
        surplus = len(kept) - min(message.latched, _MAX_PUBLISHERS)
        if surplus <= 0:
            return
        if number is None or message.latched == 1:
            del kept[:surplus]
            return
        numbers = [other.number for other in kept]
        if numbers.count(number - 1) <= numbers.count(number):
            kept[:] = [other for other in kept if other.number != number - 1]
        del kept[: max(0, len(kept) - _MAX_PUBLISHERS)]

    def others(self, last: Received | None = None) -> list[Received]:
        """Return the kept messages but the last one, in order of publication."""
        kept = (message for each in self._topics.values() for message in each)
        found = [message for message in kept if message is not last]
        return sorted(found, key=attrgetter("publish_time_ns"))
