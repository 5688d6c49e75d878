# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The MCAP container: the summary of a file, its chunks, and the messages in them.

The record types are those of the library `mcap`. This module adds limits, because the library
accepts any length that a file states, and splits chunks into messages with the compiled core.
"""

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Header, McapRecord, Schema, Statistics
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from tsobs_ros.core import native
from tsobs_ros.errors import BagReadError
from tsobs_ros.files import naming_path, open_regular

Rows = NDArray[np.void]
"""Messages, each a row of the type `ROW`."""

_FIELDS = ("channel", "log_time", "publish_time", "begin", "size", "chunk")
ROW = np.dtype([(name, np.int64) for name in _FIELDS])
"""A message: its channel, times [ns], first byte and size of its data in a run of records, and the
key of this run if there are several. Times that do not fit 63 bits are negative."""

MAGIC = b"\x89MCAP0\r\n"

RECORD = struct.Struct("<BQ")
"""The start of every record: its opcode and the length of its body in bytes."""

MESSAGE = struct.Struct("<BQHIQQ")
"""The start of a message: opcode, length, channel, sequence, log time, publish time."""

CHUNK_HEAD = struct.Struct("<BQQQQII")
"""Start of a chunk: opcode, length, first and last log time, size, checksum, size of codec name."""
CHUNK_HEAD_SIZE = 80

INDEX_HEAD = struct.Struct("<BQHI")
"""The start of a message index: opcode, length, channel, size of its entries."""

MAX_SIZE = 2**28
"""The largest record and chunk content that is read [bytes]; anything larger is damage."""

MAX_SUMMARY_SIZE = 2**27
"""The largest summary that is read [bytes]: enough for a million chunks, a recording of days."""

MAX_MESSAGES = 2**20
"""The largest number of messages in a chunk; as Python objects they take 300 MB."""

RECOVER_HINT = "'tsobs bag recover' makes a whole bag of what it holds"

_CHUNK_INDEX = struct.Struct("<BQQQQQI")
_CHUNK_INDEX_REST = 28
_INDEX_OFFSET = struct.Struct("<HQ")
_MAX_STATISTICS_SIZE = 2**20
_FOOTER = struct.Struct("<QQI")
_FOOTER_START = RECORD.pack(Opcode.FOOTER, _FOOTER.size)
END_SIZE = RECORD.size + _FOOTER.size + len(MAGIC)
"""Size of the footer and of the magic bytes behind it [bytes]."""
_MAX_HEADER_SIZE = 2**16
# A robot's schemas and channels take less.
_MAX_DESCRIPTIONS = 2**24


class RecordError(ValueError):
    """Bytes that are not the expected records."""


class Records(NamedTuple):
    """A run of records, and the messages in it: rows of the type `ROW`, shape (n,)."""

    data: bytes
    rows: Rows

    def descriptions(self) -> Iterator[bytes]:
        """Yield the records between the messages: schemas and channels."""
        begins = np.append(self.rows["begin"] - MESSAGE.size, len(self.data))
        ends = np.append(0, self.rows["begin"] + self.rows["size"])
        for gap in np.flatnonzero(begins != ends).tolist():
            yield from _each(self.data[int(ends[gap]) : int(begins[gap])])


def split_records(data: bytes) -> Records:
    """Return the messages in a run of whole records, such as a decompressed chunk.

    Raises:
        RecordError: A record is cut off or malformed, or there are too many messages.

    >>> record = MESSAGE.pack(Opcode.MESSAGE, 24, 1, 0, 20, 10) + b"hi"
    >>> split_records(record).rows["log_time"].tolist()
    [20]
    """
    # Parts of this array that are never written take no memory.
    found = np.empty((len(_FIELDS) - 1, min(len(data) // MESSAGE.size, MAX_MESSAGES)), np.int64)
    count = native.messages_split(data, found)
    if count < 0:
        many = f", or more than {MAX_MESSAGES} messages" if found.shape[1] == MAX_MESSAGES else ""
        raise RecordError(f"it holds bytes that are no record{many}")
    rows = np.zeros((count, len(_FIELDS)), np.int64)
    rows[:, :-1] = found[:, :count].T
    return Records(data, rows.view(ROW)[:, 0])


def by_channel(rows: Rows) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield each channel with the row numbers of its messages, ascending."""
    order = np.argsort(rows["channel"], kind="stable")
    ids, begins = np.unique(rows["channel"][order], return_index=True)
    return zip(ids.tolist(), np.split(order, begins[1:]), strict=False)


