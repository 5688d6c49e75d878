# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Writing MCAP: the bytes of `mcap.writer.Writer`, at a third of the time a message.

The library makes an object of every message and writes its fields one by one. Here a message is
packed at once; all other records, of which there are few, are the library's.
"""

import struct
import zlib
from array import array
from collections.abc import Callable, Mapping, Sequence
from typing import IO, Any

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.exceptions import UnsupportedCompressionError
from mcap.opcode import Opcode

from tsobs_ros.bag.mcap.records import (
    FRAME,
    INDEX_HEAD,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD_SIZE,
    MESSAGE_OPCODE,
)

_FOOTER_FRONT = struct.Struct("<BQQQ")
_FOOTER_SIZE = 20


class McapWriter:
    """Writes one file in chunks, with all indexes, statistics and checksums of chunks.

    Args:
        stream: Where to; it is not closed.
        chunk_size: A chunk ends when it has more bytes than this.
        compression: As chunks say: `lz4`, `zstd` or an empty string.

    Raises:
        UnsupportedCompressionError: There is no such compression, or its library is not installed.
    """

    def __init__(self, stream: IO[bytes], chunk_size: int, compression: str) -> None:
        self._stream = stream
        self._chunk_size = chunk_size
        self._compression = compression
        self._compress = _compressor(compression)
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunk_indexes: list[records.ChunkIndex] = []
        self._metadata_indexes: list[records.MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._start_time = self._end_time = 0
        # The chunk in progress, and by channel the log time and place of each message in it.
        self._parts: list[bytes] = []
        self._size = 0
        self._entries: dict[int, array[int]] = {}

    def start(self, profile: str, library: str) -> None:
        """Write what the file begins with."""
        self._stream.write(MAGIC + _built(records.Header(profile=profile, library=library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema, and return its number."""
        schema = records.Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data)
        self._schemas.append(schema)
        self._add(_built(schema))
        return schema.id

    def register_channel(
        self, topic: str, message_encoding: str, schema_id: int, metadata: dict[str, str]
    ) -> int:
        """Add a channel, and return its number."""
        channel = records.Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=message_encoding,
            schema_id=schema_id,
            metadata=metadata,
        )
        self._channels.append(channel)
        self._add(_built(channel))
        return channel.id

    def add_message(self, channel: int, log_time: int, data: bytes, publish_time: int) -> None:
        """Add a message of a channel, with its times in ns."""
        length = len(data) + MESSAGE_HEAD_SIZE
        head = MESSAGE.pack(MESSAGE_OPCODE, length, channel, 0, log_time, publish_time)
        entries = self._entries.get(channel)
        if entries is None:
            entries = self._entries[channel] = array("Q")
        entries.append(log_time)
        entries.append(self._size)
        self._parts += (head, data)
        self._size += length + FRAME.size
        if self._size > self._chunk_size:
            self._end_chunk()

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Add metadata, after the chunks that have ended."""
        record = _built(records.Metadata(name=name, metadata=metadata))
        index = records.MetadataIndex(offset=self._stream.tell(), length=len(record), name=name)
        self._stream.write(record)
        self._metadata_indexes.append(index)

    def flush(self) -> None:
        """End the chunk in progress, if it has messages, and hand everything to the system."""
        self._end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """End the file: what it holds, where, and how much."""
        self._end_chunk()
        self._stream.write(_built(records.DataEnd(0)))
        begin = self._stream.tell()
        groups: tuple[tuple[Opcode, Sequence[Any]], ...] = (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, []),
            (Opcode.METADATA_INDEX, self._metadata_indexes),
        )
        summary, offsets = b"", b""
        for opcode, group in groups:
            data = _built(*group)
            offset = records.SummaryOffset(
                group_opcode=opcode, group_start=begin + len(summary), group_length=len(data)
            )
            summary, offsets = summary + data, offsets + _built(offset)
        offsets_begin = begin + len(summary)
        front = _FOOTER_FRONT.pack(Opcode.FOOTER, _FOOTER_SIZE, begin, offsets_begin)
        crc = zlib.crc32(front, zlib.crc32(summary + offsets))
        footer = records.Footer(
            summary_start=begin, summary_offset_start=offsets_begin, summary_crc=crc
        )
        self._stream.write(summary + offsets + _built(footer) + MAGIC)

    def _add(self, record: bytes) -> None:
        self._parts.append(record)
        self._size += len(record)
        if self._size > self._chunk_size:
            self._end_chunk()

    def _end_chunk(self) -> None:
        """Write the chunk in progress and its indexes; without messages it goes on."""
        if not self._entries:
            return
        data, entries = b"".join(self._parts), self._entries
        self._parts, self._size, self._entries = [], 0, {}
        start = min(min(each[::2]) for each in entries.values())
        end = max(max(each[::2]) for each in entries.values())
        self._count(entries, start, end)
        compressed = self._compress(data)
        chunk = records.Chunk(
            compression=self._compression,
            data=compressed,
            message_start_time=start,
            message_end_time=end,
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        record = _built(chunk)
        offset = self._stream.tell()
        index_offset = offset + len(record)
        indexes, offsets = b"", {}
        for channel, each in entries.items():
            offsets[channel] = index_offset + len(indexes)
            indexes += _message_index(channel, each)
        self._chunk_indexes.append(
            records.ChunkIndex(
                message_start_time=start,
                message_end_time=end,
                chunk_start_offset=offset,
                chunk_length=len(record),
                message_index_offsets=offsets,
                message_index_length=len(indexes),
                compression=self._compression,
                compressed_size=len(compressed),
                uncompressed_size=len(data),
            )
        )
        self._stream.write(record)
        self._stream.write(indexes)

    def _count(self, entries: Mapping[int, "array[int]"], start: int, end: int) -> None:
        self._start_time = min(start, self._start_time) if self._counts else start
        self._end_time = max(end, self._end_time)
        for channel, each in entries.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(each) // 2

    def _statistics(self) -> records.Statistics:
        return records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunk_indexes),
            message_count=sum(self._counts.values()),
            message_end_time=self._end_time,
            message_start_time=self._start_time,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )


def _built(*group: Any) -> bytes:
    """Return records as bytes."""
    # Any: mcap annotates its methods only in part.
    builder: Any = RecordBuilder()
    for record in group:
        record.write(builder)
    return bytes(builder.end())


def _message_index(channel: int, entries: "array[int]") -> bytes:
    size = 8 * len(entries)
    frame = FRAME.pack(Opcode.MESSAGE_INDEX, INDEX_HEAD.size + size)
    return frame + INDEX_HEAD.pack(channel, size) + struct.pack(f"<{len(entries)}Q", *entries)


def _compressor(name: str) -> Callable[[bytes], bytes]:
    # Here, because a bag without compression needs neither library.
    try:
        if name == "lz4":
            import lz4.frame

            return lambda data: bytes(lz4.frame.compress(data))
        if name == "zstd":
            import zstandard

            return zstandard.compress
    except ImportError as error:
        raise UnsupportedCompressionError(name) from error
    if name:
        raise UnsupportedCompressionError(name)
    return lambda data: data
