# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The MCAP container: the summary of a file, its chunks, and the messages in them.

The records are those of the library `mcap`. Ours are the limits, as the library accepts any length
a file states, and the splitting of a chunk into messages, as the library's takes 8 to 30 times as
long.
"""

import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import IO, NamedTuple, TypeAlias

from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Header, McapRecord, Schema, Statistics
from mcap.stream_reader import StreamReader

from tsobs_ros.errors import BagReadError
from tsobs_ros.files import open_regular

MAGIC = b"\x89MCAP0\r\n"

RECORD = struct.Struct("<BQ")
"""The start of every record: its opcode and the length of its body in bytes."""

MESSAGE = struct.Struct("<BQHIQQ")
"""The start of a message: opcode, length, channel, sequence, log time, publish time."""

MESSAGE_OPCODE = int(Opcode.MESSAGE)

CHUNK_HEAD = struct.Struct("<BQQQQII")
"""The start of a chunk: opcode, length, first and last log time, size, checksum, size of a name."""

INDEX_HEAD = struct.Struct("<BQHI")
"""The start of a message index: opcode, length, channel, size of its entries."""

CHUNK_INDEX = struct.Struct("<QQQQI")
"""The body of a chunk index: first and last log time, place, size, size of its offsets."""

MAX_SIZE = 2**28
"""The largest record and chunk content that is read, bytes; larger ones are damage."""

MAX_SUMMARY_SIZE = 2**27
"""The largest summary that is read, bytes: of a million chunks, a recording of days."""

RECOVER_HINT = "'tsobs bag recover' makes a whole bag of what it holds"

RawMessage: TypeAlias = tuple[int, int, int, int, bytes]
"""Channel, log time [ns], publish time [ns], sequence and data of a message."""

# More than there can be schemas and channels.
_MAX_OTHERS = 2**18
_MESSAGE_BODY_SIZE = MESSAGE.size - RECORD.size
_MAX_CHUNK_HEAD_SIZE = 80
_CHUNK_INDEX_REST = 28
_INDEX_OFFSET = struct.Struct("<HQ")
_MAX_STATISTICS_SIZE = 2**20
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
    start, size, others = 0, len(records), 0
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
                kind, length = RECORD.unpack_from(records, start)
                end = start + RECORD.size + length
                others += 1
                # Zeros are no records without a body.
                if end > size or not kind or others > _MAX_OTHERS:
                    break
            start = end
    except struct.error as error:
        raise RecordError(f"the record at byte {start} of {size} is cut off") from error
    if others > _MAX_OTHERS:
        raise RecordError(f"more than {_MAX_OTHERS} records are no messages, too many to read")
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


class ContentLimit:
    """What the chunks of a file may decompress to: 1 GiB and 100 bytes for each byte of the file.

    In these there may be 524,288 records, and one for each six bytes of the file. Without a
    limit, a file of some kilobytes can be hours of work.

    Args:
        size: The file's size, bytes.
        is_trusted: Whether there is no limit.

    Attributes:
        records_left: How many more records there may be.
    """

    def __init__(self, size: int, is_trusted: bool) -> None:
        self._bytes_left = 2**64 if is_trusted else 2**30 + 100 * size
        self.records_left = 2**64 if is_trusted else 2**19 + size // 6

    def count_chunk(self, chunk: Chunk) -> None:
        """Count a chunk before it is decompressed.

        Raises:
            RecordError: There are too many bytes.
        """
        if chunk.compression:
            self._bytes_left -= min(chunk.uncompressed_size, MAX_SIZE)
        self.count_records(0)

    def count_records(self, number: int) -> None:
        """Count records in chunks.

        Raises:
            RecordError: There are too many.
        """
        self.records_left -= number
        if min(self._bytes_left, self.records_left) < 0:
            raise RecordError(
                "the chunks decompress to too much for a file of this size; --trusted reads them"
            )


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
        places: The places of its message indexes in the file, as its record has them.
    """

    start: int
    end: int
    rank: int
    offset: int
    size: int
    is_chunk: bool
    places: bytes = b""

    @property
    def index_offsets(self) -> dict[int, int]:
        """The places of its message indexes in the file, by channel."""
        return dict(_INDEX_OFFSET.iter_unpack(self.places))

    def check(self, first: int, last: int) -> None:
        """Raise `RecordError` unless log times in it are as the index states [ns]."""
        if not self.start <= first <= last <= self.end:
            raise RecordError(f"the index states other times at byte {self.offset}")

    @property
    def channels(self) -> frozenset[int] | None:
        """The channels it has messages of; None if that is unknown."""
        return frozenset(self.index_offsets) or None


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
        with open_regular(path) as stream:
            return _read_summary(path, rank, stream)
    except (RecordError, McapError, struct.error, UnicodeDecodeError) as error:
        reason = f"the file is damaged: {_reason(error)}; {RECOVER_HINT}"
        raise BagReadError(f"{path}: {reason}") from error
    except OSError as error:
        if isinstance(error, BagReadError):
            raise
        raise BagReadError(f"{path}: cannot read it: {error.strerror or error}") from error


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
    if size - start > MAX_SUMMARY_SIZE:
        raise RecordError(f"it states a summary of {size - start} bytes, too many to read")
    stream.seek(start)
    summary = stream.read(footer_at - start)
    # The checksum covers the summary and the footer up to the checksum.
    stated, covered = footer.summary_crc, end[: _FOOTER.size - 4]
    if stated and (crc := zlib.crc32(covered, zlib.crc32(summary))) != stated:
        raise RecordError(f"the checksum (crc) of its summary is {stated:08x}, not {crc:08x}")
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    chunks: list[Span] = []
    statistics: Statistics | None = None
    at = 0
    while at < len(summary):
        opcode, length = RECORD.unpack_from(summary, at)
        body = at + RECORD.size
        following = body + length
        if following > len(summary) or not opcode:
            raise RecordError(f"at byte {start + at} there is no record, or one that is cut off")
        if opcode == Opcode.CHUNK_INDEX:
            chunks.append(_chunk_span(summary, body, following, rank, size))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
            if opcode == Opcode.STATISTICS and length > _MAX_STATISTICS_SIZE:
                raise RecordError(f"it states statistics of {length} bytes, too many to read")
            match next(_records(summary[at:following])):
                case Schema() as record:
                    schemas[record.id] = record
                case Channel() as record:
                    channels[record.id] = record
                case Statistics() as record:
                    statistics = record
        at = following
    if statistics is None:
        raise BagReadError(f"{path}: the file has no index; {RECOVER_HINT}")
    if statistics.chunk_count != len(chunks):
        raise RecordError(f"{statistics.chunk_count} chunks, but {len(chunks)} in the index")
    # Else a few bytes of index could ask for the same large chunk again and again.
    for one, other in pairwise(sorted(chunks, key=attrgetter("offset"))):
        if one.offset + one.size > other.offset:
            raise RecordError(f"the index states chunks that overlap at byte {other.offset}")
    if statistics.message_count and not chunks:
        chunks = list(_bare_spans(stream, rank, start))
    return Summary(path, header.profile, schemas, channels, statistics, tuple(chunks))


