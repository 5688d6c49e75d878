# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Checking the summary at the end of a file against what the file holds."""

import zlib
from dataclasses import dataclass, field
from typing import IO

from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    Footer,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from tsobs_ros.bag.mcap.chunk import Chunk
from tsobs_ros.bag.mcap.records import Frame, RecordError, parse, read_body, read_frame
from tsobs_ros.bag.verification.content import ContentCheck
from tsobs_ros.bag.verification.findings import Findings

_CRC_SIZE = 4


@dataclass
class ChunkFacts:
    """A chunk and the message indexes behind it.

    Attributes:
        frame: Where the chunk is.
        chunk: Its head.
        compressed_size: The size of its data, bytes.
        is_damaged: Whether its content is unknown.
        entries: Log time and offset of its messages, by channel; of those not indexed so far.
        index_offsets: Where its message indexes are, by channel.
        indexes_end: Where the last of them ends; 0 without any.
    """

    frame: Frame
    chunk: Chunk
    compressed_size: int
    is_damaged: bool = False
    entries: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    index_offsets: dict[int, int] = field(default_factory=dict)
    indexes_end: int = 0

    def index(self) -> ChunkIndex:
        """Return the record that the summary should have of it."""
        return ChunkIndex(
            chunk_start_offset=self.frame.start,
            chunk_length=self.frame.end - self.frame.start,
            compression=self.chunk.compression,
            compressed_size=self.compressed_size,
            uncompressed_size=self.chunk.size,
            message_start_time=self.chunk.start,
            message_end_time=self.chunk.end,
            message_index_offsets=self.index_offsets,
            message_index_length=max(0, self.indexes_end - self.frame.end),
        )


@dataclass
class DataFacts:
    """What the data section of a file holds.

    Attributes:
        content: Its topics and messages.
        chunks: Its chunks.
        metadata: Offset, length and name of its metadata records.
        attachments: How many attachments it has.
        bare_messages: How many messages are outside of chunks.
        end: Where the section ends; None while that is not known.
    """

    content: ContentCheck
    chunks: list[ChunkFacts] = field(default_factory=list)
    metadata: list[tuple[int, int, str]] = field(default_factory=list)
    attachments: int = 0
    bare_messages: int = 0
    end: int | None = None


def verify_summary(
    name: str, stream: IO[bytes], facts: DataFacts, end: int, findings: Findings
) -> None:
    """Check the summary of a file.

    Args:
        name: The file's name.
        stream: The file.
        facts: What its data section holds.
        end: Where the magic bytes at its end begin.
        findings: Where to add what is wrong.

    Raises:
        RecordError: The summary cannot be read to its end.
    """
    _SummaryCheck(name, stream, facts, findings).run(end)


