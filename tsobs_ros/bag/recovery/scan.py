# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Reading an MCAP file that may be damaged anywhere, from its beginning to its end.

Three things can be relied on. A chunk's checksum tells whether its records are what was written.
A chunk's head states its size twice. And where a file was cut off, what comes before the cut is
what was written. So a chunk whose checksum holds is kept, of a chunk that is cut off the front is
kept, and of a chunk whose checksum fails nothing is, unless one asks for it: there is no telling
which of its messages are damaged. After bytes that are no record, the next record is searched for.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import IO

from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd

from tsobs_ros.bag.mcap.chunk import Chunk, chunk_front, chunk_records, parse_chunk
from tsobs_ros.bag.mcap.records import (
    FRAME,
    INDEX_ENTRY,
    INDEX_HEAD,
    MAGIC,
    MAX_RECORD_SIZE,
    MESSAGE,
    MESSAGE_HEAD_SIZE,
    Frame,
    RecordError,
    parse,
    read_body,
    read_frame,
)
from tsobs_ros.bag.recovery.pieces import Content, Damage, Found, MessageCount, Piece

_OPCODES = frozenset(map(int, Opcode))
_BLOCK_SIZE = 2**20
_CHUNK_HEAD_SIZE = 64
_ZERO_TAIL = 16
"""Fewer zeros at the end of a chunk whose checksum fails do not explain that."""
_CANDIDATE = re.compile(
    # The opcodes of header, schema, channel, message, chunk, metadata and data end, with a length
    # that is not too large. Looking ahead finds those that overlap, too.
    rb"(?=[\x01\x03\x04\x05\x06\x0c\x0f].{3}[\x00-\x0f]\x00{4})",
    re.DOTALL,
)