def _records(data: bytes) -> Iterator[McapRecord]:
    # From memory, so that a length that goes beyond the end allocates nothing.
    return iter(StreamReader(BytesIO(data), skip_magic=True, emit_chunks=True).records)


def _chunk_span(summary: bytes, at: int, end: int, rank: int, file_size: int) -> Span:
    """Return the chunk that a chunk index is of; the library takes ten times as long."""
    start_time, end_time, offset, size, index_size = CHUNK_INDEX.unpack_from(summary, at)
    at += CHUNK_INDEX.size
    if index_size % _INDEX_OFFSET.size or at + index_size + _CHUNK_INDEX_REST > end:
        raise RecordError("an index of a chunk is malformed")
    if offset + size > file_size:
        raise RecordError(f"the index states a chunk up to byte {offset + size} of {file_size}")
    index = summary[at : at + index_size]
    return Span(start_time, end_time, rank, offset, size, True, index)


def _bare_spans(stream: IO[bytes], rank: int, end: int) -> Iterator[Span]:
    """Yield runs of messages outside of chunks; their times stand in no index."""
    start = first = len(MAGIC)
    times: list[int] = []
    while start < end:
        stream.seek(start)
        head = stream.read(MESSAGE.size)
        if len(head) < RECORD.size:
            raise RecordError(f"the record at byte {start} is cut off")
        opcode, length = RECORD.unpack_from(head)
        following = start + RECORD.size + length
        if following > end or not opcode:
            raise RecordError(f"the record at byte {start} ends at byte {following}, not by {end}")
        if opcode == MESSAGE_OPCODE:
            if length < _MESSAGE_BODY_SIZE:
                raise RecordError(f"the message at byte {start} has only {length} bytes")
            times.append(MESSAGE.unpack(head)[4])
        if times and (following - first > _RUN_SIZE or following == end):
            yield Span(min(times), max(times), rank, first, following - first, False)
            times, first = [], following
        start = following


