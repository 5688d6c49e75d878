# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The intact parts of an MCAP file that may be damaged anywhere, and what is wrong between them.

Three things are certain. The checksum of a chunk covers its records. The head of a chunk states its
size twice. And a file that was cut off is intact up to the cut. So a chunk is taken if its checksum
holds, the front of a chunk is taken if the end of the file cuts it off, and after bytes that are no
record the next chunk is searched for. A file that ends with a footer was not cut off.

But messages may carry chunks themselves, and a disk may hold chunks of other files. So of a
finished file only the chunks that its summary states are its own. In others a chunk that comes
again is dropped, and so is what is found inside of a message, or of a chunk that has lost bytes; if
messages carry whole files, nothing is searched for.
"""

import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import IO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, McapRecord, Metadata

from tsobs_ros.bag.container import (
    CHUNK_HEAD_SIZE,
    INDEX_HEAD,
    MAGIC,
    MAX_MESSAGES,
    MAX_SIZE,
    MAX_SUMMARY_SIZE,
    MESSAGE,
    RECORD,
    RecordError,
    Records,
    Summary,
    chunk_head,
    chunk_records,
    decompressed,
    parse_record,
    parse_summary,
    split_records,
)

Progress = Callable[[int], object]
"""Called with the number of bytes that were read since the last call."""

_MAX_OTHER_SIZE = 2**24
_MAX_PARSED_SIZE = 2**12
_MAX_DAMAGES = 10_000
# A file that ends with them, and perhaps with some bytes behind them, was not cut off.
_END = re.compile(re.escape(RECORD.pack(Opcode.FOOTER, 20)) + b".{20}" + MAGIC, re.DOTALL)
_MAX_END_SIZE = 2**16
_DATA_END = RECORD.pack(Opcode.DATA_END, 4)
_MAX_TRIES = 4
_BLOCK_SIZE = 2**20
# A message or a chunk of less than 256 MiB; looking ahead finds those that overlap, too.
_CANDIDATE = re.compile(rb"(?=[\x05\x06].{3}[\0-\x0f]\0{4})", re.DOTALL)
_IN_CHUNKS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_OTHERS = frozenset(map(int, Opcode)) - {
    Opcode.CHUNK, Opcode.MESSAGE, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT
}  # fmt: skip

_Head = tuple[int, int, int]
"""What an index states of a chunk: its first and last log time, and its size."""


class Part(NamedTuple):
    """An intact part of a file.

    Attributes:
        at: Its first byte in the file.
        size: Its size in the file, bytes.
        record: The record that it is: a chunk without its data, None for a message or an index.
        content: What it holds of messages, schemas and channels.
        is_checked: Whether a checksum covers them.
    """

    at: int
    size: int
    record: McapRecord | None = None
    content: Records | None = None
    is_checked: bool = False

    def described(self) -> Iterator[McapRecord | None]:
        """Yield the record, or those between messages, each once; None for a malformed one."""
        if self.content is None:
            yield from [self.record] if self.record is not None else []
            return
        for description in dict.fromkeys(self.content.descriptions()):
            try:
                yield parse_record(description)
            except RecordError:
                yield None


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


class FileWalker:
    """The parts of one file, in their order.

    Chunks may decompress to 1 GiB and 100 bytes for each byte of the file, and have 524,288 records
    and one for each six bytes: else a file of some kilobytes can be hours of work.

    Args:
        stream: The file.
        size: The number of bytes to read: the file may be growing.
        keep_unchecked: Whether to give the front of chunks whose checksum fails.
        is_trusted: Whether to read chunks however much they decompress to.
        bad: Reasons against chunks by their offsets, which a walk adds and the next one keeps.

    Attributes:
        damage: The parts that are lost, as far as the file has been read.
        summary: The summary at the end of the file, if it is sound.
    """

    def __init__(
        self,
        stream: IO[bytes],
        size: int,
        *,
        keep_unchecked: bool = False,
        is_trusted: bool = False,
        bad: dict[int, str] | None = None,
    ) -> None:
        self._bad = {} if bad is None else bad
        self.damage: list[Damage] = []
        self.summary: Summary | None = None
        self._descriptor, self._size = stream.fileno(), size
        self._keep_unchecked = keep_unchecked
        self._bytes_left = 2**64 if is_trusted else 2**30 + 100 * size
        self._records_left = 2**64 if is_trusted else 2**19 + size // 6
        # Half of what docs/security.md allows, as a recovery walks twice.
        self._vain_left = 32 * size + 2**29
        self._written_end = self._end_without_zeros()
        self._data_end = self._size
        # The heads of the chunks that the summary states, by place, and those not found there.
        self._stated: dict[int, _Head] = {}
        self._moved: Counter[_Head] = Counter()
        self._seen: set[tuple[_Head, int]] = set()
        self._has_end = self._read_end()
        # In front of this there is nothing of the file itself: a damaged chunk, a message.
        self._inside = 0
        # A file without chunks describes its channels before its messages.
        self._bare_channels: set[int] = set()
        self._has_chunks = False
        self._follows_damage = False

    def parts(self, progress: Progress = lambda _: None) -> Iterator[Part]:
        """Yield what is intact; `progress` is called with the number of bytes got through."""
        at = 0
        while at < self._size:
            part: Part | None = None
            try:
                if at >= self._written_end:
                    following = self._lose(at, "nothing but zeros to the end", self._size)
                elif self._bytes(at, len(MAGIC)) == MAGIC:
                    following = at + len(MAGIC)
                elif self._bytes(at, 1)[0] == Opcode.CHUNK:
                    part, following = self._read_chunk(at)
                else:
                    part = self._read_other(at)
                    following = at + part.size
            except RecordError as error:
                following = self._lose(at, str(error))
            if part is not None:
                yield part
            progress(following - at)
            at = following

    def _lose(self, at: int, reason: str, following: int | None = None) -> int:
        """Take account of damage, and return what follows: by default, the next record."""
        following = self._search(at + 1) if following is None else following
        last = self.damage[-1] if self.damage else None
        if last and (last.offset + last.size == at or len(self.damage) > _MAX_DAMAGES):
            last.size += following - at
        else:
            further = len(self.damage) == _MAX_DAMAGES
            reason = "and further parts behind it" if further else reason
            self.damage.append(Damage(at, following - at, reason))
        self._follows_damage = True
        return following

    def _read_chunk(self, at: int) -> tuple[Part | None, int]:
        chunk, data_at, size = chunk_head(self._bytes(at, CHUNK_HEAD_SIZE))
        data_at, end = at + data_at, at + size
        self._has_chunks = True
        head = chunk.message_start_time, chunk.message_end_time, size
        if not self._is_own(at, head):
            reason = "a chunk that the index of the file does not state"
            return None, self._lose(at, reason)
        chunk.data = self._bytes(data_at, end - data_at)
        content, is_checked, reason = None, chunk.uncompressed_crc != 0, ""
        try:
            if at in self._bad:
                raise RecordError(self._bad[at])
            if end > self._size:
                raise RecordError("the file ends inside of a chunk")
            content = self._content(chunk)
            # If a chunk without a checksum has lost bytes, this shows behind it.
            if not (is_checked or self._starts_record(end)):
                raise RecordError("the chunk has no checksum, and no record follows it")
        except RecordError as error:
            self._bad[at] = reason = str(error)
        if content is None or reason:
            del content  # it may be large
            return self._read_damaged_chunk(at, end, chunk, reason)
        again = head, zlib.crc32(content.data)
        if self.summary is None and again in self._seen:
            return None, self._lose(at, "a chunk that was there already", end)
        self._seen.add(again)
        self._follows_damage = False
        return Part(at, size, replace(chunk, data=b""), content, is_checked), end

    def _content(self, chunk: Chunk) -> Records:
        """Return what a chunk holds."""
        self._bytes_left -= min(chunk.uncompressed_size, MAX_SIZE) if chunk.compression else 0
        if self._bytes_left >= 0:
            content = split_records(chunk_records(chunk))
            self._records_left -= len(content.rows)
            for count, description in enumerate(content.descriptions()):
                # They take ten times as long as messages.
                is_known = description[0] in _IN_CHUNKS or description[0] >= 0x80
                if not is_known or 10 * count > self._records_left:
                    raise RecordError("the chunk holds bytes that are no record, or too many")
        if min(self._bytes_left, self._records_left) < 0:
            raise RecordError(
                "the chunks decompress to too much for a file of this size; --trusted reads them"
            )
        times = content.rows["log_time"].view("u8")
        if not chunk.uncompressed_crc and len(times):
            first, last = int(times.min()), int(times.max())
            if first < chunk.message_start_time or last > chunk.message_end_time:
                raise RecordError("the chunk holds bytes that are no record of its times")
        return content

    def _read_damaged_chunk(
        self, at: int, end: int, chunk: Chunk, reason: str
    ) -> tuple[Part | None, int]:
        """Return the front of a chunk if the end of the file cuts it off, or all is wanted."""
        part = Part(at, min(end, self._size) - at, replace(chunk, data=b""))
        if not self._has_end and self._written_end < end:
            front, is_cut = _front(chunk)
            # If its records go on through the zeros, those are its own; the damage is elsewhere.
            if end > self._size or len(front.data) < chunk.uncompressed_size:
                data_at = min(end, self._size) - len(chunk.data)
                cut = chunk.data[: max(0, self._written_end - data_at)]
                front, is_cut = _front(replace(chunk, data=cut))
                if is_cut:
                    reason = "the file ends inside of a chunk, the front of which is kept"
                    self._lose(at, reason, self._size)
                    return part._replace(size=self._size - at, content=front), self._size
        kept = part._replace(content=_front(chunk)[0]) if self._keep_unchecked else None
        following = end if end <= self._size and self._starts_record(end) else None
        if following is None:
            # A chunk that has lost bytes reaches into what follows it: search inside of it, unless
            # so many do that the file was made to take the time for it.
            self._vain_left -= len(chunk.data) + chunk.uncompressed_size % MAX_SIZE
            self._inside = max(self._inside, min(end, self._size))
        return kept, self._lose(at, reason, following)

    def _read_other(self, at: int) -> Part:
        """Return the record at an offset, which is no chunk."""
        head = self._bytes(at, INDEX_HEAD.size)
        if len(head) < RECORD.size:
            raise RecordError("a record is cut off")
        opcode, length = RECORD.unpack_from(head)
        part = Part(at, RECORD.size + length)
        end = at + part.size
        if end > self._size or (length > MAX_SIZE and opcode != Opcode.ATTACHMENT):
            raise RecordError("not a record, or one that is cut off")
        if opcode != Opcode.MESSAGE_INDEX:
            self._follows_damage = False
        if opcode in _OTHERS and length <= _MAX_OTHER_SIZE:
            record = parse_record(self._bytes(at, part.size))
            # One that has lost bytes may take them from the chunk that follows.
            if isinstance(record, Metadata) and not self._starts_record(end):
                raise RecordError("not a record")
            # Behind damage it may be one of a chunk whose head is lost, and whose checksum with it.
            is_bare = not self._has_chunks and (self._keep_unchecked or not self.damage)
            if isinstance(record, Channel) and is_bare:
                self._bare_channels.add(record.id)
            return part._replace(record=record)
        # Nothing but the record that follows confirms the length of all others.
        if self._starts_record(end):
            channel = int.from_bytes(head[9:11], "little")
            if opcode == Opcode.MESSAGE_INDEX:
                # The indexes of a chunk follow it, also if the chunk is damaged.
                if self._follows_damage:
                    held = self.damage[-1].messages or 0
                    self.damage[-1].messages = held + (part.size - INDEX_HEAD.size) // 16
                return part
            is_bare = opcode == Opcode.MESSAGE and channel in self._bare_channels
            if is_bare and end <= self._written_end:
                return self._read_run(part)
            if opcode == Opcode.ATTACHMENT or opcode >= 0x80:
                return part
        raise RecordError("not a record")

    def _read_run(self, first: Part) -> Part:
        """Return a message outside of chunks and those behind it."""
        block = self._bytes(first.at, max(first.size, _BLOCK_SIZE))
        last, end = 0, first.size
        stop = min(len(block), self._written_end - first.at)
        while end + MESSAGE.size <= stop:
            opcode, length, channel, _, _, _ = MESSAGE.unpack_from(block, end)
            following = end + RECORD.size + length
            if opcode != Opcode.MESSAGE or channel not in self._bare_channels:
                break
            if length < MESSAGE.size - RECORD.size or following > stop:
                break
            last, end = end, following
        if last and not self._starts_record(first.at + end):
            end = last
        return first._replace(size=end, content=split_records(block[:end]))

    def _starts_record(self, at: int) -> bool:
        """Whether there may be a record, even one that is cut off, or the end."""
        head = self._bytes(at, CHUNK_HEAD_SIZE)
        if at >= self._written_end or len(head) < INDEX_HEAD.size or head.startswith(MAGIC):
            return True
        opcode, length, channel, size = INDEX_HEAD.unpack_from(head)
        if opcode == Opcode.CHUNK:
            return self._is_chunk(at, head)
        if length > self._size - at - RECORD.size:
            return 0 < opcode <= max(Opcode) and length <= MAX_SIZE and not self._has_end
        if opcode == Opcode.MESSAGE_INDEX:
            return bool(size == length - INDEX_HEAD.size + RECORD.size)
        if opcode == Opcode.MESSAGE:
            return channel in self._bare_channels
        with suppress(RecordError):
            if opcode in _OTHERS and length <= _MAX_OTHER_SIZE:
                if length <= _MAX_PARSED_SIZE:
                    parse_record(self._bytes(at, RECORD.size + length))
                return True
        return False

    def _is_chunk(self, at: int, head: bytes) -> bool:
        """Whether there may be a chunk of the file itself."""
        try:
            end = at + chunk_head(head)[2]
        except RecordError:
            return False
        if self.summary is None and end <= self._inside:
            return False
        if self._has_end and end > self._size:  # it has lost bytes
            self._inside = self._size
            return False
        return True

    def _search(self, at: int) -> int:
        """Return where the next chunk, or message outside of chunks, is; else the end."""
        end = min(self._data_end, self._written_end)
        otherwise = self._data_end if at <= self._data_end else self._size
        if self._vain_left < 0 or (self.summary is None and self._carries_files):
            return otherwise
        covered = self._covered(at - 1)
        for begin, block in self._blocks(at, end, _MAX_PARSED_SIZE, RECORD.size - 1):
            for match in _CANDIDATE.finditer(block):
                at = begin + match.start()
                if at >= end or (self.summary is None and at < covered):
                    continue
                if block[match.start()] == Opcode.CHUNK:
                    if self._is_chunk(at, self._bytes(at, CHUNK_HEAD_SIZE)):
                        return at
                elif self._bare_channels:
                    with suppress(RecordError):
                        self._read_other(at)
                        return at
                else:
                    covered = max(covered, self._covered(at))
        return otherwise

    def _blocks(self, at: int, end: int, step: int, overlap: int) -> Iterator[tuple[int, bytes]]:
        """Yield parts of the file that get larger, without the holes of a sparse file."""
        while at < end:
            with suppress(OSError):  # there may be nothing but a hole
                at = max(at, os.lseek(self._descriptor, at, os.SEEK_DATA))
            yield at, self._bytes(at, step + overlap)
            at, step = at + step, min(2 * step, _BLOCK_SIZE)

    @cached_property
    def _carries_files(self) -> bool:
        """Whether there are the marks of other files in it, such as messages may carry."""
        at = self._bytes(0, _MAX_END_SIZE).find(MAGIC) + 1  # behind its own
        end = min(self._data_end, self._written_end)
        blocks = self._blocks(at, end, _BLOCK_SIZE, len(MAGIC))
        return any(MAGIC in block[: end - begin] for begin, block in blocks)

    def _covered(self, at: int) -> int:
        """Return where what may be a message in a damaged chunk ends; there is no record in it."""
        with suppress(struct.error):
            opcode, length = RECORD.unpack(self._bytes(at, RECORD.size))
            if opcode == Opcode.MESSAGE and MESSAGE.size - RECORD.size <= length <= MAX_SIZE:
                end: int = at + RECORD.size + length
                # The next one in the chunk, or the index behind it.
                following, size = RECORD.unpack(self._bytes(end, RECORD.size))
                if following in (*_IN_CHUNKS, Opcode.MESSAGE_INDEX) and size <= MAX_SIZE:
                    return end
        return 0

    def _is_own(self, at: int, head: _Head) -> bool:
        """Return whether the file states a chunk, there or, once, at a place where it is not."""
        stated = self._stated.get(at)
        if self.summary is None or stated == head:
            return True
        if stated and stated[2] == head[2] and head not in self._heads:
            return True  # its times are what is damaged
        self._moved[head] -= 1
        return self._moved[head] >= 0

    @cached_property
    def _heads(self) -> set[_Head]:
        return set(self._stated.values())

    def _head(self, at: int) -> _Head | None:
        with suppress(RecordError):
            chunk, _, size = chunk_head(self._bytes(at, CHUNK_HEAD_SIZE))
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
        self._data_end = footer_at = begin + ends[-1].start()
        tail = self._bytes(max(0, footer_at - _MAX_OTHER_SIZE), _MAX_OTHER_SIZE)[:footer_at]
        tries, place = [footer.summary_start], len(tail)
        for _ in range(_MAX_TRIES):
            place = tail.rfind(_DATA_END, 0, max(0, place))
            tries += [footer_at - len(tail) + place + len(_DATA_END) + 4] if place >= 0 else []
        for start in tries if tries[0] else ():
            if not 0 < start <= footer_at <= start + MAX_SUMMARY_SIZE:
                continue
            data = self._bytes(start, footer_at - start)
            if zlib.crc32(ends[-1][0][: RECORD.size + 16], zlib.crc32(data)) == footer.summary_crc:
                with suppress(RecordError):
                    self._take(parse_summary(data), start, has_moved=start > tries[0])
                break
        return True

    def _take(self, summary: Summary, start: int, *, has_moved: bool) -> None:
        """Take the chunks that a summary states, if it is the file's own.

        One that has moved back may be that of a file within a message: it must state a chunk that
        has not.
        """
        stated = {s.offset: (s.start, s.end, s.size) for s in summary.spans}
        moved = Counter(head for at, head in stated.items() if self._head(at) != head)
        if has_moved and moved.total() == len(stated):
            return
        self.summary, self._stated, self._moved, self._data_end = summary, stated, moved, start

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


def _front(chunk: Chunk) -> tuple[Records, bool]:
    """Return the whole records in the front of a damaged chunk, and whether a cut ends them.

    A record of a kind, size or time that cannot be in the chunk is no cut.
    """
    content, at, count = bytearray(), 0, 0
    with suppress(Exception):  # the libraries' errors have several roots
        for part in decompressed(chunk) if chunk.uncompressed_size <= MAX_SIZE else ():
            content += part
    data = bytes(content[: chunk.uncompressed_size])
    is_cut = True
    while at + RECORD.size <= len(data) and count < MAX_MESSAGES:
        opcode, length = RECORD.unpack_from(data, at)
        end = at + RECORD.size + length
        is_cut = end <= chunk.uncompressed_size and opcode in _IN_CHUNKS
        if is_cut and opcode == Opcode.MESSAGE:
            is_cut = at + MESSAGE.size <= end
            if is_cut and at + MESSAGE.size <= len(data):
                log_time = MESSAGE.unpack_from(data, at)[4]
                is_cut = chunk.message_start_time <= log_time <= chunk.message_end_time
        if not is_cut or end > len(data):
            break
        at, count = end, count + 1
    return split_records(data[:at]), is_cut
