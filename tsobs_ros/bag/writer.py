# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Writing bags: a folder of MCAP files with a metadata.yaml, as `ros2 bag record -s mcap` does."""

import itertools
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any, NamedTuple, Self, TypeAlias

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from tsobs_ros import __version__
from tsobs_ros.bag.container import MESSAGE, MESSAGE_OPCODE, RECORD
from tsobs_ros.bag.copying import RecordedChunk
from tsobs_ros.bag.definitions import MessageDefinition, find_definition
from tsobs_ros.bag.file_writer import COMPRESSIONS, FileWriter, Records
from tsobs_ros.bag.message_rows import pieces
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
from tsobs_ros.files import written_whole

LIBRARY = "tsobs_ros"
CHUNK_SIZE = 786_432
_TIME_LIMIT_NS = EMPTY_START_NS

Message: TypeAlias = tuple[str, str, bytes, int, int]
"""A `BagMessage` as a plain tuple, whose class would cost more than the rest of it."""


class MessageSeries(NamedTuple):
    """Messages of a topic that have the same size, n of them.

    Attributes:
        topic: The topic.
        type: Its type.
        log_times: ns since the epoch, shape (n,).
        publish_times: ns since the epoch, shape (n,).
        data: In CDR, shape (n, size).
    """

    topic: str
    type: str
    log_times: NDArray[np.int64]
    publish_times: NDArray[np.int64]
    data: NDArray[np.uint8]

    def take(self, chosen: NDArray[Any] | slice) -> "MessageSeries":
        """Return some of the messages."""
        times = self.log_times[chosen], self.publish_times[chosen]
        return MessageSeries(self.topic, self.type, *times, self.data[chosen])

    def messages(self) -> list[Message]:
        """Return them one by one."""
        count, size = self.data.shape
        data = self.data.tobytes()
        each = [data[size * place : size * (place + 1)] for place in range(count)]
        times = self.log_times.tolist(), self.publish_times.tolist()
        return [(self.topic, self.type, *one) for one in zip(each, *times, strict=True)]


