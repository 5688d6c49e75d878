# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A bag being recorded: written at once or as snapshots, kept safe, complete after a pause."""

from collections import deque
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.bag.qos import QosProfile
from tsobs_ros.bag.recording.latched import LatchedMessage, LatchedMessages
from tsobs_ros.bag.recording.snapshot import BufferedMessage, SnapshotBuffer
from tsobs_ros.bag.recording.syncing import BackgroundSync
from tsobs_ros.bag.writer import BagWriter

# Of a snapshot in one go: what arrives meanwhile must not wait too long.
_SNAPSHOT_SLICE = 5000


@dataclass(frozen=True)
class RecordingOptions:
    """How to record.

    Attributes:
        compression: Of the chunks: `none`, `lz4` or `zstd`.
        max_size: Begin another file when the current one has so many bytes; 0 never does.
        max_duration_ns: Begin another file rather than let one span more log time, ns; 0 never.
        repeat_latched: How many messages of each latched publisher every file begins with.
        sync_period: How often to force what is flushed to the disk, s.
        snapshot_duration_ns: Write only snapshots, which go back so far, ns; 0 writes everything.
        snapshot_size: The memory that a snapshot may take, bytes.
    """

    compression: str = "zstd"
    max_size: int = 0
    max_duration_ns: int = 0
    repeat_latched: int = 1
    sync_period: float = 5.0
    snapshot_duration_ns: int = 0
    snapshot_size: int = 0


class Recording:
    """Writes a bag from messages as they arrive, and counts them.

    All methods belong to one thread; a thread of its own syncs the disk.

    Args:
        path: The bag's folder, which must not exist.
        options: How to record.

    Attributes:
        path: The bag's folder.
        counts: The messages that were recorded, or kept for a snapshot, by topic.
        bytes: The bytes of these messages.
        discarded: The messages that arrived during pauses.
        snapshot: The buffer of the last seconds; None where everything is written.

    Raises:
        BagWriteError: The folder exists or cannot be created.
    """

    def __init__(self, path: Path, options: RecordingOptions) -> None:
        self.path = path
        self.counts: dict[str, int] = {}
        self.bytes = 0
        self.discarded = 0
        self.snapshot: SnapshotBuffer | None = None
        if options.snapshot_duration_ns:
            self.snapshot = SnapshotBuffer(options.snapshot_duration_ns, options.snapshot_size)
        self._repeats = options.repeat_latched > 0
        self._latched = LatchedMessages(max(1, options.repeat_latched))
        self._has_unlogged = False
        self._pending: deque[BufferedMessage] = deque()
        self._writer = BagWriter(
            path,
            compression=options.compression,
            max_size=options.max_size,
            max_duration_ns=options.max_duration_ns,
            on_split=self._begin_file,
        )
        self._sync = BackgroundSync(self._writer.sync, options.sync_period)

    @property
    def file_count(self) -> int:
        """The number of files of the bag."""
        return len(self._writer.metadata().files)

    @property
    def sync_age(self) -> float:
        """The time since what had been flushed was forced to the disk, s."""
        return self._sync.age

    def add_topic(
        self, name: str, definition: MessageDefinition, offers: Iterable[QosProfile]
    ) -> None:
        """Register a topic before its first message.

        Args:
            name: The full topic name.
            definition: Its type.
            offers: What its publishers offer.

        Raises:
            BagWriteError: The bag cannot be written.
        """
        self._writer.add_topic(name, definition.type, offers, definition=definition)
        self.counts.setdefault(name, 0)

    def record(self, message: BufferedMessage, latched_by: bytes | None = None) -> None:
        """Write a message, or keep it for a snapshot.

        Args:
            message: The message, of a registered topic.
            latched_by: Its publisher, if that is latched.

        Raises:
            BagWriteError: The bag cannot be written.
        """
        if self._has_unlogged:
            self._log_what_pauses_hid(message.log_time_ns)
        if latched_by is not None:
            self._latched.keep(latched_by, _latched(message, message.log_time_ns))
        self._store(message)

    def discard(self, message: BufferedMessage, latched_by: bytes | None = None) -> None:
        """Count a message that is not to be recorded; a latched one will be when others are.

        Args:
            message: The message; its log time does not matter.
            latched_by: Its publisher, if that is latched.
        """
        self.discarded += 1
        if latched_by is not None:
            self._latched.keep(latched_by, _latched(message, None))
            self._has_unlogged = True

    def split(self) -> None:
        """Go on in another file, unless the current one is empty.

        Raises:
            BagWriteError: The bag cannot be written.
        """
        self._writer.split()
        self._sync.hurry()

    def take_snapshot(self) -> int:
        """Have written what is kept, by the next calls of `write_pending`.

        Returns:
            The number of messages, those that are latched and older among them.
        """
        assert self.snapshot is not None, "not recording snapshots"
        messages = self.snapshot.take()
        before = len(self._pending)
        if messages:
            begin_ns = messages[0].log_time_ns
            older = self._latched.before(begin_ns) if self._repeats else []
            self._pending += (_repeated(message, begin_ns) for message in older)
            self._pending += messages
        return len(self._pending) - before

    def write_pending(self) -> bool:
        """Write some of a snapshot, and return whether there is more.

        Raises:
            BagWriteError: The bag cannot be written.
        """
        for _ in range(min(len(self._pending), _SNAPSHOT_SLICE)):
            self._writer.write(*self._pending.popleft())
        return bool(self._pending)

    def flush(self) -> None:
        """Hand everything written so far to the operating system: it survives a kill.

        Raises:
            BagWriteError: The bag cannot be written, or the disk failed to sync.
        """
        self._writer.flush()
        if self._sync.error is not None:
            raise self._sync.error

    def close(self) -> None:
        """Finish the bag; safe to call twice.

        Raises:
            BagWriteError: The bag cannot be finished; it can be recovered as far as flushed.
        """
        with ExitStack() as stack:
            stack.callback(self._writer.close)
            stack.callback(self._sync.stop)
            while self.write_pending():
                pass

    def _store(self, message: BufferedMessage) -> None:
        self.counts[message.topic] += 1
        self.bytes += len(message.data)
        if self.snapshot is None:
            self._writer.write(*message)
        else:
            self.snapshot.add(message)

    def _log_what_pauses_hid(self, log_time_ns: int) -> None:
        self._has_unlogged = False
        for message in self._latched.take_unlogged(log_time_ns):
            self._store(_repeated(message, log_time_ns))

    def _begin_file(self, log_time_ns: int) -> None:
        self._sync.hurry()
        for message in self._latched.before(log_time_ns) if self._repeats else ():
            self._writer.write(*_repeated(message, log_time_ns))


def _latched(message: BufferedMessage, log_time_ns: int | None) -> LatchedMessage:
    return LatchedMessage(message.topic, message.data, message.publish_time_ns, log_time_ns)


def _repeated(message: LatchedMessage, log_time_ns: int) -> BufferedMessage:
    return BufferedMessage(message.topic, message.data, log_time_ns, message.publish_time_ns)