def message_indexes(rows: Rows) -> Iterator[tuple[int, int, bytes]]:
    """Yield each channel of a chunk with its count and message index, ordered by first message."""
    entries = np.stack([rows["log_time"], rows["begin"] - MESSAGE.size], axis=1).astype("<i8")
    for channel, places in sorted(by_channel(rows), key=lambda each: int(each[1][0])):
        own = entries[places].tobytes()
        length = INDEX_HEAD.size - RECORD.size + len(own)
        head = INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, length, channel, len(own))
        yield channel, len(places), head + own


def pieces(data: NDArray[np.uint8], size: int) -> NDArray[np.void]:
    """Return a view, without a copy, of the `size` bytes that begin at each offset of `data`."""
    return np.ndarray((len(data) - size + 1,), f"V{size}", data, 0, (1,))


def read_chunk(chunk: Chunk) -> Records:
    """Return the records of a chunk, decompressed and checked.

    Raises:
        RecordError: The chunk states more than `MAX_SIZE` bytes of content; or its content cannot
            be decompressed, has a size or checksum other than stated, is malformed, or has too many
            bytes outside of messages.
    """
    if chunk.uncompressed_size > MAX_SIZE:
        raise RecordError(f"the chunk states {chunk.uncompressed_size} bytes, too many to read")
    try:
        data = _decompressed(chunk)
    except Exception as error:  # the libraries' errors have several roots
        raise RecordError(f"the chunk cannot be decompressed: {error}") from error
    if len(data) != chunk.uncompressed_size:
        raise RecordError(
            f"the chunk states another size of its content: {chunk.uncompressed_size}"
        )
    stated = chunk.uncompressed_crc
    if stated and (crc := zlib.crc32(data)) != stated:
        raise RecordError(f"the chunk's checksum (crc) is {stated:08x}, its content's {crc:08x}")
    content = split_records(data)
    size = MESSAGE.size * len(content.rows) + int(content.rows["size"].sum())
    if len(data) - size > _MAX_DESCRIPTIONS:
        raise RecordError(f"more than {_MAX_DESCRIPTIONS} bytes of it are no messages")
    return content


def _decompressed(chunk: Chunk) -> bytes:
    """Return the content of a chunk, at most one byte beyond the size it states."""
    # Imported here: bags without compression need neither library.
    if chunk.compression == "lz4":
        import lz4.frame

        stream, limit = lz4.frame.LZ4FrameDecompressor(), chunk.uncompressed_size + 1
        return bytes(stream.decompress(chunk.data, max_length=limit))
    if chunk.compression == "zstd":
        import zstandard

        reader = zstandard.ZstdDecompressor().stream_reader(chunk.data)
        return bytes(reader.read(chunk.uncompressed_size + 1))
    if chunk.compression:
        raise RecordError(f"compression '{chunk.compression}' is not known")
    return chunk.data


class Span(NamedTuple):
    """The location of a chunk, which is read as a whole, and its first and last log time [ns].

    `rank` is the number of its file in the bag, `offset` its first byte in that file, `size` is in
    bytes; `places` has the offsets of its message indexes in the file, encoded as in its record.
    """

    start: int
    end: int
    rank: int
    offset: int
    size: int
    places: bytes

    @property
    def index_offsets(self) -> dict[int, int]:
        """The offsets of its message indexes in the file, by channel; a file may have none."""
        return dict(_INDEX_OFFSET.iter_unpack(self.places))


class Summary(NamedTuple):
    """The summary of a finished file: schemas and channels by id, counts and times, chunks.

    `profile` is the one in the file's header.
    """

    profile: str
    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    statistics: Statistics
    spans: tuple[Span, ...]


def read_summary(path: Path, rank: int = 0) -> Summary:
    """Return the summary of a finished MCAP file; `rank` is the number of the file in its bag.

    Raises:
        BagReadError: The file cannot be read, is not an MCAP file, has no end or no summary, or
            either is damaged.
    """
    try:
        with naming_path(path, BagReadError), open_regular(path) as stream:
            return _read_summary(path, rank, stream)
    except RecordError as error:
        raise BagReadError(f"{path}: the file is damaged: {error}; {RECOVER_HINT}") from error


def _read_summary(path: Path, rank: int, stream: IO[bytes]) -> Summary:
    size = stream.seek(0, 2)
    stream.seek(0)
    front = stream.read(_MAX_HEADER_SIZE)
    if not front.startswith(MAGIC):
        raise BagReadError(f"{path}: not an MCAP file")
    stream.seek(max(len(MAGIC), size - END_SIZE))
    if (footer := find_footer(stream.read())) is None:
        raise BagReadError(
            f"{path}: the file has no end: it is still being recorded, was truncated, or its "
            f"recorder was killed; {RECOVER_HINT}"
        )
    header = parse_record(next(_each(front[len(MAGIC) :])))
    if not isinstance(header, Header):
        raise RecordError("it does not start with a header")
    start = footer.summary_start
    if not len(MAGIC) < start < size - END_SIZE:
        raise RecordError("it has no index")
    if size - start > MAX_SUMMARY_SIZE:
        raise RecordError(f"it states a summary of {size - start} bytes, too many to read")
    stream.seek(start)
    data = stream.read(size - END_SIZE - start)
    summary = parse_summary(data, footer, header.profile, rank)
    spans = summary.spans
    # Otherwise a few bytes of index could have the same large chunk read again and again.
    for one, other in pairwise(sorted(spans, key=attrgetter("offset"))):
        if one.offset + one.size > other.offset:
            raise RecordError(f"the index states chunks that overlap at byte {other.offset}")
    if (reach := max((span.offset + span.size for span in spans), default=0)) > size:
        raise RecordError(f"the index states a chunk up to byte {reach} of {size}")
    return summary


