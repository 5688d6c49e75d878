# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Checking the structure of a file of a bag: each record, each index, each checksum."""

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Header, Metadata, Schema

from tsobs_ros.bag.container import RECOVER_HINT
from tsobs_ros.bag.mcap.chunk import chunk_records, parse_chunk
from tsobs_ros.bag.mcap.records import (
    FRAME,
    INDEX_ENTRY,
    INDEX_HEAD,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD_SIZE,
    Frame,
    RecordError,
    parse,
    read_body,
    read_frame,
)
from tsobs_ros.bag.metadata import BagMetadata
from tsobs_ros.bag.verification.content import ContentCheck
from tsobs_ros.bag.verification.findings import Findings
from tsobs_ros.bag.verification.summary import ChunkFacts, DataFacts, verify_summary

_BLOCK_SIZE = 2**20


class FileFacts(NamedTuple):
    """What a file turned out to hold.

    Attributes:
        content: Its topics and messages.
        stated: What its last metadata record says of the bag; None if there is none.
        is_damaged: Whether some of its content is unknown.
    """

    content: ContentCheck
    stated: BagMetadata | None
    is_damaged: bool


def verify_file(
    path: Path, findings: Findings, progress: Callable[[int], object]
) -> FileFacts | None:
    """Check a file.

    Args:
        path: The file.
        findings: Where to add what is wrong.
        progress: Called with the number of bytes that were checked since the last call.

    Returns:
        What it holds; None if it cannot be read to its end.
    """
    try:
        with path.open("rb") as stream:
            return _FileCheck(path.name, stream, findings).run(progress)
    except RecordError as error:
        findings.error(path.name, f"the file is damaged: {error}; {RECOVER_HINT}")
    except OSError as error:
        findings.error(path.name, f"cannot be read: {error}")
    return None


