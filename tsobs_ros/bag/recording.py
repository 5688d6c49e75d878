# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A bag being recorded: messages written at once or as snapshots, synced to the disk, with the
latched ones in every file.

A map or a transform is published once and meant for all who come later. A file that starts an hour
into a recording, a snapshot of the last minute and what follows a pause make sense only with it.
"""

import time
from collections import Counter, deque
from contextlib import ExitStack
from operator import attrgetter
from pathlib import Path
from threading import Event, Thread
from typing import Any, NamedTuple

from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.errors import BagWriteError

# Messages of a snapshot written in one go: those that arrive meanwhile must not wait too long.
_SNAPSHOT_SLICE = 5000
# The memory of a buffered message beyond its data [bytes].
_OVERHEAD = 256
# Of one topic, whose latched messages are kept: each start of a node leaves one behind.
_MAX_PUBLISHERS = 64


class BufferedMessage(NamedTuple):
    """A message as it goes to the bag; times in ns since the epoch, before 0 if not yet logged."""

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
        repeat_latched: Messages of each latched publisher that every file starts with.
        sync_period: Pause between two syncs of the disk [s].
        snapshot: A buffer to keep messages in until `take_snapshot`; None: everything is written.
        options: Those of `BagWriter`.

    Attributes:
        counts: The messages recorded, or kept for a snapshot, by topic.
        bytes: The bytes of these messages.
        discarded: The number of messages that arrived during pauses.
        snapshot: The buffer of the last seconds; None if everything is written.

    Raises:
        BagWriteError: As `BagWriter`; or the disk has failed to sync.
    """

    def __init__(
        self,
        path: Path,
        *,
        repeat_latched: int = 1,
        sync_period: float = 5.0,
        snapshot: "SnapshotBuffer | None" = None,
        **options: Any,
    ) -> None:
        super().__init__(path, **options)
        self._is_limited = True
        self.counts: Counter[str] = Counter()
        self.bytes = self.discarded = 0
        self.snapshot = snapshot
        self._repeats, self._repeating = repeat_latched > 0, False
        self._latched = LatchedMessages(max(1, repeat_latched))
        self._pending: deque[BufferedMessage] = deque()
        self._sync_failure: BagWriteError | None = None
        self._synced_at = time.monotonic()
        self._stopping = Event()
        # A disk may take seconds over it.
        self._syncing = Thread(target=self._sync_often, args=(sync_period,), daemon=True)
        self._syncing.start()

    @property
    def sync_age(self) -> float:
        """The time since the last sync of the disk that succeeded was begun [s]."""
        return time.monotonic() - self._synced_at

    def _sync_often(self, period: float) -> None:
        while not self._stopping.wait(period):
            called_at = time.monotonic()
            try:
                self.sync()
            except BagWriteError as error:
                self._sync_failure = error
                return
            self._synced_at = called_at

    def record(self, message: BufferedMessage, latch: Latch | None = None) -> None:
        """Write a message of a registered topic, or keep it for a snapshot.

        Args:
            message: The message.
            latch: Its publisher's, if it is latched.
        """
        for hidden in self._latched.log(message.log_time_ns):
            self._store(hidden)
        if latch is not None:
            self._latched.keep(message, latch)
        self._store(message)

    def discard(self, message: BufferedMessage, latch: Latch | None = None) -> None:
        """Count a message that is not recorded; a latched one will be with the next that is.

        Args:
            message: The message; its log time does not matter.
            latch: Its publisher's, if it is latched.
        """
        self.discarded += 1
        if latch is not None:
            self._latched.keep(message._replace(log_time_ns=-1), latch)

    def take_snapshot(self) -> int:
        """Have the buffer written by the next calls of `write_pending`; return its length.

        Latched messages from before are written and counted, too.
        """
        assert self.snapshot is not None, "not recording snapshots"
        messages = self.snapshot.take()
        before = len(self._pending)
        if messages:
            self._pending += self._repeated(messages[0].log_time_ns)
            self._pending += messages
        return len(self._pending) - before

    def write_pending(self) -> bool:
        """Write some of a snapshot, and return whether there is more."""
        for _ in range(min(len(self._pending), _SNAPSHOT_SLICE)):
            self.write(*self._pending.popleft())
        return bool(self._pending)

    def flush(self) -> None:
        """Hand everything written so far to the operating system: it survives a kill."""
        super().flush()
        if self._sync_failure is not None:
            raise self._sync_failure

    def close(self) -> None:
        """Finish the bag; safe to call twice."""
        with ExitStack() as stack:
            stack.callback(super().close)
            stack.callback(self._syncing.join)
            stack.callback(self._stopping.set)
            while self.write_pending():
                pass

    def _store(self, message: BufferedMessage) -> None:
        self.counts[message.topic] += 1
        self.bytes += len(message.data)
        if self.snapshot is None:
            self.write(*message)
        else:
            self.snapshot.add(message)

    def _make_room(self, log_time_ns: int) -> None:
        super()._make_room(log_time_ns)
        is_first = self._file.message_count == 0 and self._finished_files
        if is_first and not self._repeating:
            self._repeating = True  # the messages come here, too
            for message in self._repeated(log_time_ns):
                self.write(*message)
            self._repeating = False

    def _repeated(self, log_time_ns: int) -> list[BufferedMessage]:
        return self._latched.before(log_time_ns) if self._repeats else []


