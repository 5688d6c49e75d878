# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The intact pieces of an MCAP file that may be damaged anywhere.

Three things are certain. The checksum of a chunk covers its records. The head of a chunk states its
size twice. And a file that was cut off is intact up to the cut. So a chunk is taken if its checksum
holds, the front of a chunk is taken if the end of the file cuts it off, and after bytes that are no
record the next record is searched for. A file that ends with a footer was not cut off.

But messages may carry chunks themselves, and a disk may hold chunks of other files. So of a
finished file only the chunks that its summary states are its own. In others a chunk that comes
again is dropped, and so is what is found inside of a message, or of a chunk that has lost bytes; if
messages carry whole files, nothing is searched for.
"""

import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from io import BytesIO
from types import MappingProxyType
from typing import IO, Any, NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, McapRecord, Metadata, Statistics
from mcap.stream_reader import StreamReader

from tsobs_ros.bag.container import (
    CHUNK_INDEX,
    INDEX_HEAD,
    MAGIC,
    MAX_SIZE,
    MAX_SUMMARY_SIZE,
    MESSAGE,
    RECORD,
    ContentLimit,
    RecordError,
    chunk_head,
    chunk_records,
)

INDEX_ENTRY = struct.Struct("<QQ")
"""An entry of a message index: log time and place in the chunk."""

_CHUNK_HEAD_SIZE = 80
_MAX_OTHER_SIZE = 2**24
_MAX_DAMAGES = 10_000
# A file that ends with them, and perhaps with some bytes behind them, was not cut off.
_END = re.compile(re.escape(RECORD.pack(Opcode.FOOTER, 20)) + b".{20}" + MAGIC, re.DOTALL)
_MAX_END_SIZE = 2**16
_DATA_END = RECORD.pack(Opcode.DATA_END, 4)
_DATA_END_SIZE = RECORD.size + 4
_MAX_TRIES = 4
_FOREIGN = "a chunk that the index of the file does not state"
_BLOCK_SIZE = 2**20
_STEP = 2**16
# Header, schema, channel, message, chunk, metadata or data end, of less than 256 MiB. Looking ahead
# finds those that overlap, too.
_CANDIDATE = re.compile(rb"(?=[\x01\x03-\x06\x0c\x0f].{3}[\0-\x0f]\0{4})", re.DOTALL)
_DESCRIPTIONS = frozenset(map(int, Opcode)).difference(
    {Opcode.CHUNK, Opcode.MESSAGE, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT}
)
_CANDIDATE_COST = 4096
"""The cost of looking at one candidate, in bytes that can be read in that time."""

_MAX_FRONT = 2**20
"""The largest number of records that are kept of a damaged chunk."""

_RECORD_COST = 300
"""The cost of looking at a record in a chunk, in bytes that can be read in that time."""


class Content(NamedTuple):
    """Whole records: those of a chunk, or one message outside of any chunk.

    Attributes:
        records: The records.
        is_checked: Whether a checksum covers them.
        descriptions: The schemas and channels among them, each as its bytes.
    """

    records: bytes
    is_checked: bool = False
    descriptions: tuple[bytes, ...] = ()


@dataclass
class Damage:
    """A part of a file that is lost.

    Attributes:
        offset: The place of its first byte in the file.
        size: The number of its bytes.
        reason: What is wrong with it.
        messages: The number of messages it held; None if that is unknown.
    """

    offset: int
    size: int
    reason: str
    messages: int | None = None

    def __str__(self) -> str:
        """Return one line for people."""
        held = "" if self.messages is None else f", {self.messages} messages"
        return f"bytes {self.offset} to {self.offset + self.size}{held}: {self.reason}"


_Head = tuple[int, int, int]
"""What an index states of a chunk: its first and last log time, and its size."""


class Lost(NamedTuple):
    """What is known of a lost part: reason, what follows, and whether any of it is kept."""

    reason: str
    following: int
    kept: bool
    has_chunks: bool


class DamagedFile:
    """The pieces of one file, in their order.

    The time is linear in the size of the file and of what its chunks decompress to: searching ends
    for good if too much of the file looks like records without being any. Memory is bounded by the
    largest chunk, at most `MAX_SIZE`.

    Args:
        stream: The file.
        size: The number of bytes to read: the file may be growing.
        keep_unchecked: Whether to give the front of chunks whose checksum fails.
        is_trusted: Whether to read chunks however much they decompress to.
        lost: What an earlier reading found to be lost, which need not be searched again.

    Attributes:
        damage: The parts that are lost, as far as the file has been read.
        lost: What is lost, by the place of its first byte.
    """

    def __init__(
        self,
        stream: IO[bytes],
        size: int,
        *,
        keep_unchecked: bool = False,
        is_trusted: bool = False,
        lost: Mapping[int, Lost] = MappingProxyType({}),
    ) -> None:
        self.damage: list[Damage] = []
        self.lost = dict(lost)
        self._content = ContentLimit(size, is_trusted)
        self._descriptor = stream.fileno()
        self._size = size
        self._keep_unchecked = keep_unchecked
        self._written_end = self._end_without_zeros()
        # The chunks that the file has, by what is known of them; None if it does not tell.
        self._places: dict[_Head, set[int]] | None = None
        self._sizes: dict[int, int] = {}
        self._moved: dict[_Head, int] = {}
        self._seen: set[tuple[_Head, int]] = set()
        self._described: list[McapRecord] = []
        self._data_end = self._written_end
        self._has_end = self._read_end()
        # In front of these there is nothing of the file itself: a damaged chunk, a message.
        self._inside = self._covered = 0
        # A file without chunks describes its channels before its messages.
        self._bare_channels: set[bytes] = set()
        self._has_chunks = False
        # What was looked at last, and is read next if it is a record.
        self._parsed: tuple[int, McapRecord | None] = -1, None
        self._follows_damage = False
        self._effort_left = 64 * size + 2**30

    def pieces(self, progress: Callable[[int], object]) -> Iterator[Content | McapRecord]:
        """Yield what is intact; `progress` is called with the number of bytes got through."""
        at = 0
        yield from self._described
        while at < self._size:
            try:
                piece, following = self._read(at)
            except RecordError as error:
                piece, following = None, self._lose(at, str(error))
            if piece is not None:
                yield piece
            progress(following - at)
            at = following

    def _read(self, at: int) -> tuple[Content | McapRecord | None, int]:
        """Return the piece at an offset, if it is one, and where to go on.

        Raises:
            RecordError: There is no record.
        """
        if at >= self._written_end:
            return None, self._lose(at, "nothing but zeros to the end", self._size)
        if (lost := self.lost.get(at)) and not lost.kept:
            self._has_chunks = lost.has_chunks
            return None, self._lose(at, lost.reason, lost.following)
        head = self._bytes(at, len(MAGIC))
        if head == MAGIC:
            return None, at + len(MAGIC)
        if head[0] == Opcode.CHUNK:
            return self._read_chunk(at)
        if head[0] != Opcode.MESSAGE_INDEX:
            self._follows_damage = False
        return self._read_other(at)

    def _lose(self, at: int, reason: str, following: int | None = None, kept: bool = False) -> int:
        """Take account of damage, and return what follows: by default, the next record."""
        if following is None:
            known = self.lost.get(at)
            following = known.following if known else self._search(at + 1)
            if self._effort_left < 0:
                reason += "; too many of the bytes after it look like records to be searched"
        self.lost[at] = Lost(reason, following, kept, self._has_chunks)
        last = self.damage[-1] if self.damage else None
        if last and (last.offset + last.size == at or len(self.damage) > _MAX_DAMAGES):
            last.size += following - at
        elif len(self.damage) == _MAX_DAMAGES:
            self.damage.append(Damage(at, following - at, "and further parts behind it"))
        else:
            self.damage.append(Damage(at, following - at, reason))
        self._follows_damage = True
        return following

    def _read_chunk(self, at: int) -> tuple[Content | None, int]:
        chunk, data_at, size = chunk_head(self._bytes(at, _CHUNK_HEAD_SIZE))
        data_at, end = at + data_at, at + size
        self._has_chunks = True
        head = chunk.message_start_time, chunk.message_end_time, size
        if not self._is_own(at, head):
            return None, self._lose(at, _FOREIGN)
        chunk.data = self._bytes(data_at, end - data_at)
        cost = len(chunk.data)
        try:
            if end > self._size:
                raise RecordError("the file ends inside of a chunk")
            self._content.count_chunk(chunk)
            records = chunk_records(chunk)
            found = _whole_records(records, chunk, self._content.records_left)
            cost += len(records) + _RECORD_COST * found.number
            self._content.count_records(found.number)
            if found.size < len(records):
                raise RecordError("the chunk holds bytes that are no record")
            is_checked = chunk.uncompressed_crc != 0
            # If a chunk without a checksum has lost bytes, this shows behind it.
            if not (is_checked or self._starts_record(end)):
                raise RecordError("the chunk has no checksum, and no record follows it")
            again = (head, zlib.crc32(records))
            if self._places is None and head[0] < head[1] and again in self._seen:
                return None, self._lose(at, "a chunk that was there already", end)
            self._seen.add(again)
            self._follows_damage = False
            return found.content(records, is_checked), end
        except RecordError as error:
            reason = str(error)
        if not self._has_end and self._written_end < end:
            front, records = _front(chunk)
            # If its records go on through the zeros, those are its own; the damage is elsewhere.
            if end > self._size or front.size < chunk.uncompressed_size:
                chunk.data = chunk.data[: self._written_end - data_at]
                front, records = _front(chunk)
                if front.is_cut:
                    reason = "the file ends inside of a chunk, the front of which is kept"
                    return front.content(records), self._lose(at, reason, self._size, kept=True)
            cost += 2 * (len(records) + _RECORD_COST * front.number)
        content: Content | None = None
        if self._keep_unchecked:
            front, records = _front(chunk)
            content = front.content(records)
            cost += len(records) + _RECORD_COST * front.number
        following = end if end <= self._size and self._starts_record(end) else None
        if following is None:
            # A chunk that has lost bytes reaches into what follows it: search inside of it.
            self._effort_left -= cost
            self._inside = max(self._inside, min(end, self._size))
        return content, self._lose(at, reason, following, kept=content is not None)

    def _read_other(self, at: int) -> tuple[Content | McapRecord | None, int]:
        """Return the record at an offset, which is no chunk, and where it ends.

        Raises:
            RecordError: There is none.
        """
        head = self._bytes(at, INDEX_HEAD.size)
        if len(head) < RECORD.size:
            raise RecordError("a record is cut off")
        opcode, length = RECORD.unpack_from(head)
        size, end = RECORD.size + length, at + RECORD.size + length
        if end > self._size:
            raise RecordError("not a record, or one that is cut off")
        channel = head[9:11]
        if opcode in _DESCRIPTIONS and length <= _MAX_OTHER_SIZE:
            if self._parsed[0] != at:
                self._effort_left -= size
                self._parsed = at, parse_record(self._bytes(at, size))
            record = self._parsed[1]
            # One that has lost bytes may take them from the chunk that follows.
            if isinstance(record, Metadata) and not self._starts_record(end):
                raise RecordError("not a record")
            # Behind damage it may be one of a chunk whose head is lost, and whose checksum with it.
            is_bare = not self._has_chunks and (self._keep_unchecked or not self.damage)
            if isinstance(record, Channel) and is_bare:
                self._bare_channels.add(channel)
            return record, end
        # Nothing but the record that follows confirms the length of all others.
        if self._starts_record(end):
            if opcode == Opcode.MESSAGE_INDEX:
                # The indexes of a chunk follow it, also if the chunk is damaged.
                if self._follows_damage:
                    held = self.damage[-1].messages or 0
                    entries = (size - INDEX_HEAD.size) // INDEX_ENTRY.size
                    self.damage[-1].messages = held + entries
                return None, end
            is_whole = MESSAGE.size <= size <= MAX_SIZE and end <= self._written_end
            if opcode == Opcode.MESSAGE and channel in self._bare_channels and is_whole:
                return Content(self._bytes(at, size)), end
            if opcode == Opcode.ATTACHMENT or opcode >= 0x80:
                return None, end
        raise RecordError("not a record")

    def _starts_record(self, at: int) -> bool:
        """Whether there may be a record, even one that is cut off, or the end."""
        head = self._bytes(at, INDEX_HEAD.size)
        if at >= self._written_end or len(head) < INDEX_HEAD.size or head.startswith(MAGIC):
            return True
        opcode, length, channel, size = INDEX_HEAD.unpack(head)
        if opcode != Opcode.CHUNK and length > self._size - at - RECORD.size:
            return 0 < opcode <= max(Opcode) and length <= MAX_SIZE and not self._has_end
        if opcode == Opcode.MESSAGE_INDEX:
            return bool(size == length - INDEX_HEAD.size + RECORD.size)
        if opcode == Opcode.MESSAGE:
            return channel.to_bytes(2, "little") in self._bare_channels
        return (opcode == Opcode.CHUNK or opcode in _DESCRIPTIONS) and self._has_record(at, opcode)

    def _search(self, at: int) -> int:
        """Return where the next record is; the end if there is none."""
        if self._places is None and self._carries_files:
            return self._size
        self._cover(at - 1)
        step = _CANDIDATE_COST
        while at < self._written_end:
            with suppress(OSError):  # a sparse file has holes of any size
                at = max(at, os.lseek(self._descriptor, at, os.SEEK_DATA))
            block = self._bytes(at, step + RECORD.size - 1)
            for match in _CANDIDATE.finditer(block):
                place = match.start()
                if self._places is None and at + place < self._covered:
                    continue
                if block[place] == Opcode.MESSAGE and not self._bare_channels:
                    self._cover(at + place)
                    continue
                self._effort_left -= _CANDIDATE_COST
                if self._effort_left < 0:
                    return self._size
                if self._has_record(at + place, block[place]):
                    return at + place
            at, step = at + step, min(2 * step, _BLOCK_SIZE)
        return self._size

    @cached_property
    def _carries_files(self) -> bool:
        """Whether there are the marks of other files in it, such as messages may carry."""
        at = self._bytes(0, _MAX_END_SIZE).find(MAGIC) + 1  # behind its own
        while at < self._data_end:
            with suppress(OSError):  # a sparse file has holes of any size
                at = max(at, os.lseek(self._descriptor, at, os.SEEK_DATA))
            if MAGIC in self._bytes(at, min(_BLOCK_SIZE + len(MAGIC), self._data_end - at)):
                return True
            at += _BLOCK_SIZE
        return False

    def _cover(self, at: int) -> None:
        """Take account of what may be a message in a damaged chunk, in which there is no record."""
        with suppress(struct.error):
            opcode, length = RECORD.unpack(self._bytes(at, RECORD.size))
            if opcode != Opcode.MESSAGE or not MESSAGE.size - RECORD.size <= length <= MAX_SIZE:
                return
            end = at + RECORD.size + length
            # The next one in the chunk, or the index behind it.
            following, size = RECORD.unpack(self._bytes(end, RECORD.size))
            kinds = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.MESSAGE_INDEX)
            if following in kinds and size <= MAX_SIZE:
                self._covered = max(self._covered, end)

    def _is_own(self, at: int, head: _Head) -> bool:
        """Return whether the file states a chunk, there or, once, at a place where it is not."""
        if self._places is None:
            return True
        if at in self._places.get(head, ()):
            return True
        if self._sizes.get(at) == head[2] and head not in self._places:
            return True  # its times are what is damaged
        if head not in self._moved:
            places = self._places.get(head, set())
            self._moved[head] = sum(self._head(place) != head for place in places)
        self._moved[head] -= 1
        return self._moved[head] >= 0

    def _head(self, at: int) -> _Head | None:
        with suppress(RecordError):
            chunk, _, size = chunk_head(self._bytes(at, _CHUNK_HEAD_SIZE))
            return chunk.message_start_time, chunk.message_end_time, size
        return None

    def _read_end(self) -> bool:
        """Return whether the file has an end, and take the summary in front of it, if it is sound.

        It has moved if bytes were lost or added.
        """
        begin = max(0, self._written_end - _MAX_END_SIZE)
        ends = list(_END.finditer(self._bytes(begin, _MAX_END_SIZE)))
        if not ends:
            return False
        footer = parse_record(ends[-1][0][: -len(MAGIC)])
        assert isinstance(footer, Footer)
        footer_at = begin + ends[-1].start()
        self._data_end, stated_at = footer_at, footer.summary_start
        tail = self._bytes(max(0, footer_at - _MAX_OTHER_SIZE), _MAX_OTHER_SIZE)[:footer_at]
        tries, place = [stated_at], len(tail)
        for _ in range(_MAX_TRIES):
            place = tail.rfind(_DATA_END, 0, max(0, place))
            tries += [footer_at - len(tail) + place + _DATA_END_SIZE] if place >= 0 else []
        for start in tries if stated_at else ():
            if not 0 < start <= footer_at <= start + MAX_SUMMARY_SIZE:
                continue
            summary = self._bytes(start, footer_at - start)
            covered = ends[-1][0][: RECORD.size + 16]
            if zlib.crc32(covered, zlib.crc32(summary)) == footer.summary_crc:
                with suppress(RecordError, struct.error):
                    self._take(summary, has_moved=start > stated_at)
                break
        return True

    def _take(self, summary: bytes, *, has_moved: bool) -> None:
        """Take the chunks that a summary states, and the channels.

        One that has moved back may be that of a file within a message: it must state a chunk that
        has not.

        Raises:
            RecordError, struct.error: It is malformed.
        """
        at, places, described, chunks = 0, dict[_Head, set[int]](), list[McapRecord](), -1
        while at < len(summary):
            opcode, length = RECORD.unpack_from(summary, at)
            body, at = at + RECORD.size, at + RECORD.size + length
            if opcode == Opcode.CHUNK_INDEX:
                first, last, place, size, _ = CHUNK_INDEX.unpack_from(summary, body)
                places.setdefault((first, last, size), set()).add(place)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
                if length > _MAX_OTHER_SIZE:
                    raise RecordError("too large")
                described.append(parse_record(summary[body - RECORD.size : at]))
                if isinstance(described[-1], Statistics):
                    chunks = described[-1].chunk_count
        stated = [(head, place) for head, own in places.items() for place in own]
        if has_moved and not any(self._head(place) == head for head, place in stated):
            return
        if chunks == len(stated):
            self._places, self._described = places, described
            self._sizes = {place: head[2] for head, place in stated}

    def _has_record(self, at: int, opcode: int) -> bool:
        try:
            if opcode == Opcode.CHUNK:
                end = at + chunk_head(self._bytes(at, _CHUNK_HEAD_SIZE))[2]
                if self._places is None and end <= self._inside:
                    return False
                if self._has_end and end > self._size:  # it has lost bytes
                    self._inside = self._size
                    return False
            else:
                self._read_other(at)
        except RecordError:
            return False
        return True

    def _bytes(self, at: int, size: int) -> bytes:
        return os.pread(self._descriptor, max(0, min(size, self._size - at)), max(0, at))

    def _end_without_zeros(self) -> int:
        """Return where the zeros start with which the file ends: pages lost in a power cut."""
        descriptor, end = self._descriptor, 0
        with suppress(OSError):  # no data follows; a sparse file may end in a hole of any size
            while end < self._size:
                end = os.lseek(descriptor, os.lseek(descriptor, end, os.SEEK_DATA), os.SEEK_HOLE)
        end = min(end, self._size)
        while end > 0:
            start = max(0, end - _BLOCK_SIZE)
            if kept := len(self._bytes(start, end - start).rstrip(b"\0")):
                return start + kept
            end = start
        return 0


def parse_record(record: bytes) -> McapRecord:
    """Return the record that some bytes are, of a kind that the library `mcap` has.

    Raises:
        RecordError: They are no such record, or not as many bytes as the lengths in it need.
    """
    written: Any = RecordBuilder()
    try:
        # From memory, so that no length allocates more than there is.
        reader = StreamReader(BytesIO(record), skip_magic=True, emit_chunks=True)
        found = next(reader.records)
        found.write(written)
    except (McapError, struct.error, ValueError, OverflowError) as error:
        raise RecordError("not a record") from error
    # The library accepts a text that ends early.
    if written.end() != record:
        raise RecordError("not a record")
    return found


class _Front(NamedTuple):
    """The whole records in the front of a chunk's.

    Attributes:
        size: Their size, bytes.
        number: How many they are.
        descriptions: Where the first schema or channel of each id starts and ends.
        is_cut: Whether nothing but a cut ends them.
    """

    size: int
    number: int
    descriptions: list[tuple[int, int]]
    is_cut: bool

    def content(self, records: bytes, is_checked: bool = False) -> Content:
        described = tuple(records[start:end] for start, end in self.descriptions)
        return Content(records[: self.size], is_checked, described)


def _whole_records(records: bytes, chunk: Chunk, max_number: int = _MAX_FRONT) -> _Front:
    """Return the whole records in the front of a chunk's, until there are too many.

    A record of a kind or size that cannot be in the chunk is no cut. Neither is a message of
    another time, unless a checksum covers all of them.
    """
    at = count = 0
    available, is_cut = len(records), True
    descriptions: dict[tuple[int, bytes], tuple[int, int]] = {}
    first_time, last_time = chunk.message_start_time, chunk.message_end_time
    if chunk.uncompressed_crc and len(records) == chunk.uncompressed_size:
        first_time, last_time = 0, 2**64
    message, unpack = int(Opcode.MESSAGE), RECORD.unpack_from
    while at + RECORD.size <= available and count <= max_number:
        opcode, length = unpack(records, at)
        end = at + RECORD.size + length
        if opcode == message:
            head_end = at + MESSAGE.size
            is_cut = head_end <= end
            if is_cut and last_time < 2**64 and head_end <= available:
                is_cut = first_time <= MESSAGE.unpack_from(records, at)[4] <= last_time
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            if end <= available:
                descriptions.setdefault((opcode, records[at + 9 : at + 11]), (at, end))
        else:
            is_cut = opcode >= 0x80
        is_cut = is_cut and end <= chunk.uncompressed_size
        if not is_cut or end > available:
            break
        at, count = end, count + 1
    return _Front(at, count, list(descriptions.values()), is_cut)


def _front(chunk: Chunk) -> tuple[_Front, bytes]:
    """Return the front of a damaged chunk, and what it was found in."""
    data = bytearray()
    limit = chunk.uncompressed_size if chunk.uncompressed_size <= MAX_SIZE else 0
    with suppress(Exception):  # the libraries' errors have several roots
        for part in _decompressed(chunk):
            data += part
            if len(data) >= limit:
                break
    del data[limit:]
    records = bytes(data)
    return _whole_records(records, replace(chunk, data=b"", uncompressed_crc=0)), records


def _decompressed(chunk: Chunk) -> Iterator[bytes]:
    """Yield what data that may be cut off decompresses to, in steps."""
    if not chunk.compression:
        yield chunk.data
    elif chunk.compression == "lz4":
        import lz4.frame

        decompressor = lz4.frame.LZ4FrameDecompressor()
        yield decompressor.decompress(chunk.data, max_length=_STEP)
        while not (decompressor.needs_input or decompressor.eof):
            yield decompressor.decompress(b"", max_length=_STEP)
    elif chunk.compression == "zstd":
        import zstandard

        reader = zstandard.ZstdDecompressor().stream_reader(chunk.data)
        while part := reader.read(_STEP):
            yield part