class _FileCheck:
    def __init__(self, name: str, stream: IO[bytes], findings: Findings) -> None:
        self._name = name
        self._stream = stream
        self._size = stream.seek(0, 2)
        self._findings = findings
        self._content = ContentCheck(name, findings)
        self._facts = DataFacts(self._content)
        self._stated: BagMetadata | None = None

    def run(self, progress: Callable[[int], object]) -> FileFacts | None:
        """Check the file from its beginning to its end."""
        end = self._size - len(MAGIC)
        self._stream.seek(0)
        if self._stream.read(len(MAGIC)) != MAGIC:
            self._findings.error(self._name, "not an MCAP file")
            return None
        self._stream.seek(max(len(MAGIC), end))
        if self._stream.read() != MAGIC:
            text = f"has no end, it is unfinished or was truncated; {RECOVER_HINT}"
            self._findings.error(self._name, text)
            return None
        self._check_data(end, progress)
        verify_summary(self._name, self._stream, self._facts, end, self._findings)
        is_damaged = any(chunk.is_damaged for chunk in self._facts.chunks)
        return FileFacts(self._content, self._stated, is_damaged)

    def _check_data(self, end: int, progress: Callable[[int], object]) -> None:
        place = len(MAGIC)
        while self._facts.end is None:
            frame = read_frame(self._stream, place, end)
            if (place == len(MAGIC)) != (frame.opcode == Opcode.HEADER):
                raise RecordError(f"expected a header at byte {len(MAGIC)}, and only there")
            self._check_record(frame)
            progress(frame.end - place)
            place = frame.end
        metadata = sum(name == "rosbag2" for _, _, name in self._facts.metadata)
        if metadata != 2:
            text = f"has {metadata} metadata records 'rosbag2', where rosbag2 writes 2"
            self._findings.remark(self._name, text)
        if self._facts.bare_messages:
            text = f"has {self._facts.bare_messages} messages outside of chunks, without an index"
            self._findings.remark(self._name, text)

    def _check_record(self, frame: Frame) -> None:
        facts, findings = self._facts, self._findings
        if frame.opcode == Opcode.ATTACHMENT:
            facts.attachments += 1
            findings.remark(self._name, "has an attachment, which rosbag2 never writes", "attached")
            return
        body = read_body(self._stream, frame)
        if frame.opcode == Opcode.CHUNK:
            self._check_chunk(frame, body)
        elif frame.opcode == Opcode.MESSAGE_INDEX:
            self._check_message_index(frame, body)
        elif frame.opcode == Opcode.MESSAGE:
            facts.bare_messages += 1
            self._check_content(FRAME.pack(frame.opcode, len(body)) + body)
        else:
            self._check_other(frame, parse(frame.opcode, body))

    def _check_other(self, frame: Frame, record: object) -> None:
        match record:
            case Header():
                if record.profile != "ros2":
                    self._error(f"its profile is '{record.profile}', not 'ros2'")
            case Schema():
                self._content.add_schema(record)
            case Channel():
                self._content.add_channel(record)
            case Metadata():
                place = (frame.start, frame.end - frame.start, record.name)
                self._facts.metadata.append(place)
                self._stated = self._content.add_metadata(record) or self._stated
            case DataEnd():
                self._facts.end = frame.end
                if record.data_section_crc and record.data_section_crc != self._crc(frame.start):
                    self._error("the checksum of the data section is wrong")
            case None:
                kind = f"{frame.opcode:#04x}"
                self._findings.remark(self._name, f"has a record of unknown kind {kind}", kind)
            case _:
                raise RecordError(f"the record at byte {frame.start} belongs behind the data")

    def _check_chunk(self, frame: Frame, body: bytes) -> None:
        chunk = parse_chunk(body)
        facts = ChunkFacts(frame, chunk._replace(data=memoryview(b"")), len(chunk.data))
        self._facts.chunks.append(facts)
        try:
            records = chunk_records(chunk)
        except RecordError as error:
            facts.is_damaged = True
            self._error(f"at byte {frame.start}: {error}; {RECOVER_HINT}")
            return
        facts.entries = self._check_content(records)
        times = [time for entries in facts.entries.values() for time, _ in entries]
        place = f"the chunk at byte {frame.start}"
        self._expect(f"the smallest log time of {place}", chunk.start, min(times, default=0))
        self._expect(f"the largest log time of {place}", chunk.end, max(times, default=0))

    def _check_content(self, records: bytes) -> dict[int, list[tuple[int, int]]]:
        """Check a run of records and return the message index that it should have."""
        entries: dict[int, list[tuple[int, int]]] = {}
        place = 0
        while place < len(records):
            if len(records) - place < FRAME.size:
                raise RecordError("a chunk ends inside of a record")
            opcode, length = FRAME.unpack_from(records, place)
            end = place + FRAME.size + length
            if end > len(records):
                raise RecordError("a chunk ends inside of a record")
            if opcode == Opcode.MESSAGE:
                if length < MESSAGE_HEAD_SIZE:
                    raise RecordError(f"a message has {length} bytes, too few for its head")
                _, _, channel, sequence, log_time, publish_time = MESSAGE.unpack_from(
                    records, place
                )
                data = records[place + MESSAGE.size : end]
                self._content.add_message(channel, sequence, log_time, publish_time, data)
                entries.setdefault(channel, []).append((log_time, place))
            else:
                match parse(opcode, records[place + FRAME.size : end]):
                    case Schema() as schema:
                        self._content.add_schema(schema)
                    case Channel() as channel_record:
                        self._content.add_channel(channel_record)
                    case _:
                        raise RecordError(f"a record of kind {opcode:#04x} is inside of a chunk")
            place = end
        return entries

    def _check_message_index(self, frame: Frame, body: bytes) -> None:
        if not self._facts.chunks:
            raise RecordError(f"the message index at byte {frame.start} follows no chunk")
        chunk = self._facts.chunks[-1]
        if len(body) < INDEX_HEAD.size:
            raise RecordError(f"the message index at byte {frame.start} is cut off")
        channel, size = INDEX_HEAD.unpack_from(body)
        if size != len(body) - INDEX_HEAD.size or size % INDEX_ENTRY.size:
            raise RecordError(f"the message index at byte {frame.start} is malformed")
        found = sorted(INDEX_ENTRY.iter_unpack(memoryview(body)[INDEX_HEAD.size :]))
        if found:
            chunk.index_offsets[channel] = frame.start
        chunk.indexes_end = frame.end
        if not chunk.is_damaged and found != sorted(chunk.entries.pop(channel, [])):
            text = f"the index of channel {channel} at byte {frame.start} is not that of its chunk"
            self._error(text)

    def _crc(self, end: int) -> int:
        crc, place = 0, 0
        self._stream.seek(0)
        while place < end:
            block = self._stream.read(min(_BLOCK_SIZE, end - place))
            crc, place = zlib.crc32(block, crc), place + len(block)
        return crc

    def _expect(self, what: str, stated: object, actual: object) -> None:
        self._findings.expect(self._name, what, stated, actual)

    def _error(self, text: str) -> None:
        self._findings.error(self._name, text)
