# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Writing bags: a folder of MCAP files with a metadata.yaml, as `ros2 bag record -s mcap` does."""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any, Self, TypeAlias

from mcap.exceptions import UnsupportedCompressionError
from mcap.writer import LIBRARY_IDENTIFIER, CompressionType, Writer

from tsobs_ros import __version__
from tsobs_ros.bag.definitions import MessageDefinition, find_definition
from tsobs_ros.bag.metadata import (
    EMPTY_START_NS,
    BagMetadata,
    FileMetadata,
    QosProfile,
    TopicInfo,
    fsync_folder,
    profiles_to_yaml,
    write_metadata,
)
from tsobs_ros.errors import BagWriteError

LIBRARY = "tsobs_ros"
CHUNK_SIZE = 786_432
COMPRESSIONS: Mapping[str, CompressionType] = {
    "none": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}
_TIME_LIMIT_NS = EMPTY_START_NS

Message: TypeAlias = tuple[str, str, bytes, int, int]
"""A `BagMessage` as a plain tuple, whose class would cost more than the rest of it."""


class _BagFile:
    """One file of a bag; every method raises `BagWriteError` if the file cannot be written.

    Once writing has failed, all further writing does: there may be half a chunk in the file, and
    an index that states the whole would hide what can be recovered.
    """

    def __init__(self, path: Path, compression: str, metadata: BagMetadata) -> None:
        self.path = path
        self.message_count = 0
        self._finished = False
        self._failure: OSError | None = None
        self._start_ns = EMPTY_START_NS
        self._end_ns = 0
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        try:
            # Buffered: the writer hands over a record in several pieces.
            self._stream = path.open("xb")
        except OSError as error:
            raise BagWriteError(f"{path}: cannot create it: {error}") from error
        # In this order: on a full disk closing fails as well, and that is the same error.
        with self._writing(), ExitStack() as undo:
            undo.callback(self._stream.close)
            # Any: the library annotates its methods only in part.
            self._writer: Any = Writer(self._stream, CHUNK_SIZE, COMPRESSIONS[compression])
            self._writer.start("ros2", f"{LIBRARY} {__version__}; {LIBRARY_IDENTIFIER}")
            self._add_metadata(metadata)
            self._stream.flush()
            undo.pop_all()

    def add_topic(self, topic: TopicInfo) -> None:
        definition = topic.definition
        assert definition is not None
        with self._writing():
            if (schema := self._schemas.get(topic.type)) is None:
                schema = self._writer.register_schema(
                    topic.type, definition.encoding, definition.text.encode()
                )
                self._schemas[topic.type] = schema
            metadata = {
                "offered_qos_profiles": profiles_to_yaml(topic.qos_profiles),
                "topic_type_hash": topic.type_hash,
            }
            channel = self._writer.register_channel(topic.name, "cdr", schema, metadata)
            self._channels[topic.name] = channel

    def write(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        # As `_writing` does it, at a tenth of its cost.
        if self._failure is not None:
            raise self._cannot_write(self._failure)
        try:
            self._writer.add_message(self._channels[topic], log_time_ns, data, publish_time_ns)
        except OSError as error:
            self._failure = error
            raise self._cannot_write(error) from error
        self.message_count += 1
        if log_time_ns < self._start_ns:
            self._start_ns = log_time_ns
        if log_time_ns > self._end_ns:
            self._end_ns = log_time_ns

    def write_all(self, messages: Sequence[Message]) -> None:
        """Write some messages, at least one, at a fraction of the cost of `write`."""
        add, channels, count = self._writer.add_message, self._channels, 0
        with self._writing():
            try:
                for topic, _, data, log_time_ns, publish_time_ns in messages:
                    add(channels[topic], log_time_ns, data, publish_time_ns)
                    count += 1
            finally:
                self.message_count += count
                times = [message[3] for message in messages[:count]]
                self._start_ns = min([self._start_ns, *times])
                self._end_ns = max([self._end_ns, *times])

    def duration_with(self, log_time_ns: int) -> int:
        """Return the file's duration, ns, if a message of this log time were in it too."""
        return max(self._end_ns, log_time_ns) - min(self._start_ns, log_time_ns)

    @property
    def size(self) -> int:
        """The bytes written so far, without the chunk in progress."""
        return self._stream.tell()

    def info(self) -> FileMetadata:
        duration = self._end_ns - self._start_ns if self.message_count else 0
        return FileMetadata(self.path.name, self._start_ns, duration, self.message_count)

    def flush(self) -> None:
        """Hand all messages so far to the operating system: they survive a kill."""
        with self._writing():
            self._writer.flush()

    def sync(self) -> None:
        """Force what has been flushed to the disk: it survives a power cut."""
        with self._errors():
            os.fdatasync(self._stream.fileno())

    def finish(self, metadata: BagMetadata) -> None:
        """Write the index, once: the file is complete, and survives a kill as it is."""
        if self._finished:
            return
        with self._writing():
            self._add_metadata(metadata)
            self._writer.finish()
            self._stream.flush()
        self._finished = True

    def close(self) -> None:
        """Force everything to the disk; the descriptor is released even if that fails."""
        with self._errors(), self._stream:
            os.fsync(self._stream.fileno())

    def _add_metadata(self, metadata: BagMetadata) -> None:
        # In the order of writing: the library would write it before the chunk in progress.
        self._writer.flush()
        self._writer.add_metadata("rosbag2", {"serialized_metadata": metadata.to_yaml()})

    @contextmanager
    def _writing(self) -> Iterator[None]:
        if self._failure is not None:
            raise self._cannot_write(self._failure)
        with self._errors():
            try:
                yield
            except OSError as error:
                self._failure = error
                raise

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._cannot_write(error) from error
        except UnsupportedCompressionError as error:
            raise BagWriteError(f"{self.path}: {error}: its library is not installed") from error

    def _cannot_write(self, reason: OSError) -> BagWriteError:
        return BagWriteError(f"{self.path}: cannot write it: {reason}")


class BagWriter:
    """Writes one bag; a context manager that closes it.

    All methods but `sync` belong to one thread.

    Args:
        path: The bag's folder, which must not exist; missing parents are created.
        compression: Of the chunks: `none`, `lz4` or `zstd`.
        max_size: The size at which another file is started, bytes; 0 for no limit.
        max_duration_ns: The longest time of a file between log times, ns; 0 for no limit.
        custom_data: Notes for the bag's metadata.
        on_split: Called before the first message of every file after the first, with the log time
            of that message, ns; the messages that it writes come first in the file.

    Raises:
        BagWriteError: The folder exists or cannot be created, or the compression is unknown.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: str = "zstd",
        max_size: int = 0,
        max_duration_ns: int = 0,
        custom_data: Mapping[str, str] | None = None,
        on_split: Callable[[int], None] | None = None,
    ) -> None:
        self.path = Path(path).absolute()
        if compression not in COMPRESSIONS:
            names = ", ".join(COMPRESSIONS)
            raise BagWriteError(f"{path}: no compression '{compression}', there is {names}")
        self._compression = compression
        self._max_size = max_size
        self._max_duration_ns = max_duration_ns
        self._is_limited = bool(max_size or max_duration_ns)
        self._custom_data = custom_data
        self._topics: dict[str, TopicInfo] = {}
        self._counts: dict[str, int] = {}
        self._on_split = on_split
        self._splitting = False
        self._finished_files: list[FileMetadata] = []
        self._unsynced: list[_BagFile] = []
        self._on_disk = (0, 0)
        self._closed = False
        # A disk may take seconds to sync, and a split must not wait for it: `_disk` is held as long
        # as syncing takes, `_files` only while the list of files is read or changed.
        self._disk = Lock()
        self._files = Lock()
        self._create_folder()
        self._file = self._open_file()
        self._write_metadata(self.metadata())

    @property
    def message_count(self) -> int:
        """The number of messages written so far."""
        return sum(f.message_count for f in self._finished_files) + self._file.message_count

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """The registered topics and how many messages of each are written."""
        return tuple(
            replace(topic, count=self._counts[topic.name]) for topic in list(self._topics.values())
        )

    def add_topic(
        self,
        name: str,
        type: str,
        qos_profiles: Iterable[QosProfile] = (),
        *,
        definition: MessageDefinition | None = None,
    ) -> None:
        """Register a topic before its first message.

        Registering it again changes nothing: readers compare a topic's QoS in the file with the
        one in metadata.yaml, and return no messages where they differ.

        Args:
            name: The full topic name.
            type: The message type, `package/msg/Type`.
            qos_profiles: What its publishers offer.
            definition: Its definition; the installed one by default.

        Raises:
            BagWriteError: The type is not installed, the topic has another type already, or the
                bag is closed or cannot be written.
        """
        self._check_open()
        if (known := self._topics.get(name)) is not None:
            if known.type != type:
                raise BagWriteError(
                    f"{self.path}: {name} is {known.type} already, it cannot be {type}"
                )
            return
        definition = definition or find_definition(type)
        qos = tuple(qos_profiles)
        topic = TopicInfo(name, definition.type, 0, qos, definition.type_hash, definition)
        self._file.add_topic(topic)
        self._counts[name] = 0
        self._topics[name] = topic

    def write(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Append one message.

        Args:
            topic: A registered topic.
            data: The message in CDR, with its encapsulation header, as it came off the wire.
            log_time_ns: When it was received, ns since the epoch.
            publish_time_ns: When it was published, ns since the epoch.

        Raises:
            BagWriteError: The topic is not registered, a time cannot be stored, or the bag is
                closed or cannot be written.
        """
        if self._closed or topic not in self._topics:
            self._check_open()
            raise BagWriteError(f"{self.path}: topic {topic} has not been added")
        if not (0 <= log_time_ns < _TIME_LIMIT_NS and 0 <= publish_time_ns < _TIME_LIMIT_NS):
            raise BagWriteError(
                f"{self.path}: {topic}: times must be at least 0 and fit 63 bits: log "
                f"{log_time_ns} ns, publish {publish_time_ns} ns"
            )
        if self._file.message_count == 0:
            self._start_file(log_time_ns)
        elif self._is_limited and self._is_full(log_time_ns):
            self.split()
            self._start_file(log_time_ns)
        self._file.write(topic, data, log_time_ns, publish_time_ns)
        self._counts[topic] += 1

    def write_all(self, messages: Sequence[Message]) -> None:
        """Append messages, each as `write` does, faster if files have no limits.

        Args:
            messages: Topic, type, data, log time and publish time of each, as of a `BagMessage`.

        Raises:
            BagWriteError: As for `write`.
        """
        counts = Counter([message[0] for message in messages])
        times = [time for message in messages for time in message[3:]]
        if (
            self._closed
            or self._is_limited
            or self._on_split is not None
            or not counts
            or counts.keys() - self._topics.keys()
            or not 0 <= min(times) <= max(times) < _TIME_LIMIT_NS
        ):
            for topic, _, data, log_time_ns, publish_time_ns in messages:
                self.write(topic, data, log_time_ns, publish_time_ns)
            return
        self._file.write_all(messages)
        for topic, count in counts.items():
            self._counts[topic] += count

    def flush(self) -> None:
        """Hand everything written so far to the operating system: it survives a kill.

        Raises:
            BagWriteError: The bag cannot be written.
        """
        self._check_open()
        self._file.flush()

    def split(self) -> None:
        """Start another file, unless the current one is empty; a kill cannot harm that one.

        The metadata.yaml in the folder names it after the next `sync` or `close`.

        Raises:
            BagWriteError: The bag is closed or cannot be written.
        """
        self._check_open()
        if self._file.message_count == 0:
            return
        finished = self._file
        finished.finish(self.metadata())
        try:
            started = self._open_file((*self._finished_files, finished.info()))
        except BagWriteError:
            self.close()
            raise
        with self._files:
            self._unsynced.append(finished)
            self._finished_files.append(finished.info())
            self._file = started
        # Every file must make sense on its own.
        for topic in self._topics.values():
            self._file.add_topic(topic)

    def sync(self) -> None:
        """Force what has been flushed to the disk, so that it survives a power cut.

        May run in another thread than the rest, as a disk can be slow; does nothing once the bag is
        closed.

        Raises:
            BagWriteError: The disk failed.
        """
        with self._disk:
            if self._closed:
                return
            with self._files:
                current, finished, self._unsynced = self._file, self._unsynced, []
                metadata = self.metadata()
            for file in finished:
                file.close()
            current.sync()
            # Not every time: the counts are in the files, but after a power cut the folder should
            # name its topics and files.
            if self._on_disk != (len(metadata.topics), len(metadata.files)):
                self._write_metadata(metadata)

    def close(self) -> None:
        """Finish the bag: index, metadata, everything forced to the disk; safe to call twice.

        Raises:
            BagWriteError: The bag cannot be written; it can be recovered as far as flushed.
        """
        with self._disk:
            if self._closed:
                return
            self._closed = True
            with ExitStack() as stack:  # whatever fails, the rest is done
                stack.callback(lambda: self._write_metadata(self.metadata()))
                for file in (self._file, *self._unsynced):
                    stack.callback(file.close)
                self._file.finish(self.metadata())

    def metadata(self) -> BagMetadata:
        """Return the bag's metadata as of now."""
        return BagMetadata(
            topics=self.topics,
            files=(*self._finished_files, self._file.info()),
            custom_data=self._custom_data,
        )

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the bag, also when an error ends the block: what was written is kept."""
        self.close()

    def _create_folder(self) -> None:
        try:
            self.path.mkdir(parents=True)
            fsync_folder(self.path.parent)
        except FileExistsError as error:
            raise BagWriteError(f"{self.path}: exists already, bags are not overwritten") from error
        except OSError as error:
            raise BagWriteError(f"{self.path}: cannot create it: {error}") from error

    def _open_file(self, finished: tuple[FileMetadata, ...] = ()) -> _BagFile:
        path = self.path / f"{self.path.name}_{len(finished)}.mcap"
        metadata = BagMetadata(
            topics=self.topics,
            files=(*finished, FileMetadata(path.name)),
            custom_data=self._custom_data,
        )
        return _BagFile(path, self._compression, metadata)

    def _is_full(self, log_time_ns: int) -> bool:
        size, duration = self._max_size, self._max_duration_ns
        return (0 < size <= self._file.size) or (
            0 < duration < self._file.duration_with(log_time_ns)
        )

    def _start_file(self, log_time_ns: int) -> None:
        # The messages that the callback writes come here again.
        if self._on_split is None or not self._finished_files or self._splitting:
            return
        self._splitting = True
        try:
            self._on_split(log_time_ns)
        finally:
            self._splitting = False

    def _write_metadata(self, metadata: BagMetadata) -> None:
        write_metadata(self.path, metadata)
        self._on_disk = (len(metadata.topics), len(metadata.files))

    def _check_open(self) -> None:
        if self._closed:
            raise BagWriteError(f"{self.path}: the bag is closed")