class Scan:
    """One pass over a file.

    Args:
        stream: The file.
        size: How much of it to read, bytes: it may still be growing.
        progress: Called with the number of bytes that were got through since the last call.
        with_unchecked: Whether to give what can be read of chunks whose checksum fails.
    """

    def __init__(
        self,
        stream: IO[bytes],
        size: int,
        progress: Callable[[int], object] = lambda _: None,
        *,
        with_unchecked: bool = False,
    ) -> None:
        self._progress = progress
        self._with_unchecked = with_unchecked
        self._stream = stream
        self._size = size
        self._end = size
        self._written_end = _end_without_zeros(stream, size)
        self._bare_channels: set[int] = set()
        self._data_ended = False

    def pieces(self) -> Iterator[Piece]:
        """Yield what the file holds, in order, with nothing left out."""
        at = len(MAGIC) if self._bytes(0, len(MAGIC)) == MAGIC else 0
        if at and self._bytes(self._size - len(MAGIC), len(MAGIC)) == MAGIC:
            self._end = max(at, self._size - len(MAGIC))
        while at < self._end:
            try:
                pieces, following = self._read(at)
            except RecordError as error:
                following = self._find_record(at + 1)
                pieces = [Damage(at, following - at, str(error))]
            yield from pieces
            self._progress(following - at)
            at = following

    def _read(self, at: int) -> tuple[list[Piece], int]:
        """Return what is at an offset, and where to go on.

        Raises:
            RecordError: It is not a record.
        """
        if at >= self._written_end:
            return [Damage(at, self._end - at, "nothing but zeros to the end")], self._end
        try:
            frame = read_frame(self._stream, at, self._end)
        except RecordError:
            return self._front(at, self._cut_chunk(at)), self._end
        if frame.opcode == Opcode.CHUNK:
            return self._read_chunk(frame)
        if not self._is_record(frame) or not self._is_sound(frame):
            raise RecordError("not a record")
        if frame.opcode == Opcode.MESSAGE:
            return [Content(self._bytes(at, frame.end - at))], frame.end
        if frame.opcode == Opcode.MESSAGE_INDEX:
            entries = frame.end - frame.body - INDEX_HEAD.size
            return [MessageCount(entries // INDEX_ENTRY.size)], frame.end
        if frame.opcode == Opcode.ATTACHMENT:
            return [Found(None)], frame.end
        record = parse(frame.opcode, read_body(self._stream, frame))
        if isinstance(record, Channel):
            self._bare_channels.add(record.id)
        elif isinstance(record, DataEnd):
            self._data_ended = True
        return [Found(record)], frame.end

    def _read_chunk(self, frame: Frame) -> tuple[list[Piece], int]:
        chunk = parse_chunk(read_body(self._stream, frame))
        cut = self._written_end < min(frame.end, self._size - _ZERO_TAIL)
        try:
            records = chunk_records(chunk)
        except RecordError as error:
            if not cut:
                # A chunk that has lost bytes reaches into the next one: search inside for that.
                if not self._begins_record(frame.end):
                    raise
                front = b""
                if self._with_unchecked:
                    front = _whole(chunk_front(chunk), chunk.start, chunk.end)
                size = frame.end - frame.start
                return [Damage(frame.start, size, str(error), front)], frame.end
        else:
            if chunk.crc or not cut:
                return _contents(frame, records), frame.end
        written = chunk.data[: self._written_end - frame.end]
        return self._front(frame.start, chunk._replace(data=written)), self._end

    def _cut_chunk(self, at: int) -> Chunk:
        """Return the chunk that the end of the file cuts off.

        Raises:
            RecordError: There is none.
        """
        head = self._bytes(at, FRAME.size)
        if len(head) < FRAME.size:
            raise RecordError("a record is cut off")
        opcode, size = FRAME.unpack(head)
        if opcode != Opcode.CHUNK or size > MAX_RECORD_SIZE:
            raise RecordError("not a record")
        body_at = at + FRAME.size
        return parse_chunk(self._bytes(body_at, self._written_end - body_at), size)

    def _front(self, at: int, chunk: Chunk) -> list[Piece]:
        """Return what there is of a chunk that is cut off, and the rest of the file as lost."""
        front = _whole(chunk_front(chunk))
        reason = "the file ends inside of a chunk, the front of which is kept"
        return [Content(front), Damage(at, self._end - at, reason)]

    def _is_record(self, frame: Frame) -> bool:
        """Whether the content of a record is one of its kind."""
        size = frame.end - frame.body
        match frame.opcode:
            case Opcode.CHUNK:
                try:
                    parse_chunk(self._bytes(frame.body, _CHUNK_HEAD_SIZE), size)
                except RecordError:
                    return False
                return True
            case Opcode.MESSAGE:
                # A file without chunks describes its channels on their own, before the messages.
                channel = int.from_bytes(self._bytes(frame.body, 2), "little")
                known = channel in self._bare_channels and not self._data_ended
                return known and MESSAGE_HEAD_SIZE <= size <= MAX_RECORD_SIZE
            case Opcode.MESSAGE_INDEX:
                stated = int.from_bytes(self._bytes(frame.body + 2, 4), "little")
                return stated == size - INDEX_HEAD.size and stated % INDEX_ENTRY.size == 0
            case Opcode.ATTACHMENT:
                return True
            case _:
                try:
                    return parse(frame.opcode, read_body(self._stream, frame)) is not None
                except RecordError:
                    return False

    def _is_sound(self, frame: Frame) -> bool:
        """Whether a record with no inner check of its length is followed by another one."""
        if frame.opcode not in (Opcode.MESSAGE, Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX):
            with suppress(RecordError):
                parse(frame.opcode, read_body(self._stream, frame), exact=True)
                return True
        elif frame.opcode == Opcode.MESSAGE_INDEX:
            return True
        return frame.end <= self._written_end and self._begins_record(frame.end)

    def _begins_record(self, at: int) -> bool:
        """Whether there is a record, even one that is cut off, or the end."""
        if at >= min(self._written_end, self._end):
            return True
        try:
            return self._is_record(read_frame(self._stream, at, self._end))
        except RecordError:
            head = self._bytes(at, FRAME.size)
            return len(head) < FRAME.size or (head[0] in _OPCODES and head[5:] == bytes(4))

    def _find_record(self, at: int) -> int:
        """Return where the next record is; the end if there is none."""
        while at < self._written_end:
            block = self._bytes(at, _BLOCK_SIZE + FRAME.size)
            for match in _CANDIDATE.finditer(block):
                if match.start() < _BLOCK_SIZE and self._continues_at(at + match.start()):
                    return at + match.start()
            at += _BLOCK_SIZE
        return self._end

    def _continues_at(self, at: int) -> bool:
        """Whether reading can go on at an offset that nothing leads to."""
        try:
            frame = read_frame(self._stream, at, self._end)
            if frame.opcode == Opcode.CHUNK and frame.end <= self._written_end:
                chunk_records(parse_chunk(read_body(self._stream, frame)))
                return True
            return self._is_record(frame) and self._begins_record(frame.end)
        except RecordError:
            return self._is_cut_chunk(at)

    def _is_cut_chunk(self, at: int) -> bool:
        """Whether there is a chunk that the end of the file cuts off."""
        try:
            self._cut_chunk(at)
        except RecordError:
            return False
        return True

    def _bytes(self, at: int, size: int) -> bytes:
        self._stream.seek(max(0, at))
        return self._stream.read(max(0, min(size, self._size - at)))


def _contents(frame: Frame, records: bytes) -> list[Piece]:
    whole = _whole(records)
    if len(whole) == len(records):
        return [Content(whole)]
    lost = Damage(frame.start, frame.end - frame.start, "the chunk ends inside of a record")
    return [Content(whole), lost]


def _whole(records: bytes, first_time: int = 0, last_time: int = 2**64) -> bytes:
    """Return the records up to the first that is not whole, or is of another time."""
    at = 0
    while at + FRAME.size <= len(records):
        opcode, size = FRAME.unpack_from(records, at)
        end = at + FRAME.size + size
        if opcode == 0 or end > len(records):
            break
        if opcode == Opcode.MESSAGE:
            if size < MESSAGE_HEAD_SIZE:
                break
            if not first_time <= MESSAGE.unpack_from(records, at)[4] <= last_time:
                break
        at = end
    return records[:at]


def _end_without_zeros(stream: IO[bytes], size: int) -> int:
    """Return where the zeros begin with which the file ends: after a power cut, unwritten pages."""
    end = size
    while end > 0:
        start = max(0, end - _BLOCK_SIZE)
        stream.seek(start)
        block = stream.read(end - start)
        if kept := len(block.rstrip(b"\0")):
            return start + kept
        end = start
    return 0