def read_chunk(stream: IO[bytes], span: Span) -> tuple[bytes, Chunk]:
    """Return the record of a chunk as it is in a file, and the same as the library has it.

    Raises:
        RecordError: There is no chunk at the place of one, or a damaged one.
    """
    _require_size(span)
    stream.seek(span.offset)
    record = stream.read(span.size)
    try:
        chunk, data_at, size = chunk_head(record[:_MAX_CHUNK_HEAD_SIZE])
        if size != span.size:
            raise RecordError("the index states another size")
    except RecordError as error:
        raise RecordError(f"at byte {span.offset}: {error}") from error
    chunk.data = record[data_at:]
    return record, chunk


def read_span(stream: IO[bytes], span: Span) -> tuple[bytes, bool]:
    """Return the records in a span of a file, and whether a checksum covers them.

    Raises:
        RecordError: They are damaged, or there is no chunk at the place of one.
    """
    if not span.is_chunk:
        _require_size(span)
        stream.seek(span.offset)
        return stream.read(span.size), False
    _, chunk = read_chunk(stream, span)
    try:
        return chunk_records(chunk), chunk.uncompressed_crc != 0
    except RecordError as error:
        raise RecordError(f"at byte {span.offset}: {error}") from error


def _require_size(span: Span) -> None:
    if span.size > MAX_SIZE:
        raise RecordError(f"{span.size} bytes at byte {span.offset}, too many to read")


def has_checksum(stream: IO[bytes], span: Span) -> bool:
    """Return whether a checksum covers the records in a span of a file, damaged or not."""
    if span.is_chunk:
        stream.seek(span.offset)
        with suppress(RecordError):
            return chunk_head(stream.read(_MAX_CHUNK_HEAD_SIZE))[0].uncompressed_crc != 0
    return False


def chunk_head(head: bytes) -> tuple[Chunk, int, int]:
    """Return a chunk without its data, where in the record that starts, and the record's size.

    Args:
        head: The first bytes of the record, at least 80 if there are as many.

    Raises:
        RecordError: There is no chunk, or one of more than `MAX_SIZE` bytes.
    """
    try:
        opcode, length, start, end, size, crc, name_size = CHUNK_HEAD.unpack_from(head)
        name = head[CHUNK_HEAD.size : CHUNK_HEAD.size + name_size].decode("ascii")
        (data_size,) = struct.unpack_from("<Q", head, CHUNK_HEAD.size + name_size)
    except (struct.error, UnicodeDecodeError) as error:
        raise RecordError("there is no chunk") from error
    data_at = CHUNK_HEAD.size + name_size + 8
    if opcode != Opcode.CHUNK or data_at + data_size != RECORD.size + length:
        raise RecordError("there is no chunk, or it states two sizes")
    if length > MAX_SIZE:
        raise RecordError(f"the chunk states {length} bytes, too many to read")
    return Chunk(name, b"", end, start, crc, size), data_at, data_at + data_size


def _reason(error: Exception) -> str:
    return "a record is cut off" if isinstance(error, struct.error | EndOfFile) else str(error)