class _SummaryCheck:
    def __init__(self, name: str, stream: IO[bytes], facts: DataFacts, findings: Findings) -> None:
        self._name = name
        self._stream = stream
        self._facts = facts
        self._findings = findings
        self._frames: list[Frame] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: dict[int, ChunkIndex] = {}
        self._metadata: list[tuple[int, int, str]] = []
        self._offsets: list[SummaryOffset] = []
        self._statistics: Statistics | None = None

    def run(self, end: int) -> None:
        """Check all records of the summary and what they say."""
        assert self._facts.end is not None
        place = self._facts.end
        footer: Footer | None = None
        while footer is None:
            frame = read_frame(self._stream, place, end)
            record = parse(frame.opcode, read_body(self._stream, frame))
            if isinstance(record, Footer):
                footer = record
            else:
                self._take(frame, record)
            self._frames.append(frame)
            place = frame.end
        if place != end:
            self._error(f"{end - place} bytes follow the footer")
        self._check_footer(footer)
        if footer.summary_start:
            self._check_repeated()
            self._check_chunks()
            self._check_statistics()
            self._check_metadata()
            self._check_offsets()

    def _take(self, frame: Frame, record: object) -> None:
        match record:
            case Schema():
                self._schemas[record.id] = record
            case Channel():
                self._channels[record.id] = record
            case ChunkIndex():
                self._chunks[record.chunk_start_offset] = record
            case Statistics():
                self._statistics = record
            case MetadataIndex():
                self._metadata.append((record.offset, record.length, record.name))
            case SummaryOffset():
                self._offsets.append(record)
            case _ if frame.opcode in (Opcode.HEADER, Opcode.DATA_END, Opcode.METADATA):
                raise RecordError(f"the record at byte {frame.start} belongs before the summary")

    def _check_footer(self, footer: Footer) -> None:
        assert self._facts.end is not None
        if not footer.summary_start:
            self._error("has no summary: readers must search through all of it")
            return
        self._expect("the beginning of the summary", footer.summary_start, self._facts.end)
        first = [f.start for f in self._frames if f.opcode == Opcode.SUMMARY_OFFSET][:1]
        self._expect(
            "the beginning of the summary offsets",
            footer.summary_offset_start,
            first[0] if first else 0,
        )
        if footer.summary_crc:
            self._stream.seek(self._facts.end)
            covered = self._stream.read(self._frames[-1].end - _CRC_SIZE - self._facts.end)
            if zlib.crc32(covered) != footer.summary_crc:
                self._error("the checksum of the summary is wrong")

    def _check_repeated(self) -> None:
        content = self._facts.content
        for id_, schema in content.schemas.items():
            if self._schemas.get(id_) != schema:
                self._error(f"the summary does not repeat the schema of {schema.name}")
        for id_, channel in content.channels.items():
            if self._channels.get(id_) != channel:
                self._error(f"the summary does not repeat the channel of {channel.topic}")
        # Topics without messages are only here.
        for id_, schema in self._schemas.items():
            if id_ not in content.schemas:
                content.add_schema(schema)
        for id_, channel in self._channels.items():
            if id_ not in content.channels:
                content.add_channel(channel)

    def _check_chunks(self) -> None:
        for facts in self._facts.chunks:
            place = f"the chunk at byte {facts.frame.start}"
            for channel in facts.entries:
                self._error(f"{place} has no message index of channel {channel}")
            found = self._chunks.pop(facts.frame.start, None)
            if found is None:
                self._error(f"the summary has no index of {place}")
                continue
            stated, actual = vars(found), vars(facts.index())
            # Some writers also list channels of which a chunk has no messages.
            offsets = actual["message_index_offsets"]
            stated["message_index_offsets"] = {
                id_: at for id_, at in found.message_index_offsets.items() if id_ in offsets
            }
            for key, value in actual.items():
                self._expect(f"{key} of {place}", stated[key], value)
        for offset in self._chunks:
            self._error(f"the summary has an index of a chunk at byte {offset}, where none is")

    def _check_statistics(self) -> None:
        statistics, content = self._statistics, self._facts.content
        if statistics is None:
            self._error("has no statistics: readers cannot tell how many messages it has")
            return
        if any(chunk.is_damaged for chunk in self._facts.chunks):
            return
        self._expect("the number of messages", statistics.message_count, content.message_count)
        self._expect("the number of schemas", statistics.schema_count, len(content.schemas))
        self._expect("the number of channels", statistics.channel_count, len(content.channels))
        self._expect("the number of chunks", statistics.chunk_count, len(self._facts.chunks))
        self._expect(
            "the number of metadata records", statistics.metadata_count, len(self._facts.metadata)
        )
        self._expect(
            "the number of attachments", statistics.attachment_count, self._facts.attachments
        )
        if content.message_count:
            self._expect("the smallest log time", statistics.message_start_time, content.start)
            self._expect("the largest log time", statistics.message_end_time, content.end)
        counts = {id_: n for id_, n in statistics.channel_message_counts.items() if n}
        self._expect("the messages by channel", counts, content.counts)

    def _check_metadata(self) -> None:
        for entry in self._metadata:
            if entry not in self._facts.metadata:
                self._error(f"the summary has an index of metadata at byte {entry[0]}, as is none")
        for entry in self._facts.metadata:
            if entry not in self._metadata:
                self._error(f"the summary has no index of the metadata record at byte {entry[0]}")

    def _check_offsets(self) -> None:
        for offset in self._offsets:
            group = [frame for frame in self._frames if frame.opcode == offset.group_opcode]
            stated = (offset.group_start, offset.group_start + offset.group_length)
            if offset.group_length and stated != (
                (group[0].start, group[-1].end) if group else None
            ):
                kind = f"{offset.group_opcode:#04x}"
                self._error(f"the summary's records of kind {kind} are not at bytes {stated}")

    def _expect(self, what: str, stated: object, actual: object) -> None:
        self._findings.expect(self._name, what, stated, actual)

    def _error(self, text: str) -> None:
        self._findings.error(self._name, text)