def find_footer(end: bytes) -> Footer | None:
    """Return the footer from the last `END_SIZE` bytes of a file; None if it has no footer."""
    if not end.startswith(_FOOTER_START) or len(end) < END_SIZE or not end.endswith(MAGIC):
        return None
    return Footer(*_FOOTER.unpack_from(end, RECORD.size))


def parse_summary(data: bytes, footer: Footer, profile: str = "", rank: int = 0) -> Summary:
    """Return the summary from its records; the profile is not among them.

    Raises:
        RecordError: A record is malformed, the statistics are missing or state another number of
            chunks, or the checksum does not match.
    """
    crc = summary_crc(data, footer)
    if footer.summary_crc not in (0, crc):
        raise RecordError(
            f"the checksum (crc) of its summary is {footer.summary_crc:08x}, not {crc:08x}"
        )
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    spans: list[Span] = []
    statistics: Statistics | None = None
    for record in _each(data):
        if record[0] == Opcode.CHUNK_INDEX:
            spans.append(_chunk_span(record, rank))
        elif record[0] in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
            if record[0] == Opcode.STATISTICS and len(record) > _MAX_STATISTICS_SIZE:
                raise RecordError(f"it states statistics of {len(record)} bytes, too many to read")
            match parse_record(record):
                case Schema() as found:
                    schemas[found.id] = found
                case Channel() as found:
                    channels[found.id] = found
                case Statistics() as found:
                    statistics = found
    if statistics is None:
        raise RecordError("it has no index")
    if statistics.chunk_count != len(spans):
        raise RecordError(f"{statistics.chunk_count} chunks, but {len(spans)} in the index")
    return Summary(profile, schemas, channels, statistics, tuple(spans))


def summary_crc(data: bytes, footer: Footer) -> int:
    """Return the checksum of a summary, which also covers the footer up to the checksum."""
    return zlib.crc32(packed(footer)[:-4], zlib.crc32(data))


def parse_record(record: bytes) -> McapRecord:
    """Return the parsed record, which must be of a kind that the library `mcap` has.

    Raises:
        RecordError: The bytes are no such record, or their number does not match its lengths.
    """
    try:
        # From memory, so that no stated length allocates more than exists.
        reader = StreamReader(BytesIO(record), skip_magic=True, emit_chunks=True)
        found = next(reader.records)
        written = packed(found)
    except (McapError, struct.error, ValueError, OverflowError, StopIteration) as error:
        raise RecordError("not a record") from error
    # The library accepts a text that ends early.
    if written != record:
        raise RecordError("not a record")
    return found


def packed(record: McapRecord) -> bytes:
    """Return a record as bytes."""
    builder: Any = RecordBuilder()  # the library annotates its methods only in part
    record.write(builder)
    return bytes(builder.end())


def _each(data: bytes) -> Iterator[bytes]:
    """Yield each record in `data`."""
    at = 0
    while at < len(data):
        opcode, length = RECORD.unpack(data[at : at + RECORD.size].ljust(RECORD.size, b"\0"))
        end = at + RECORD.size + length
        if not opcode or end > len(data):
            raise RecordError("a record is cut off")
        yield data[at:end]
        at = end


def _chunk_span(record: bytes, rank: int) -> Span:
    """Return the chunk that a chunk index describes; the library would take ten times as long."""
    padded = record.ljust(_CHUNK_INDEX.size, b"\xff")
    _, _, start, end, offset, size, index_size = _CHUNK_INDEX.unpack_from(padded)
    rest = _CHUNK_INDEX.size + index_size
    if index_size % _INDEX_OFFSET.size or len(record) < rest + _CHUNK_INDEX_REST:
        raise RecordError("an index of a chunk is malformed")
    return Span(start, end, rank, offset, size, record[_CHUNK_INDEX.size : rest])


def chunk_head(head: bytes) -> tuple[Chunk, int, int]:
    """Return a chunk without its data, the offset of the data in the record, and the record's size.

    `head` is the first `CHUNK_HEAD_SIZE` bytes of the record.

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
