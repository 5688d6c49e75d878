# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""MCAP files that may be damaged anywhere: their intact parts, and the losses in between.

Three facts are certain. The checksum of a chunk covers its records, the head of a chunk states its
size twice, and a file that was cut off is intact up to the cut. A chunk is therefore kept if its
checksum matches, and after bytes that are no record the next chunk is searched for. A file that
ends with a footer was not cut off.

However, messages may carry MCAP files themselves, and a disk may hold chunks of other files. In a
file with a sound summary, only the chunks that the summary states count. In any other file, a
repeated chunk is dropped, and there is no search if the file has the magic bytes of further files.
"""

import os
import re
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, McapRecord, Metadata, Schema

from tsobs_ros.bag.container import (
    CHUNK_HEAD_SIZE,
    END_SIZE,
    INDEX_HEAD,
    MAGIC,
    MAX_SIZE,
    MAX_SUMMARY_SIZE,
    MESSAGE,
    RECORD,
    RecordError,
    Records,
    Summary,
    by_channel,
    chunk_head,
    find_footer,
    parse_record,
    parse_summary,
    read_chunk,
    split_records,
)
from tsobs_ros.bag.metadata import EMPTY_START_NS, BagMetadata, Descriptions, TopicInfo
from tsobs_ros.files import open_regular
from tsobs_ros.yaml_files import MAX_BYTES, load_yaml

Progress = Callable[[int], object]
"""Called with the number of bytes that were read since the last call."""

_MAX_OTHER_SIZE = 2**24
_MAX_DAMAGES = 10_000
_BLOCK_SIZE = 2**20
# The start of a message or chunk of less than 256 MiB; the lookahead finds overlapping ones, too.
_CANDIDATE = re.compile(rb"(?=[\x05\x06].{3}[\0-\x0f]\0{4})", re.DOTALL)
_IN_CHUNKS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_UNPARSED = (Opcode.MESSAGE, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT)


class Part(NamedTuple):
    """A part of a file: the record at byte `at`, or a run of messages outside of chunks.

    Attributes:
        at: Its first byte in the file.
        size: Its size in the file, bytes.
        record: The parsed record; None for messages, indexes and unknown records.
        content: The messages, schemas and channels that were read from it.
        is_checked: Whether a checksum covers them.
    """

    at: int
    size: int
    record: McapRecord | None = None
    content: Records | None = None
    is_checked: bool = False

    def described(self) -> Iterator[McapRecord | None]:
        """Yield the record, or the records between messages, each once; None for malformed ones."""
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
    """A lost part of a file: its first byte, its size in bytes, and the reason."""

    offset: int
    size: int
    reason: str

    def __str__(self) -> str:
        """Return one line for people."""
        return f"bytes {self.offset} to {self.offset + self.size}: {self.reason}"


class FileWalker:
    """The parts of one file, in file order.

    All chunks may decompress to 1 GiB plus 100 bytes per byte of the file, and hold 524,288 records
    plus one per six bytes. Without these limits, a file of some kilobytes could take hours.

    Only `size` bytes are read, as the file may be growing. `is_trusted` lifts the limits on chunks.

    Attributes:
        damage: The lost parts of what has been read so far.
        summary: The summary at the end of the file, if a checksum covers it.
        has_end: Whether the file ends with a footer.
    """

    def __init__(self, stream: IO[bytes], size: int, *, is_trusted: bool = False) -> None:
        self.damage: list[Damage] = []
        self.summary: Summary | None = None
        self.has_end = False
        self._descriptor, self._size = stream.fileno(), size
        self._bytes_left = 2**64 if is_trusted else 2**30 + 100 * size
        self._records_left = 2**64 if is_trusted else 2**19 + size // 6
        self._vain_left = 64 * size + 2**30
        # The end of the part to read: zeros, the footer or a sound summary may follow.
        self._end = self._end_without_zeros()
        # Times and sizes of the chunks that the summary states and that are not found yet.
        self._stated: Counter[tuple[int, int, int]] = Counter()
        self._seen: set[tuple[int, int, int, int]] = set()
        # Channels described outside of chunks; a file without chunks has them before its messages.
        self._bare_channels: set[int] = set()
        self._has_chunks = False
        if (footer := find_footer(self._bytes(self._end - END_SIZE, END_SIZE))) is not None:
            self.has_end, self._end, start = True, self._end - END_SIZE, footer.summary_start
            if footer.summary_crc and 0 < start <= self._end <= start + MAX_SUMMARY_SIZE:
                with suppress(RecordError):
                    self.summary = parse_summary(self._bytes(start, self._end - start), footer)
                    self._end = start
                    self._stated.update((s.start, s.end, s.size) for s in self.summary.spans)

    def parts(self, progress: Progress = lambda _: None) -> Iterator[Part]:
        """Yield the intact parts; `progress` gets the number of bytes read since its last call."""
        at = len(MAGIC) if self._bytes(0, len(MAGIC)) == MAGIC else 0
        progress(at)
        while at < self._end:
            try:
                part = self._read(at)
            except RecordError as error:
                following = self._lose(at, str(error))
            else:
                following = at + part.size
                yield part
            progress(following - at)
            at = following
        if at < self._size and not self.has_end:
            self._lose(at, "nothing but zeros to the end", self._size)
        progress(self._size - at)

    def _lose(self, at: int, reason: str, following: int | None = None) -> int:
        """Note damage, and return the offset behind it: by default, that of the next record."""
        following = self._search(at + 1) if following is None else following
        last = self.damage[-1] if self.damage else None
        if last and (last.offset + last.size == at or len(self.damage) >= _MAX_DAMAGES):
            last.size += following - at
        else:
            self.damage.append(Damage(at, following - at, reason))
        return following

    def _read(self, at: int) -> Part:
        """Return the part that begins at an offset.

        Raises:
            RecordError: No intact part begins there, and the next one has to be searched for.
        """
        head = self._bytes(at, CHUNK_HEAD_SIZE)
        if len(head) < RECORD.size:
            raise RecordError("a record is cut off")
        opcode, length = RECORD.unpack_from(head)
        if opcode == Opcode.CHUNK:
            return self._read_chunk(at, head)
        part = Part(at, RECORD.size + length)
        end = at + part.size
        if end > self._end or (length > MAX_SIZE and opcode != Opcode.ATTACHMENT):
            raise RecordError("not a record, or one that is cut off")
        if opcode == Opcode.MESSAGE and int.from_bytes(head[9:11], "little") in self._bare_channels:
            return self._read_run(part)
        # Only the record behind it confirms the length of a record that is not parsed. A metadata
        # record that has lost bytes may include the first bytes of the chunk behind it.
        is_parsed = opcode < 0x80 and opcode not in _UNPARSED and length <= _MAX_OTHER_SIZE
        record = parse_record(self._bytes(at, part.size)) if is_parsed else None
        if opcode == Opcode.MESSAGE or (
            (record is None or isinstance(record, Metadata)) and not self._starts_record(end)
        ):
            raise RecordError("not a record")
        # Behind damage, it may be from a chunk that has lost its head and with it its checksum.
        if isinstance(record, Channel) and not (self._has_chunks or self.damage):
            self._bare_channels.add(record.id)
        return part._replace(record=record)

    def _read_chunk(self, at: int, head: bytes) -> Part:
        chunk, data_at, size = self._own_head(head)
        self._has_chunks = True
        key, end = (chunk.message_start_time, chunk.message_end_time, size), at + size
        chunk.data = self._bytes(at + data_at, size - data_at)
        part, is_checked = Part(at, size, chunk), chunk.uncompressed_crc != 0
        try:
            if end > self._size:
                raise RecordError("the file ends inside of a chunk")
            content = self._content(chunk)
            # Without a checksum, lost bytes show only in what follows the chunk.
            if not (is_checked or self._starts_record(end)):
                raise RecordError("the chunk has no checksum, and no record follows it")
        except RecordError as error:
            if end > self._end or not self._starts_record(end):
                # A chunk that has lost bytes reaches into the bytes behind it: search inside of it,
                # within a budget, as a hostile file may consist of such chunks.
                self._vain_left -= len(chunk.data) + chunk.uncompressed_size % MAX_SIZE
                raise
            self._lose(at, str(error), end)
            return part
        if self.summary is not None:
            self._stated[key] -= 1
        elif (again := (*key, zlib.crc32(content.data))) in self._seen:
            self._lose(at, "a chunk that was there already", end)
            return part
        else:
            self._seen.add(again)
        return part._replace(content=content, is_checked=is_checked)

    def _own_head(self, head: bytes) -> tuple[Chunk, int, int]:
        """Return the result of `chunk_head` for a chunk that belongs to the file itself."""
        chunk, data_at, size = chunk_head(head)
        key = chunk.message_start_time, chunk.message_end_time, size
        if self.summary is not None and self._stated[key] <= 0:
            raise RecordError("a chunk that the index of the file does not state")
        return chunk, data_at, size

    def _content(self, chunk: Chunk) -> Records:
        """Return the records of a chunk, within the limits."""
        self._bytes_left -= min(chunk.uncompressed_size, MAX_SIZE) if chunk.compression else 0
        if self._bytes_left >= 0:
            content = read_chunk(chunk)
            self._records_left -= len(content.rows)
            for count, description in enumerate(content.descriptions()):
                # A description takes ten times as long as a message.
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

    def _read_run(self, first: Part) -> Part:
        """Return a run of messages outside of chunks that begins with `first`."""
        block = self._bytes(first.at, max(first.size, _BLOCK_SIZE))[: self._end - first.at]
        ends = [0]
        while ends[-1] + MESSAGE.size <= len(block):
            opcode, length, channel, _, _, _ = MESSAGE.unpack_from(block, ends[-1])
            following = ends[-1] + RECORD.size + length
            is_message = opcode == Opcode.MESSAGE and channel in self._bare_channels
            if not is_message or length < MESSAGE.size - RECORD.size or following > len(block):
                break
            ends.append(following)
        if not self._starts_record(first.at + ends[-1]):
            ends.pop()
        if len(ends) < 2:
            raise RecordError("not a record")
        return first._replace(size=ends[-1], content=split_records(block[: ends[-1]]))

    def _starts_record(self, at: int) -> bool:
        """Whether a record, even one that is cut off, may start at `at`, or the file ends there."""
        head = self._bytes(at, CHUNK_HEAD_SIZE)
        if at >= self._end or len(head) < INDEX_HEAD.size:
            return True
        opcode, length, channel, size = INDEX_HEAD.unpack_from(head)
        if opcode == Opcode.CHUNK:
            with suppress(RecordError):
                chunk_head(head)
                return True
            return False
        if length > self._end - at - RECORD.size:
            return 0 < opcode <= max(Opcode) and length <= MAX_SIZE and not self.has_end
        if opcode == Opcode.MESSAGE_INDEX:
            return bool(size == length - INDEX_HEAD.size + RECORD.size)
        if opcode == Opcode.MESSAGE:
            return channel in self._bare_channels
        return bool(opcode == Opcode.ATTACHMENT or (opcode > 0 and length <= _MAX_OTHER_SIZE))

    def _search(self, at: int) -> int:
        """Return the offset of the next chunk, or message outside of chunks; else the end."""
        if self._vain_left < 0 or (self.summary is None and self._carries_files):
            return self._end
        for begin, block in self._blocks(at, RECORD.size - 1):
            for match in _CANDIDATE.finditer(block):
                place = begin + match.start()
                with suppress(RecordError):
                    if block[match.start()] == Opcode.CHUNK:
                        *_, size = self._own_head(self._bytes(place, CHUNK_HEAD_SIZE))
                        if not self.has_end or place + size <= self._end:
                            return place
                    elif self._bare_channels:
                        self._read(place)
                        return place
        return self._end

    @cached_property
    def _carries_files(self) -> bool:
        """Whether it has the magic bytes of other MCAP files, which messages may carry."""
        return any(MAGIC in block for _, block in self._blocks(1, len(MAGIC) - 1))

    def _blocks(self, at: int, overlap: int) -> Iterator[tuple[int, bytes]]:
        """Yield blocks of growing size and their offsets, without the holes of a sparse file."""
        step = 2**12
        while at < self._end:
            with suppress(OSError):  # only a hole may be left
                at = max(at, os.lseek(self._descriptor, at, os.SEEK_DATA))
            yield at, self._bytes(at, min(step + overlap, self._end - at))
            at, step = at + step, min(2 * step, _BLOCK_SIZE)

    def _bytes(self, at: int, size: int) -> bytes:
        return os.pread(self._descriptor, max(0, min(size, self._size - at)), max(0, at))

    def _end_without_zeros(self) -> int:
        """Return where the zeros at the end of the file start: pages lost in a power cut."""
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


class DamagedFile:
    """One file: the descriptions of its topics, its messages, and an account of its losses.

    Args:
        path: The file.
        of_bag: The topics of the bag by name; those of the file are added to them.

    Attributes:
        name: The name of the file.
        bytes_read: Its size.
        finished: Whether its recorder had closed it.
        kept: The number of messages kept, by topic.
        unchecked: The number of messages kept that no checksum covers.
        dropped: The number of messages found and not kept, by reason.
        missing: The number of messages that the file states, but does not hold, by topic.
        damage: The parts that are lost.
        error: The reason why it was not read at all; empty if it was.
        described: The descriptions of its topics; only messages of described topics can be kept.
        counts: The number of messages found, by channel.
        times: The smallest and the largest log time kept of each topic, ns since the epoch.
        profile: The profile in its header; None without one.
        metadata: The metadata of the bag, if the file carries it.
    """

    def __init__(self, path: Path, of_bag: dict[str, TopicInfo]) -> None:
        self.path, self.name = path, path.name
        self.bytes_read = self.unchecked = 0
        self.finished = False
        self.kept, self.dropped, self.missing = Counter[str](), Counter[str](), Counter[str]()
        self.damage: list[Damage] = []
        self.error = ""
        self.described = Descriptions(of_bag)
        self.counts = Counter[int]()
        self.times: dict[str, tuple[int, int]] = {}
        self.profile: str | None = None
        self.metadata: BagMetadata | None = None
        self._metadata_room = MAX_BYTES

    @property
    def is_whole(self) -> bool:
        """Whether nothing is known to be lost."""
        return not (self.error or self.damage or self.dropped or self.missing)

    @property
    def span(self) -> tuple[int, int] | None:
        """The smallest and the largest log time kept, ns since the epoch; None without messages."""
        starts, ends = zip(*self.times.values(), strict=True) if self.times else ((), ())
        return (min(starts), max(ends)) if starts else None

    def parts(
        self,
        progress: Progress = lambda _: None,
        *,
        is_trusted: bool = False,
        described_by_summary: bool = True,
    ) -> Iterator[tuple[Part, Records | None]]:
        """Yield each intact part with the messages kept of it, if it has any, and count them.

        Args:
            progress: Called with the number of bytes that were read since the last call.
            is_trusted: Whether to read chunks of any decompressed size.
            described_by_summary: Whether the summary may describe topics before their messages.
        """
        counts = dict[int, int]()
        try:
            with open_regular(self.path) as stream:
                self.bytes_read = stream.seek(0, 2)
                walker = FileWalker(stream, self.bytes_read, is_trusted=is_trusted)
                self.damage, self.finished = walker.damage, walker.has_end
                if described_by_summary and walker.summary is not None:
                    self.described.add_all(walker.summary.schemas, walker.summary.channels)
                    counts = walker.summary.statistics.channel_message_counts
                for part in walker.parts(progress):
                    for record in part.described():
                        self._describe(record)
                    yield part, None if part.content is None else self._keep(part, part.content)
        except OSError as error:
            self.error = error.strerror or str(error)
        names = {id_: topic.name for id_, topic in self.described.topics.items()}
        stated = Counter[str]()
        for id_, number in counts.items():
            stated[names.get(id_, f"channel {id_}")] += number
        self.missing = stated - self.kept

    def _keep(self, part: Part, content: Records) -> Records:
        rows, kept = content.rows, np.zeros(len(content.rows), np.bool_)
        times = np.stack([rows["log_time"], rows["publish_time"]])
        fits = (times.min(axis=0) >= 0) & (times.max(axis=0) < EMPTY_START_NS)
        for id_, places in by_channel(rows):
            self.counts[id_] += len(places)
            if (topic := self.described.topics.get(id_)) is None:
                lost = f"channel {id_} is not described before its messages"
                self.dropped[self.described.problems.get(id_, lost)] += len(places)
                continue
            own = places[fits[places]]
            if len(own) < len(places):
                self.dropped[f"{topic.name}: times do not fit 63 bits"] += len(places) - len(own)
            if len(own):
                kept[own] = True
                self.kept[topic.name] += len(own)
                first, last = int(times[0, own].min()), int(times[0, own].max())
                start, end = self.times.get(topic.name, (first, last))
                self.times[topic.name] = min(start, first), max(end, last)
        self.unchecked += 0 if part.is_checked else int(kept.sum())
        return content if kept.all() else Records(content.data, rows[kept])

    def _describe(self, record: McapRecord | None) -> None:
        match record:
            case None:
                self.described.problems["record"] = "a record between its messages is malformed"
            case Header() if self.profile is None:
                self.profile = record.profile
            case Metadata(name="rosbag2"):
                text = record.metadata.get("serialized_metadata", "")
                self._metadata_room -= len(text)
                if self._metadata_room >= 0 and self.metadata is None:
                    with suppress(ValueError):
                        self.metadata = BagMetadata.from_map(load_yaml(text))
            case Schema() | Channel():
                self.described.add(record)
