# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What is where in a finished MCAP file: its topics, its counts, and its spans of messages."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Schema, Statistics

from tsobs_ros.bag.mcap.chunk import chunk_records, parse_chunk
from tsobs_ros.bag.mcap.records import (
    FRAME,
    MAGIC,
    MESSAGE,
    Frame,
    RecordError,
    parse,
    read_body,
    read_frame,
)
from tsobs_ros.errors import BagReadError

RECOVER_HINT = "'tsobs bag recover' makes a whole bag of what it holds"
_FOOTER_SIZE = FRAME.size + 20 + len(MAGIC)
_BARE_SPAN_SIZE = 1_000_000


class Span(NamedTuple):
    """A piece of a file that is read at once: a chunk, or messages outside of any chunk.

    Attributes:
        start: The smallest log time in it, ns.
        end: The largest log time in it, ns.
        rank: Its file's place in the bag.
        frame: Where it is; the opcode is CHUNK for a chunk, MESSAGE for bare messages.
        channels: The channels it has messages of; None if that is not known.
        indexes: Where the message indexes of its channels are, as far as it has any.
    """

    start: int
    end: int
    rank: int
    frame: Frame
    channels: frozenset[int] | None
    indexes: Mapping[int, int]


@dataclass(frozen=True)
class FileIndex:
    """What a file's summary tells.

    Attributes:
        path: The file.
        rank: Its place in the bag.
        profile: The profile in its header.
        schemas: Its schemas by id.
        channels: Its channels by id.
        statistics: Its counts and times.
        spans: Where its messages are.
    """

    path: Path
    rank: int
    profile: str
    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    statistics: Statistics
    spans: tuple[Span, ...]


def read_index(path: Path, rank: int = 0) -> FileIndex:
    """Return the index of a finished MCAP file.

    Args:
        path: The file.
        rank: Its place in the bag.

    Raises:
        BagReadError: It cannot be read, is not an MCAP file, has no end or index, or they are
            damaged.
    """
    try:
        with path.open("rb") as stream:
            return _Reading(path, rank, stream).index()
    except RecordError as error:
        raise BagReadError(f"{path}: the file is damaged: {error}; {RECOVER_HINT}") from error
    except OSError as error:
        if isinstance(error, BagReadError):
            raise
        raise BagReadError(f"{path}: cannot read it: {error}") from error


def read_span(stream: IO[bytes], frame: Frame) -> bytes:
    """Return the records in a span of a file.

    Raises:
        RecordError: They are damaged.
    """
    if frame.opcode != Opcode.CHUNK:
        return read_body(stream, frame)
    found = read_frame(stream, frame.start, frame.end)
    if found != frame:
        raise RecordError(f"the index states a chunk at byte {frame.start}, but there is none")
    try:
        return chunk_records(parse_chunk(read_body(stream, frame)))
    except RecordError as error:
        raise RecordError(f"at byte {frame.start}: {error}") from error


class _Reading:
    def __init__(self, path: Path, rank: int, stream: IO[bytes]) -> None:
        self._path = path
        self._rank = rank
        self._stream = stream
        self._size = stream.seek(0, 2)

    def index(self) -> FileIndex:
        self._check_ends()
        header = read_frame(self._stream, len(MAGIC), self._size)
        if header.opcode != Opcode.HEADER:
            raise RecordError("it does not begin with a header")
        profile = parse(Opcode.HEADER, read_body(self._stream, header)).profile
        footer_at = self._size - _FOOTER_SIZE
        frame = read_frame(self._stream, footer_at, self._size - len(MAGIC))
        if frame.opcode != Opcode.FOOTER:
            raise RecordError("it does not end with a footer")
        footer: Footer = parse(Opcode.FOOTER, read_body(self._stream, frame))
        if not header.end <= footer.summary_start < footer_at:
            raise BagReadError(f"{self._path}: the file has no index; {RECOVER_HINT}")
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        chunks: list[ChunkIndex] = []
        statistics: Statistics | None = None
        for frame in self._frames(footer.summary_start, footer_at):
            match parse(frame.opcode, read_body(self._stream, frame)):
                case Schema() as schema:
                    schemas[schema.id] = schema
                case Channel() as channel:
                    channels[channel.id] = channel
                case ChunkIndex() as chunk:
                    chunks.append(chunk)
                case Statistics() as record:
                    statistics = record
        if statistics is None:
            raise BagReadError(f"{self._path}: the file has no index; {RECOVER_HINT}")
        if statistics.chunk_count != len(chunks):
            raise RecordError(f"{statistics.chunk_count} chunks, but {len(chunks)} in the index")
        if chunks or not statistics.message_count:
            spans = tuple(map(self._chunk_span, chunks))
        else:
            spans = tuple(self._bare_spans(header.end, footer.summary_start))
        return FileIndex(self._path, self._rank, profile, schemas, channels, statistics, spans)

    def _check_ends(self) -> None:
        self._stream.seek(0)
        if self._stream.read(len(MAGIC)) != MAGIC:
            raise BagReadError(f"{self._path}: not an MCAP file")
        self._stream.seek(max(len(MAGIC), self._size - len(MAGIC)))
        if self._stream.read() != MAGIC or self._size < 2 * len(MAGIC) + _FOOTER_SIZE:
            raise BagReadError(
                f"{self._path}: the file has no end: it is still being recorded, was truncated, or "
                f"its recorder was killed; {RECOVER_HINT}"
            )

    def _frames(self, start: int, end: int) -> Iterator[Frame]:
        while start < end:
            frame = read_frame(self._stream, start, end)
            yield frame
            start = frame.end

    def _chunk_span(self, chunk: ChunkIndex) -> Span:
        start, end = chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length
        if end > self._size:
            raise RecordError(f"the index states a chunk up to byte {end}, but it has {self._size}")
        # Without message indexes nothing is said about the channels.
        channels = frozenset(chunk.message_index_offsets) or None
        frame = Frame(Opcode.CHUNK, start, start + FRAME.size, end)
        indexes = chunk.message_index_offsets
        start_time, end_time = chunk.message_start_time, chunk.message_end_time
        return Span(start_time, end_time, self._rank, frame, channels, indexes)

    def _bare_spans(self, start: int, end: int) -> Iterator[Span]:
        """Yield runs of messages outside of chunks, whose times nobody has noted."""
        times: list[int] = []
        channels: set[int] = set()
        first = start
        for frame in self._frames(start, end):
            if frame.opcode == Opcode.MESSAGE:
                if frame.end - frame.start < MESSAGE.size:
                    raise RecordError(f"the message at byte {frame.start} has no head")
                self._stream.seek(frame.start)
                _, _, channel, _, time, _ = MESSAGE.unpack(self._stream.read(MESSAGE.size))
                times.append(time)
                channels.add(channel)
            if times and (frame.end - first > _BARE_SPAN_SIZE or frame.end == end):
                bare = Frame(Opcode.MESSAGE, first, first, frame.end)
                yield Span(min(times), max(times), self._rank, bare, frozenset(channels), {})
                times, channels, first = [], set(), frame.end
