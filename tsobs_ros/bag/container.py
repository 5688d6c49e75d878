# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The MCAP container: the summary of a file, its chunks, and the messages in them.

The records are those of the library `mcap`. Ours are the limits, as the library accepts any length
a file states, and the splitting of a chunk into messages, as the library's takes 8 to 30 times as
long.
"""

import struct
import zlib
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple, TypeAlias

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Footer, Header, McapRecord, Schema, Statistics
from mcap.stream_reader import StreamReader

from tsobs_ros.errors import BagReadError

MAGIC = b"\x89MCAP0\r\n"

RECORD = struct.Struct("<BQ")
"""The start of every record: its opcode and the length of its body in bytes."""

MESSAGE = struct.Struct("<BQHIQQ")
"""The start of a message: opcode, length, channel, sequence, log time, publish time."""

MESSAGE_OPCODE = int(Opcode.MESSAGE)

MAX_SIZE = 2**28
"""The largest record, chunk content and summary that is read, bytes; larger ones are damage."""

RECOVER_HINT = "'tsobs bag recover' makes a whole bag of what it holds"

RawMessage: TypeAlias = tuple[int, int, int, int, bytes]
"""Channel, log time [ns], publish time [ns], sequence and data of a message."""

_MESSAGE_BODY_SIZE = MESSAGE.size - RECORD.size
_FOOTER = struct.Struct("<BQQQI")
_MAX_HEADER_SIZE = 2**16
_RUN_SIZE = 1_000_000


class RecordError(ValueError):
    """Bytes that are not the records they should be."""


def split_messages(records: bytes) -> Iterator[RawMessage]:
    """Yield the messages in a run of records, in their order; records of other kinds are skipped.

    Args:
        records: Whole records, one after the other, as in a decompressed chunk.

    Raises:
        RecordError: A record is cut off or malformed; all messages before it have been yielded.

    >>> record = MESSAGE.pack(Opcode.MESSAGE, 24, 1, 0, 20, 10) + b"hi"
    >>> list(split_messages(record))
    [(1, 20, 10, 0, b'hi')]
    """
    # Local names: a bag has millions of messages.
    opcode, head_size, unpack = MESSAGE_OPCODE, MESSAGE.size, MESSAGE.unpack_from
    start, size = 0, len(records)
    try:
        while start < size:
            if records[start] == opcode:
                _, length, channel, sequence, log_time, publish_time = unpack(records, start)
                end = start + RECORD.size + length
                data = start + head_size
                if not data <= end <= size:
                    break
                yield channel, log_time, publish_time, sequence, records[data:end]
            else:
                end = start + RECORD.size + RECORD.unpack_from(records, start)[1]
                if end > size:
                    break
            start = end
    except struct.error as error:
        raise RecordError(f"the record at byte {start} of {size} is cut off") from error
    if start != size:
        length = RECORD.unpack_from(records, start)[1]
        raise RecordError(
            f"the record at byte {start} of {size} states a length of {length} bytes, "
            f"{size - start - RECORD.size} follow"
        )


def chunk_records(chunk: Chunk) -> bytes:
    """Return the records in a chunk, decompressed and checked.

    Raises:
        RecordError: The chunk states more than `MAX_SIZE` bytes of content, its content cannot be
            decompressed, or has another size or checksum than the chunk states.
    """
    size = chunk.uncompressed_size
    if size > MAX_SIZE:
        raise RecordError(f"the chunk states {size} bytes of content, too many to read")
    try:
        records = _decompress(chunk.compression, chunk.data, size)
    except Exception as error:  # the libraries' errors have several roots
        raise RecordError(f"the chunk cannot be decompressed: {error}") from error
    if len(records) != size:
        raise RecordError(f"the chunk states {size} bytes of content, but has {len(records)}")
    stated = chunk.uncompressed_crc
    if stated and (crc := zlib.crc32(records)) != stated:
        raise RecordError(f"the chunk's checksum (crc) is {stated:08x}, its content's {crc:08x}")
    return records


def _decompress(compression: str, data: bytes, size: int) -> bytes:
    # Imported here: bags without compression need neither library.
    if not compression:
        return data
    if compression == "lz4":
        import lz4.frame

        # The plain function allocates whatever size the frame states.
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
    if compression == "zstd":
        import zstandard

        stated = zstandard.get_frame_parameters(data).content_size
        if stated not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise RecordError(f"zstd states {stated} bytes of content, the chunk {size}")
        return bytes(zstandard.ZstdDecompressor().decompress(data, max_output_size=size))
    raise RecordError(f"compression '{compression}' is not known")


class Span(NamedTuple):
    """A part of a file that is read at once: a chunk, or messages outside of any chunk.

    Attributes:
        start: The smallest log time in it, ns.
        end: The largest log time in it, ns.
        rank: The place of its file in the bag.
        offset: Its first byte in the file.
        size: Its size in the file, bytes.
        is_chunk: Whether it is a chunk record.
        channels: The channels it has messages of; None if that is unknown.
        index_offsets: The places of its message indexes in the file, by channel.
    """

    start: int
    end: int
    rank: int
    offset: int
    size: int
    is_chunk: bool
    channels: frozenset[int] | None
    index_offsets: Mapping[int, int]


class Summary(NamedTuple):
    """The summary of a finished file.

    Attributes:
        path: The file.
        profile: The profile in its header.
        schemas: Its schemas by id.
        channels: Its channels by id.
        statistics: Its counts and times.
        spans: The places of its messages.
    """

    path: Path
    profile: str
    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    statistics: Statistics
    spans: tuple[Span, ...]


def read_summary(path: Path, rank: int = 0) -> Summary:
    """Return the summary of a finished MCAP file.

    Args:
        path: The file.
        rank: Its place in the bag.

    Raises:
        BagReadError: It cannot be read, is not an MCAP file, has no end or no summary, or they are
            damaged.
    """
    try:
        with path.open("rb") as stream:
            return _read_summary(path, rank, stream)
    except (RecordError, McapError, struct.error, UnicodeDecodeError) as error:
        reason = f"the file is damaged: {_reason(error)}; {RECOVER_HINT}"
        raise BagReadError(f"{path}: {reason}") from error
    except OSError as error:
        if isinstance(error, BagReadError):
            raise
        raise BagReadError(f"{path}: cannot read it: {error}") from error


def _read_summary(path: Path, rank: int, stream: IO[bytes]) -> Summary:
    size = stream.seek(0, 2)
    footer_at = size - _FOOTER.size - len(MAGIC)
    stream.seek(0)
    front = stream.read(_MAX_HEADER_SIZE)
    if not front.startswith(MAGIC):
        raise BagReadError(f"{path}: not an MCAP file")
    stream.seek(max(len(MAGIC), footer_at))
    end = stream.read()
    if footer_at < len(MAGIC) or not end.endswith(MAGIC):
        raise BagReadError(
            f"{path}: the file has no end: it is still being recorded, was truncated, or its "
            f"recorder was killed; {RECOVER_HINT}"
        )
    header, footer = next(_records(front[len(MAGIC) :])), next(_records(end))
    if not isinstance(header, Header):
        raise RecordError("it does not start with a header")
    if not isinstance(footer, Footer):
        raise RecordError("it does not end with a footer")
    start = footer.summary_start
    if not len(MAGIC) < start < footer_at:
        raise BagReadError(f"{path}: the file has no index; {RECOVER_HINT}")
    if size - start > MAX_SIZE:
        raise RecordError(f"it states a summary of {size - start} bytes, too many to read")
    stream.seek(start)
    summary = stream.read(size - start)
    # The checksum covers the summary and the footer up to the checksum.
    stated, covered = footer.summary_crc, len(summary) - len(MAGIC) - 4
    if stated and (crc := zlib.crc32(summary[:covered])) != stated:
        raise RecordError(f"the checksum (crc) of its summary is {stated:08x}, not {crc:08x}")
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    chunks: list[ChunkIndex] = []
    statistics: Statistics | None = None
    for record in _records(summary):
        match record:
            case Schema():
                schemas[record.id] = record
            case Channel():
                channels[record.id] = record
            case ChunkIndex():
                chunks.append(record)
            case Statistics():
                statistics = record
    if statistics is None:
        raise BagReadError(f"{path}: the file has no index; {RECOVER_HINT}")
    if statistics.chunk_count != len(chunks):
        raise RecordError(f"{statistics.chunk_count} chunks, but {len(chunks)} in the index")
    if chunks or not statistics.message_count:
        spans = tuple(_chunk_span(chunk, rank, size) for chunk in chunks)
    else:
        spans = tuple(_bare_spans(stream, rank, start))
    return Summary(path, header.profile, schemas, channels, statistics, spans)


def _records(data: bytes) -> Iterator[McapRecord]:
    # From memory, so that a length that goes beyond the end allocates nothing.
    return iter(StreamReader(BytesIO(data), skip_magic=True, emit_chunks=True).records)


def _chunk_span(chunk: ChunkIndex, rank: int, file_size: int) -> Span:
    offset, size, indexes = (
        chunk.chunk_start_offset,
        chunk.chunk_length,
        chunk.message_index_offsets,
    )
    if offset + size > file_size:
        raise RecordError(f"the index states a chunk up to byte {offset + size} of {file_size}")
    return Span(
        start=chunk.message_start_time,
        end=chunk.message_end_time,
        rank=rank,
        offset=offset,
        size=size,
        is_chunk=True,
        # Without message indexes the channels are unknown.
        channels=frozenset(indexes) or None,
        index_offsets=indexes,
    )


def _bare_spans(stream: IO[bytes], rank: int, end: int) -> Iterator[Span]:
    """Yield runs of messages outside of chunks; their times stand in no index."""
    start = first = len(MAGIC)
    times: list[int] = []
    channels: set[int] = set()
    while start < end:
        stream.seek(start)
        head = stream.read(MESSAGE.size)
        if len(head) < RECORD.size:
            raise RecordError(f"the record at byte {start} is cut off")
        opcode, length = RECORD.unpack_from(head)
        following = start + RECORD.size + length
        if following > end:
            raise RecordError(f"the record at byte {start} ends at byte {following}, not by {end}")
        if opcode == MESSAGE_OPCODE:
            if length < _MESSAGE_BODY_SIZE:
                raise RecordError(f"the message at byte {start} has only {length} bytes")
            _, _, channel, _, time, _ = MESSAGE.unpack(head)
            times.append(time)
            channels.add(channel)
        if times and (following - first > _RUN_SIZE or following == end):
            size, seen = following - first, frozenset(channels)
            yield Span(min(times), max(times), rank, first, size, False, seen, {})
            times, channels, first = [], set(), following
        start = following


def read_span(stream: IO[bytes], span: Span) -> bytes:
    """Return the records in a span of a file.

    Raises:
        RecordError: They are damaged, or there is no chunk at the place of one.
    """
    if span.size > MAX_SIZE:
        raise RecordError(f"{span.size} bytes at byte {span.offset}, too many to read")
    stream.seek(span.offset)
    data = stream.read(span.size)
    if not span.is_chunk:
        return data
    head = RECORD.pack(Opcode.CHUNK, span.size - RECORD.size) if span.size >= RECORD.size else b""
    if not head or not data.startswith(head):
        raise RecordError(f"the index states a chunk at byte {span.offset}, but there is none")
    try:
        return chunk_records(Chunk.read(ReadDataStream(BytesIO(data[RECORD.size :]))))
    except (RecordError, McapError, struct.error, UnicodeDecodeError) as error:
        raise RecordError(f"at byte {span.offset}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    return "a record is cut off" if isinstance(error, struct.error | EndOfFile) else str(error)