class LatchedMessages:
    """Keeps the last messages of each latched publisher, without knowing whose each one is.

    Message n of a publisher takes the place of its message n - depth. If several publishers have
    sent that one, none is dropped before as many have sent message n: an outdated message too many
    is kept rather than one too few.

    Args:
        depth: How many of each publisher.
    """

    def __init__(self, depth: int) -> None:
        self._depth = depth
        self._has_unlogged = False
        # The messages of a topic, with their publishers' counts of them.
        self._topics: dict[str, list[tuple[BufferedMessage, int | None]]] = {}

    def keep(self, message: BufferedMessage, latch: Latch) -> None:
        """Keep a message, and drop what it replaces."""
        number, depth = latch.number, self._depth
        self._has_unlogged |= message.log_time_ns < 0
        kept = self._topics.setdefault(message.topic, [])
        kept.append((message, number))
        surplus = len(kept) - depth * min(latch.publishers, _MAX_PUBLISHERS)
        if surplus <= 0:
            return
        if number is None or latch.publishers == 1:
            del kept[:surplus]
            return
        numbers = [other for _, other in kept]
        if numbers.count(number - depth) <= numbers.count(number):
            kept[:] = [each for each in kept if each[1] != number - depth]
        del kept[: max(0, len(kept) - depth * _MAX_PUBLISHERS)]

    def before(self, log_time_ns: int) -> list[BufferedMessage]:
        """Return what was logged before a time [ns], or not yet, with that log time.

        It is in order of publication.
        """
        kept = (message for each in self._topics.values() for message, _ in each)
        found = [m._replace(log_time_ns=log_time_ns) for m in kept if m.log_time_ns < log_time_ns]
        return sorted(found, key=attrgetter("publish_time_ns"))

    def log(self, log_time_ns: int) -> list[BufferedMessage]:
        """Return what was not logged, in order of publication; it is now logged at a time [ns]."""
        found: list[BufferedMessage] = []
        for kept in self._topics.values() if self._has_unlogged else ():
            for place, (message, number) in enumerate(kept):
                if message.log_time_ns < 0:
                    found.append(message._replace(log_time_ns=log_time_ns))
                    kept[place] = (found[-1], number)
        self._has_unlogged = False
        return sorted(found, key=attrgetter("publish_time_ns"))


class SnapshotBuffer:
    """Holds the newest messages, as many as fit into a time and into memory.

    Args:
        max_duration_ns: Greatest log time between the oldest and the newest [ns].
        max_size: Memory they may take [bytes].

    Attributes:
        size: Memory they take, roughly [bytes].
        refused: Number of messages lost, as they were larger than all the memory.
    """

    def __init__(self, max_duration_ns: int, max_size: int) -> None:
        self.size = self.refused = 0
        self._max_duration_ns, self._max_size = max_duration_ns, max_size
        self._messages: deque[BufferedMessage] = deque()

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self._messages)

    @property
    def duration_ns(self) -> int:
        """The log time from the oldest to the newest message [ns]; 0 if time went back."""
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
