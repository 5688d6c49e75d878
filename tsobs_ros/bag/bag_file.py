# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One MCAP file of a bag, laid out as rosbag2 lays it out."""

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from mcap.exceptions import UnsupportedCompressionError
from mcap.writer import LIBRARY_IDENTIFIER

from tsobs_ros import __version__
from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.bag.mcap.writer import McapWriter
from tsobs_ros.bag.metadata import EMPTY_START_NS, BagMetadata, FileMetadata
from tsobs_ros.bag.qos import QosProfile, profiles_to_yaml
from tsobs_ros.errors import BagWriteError

LIBRARY = "tsobs_ros"
CHUNK_SIZE = 786_432
COMPRESSIONS: Mapping[str, str] = {"none": "", "lz4": "lz4", "zstd": "zstd"}


class BagFile:
    """Writes one file: header, chunks of messages, index.

    Once writing has failed, all further writing does: there may be half a chunk in the file, and
    an index that states the whole would hide what can be recovered.

    Args:
        path: The file, which must not exist.
        compression: A name of `COMPRESSIONS`.
        metadata: The bag's metadata at the opening of the file.

    Raises:
        BagWriteError: The file exists or cannot be created, or the compression's library is not
            installed.
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
            # Buffered: the writer hands over a record in many small pieces.
            self._stream = path.open("xb")
        except OSError as error:
            raise BagWriteError(f"{path}: cannot create it: {error}") from error
        # In this order: on a full disk closing fails as well, and that is the same error.
        with self._writing(), ExitStack() as undo:
            undo.callback(self._stream.close)
            self._writer = McapWriter(self._stream, CHUNK_SIZE, COMPRESSIONS[compression])
            self._writer.start(
                profile="ros2", library=f"{LIBRARY} {__version__}; {LIBRARY_IDENTIFIER}"
            )
            self._add_metadata(metadata)
            self._stream.flush()
            undo.pop_all()

    def add_topic(
        self, topic: str, definition: MessageDefinition, qos: tuple[QosProfile, ...]
    ) -> None:
        """Register a topic, once, before its first message.

        Raises:
            BagWriteError: The file cannot be written.
        """
        with self._writing():
            if (schema := self._schemas.get(definition.type)) is None:
                schema = self._writer.register_schema(
                    definition.type, definition.encoding, definition.text.encode()
                )
                self._schemas[definition.type] = schema
            self._channels[topic] = self._writer.register_channel(
                topic,
                "cdr",
                schema,
                {
                    "offered_qos_profiles": profiles_to_yaml(qos),
                    "topic_type_hash": definition.type_hash,
                },
            )

    def write(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Append one message of a registered topic.

        Raises:
            BagWriteError: The file cannot be written.
        """
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

    def duration_with(self, log_time_ns: int) -> int:
        """Return the file's duration, ns, if a message of this log time were in it too."""
        start = min(self._start_ns, log_time_ns)
        return max(self._end_ns, log_time_ns) - start

    @property
    def size(self) -> int:
        """The bytes written so far; the chunk being filled is not among them."""
        return self._stream.tell()

    def info(self) -> FileMetadata:
        """Return what the bag's metadata says about this file."""
        duration = self._end_ns - self._start_ns if self.message_count else 0
        return FileMetadata(self.path.name, self._start_ns, duration, self.message_count)

    def flush(self) -> None:
        """Hand all messages so far to the operating system: they survive a kill.

        Raises:
            BagWriteError: The file cannot be written.
        """
        with self._writing():
            self._writer.flush()

    def sync(self) -> None:
        """Force what has been flushed to the disk: it survives a power cut.

        Raises:
            BagWriteError: The disk failed.
        """
        with self._errors():
            os.fdatasync(self._stream.fileno())

    def finish(self, metadata: BagMetadata) -> None:
        """Write the index, once: the file is complete, and survives a kill as it is.

        Args:
            metadata: The bag's metadata with this file in its final state.

        Raises:
            BagWriteError: The file cannot be written.
        """
        if self._finished:
            return
        with self._writing():
            self._add_metadata(metadata)
            self._writer.finish()
            self._stream.flush()
        self._finished = True

    def close(self) -> None:
        """Force everything to the disk and release the file.

        Raises:
            BagWriteError: The disk failed; the descriptor is released all the same.
        """
        with self._errors(), self._stream:
            os.fsync(self._stream.fileno())

    def _add_metadata(self, metadata: BagMetadata) -> None:
        # Inside the chunk in progress a metadata record is not allowed, so end that one first.
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
