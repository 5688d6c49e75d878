# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A writer of bags: folders of MCAP files with a metadata.yaml, as of `ros2 bag record -s mcap`."""

import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from tsobs_ros import __version__
from tsobs_ros.bag.cdr import MessageSeries
from tsobs_ros.bag.container import MESSAGE, RECORD, Records, pieces, split_records
from tsobs_ros.bag.definitions import MessageDefinition, find_definition
from tsobs_ros.bag.file_writer import COMPRESSIONS, FileWriter, pick
from tsobs_ros.bag.metadata import (
    EMPTY_START_NS,
    BagMetadata,
    QosProfile,
    TopicInfo,
    write_metadata,
)
from tsobs_ros.errors import BagWriteError
from tsobs_ros.files import fsync_folder, naming_path, written_whole

if TYPE_CHECKING:
    from tsobs_ros.bag.reader import BagReader

CHUNK_SIZE = 786_432

# Size of the part of a message in front of its times.
_HEAD_SIZE = MESSAGE.size - 16


class BagWriter(AbstractContextManager["BagWriter"]):
    """Writes one bag; a context manager that closes it.

    All methods except `sync` belong to one thread. Once a write has failed, all further writes
    fail: a file may have half a chunk, and an index would hide messages that can be recovered.

    Args:
        path: The bag's folder, which must not exist; missing parents are created.
        compression: Compression of the chunks: `none`, `lz4` or `zstd`.
        max_size: The size at which another file is started, bytes; 0 for no limit.
        max_duration_ns: The longest span of log times in a file, ns; 0 for no limit.
        custom_data: Notes for the bag's metadata.

    Raises:
        BagWriteError: The folder exists or cannot be created, or the compression is unknown. All
            methods raise it if the bag is closed or cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: str = "zstd",
        max_size: int = 0,
        max_duration_ns: int = 0,
        custom_data: Mapping[str, str] | None = None,
    ) -> None:
        self.path = Path(path).absolute()
        if compression not in COMPRESSIONS:
            names = ", ".join(COMPRESSIONS)
            raise BagWriteError(f"{path}: no compression '{compression}', there is {names}")
        self._compression = compression
        self._max_size, self._max_duration_ns = max_size, max_duration_ns
        self._custom_data = custom_data
        self._topics: dict[str, TopicInfo] = {}
        self._files: list[FileWriter] = []
        self._on_disk = (0, 0)
        self._closed = False
        self._failure = ""
        # Held during a sync of the disk, which may take seconds.
        self._disk = Lock()
        if os.path.lexists(self.path):
            raise BagWriteError(f"{self.path}: exists already, bags are not overwritten")
        with naming_path(self.path, BagWriteError, "create"):
            self.path.mkdir(parents=True)
            fsync_folder(self.path.parent)
        self._start_file()
        self._write_metadata()

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """The registered topics, with the number of messages of each in finished chunks."""
        files, topics = list(self._files), list(self._topics.values())
        return tuple(replace(one, count=sum(f.count(one.name) for f in files)) for one in topics)

    @property
    def file_count(self) -> int:
        """The number of files of the bag."""
        return len(self._files)

    @property
    def _file(self) -> FileWriter:
        return self._files[-1]

    def _metadata(self, *started: FileWriter) -> BagMetadata:
        files = [file.info() for file in (*self._files, *started)]
        return BagMetadata.of(self.topics, files, self._custom_data)

    def add_topic(
        self,
        name: str,
        type: str,
        qos_profiles: Iterable[QosProfile] = (),
        *,
        definition: MessageDefinition | None = None,
    ) -> None:
        """Register a topic before its first message.

        Registering a topic again changes nothing: readers compare its QoS in the file with that in
        metadata.yaml, and return no messages if they differ.

        Args:
            name: The full topic name.
            type: The message type, `package/msg/Type`.
            qos_profiles: The offers of its publishers.
            definition: Its definition; the installed one by default.
        """
        if (known := self._topics.get(name)) is not None:
            if known.type != type:
                raise BagWriteError(
                    f"{self.path}: {name} is {known.type} already, it cannot be {type}"
                )
            return
        definition = definition or find_definition(type)
        qos = tuple(qos_profiles)
        topic = TopicInfo(name, definition.type, 0, qos, definition.type_hash, definition)
        with self._writing():
            self._file.add_topic(topic)
        self._topics[name] = topic

    def add_topics(self, topics: Iterable[TopicInfo]) -> None:
        """Register topics of another bag, in their order there."""
        for one in topics:
            self.add_topic(one.name, one.type, one.qos_profiles, definition=one.definition)

    def write(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Append one message.

        Args:
            topic: A registered topic.
            data: The message in CDR, with its encapsulation header, as it came off the wire.
            log_time_ns: When it was received, ns since the epoch.
            publish_time_ns: When it was published, ns since the epoch.
        """
        if self._failure:
            raise BagWriteError(self._failure)
        is_right = 0 <= log_time_ns < EMPTY_START_NS and 0 <= publish_time_ns < EMPTY_START_NS
        if topic not in self._topics or not is_right:
            self._require(topic, np.array([log_time_ns, publish_time_ns]))
        if self._max_size or self._max_duration_ns:
            self._make_room(log_time_ns)
        try:
            self._file.add_message(topic, data, log_time_ns, publish_time_ns)
        except OSError as error:
            raise self._failed(error) from error

    def write_series(self, series: Sequence[MessageSeries]) -> None:
        """Append messages in order of log time, equal ones in order of the series.

        The limits on size and duration of files do not apply.
        """
        made = []
        for one in filter(lambda one: len(one.data), series):
            self._require(one.topic, one.log_times, one.publish_times)
            count, size = one.data.shape
            front = Opcode.MESSAGE, MESSAGE.size - RECORD.size + size, self._file.ids[one.topic]
            times = [("log_time", "<u8"), ("publish_time", "<u8")]
            fields = [("head", f"V{_HEAD_SIZE}"), *times, ("data", "u1", (size,))]
            made.append(np.zeros(count, fields))
            made[-1]["head"] = np.void(MESSAGE.pack(*front, 0, 0, 0)[:_HEAD_SIZE])
            made[-1]["log_time"], made[-1]["publish_time"] = one.log_times, one.publish_times
            made[-1]["data"] = one.data
        if not made:
            return
        order = np.argsort(np.concatenate([rows["log_time"] for rows in made]), kind="stable")
        sizes = np.concatenate([np.full(len(rows), rows.itemsize) for rows in made])[order]
        ends, places = np.cumsum(sizes), np.empty(len(order), np.int64)
        places[order] = ends - sizes
        data = np.empty(int(ends[-1]), np.uint8)
        for rows in made:
            own, places = places[: len(rows)], places[len(rows) :]
            pieces(data, rows.itemsize)[own] = rows.view(f"V{rows.itemsize}")
        # Chunks of the usual size: the message that exceeds it is the last of its chunk.
        begin = 0
        while begin < len(data):
            end = int(ends[np.searchsorted(ends[:-1], begin + CHUNK_SIZE, side="right")])
            self._add_chunk(split_records(data[begin:end].tobytes()))
            begin = end

    def copy_topics(self, reader: "BagReader", topics: Collection[str]) -> None:
        """Copy the messages of some topics from the chunks of a bag, in the order of its files.

        Raises:
            BagReadError: A chunk is damaged; the chunks before it are copied.
        """
        for summary in reader.summaries:
            each = summary.channels.items()
            wanted = {id_: one.topic for id_, one in each if one.topic in topics}
            for span in sorted(summary.spans, key=attrgetter("offset")):
                if not reader.topics_of(span).isdisjoint(topics):
                    self.copy(reader.read(span)[0], wanted)

    def copy(self, content: Records, topics: Mapping[int, str]) -> None:
        """Copy the messages of some topics from a chunk of another bag; file limits do not apply.

        `topics` has the topics to copy, all registered, by their channels in that bag.
        """
        ids = {id_: self._file.ids[topic] for id_, topic in topics.items()}
        if len((picked := pick(content, ids)).rows):
            self._add_chunk(picked)

    def _add_chunk(self, records: Records) -> None:
        self._require(None, records.rows["log_time"], records.rows["publish_time"])
        with self._writing():
            self._file.add_chunk(records)

    def _require(self, topic: str | None, *times: NDArray[np.int64]) -> None:
        """Raise `BagWriteError` unless a given topic is registered and times [ns] fit 63 bits."""
        if topic is not None and topic not in self._topics:
            raise BagWriteError(f"{self.path}: topic {topic} has not been added")
        for each in times:
            if each.min() < 0 or each.max() >= EMPTY_START_NS:
                text = f"times must be at least 0 and fit 63 bits: {each.min()} to {each.max()} ns"
                raise BagWriteError(f"{self.path}: {topic or 'a message'}: {text}")

    def flush(self) -> None:
        """Hand everything written so far to the operating system: it survives a kill."""
        with self._writing():
            self._file.flush()

    def split(self) -> None:
        """Start another file, unless the current one is empty; a kill cannot harm the old one.

        The metadata.yaml in the folder names the new file after the next `sync` or `close`.
        """
        with self._writing():
            if self._file.message_count == 0:
                return
            self._finish()
        try:
            self._start_file()
        except BagWriteError:
            with suppress(BagWriteError):
                self.close()
            raise

    def sync(self) -> None:
        """Force all flushed data to the disk, so that they survive a power cut.

        It may run in a separate thread, as a disk can be slow. It does nothing once the bag is
        closed.
        """
        with self._disk:
            if self._closed:
                return
            *finished, current = self._files
            with naming_path(current.path, BagWriteError, "write"):
                for file in finished:
                    file.close()
                current.sync()
            # Only if topics or files are new: the files have the counts, but after a power cut
            # metadata.yaml should name all topics and files.
            if self._on_disk != (len(self._topics), len(self._files)):
                self._write_metadata()

    def close(self) -> None:
        """Finish the bag: index, metadata, everything forced to the disk; safe to call twice."""
        with self._disk:
            if self._closed:
                return
            self._closed = True
            with naming_path(self._file.path, BagWriteError, "write"), ExitStack() as stack:
                # Every step is done, even if another one fails.
                stack.callback(self._write_metadata)
                stack.callback(self._file.path.stat)  # fails if the file was deleted
                for file in self._files:
                    stack.callback(file.close)
                if not self._file.is_finished:
                    with self._writing():
                        self._finish()
                self._failure = f"{self.path}: the bag is closed"

    def __exit__(self, *_: object) -> None:
        """Close the bag, also when an error ends the block: what was written is kept."""
        self.close()

    def _start_file(self) -> None:
        path = self.path / f"{self.path.name}_{len(self._files)}.mcap"
        try:
            with naming_path(path, BagWriteError, "write"):
                file = FileWriter(path, f"tsobs_ros {__version__}", self._compression, CHUNK_SIZE)
                file.add_metadata(self._metadata(file))
                file.flush()
                # Every file must make sense on its own.
                for topic in self._topics.values():
                    file.add_topic(topic)
        except ModuleNotFoundError as error:
            text = f"the library of its compression is not installed: {error}"
            raise BagWriteError(f"{path}: {text}") from error
        self._files.append(file)

    def _finish(self) -> None:
        self._file.flush()
        self._file.add_metadata(self._metadata())
        self._file.finish()

    def _make_room(self, log_time_ns: int) -> None:
        """Start another file if this one is full."""
        file, size, duration = self._file, self._max_size, self._max_duration_ns
        if file.message_count and (
            0 < size <= file.size or 0 < duration < file.duration_with(log_time_ns)
        ):
            self.split()

    def _write_metadata(self) -> None:
        metadata = self._metadata()
        write_metadata(self.path, metadata)
        self._on_disk = (len(metadata.topics_with_message_count), len(metadata.files))

    @contextmanager
    def _writing(self) -> Iterator[None]:
        if self._failure:
            raise BagWriteError(self._failure)
        try:
            yield
        except OSError as error:
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> BagWriteError:
        self._failure = f"{self._file.path}: cannot write it: {error}"
        return BagWriteError(self._failure)


@contextmanager
def whole_bag(path: str | Path, **options: Any) -> Iterator[BagWriter]:
    """Yield the `BagWriter` of a bag that appears only once it is complete, or not at all."""
    path = Path(path).absolute()
    if os.path.lexists(path):
        raise BagWriteError(f"{path}: exists already, bags are not overwritten")
    with (
        written_whole(path.parent, BagWriteError) as folder,
        BagWriter(folder / path.name, **options) as writer,
    ):
        yield writer