class _BagFile:
    """One file of a bag; every method raises `BagWriteError` if the file cannot be written.

    Once writing has failed, all further writing does: there may be half a chunk in the file, and
    an index that states the whole would hide what can be recovered.
    """

    def __init__(self, path: Path, compression: str, metadata: BagMetadata) -> None:
        self.path = path
        self._finished = False
        self._failure: OSError | None = None
        self._channels: dict[str, int] = {}
        self._schemas: dict[tuple[str, ...], int] = {}
        try:
            self._stream = path.open("xb")
        except OSError as error:
            raise BagWriteError(f"{path}: cannot create it: {error}") from error
        # In this order: on a full disk closing fails as well, and that is the same error.
        with self._writing(), ExitStack() as undo:
            undo.callback(self._stream.close)
            library = f"{LIBRARY} {__version__}"
            self._writer = FileWriter(self._stream, library, compression, CHUNK_SIZE)
            self._add_metadata(metadata)
            self._stream.flush()
            undo.pop_all()

    @property
    def message_count(self) -> int:
        return self._writer.message_count

    def add_topic(self, topic: TopicInfo, ids: tuple[int, int] | None = None) -> None:
        definition = topic.definition
        assert definition is not None
        writer = self._writer
        channel_id, schema_id = ids or (0, 0)
        with self._writing():
            described = topic.type, definition.encoding, definition.text
            if described not in self._schemas:
                id_ = _free(schema_id, writer.schemas)
                data = definition.text.encode()
                writer.add_schema(Schema(id_, data, definition.encoding, topic.type))
                self._schemas[described] = id_
            metadata = {
                "offered_qos_profiles": profiles_to_yaml(topic.qos_profiles),
                "topic_type_hash": topic.type_hash,
            }
            id_ = _free(channel_id, writer.channels)
            schema_id = self._schemas[described]
            writer.add_channel(Channel(id_, topic.name, "cdr", metadata, schema_id))
            self._channels[topic.name] = id_

    def write(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        # As `_writing` does it, at a tenth of its cost.
        if self._failure is not None:
            raise self._cannot_write(self._failure)
        try:
            self._writer.add_message(self._channels[topic], log_time_ns, data, publish_time_ns)
        except OSError as error:
            self._failure = error
            raise self._cannot_write(error) from error

    def write_all(self, messages: Sequence[Message]) -> None:
        """Write some messages at a fraction of the cost of `write`."""
        add, channels = self._writer.add_message, self._channels
        with self._writing():
            for topic, _, data, log_time_ns, publish_time_ns in messages:
                add(channels[topic], log_time_ns, data, publish_time_ns)

    def write_series(self, series: Sequence[MessageSeries]) -> None:
        """Write the messages of some series in order of log time."""
        with self._writing():
            self._writer.add_records(packed([(self._channels[one.topic], one) for one in series]))

    def copy(self, chunk: RecordedChunk, topics: Mapping[int, str]) -> Counter[str]:
        """Copy what a chunk has of some topics, and return the number of messages of each.

        Args:
            chunk: The chunk.
            topics: Those to copy, by their channels.
        """
        ids = {channel: self._channels[topic] for channel, topic in topics.items()}
        with self._writing():
            if chunk.can_stay(ids, self._writer.channels, self._writer.schemas):
                self._writer.add_chunk(chunk.record, chunk.chunk, chunk.messages)
                channels = chunk.messages.channels
            else:
                picked = chunk.pick(ids)
                channels = picked.channels
                if len(channels):
                    self._writer.add_records_as_chunk(picked)
        names = {self._channels[topic]: topic for topic in topics.values()}
        found = np.unique(channels, return_counts=True)
        each = zip(*(column.tolist() for column in found), strict=True)
        return Counter({names[channel]: number for channel, number in each})

    def duration_with(self, log_time_ns: int) -> int:
        """Return the file's duration, ns, if a message of this log time were in it too."""
        return max(self._writer.end, log_time_ns) - min(self._writer.start, log_time_ns)

    @property
    def size(self) -> int:
        """The bytes written so far, without the chunk in progress."""
        return self._stream.tell()

    def info(self) -> FileMetadata:
        if not self.message_count:
            return FileMetadata(self.path.name)
        start, end = self._writer.start, self._writer.end
        return FileMetadata(self.path.name, start, end - start, self.message_count)

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
        except ModuleNotFoundError as error:
            text = f"the library of its compression is not installed: {error}"
            raise BagWriteError(f"{self.path}: {text}") from error

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
        ids: tuple[int, int] | None = None,
    ) -> None:
        """Register a topic before its first message.

        Registering it again changes nothing: readers compare a topic's QoS in the file with the
        one in metadata.yaml, and return no messages where they differ.

        Args:
            name: The full topic name.
            type: The message type, `package/msg/Type`.
            qos_profiles: What its publishers offer.
            definition: Its definition; the installed one by default.
            ids: Channel and schema that it has in the file, if they are free.

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
        self._file.add_topic(topic, ids)
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

    def write_series(self, series: Sequence[MessageSeries]) -> None:
        """Append messages in order of log time, equal ones in order of the series.

        Args:
            series: Messages of registered topics.

        Raises:
            BagWriteError: As for `write`.
        """
        series = [one for one in series if len(one.data)]
        times = [each for one in series for each in one[2:4]]
        if (
            self._closed
            or self._is_limited
            or self._on_split is not None
            or not {one.topic for one in series} <= self._topics.keys()
            or not all(each.min() >= 0 and each.max() < _TIME_LIMIT_NS for each in times)
        ):
            messages = [message for one in series for message in one.messages()]
            self.write_all(sorted(messages, key=itemgetter(3)))
        elif series:
            self._file.write_series(series)
            for one in series:
                self._counts[one.topic] += len(one.data)

    def copy(self, chunk: RecordedChunk, topics: Mapping[int, str]) -> None:
        """Copy what a chunk of another bag has of some topics.

        The chunk is copied as it is if everything in it is wanted, with the channels and schemas
        of this bag, and a checksum covers it. Else messages are copied: to a chunk of their own, or
        one by one if files have limits.

        Args:
            chunk: The chunk.
            topics: Those to copy, all registered, by their channels.

        Raises:
            BagWriteError: As for `write`.
        """
        data, channels, log_times, begins, ends = chunk.messages
        wanted = np.isin(channels, list(topics))
        times = log_times[wanted], chunk.publish_times[wanted]
        if (
            self._closed
            or self._is_limited
            or self._on_split is not None
            or not set(topics.values()) <= self._topics.keys()
            or not all(min(each, default=0) >= 0 for each in times)
        ):
            content = data.tobytes()
            columns = (each[wanted].tolist() for each in (channels, begins, ends))
            for channel, begin, end, log_time, publish_time in zip(*columns, *times, strict=True):
                message = content[begin + MESSAGE.size : end]
                self.write(topics[channel], message, int(log_time), int(publish_time))
            return
        for topic, count in self._file.copy(chunk, topics).items():
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


@contextmanager
def whole_bag(path: str | Path, **options: Any) -> Iterator[BagWriter]:
    """Yield the writer of a bag that appears once it is complete, and not at all otherwise.

    Args:
        path: The bag's folder, which must not exist.
        options: Those of `BagWriter`.

    Raises:
        BagWriteError: As for `BagWriter`, or the bag cannot be closed.
    """
    path = Path(path).absolute()
    if os.path.lexists(path):
        raise BagWriteError(f"{path}: exists already, bags are not overwritten")
    with (
        written_whole(path.parent, BagWriteError) as folder,
        BagWriter(folder / path.name, **options) as writer,
    ):
        yield writer


def _free(wanted: int, taken: Mapping[int, object]) -> int:
    """Return an id that is not taken: the wanted one, if it is any, else the next one."""
    if wanted and wanted not in taken:
        return wanted
    return next(id_ for id_ in itertools.count(len(taken) + 1) if id_ not in taken)


def packed(series: Sequence[tuple[int, MessageSeries]]) -> Records:
    """Return the records of messages in order of log time, equal ones in order of the series.

    Args:
        series: Messages, with their channels.
    """
    log_times = np.concatenate([one.log_times for _, one in series])
    sizes = np.array([one.data.shape for _, one in series])
    lengths = np.repeat(MESSAGE.size + sizes[:, 1], sizes[:, 0])
    order = np.argsort(log_times, kind="stable")
    ends = np.cumsum(lengths[order])
    begins = ends - lengths[order]
    place = np.empty(len(order), np.int64)
    place[order] = begins
    records = np.empty(int(ends[-1]), np.uint8)
    channels = np.empty(len(order), np.int64)
    at = 0
    for channel, one in series:
        own = slice(at, at + len(one.data))
        at = own.stop
        rows = np.empty(len(one.data), _record_type(one.data.shape[1]))
        length = MESSAGE.size - RECORD.size + one.data.shape[1]
        rows["opcode"], rows["length"], rows["channel"] = MESSAGE_OPCODE, length, channel
        rows["sequence"] = 0
        rows["log_time"], rows["publish_time"] = one.log_times, one.publish_times
        rows["data"] = one.data
        size = rows.itemsize
        pieces(records, size)[place[own]] = rows.view(f"V{size}")
        channels[own] = channel
    return Records(records, channels[order], log_times[order], begins, ends)


def _record_type(size: int) -> np.dtype[Any]:
    """Return the type of the record of a message with so many bytes of data."""
    return np.dtype(
        [
            ("opcode", "u1"),
            ("length", "<u8"),
            ("channel", "<u2"),
            ("sequence", "<u4"),
            ("log_time", "<u8"),
            ("publish_time", "<u8"),
            ("data", "u1", (size,)),
        ]
    )
