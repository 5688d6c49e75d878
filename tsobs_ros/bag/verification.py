# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Verification of a bag: the questions whose answers decide what its readers give.

Can every tool open it, does each summary agree with the content of its file, do the checksums hold,
does every message have the bytes of its type, and does metadata.yaml agree with the files? An error
is what makes a reader fail or lose something; a remark is what could not be checked.
"""

import re
import zlib
from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Schema

from tsobs_ros.bag.cdr import MessageLayout, UnknownLayoutError
from tsobs_ros.bag.container import (
    INDEX_HEAD,
    MAGIC,
    MAX_SIZE,
    MESSAGE,
    RECORD,
    RECOVER_HINT,
    ContentLimit,
    RecordError,
    Summary,
    chunk_records,
    read_summary,
)
from tsobs_ros.bag.damaged_file import parse_record
from tsobs_ros.bag.metadata import (
    EMPTY_START_NS,
    FILE_NAME,
    ROOT_KEY,
    BagMetadata,
    OfferedQos,
    read_metadata,
)
from tsobs_ros.bag.reader import UNCHECKED
from tsobs_ros.errors import BagReadError, MessageError, printable
from tsobs_ros.files import open_regular
from tsobs_ros.yaml_files import read_yaml

_TYPE_NAME = re.compile(r"[A-Za-z]\w*/(msg|srv|action)/[A-Za-z]\w*", re.ASCII)
_NUMBERED = re.compile(r".+_\d+\.[^.]+")
_BLOCK_SIZE = 2**20
_MAX_FINDINGS = 1_000
_MAX_TEXT = 1_000
_COUNTED = 10_000
# In messages, which take a tenth as long.
_DESCRIPTION_COST = 10
_MAX_LAYOUTS = 2**23


class Finding(NamedTuple):
    """One thing that is not as it should be.

    Attributes:
        place: The file, or the file and the topic.
        text: What was expected and what is there, in the first such case.
        cases: The number of such cases in this place.
    """

    place: str
    text: str
    cases: int = 1

    def __str__(self) -> str:
        """Return one line for people."""
        more = f" (and {self.cases - 1} more)" if self.cases > 1 else ""
        return f"{self.place}: {self.text}{more}"


@dataclass(frozen=True)
class Verification:
    """The result of a check.

    Attributes:
        path: The bag.
        files: The number of files checked.
        messages: The number of messages checked.
        errors: What makes readers fail or lose something.
        remarks: What could not be checked.
        unchecked: The number of messages that no checksum covers, so that damage is not noticed.
    """

    path: Path
    files: int
    messages: int
    errors: tuple[Finding, ...]
    remarks: tuple[Finding, ...]
    unchecked: int = 0

    @property
    def holds(self) -> bool:
        """Whether there are no errors."""
        return not self.errors

    def as_mapping(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "bag": str(self.path),
            "holds": self.holds,
            "files": self.files,
            "messages": self.messages,
            "unchecked": self.unchecked,
            "errors": [finding._asdict() for finding in self.errors],
            "remarks": [finding._asdict() for finding in self.remarks],
        }

    def text(self) -> str:
        """Return the same for people to read."""
        lines = [f"error: {finding}" for finding in self.errors]
        lines += [f"remark: {finding}" for finding in self.remarks]
        sound = f"OK, but {self.unchecked} UNCHECKED" if self.unchecked else "OK"
        verdict = sound if self.holds else f"NOT sound, {_number(len(self.errors), 'error')}"
        count = f"{_number(self.messages, 'message')} in {_number(self.files, 'file')}"
        return "\n".join(map(printable, [*lines, f"{self.path}: {verdict}, {count}"]))


def verify(
    bag: str | Path,
    progress: Callable[[int], object] = lambda _: None,
    *,
    is_trusted: bool = False,
) -> Verification:
    """Check a bag: its folder, the structure of its files, and each message.

    Args:
        bag: A bag folder, or one MCAP file.
        progress: Called with the number of bytes that were checked since the last call.
        is_trusted: Whether to read chunks however much they decompress to.

    Raises:
        BagReadError: There is no such folder or file.
    """
    path = Path(bag)
    if not path.exists():
        raise BagReadError(f"{path}: there is no such bag")
    errors, remarks = _Findings(), _Findings()
    metadata, paths = _check_folder(path, errors) if path.is_dir() else (None, [path])
    files = {file.name: _File(file, errors, remarks, is_trusted) for file in paths}
    for file in files.values():
        file.check(progress)
    if metadata:
        _compare(metadata, files, errors)
    messages = sum(file.counts.total() for file in files.values())
    unchecked = sum(file.unchecked for file in files.values())
    found = tuple(errors.values()), tuple(remarks.values())
    return Verification(path, len(files), messages, *found, unchecked)


class _Findings(dict[tuple[str, str], Finding]):
    """Findings by place and rule."""

    def add(self, place: str, text: str, rule: str = "") -> None:
        """Add a case; those of one rule in one place are counted, and the first is kept."""
        key = place, rule or text[:_MAX_TEXT]
        if len(self) >= _MAX_FINDINGS and key not in self:
            key, place, text = ("", ""), "more", "further findings, which are not listed"
        known = self.get(key, Finding(place[:_MAX_TEXT], text[:_MAX_TEXT], 0))
        self[key] = known._replace(cases=known.cases + 1)

    def expect(self, place: str, what: str, stated: object, actual: object) -> None:
        if stated != actual:
            self.add(place, f"{what} is stated as {stated}, but is {actual}")


def _check_folder(bag: Path, errors: _Findings) -> tuple[BagMetadata | None, list[Path]]:
    """Check a folder and its metadata.yaml; return that, and the files to read."""
    try:
        present = {path.name: path for path in sorted(bag.iterdir())}
    except OSError as error:
        raise BagReadError(f"{bag}: cannot read it: {error.strerror or error}") from error
    unlisted = [path for name, path in present.items() if name.endswith(".mcap")]
    try:
        metadata = read_metadata(bag)
    except BagReadError as error:
        text = str(error).removeprefix(f"{bag / FILE_NAME}: ")
        errors.add(FILE_NAME, text if FILE_NAME in present else "there is none")
        return None, unlisted
    stated = read_yaml(bag / FILE_NAME, error=BagReadError)
    for key in ("starting_time", "duration", "message_count", "storage_identifier"):
        actual = {**metadata.to_map(), "storage_identifier": "mcap"}[key]
        errors.expect(FILE_NAME, key, stated[ROOT_KEY].get(key), actual)
    for entry in stated[ROOT_KEY]["topics_with_message_count"]:
        topic = entry["topic_metadata"]
        what = f"serialization_format of {topic['name']}"
        errors.expect(FILE_NAME, what, topic["serialization_format"], "cdr")
    listed = {Path(file.path).name: file.path for file in metadata.files}
    for name, stated_path in listed.items():
        # Nothing outside of the folder is opened: readers, too, take the last part of a path.
        if stated_path != name:
            text = f"the file '{stated_path}' is not given by its name in the bag's own folder"
            errors.add(FILE_NAME, text)
        if name not in present:
            errors.add(FILE_NAME, f"the file '{name}' is not there")
    for name in present:
        if name not in listed and _NUMBERED.fullmatch(name):
            errors.add(name, f"{FILE_NAME} does not list it: a reindexing would stumble over it")
    return metadata, [present[name] for name in listed if name in present] or unlisted


def _compare(metadata: BagMetadata, files: dict[str, "_File"], errors: _Findings) -> None:
    """Compare metadata.yaml with the content of the files."""
    topics = {topic.name: topic for topic in metadata.topics}
    found = {file.path: files.get(Path(file.path).name) for file in metadata.files}
    for stated in metadata.files:
        if (file := found[stated.path]) is None:
            continue
        if file.is_complete:
            times = (file.start, file.end - file.start) if file.counts else (EMPTY_START_NS, 0)
            what = f"the start, duration and message_count of {stated.path}"
            numbers = stated.starting_time_ns, stated.duration_ns, stated.message_count
            errors.expect(FILE_NAME, what, numbers, (*times, file.counts.total()))
        for channel in file.channels.values():
            place = f"{file.path.name}: {channel.topic}"
            if (topic := topics.get(channel.topic)) is None:
                errors.add(place, f"is not in {FILE_NAME}")
                continue
            if schema := file.schemas.get(channel.schema_id):
                errors.expect(FILE_NAME, f"type of {topic.name}", topic.type, schema.name)
            hash_ = channel.metadata.get("topic_type_hash", topic.type_hash)
            if hash_ != topic.type_hash:
                errors.add(place, f"the hash of its type is not the one in {FILE_NAME}")
            if file.qos.get(channel.id) not in (None, topic.qos_profiles):
                text = f"its QoS is not the one in {FILE_NAME}: some readers give no messages then"
                errors.add(place, text)
    complete = [file for file in found.values() if file and file.is_complete]
    if len(complete) == len(metadata.files):
        counts: Counter[str] = Counter()
        for file in complete:
            for channel in file.channels.values():
                counts[channel.topic] += file.counts[channel.id]
        for topic in metadata.topics:
            what = f"message_count of {topic.name}"
            errors.expect(FILE_NAME, what, topic.count, counts[topic.name])


class _ChunkFacts(NamedTuple):
    """What the summary should state of a chunk, and the message indexes that are to follow it."""

    size: int
    start: int
    end: int
    index_offsets: dict[int, int]
    entries: "dict[int, array[int]]"
    is_damaged: bool


class _File:
    """The check of one file: its content, and its summary against that."""

    def __init__(self, path: Path, errors: _Findings, remarks: _Findings, is_trusted: bool) -> None:
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.qos: dict[int, object] = {}
        self.counts: Counter[int] = Counter()
        self.start = EMPTY_START_NS
        self.end = 0
        self.is_complete = False
        self._errors = errors
        self._remarks = remarks
        self._layouts: dict[int, MessageLayout] = {}
        self._chunks: dict[int, _ChunkFacts] = {}
        self._topics: set[str] = set()
        self._offered = OfferedQos()
        self._is_trusted = is_trusted
        self._layout_room = _MAX_LAYOUTS
        self.unchecked = 0

    def check(self, progress: Callable[[int], object]) -> None:
        """Read the file once, from its start to its end."""
        try:
            summary = read_summary(self.path)
            self._expect("its profile", summary.profile, "ros2")
            with open_regular(self.path) as stream:
                self._check_data(stream, len(summary.spans), progress)
            self._check_summary(summary)
            self.is_complete = not any(chunk.is_damaged for chunk in self._chunks.values())
        except (RecordError, OverflowError) as error:
            self._error(f"the file is damaged: {error}; {RECOVER_HINT}")
        except OSError as error:
            self._error(str(error).removeprefix(f"{self.path}: "))

    def _check_data(
        self, stream: IO[bytes], chunks: int, progress: Callable[[int], object]
    ) -> None:
        size, at, record = stream.seek(0, 2), len(MAGIC), None
        self._content = ContentLimit(size, self._is_trusted)
        while not isinstance(record, DataEnd):
            stream.seek(at)
            head = stream.read(RECORD.size)
            opcode, length = RECORD.unpack(head.ljust(RECORD.size, b"\0"))
            if opcode == 0 or length > size - stream.tell():
                raise RecordError(f"at byte {at} there is no record, or one that is cut off")
            if opcode != Opcode.ATTACHMENT and opcode <= max(Opcode):
                if length > MAX_SIZE:
                    raise RecordError(f"the record at byte {at} has {length} bytes, too many")
                if opcode == Opcode.CHUNK and len(self._chunks) > chunks:
                    raise RecordError(f"there are more chunks than the {chunks} in its index")
                record = self._check_record(at, opcode, head + stream.read(length))
            progress(RECORD.size + length)
            at += RECORD.size + length
        if stated := record.data_section_crc:
            if stated != _crc(stream, at - RECORD.size - length):
                self._error("the checksum of the data section is wrong")
            self.unchecked = 0
        if self.unchecked:
            self._remark(f"{self.unchecked} {UNCHECKED}")

    def _check_record(self, at: int, opcode: int, record: bytes) -> McapRecord | None:
        if opcode == Opcode.MESSAGE_INDEX:
            self._check_index(at, record)
            return None
        if opcode == Opcode.MESSAGE:
            self.unchecked += 1
            self._check_records(record)
            return None
        try:
            found = parse_record(record)
        except RecordError as error:
            raise RecordError(f"at byte {at}: {error}") from error
        if isinstance(found, Chunk):
            self._check_chunk(at, len(record), found)
        else:
            self._describe(found)
        return found

    def _check_chunk(self, at: int, size: int, chunk: Chunk) -> None:
        counted = self.counts.total()
        for entries in chain.from_iterable(c.entries.values() for c in self._last_chunk()):
            del entries[:]  # only whether there are some is needed from now on
        times = chunk.message_start_time, chunk.message_end_time
        facts = _ChunkFacts(size, *times, {}, {}, is_damaged=False)
        self._content.count_chunk(chunk)
        try:
            facts = facts._replace(entries=self._check_records(chunk_records(chunk)))
            bounds = [bound for e in facts.entries.values() for bound in (min(e[::2]), max(e[::2]))]
            actual = min(bounds, default=0), max(bounds, default=0)
            self._expect(f"the log times of the chunk at byte {at}", times, actual)
        except RecordError as error:
            facts = facts._replace(is_damaged=True)
            self._error(f"at byte {at}: {error}; {RECOVER_HINT}")
        if not chunk.uncompressed_crc:
            self.unchecked += self.counts.total() - counted
        self._chunks[at] = facts

    def _last_chunk(self) -> list[_ChunkFacts]:
        return list(islice(reversed(self._chunks.values()), 1))

    def _check_records(self, records: bytes) -> "dict[int, array[int]]":
        """Check a run of records; return log time and place of each message, by channel."""
        entries: dict[int, array[int]] = {}
        at, size, count = 0, len(records), 0
        while at < size:
            count += 1
            if count >= _COUNTED:
                self._content.count_records(count)
                count = 0
            opcode, length = RECORD.unpack_from(records, at) if at + RECORD.size <= size else (0, 0)
            end = at + RECORD.size + length
            if end > size or (opcode == Opcode.MESSAGE and end < at + MESSAGE.size):
                raise RecordError(f"the record at byte {at} of {size} is cut off")
            if opcode == Opcode.MESSAGE:
                _, _, channel, _, log_time, publish_time = MESSAGE.unpack_from(records, at)
                data = records[at + MESSAGE.size : end]
                self._check_message(channel, log_time, publish_time, data)
                entries.setdefault(channel, array("Q")).extend((log_time, at))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._describe(parse_record(records[at:end]))
                count += _DESCRIPTION_COST
            else:
                raise RecordError(f"a record of kind {opcode:#04x} is inside of a chunk")
            at = end
        self._content.count_records(count)
        return entries

    def _check_index(self, at: int, record: bytes) -> None:
        chunk = next(iter(self._last_chunk()), None)
        entries = record[INDEX_HEAD.size :]
        _, _, channel, size = INDEX_HEAD.unpack_from(record.ljust(INDEX_HEAD.size))
        if chunk is None or size != len(entries) or size % 16:
            raise RecordError(f"the message index at byte {at} is malformed, or follows no chunk")
        if entries:
            chunk.index_offsets[channel] = at
        actual = chunk.entries.pop(channel, array("Q")).tobytes()
        if not chunk.is_damaged and not np.array_equal(_in_order(entries), _in_order(actual)):
            self._error(f"the index of channel {channel} at byte {at} is not that of its chunk")

    def _describe(self, record: McapRecord) -> None:
        """Check a schema or channel, unless it is a repeated one."""
        kind: Any = {Schema: self.schemas, Channel: self.channels}.get(type(record))
        if kind is None:
            return
        described: Any = record
        if (known := kind.setdefault(described.id, record)) != record:
            self._error(f"two descriptions have the id {described.id}", rule="id")
        elif known is record:
            (self._check_schema if isinstance(record, Schema) else self._check_channel)(described)

    def _check_schema(self, schema: Schema) -> None:
        if not _TYPE_NAME.fullmatch(schema.name):
            self._error(f"the schema '{schema.name}' is not named as package/msg/Type")
        if schema.encoding not in ("ros2msg", "ros2idl"):
            self._error(f"{schema.name} is defined in '{schema.encoding}', not in ros2msg")
            return
        try:
            if schema.encoding == "ros2idl":
                raise UnknownLayoutError(f"{schema.name} is defined in IDL")
            self._layout_room -= len(schema.data)
            if self._layout_room < 0:
                raise UnknownLayoutError(f"{schema.name} is one of too many definitions")
            self._layouts[schema.id] = MessageLayout(schema.name, schema.data.decode())
        except UnknownLayoutError as reason:
            self._remark(f"{reason}: its messages are not looked into")
        except ValueError as error:  # not UTF-8 is a ValueError as well
            self._error(f"the definition of {schema.name} is malformed: {error}")

    def _check_channel(self, channel: Channel) -> None:
        topic = channel.topic
        if topic in self._topics:
            self._error("has more than one channel", topic)
        self._topics.add(topic)
        if channel.message_encoding != "cdr":
            self._error(f"is encoded in '{channel.message_encoding}', not in cdr", topic)
        if channel.schema_id not in self.schemas:
            self._error(f"has the schema {channel.schema_id}, which is not there before it", topic)
        try:
            self.qos[channel.id] = self._offered[channel]
        except ValueError as error:
            self._error(str(error), topic)

    def _check_message(self, id_: int, log_time: int, publish_time: int, data: bytes) -> None:
        self.counts[id_] += 1
        if log_time < self.start:
            self.start = log_time
        if log_time > self.end:
            self.end = log_time
        if (channel := self.channels.get(id_)) is None:
            self._error(f"a message is of channel {id_}, which is not there before it")
            return
        if log_time >= EMPTY_START_NS or publish_time >= EMPTY_START_NS:
            text = f"a time does not fit 63 bits: log {log_time} ns, publish {publish_time} ns"
            self._error(text, channel.topic, "time")
        if layout := self._layouts.get(channel.schema_id):
            try:
                layout.check(data)
            except MessageError as error:
                text = f"the message at {log_time} ns is not whole: {error}"
                self._error(text, channel.topic, "data")

    def _check_summary(self, summary: Summary) -> None:
        for schema in self.schemas.values():
            if summary.schemas.get(schema.id) != schema:
                self._error(f"the summary does not repeat the schema of {schema.name}")
        for channel in self.channels.values():
            if summary.channels.get(channel.id) != channel:
                self._error(f"the summary does not repeat the channel of {channel.topic}")
        # Topics without messages are only here.
        for description in (*summary.schemas.values(), *summary.channels.values()):
            self._describe(description)
        spans = {span.offset: span for span in summary.spans if span.is_chunk}
        for at, chunk in self._chunks.items():
            for channel_id in chunk.entries:
                self._error(f"the chunk at byte {at} has no message index of channel {channel_id}")
            if (span := spans.pop(at, None)) is None:
                self._error(f"the summary has no index of the chunk at byte {at}")
                continue
            # Some writers also list channels of which a chunk has no messages.
            offsets = {id_: span.index_offsets.get(id_) for id_ in chunk.index_offsets}
            stated = span.size, span.start, span.end, offsets
            what = f"size, first and last log time, and index offsets of the chunk at byte {at}"
            self._expect(what, stated, chunk[:4])
        for at in spans:
            self._error(f"the summary has an index of a chunk at byte {at}, where none is")
        if not any(chunk.is_damaged for chunk in self._chunks.values()):
            found = summary.statistics
            by_channel = {id_: n for id_, n in found.channel_message_counts.items() if n}
            self._expect("the messages by channel", by_channel, dict(self.counts))
            self._expect("the number of messages", found.message_count, self.counts.total())
            self._expect("the number of schemas", found.schema_count, len(self.schemas))
            self._expect("the number of channels", found.channel_count, len(self.channels))
            times = (self.start, self.end) if self.counts else (0, 0)
            stated_times = found.message_start_time, found.message_end_time
            self._expect("the smallest and largest log time", stated_times, times)

    def _expect(self, what: str, stated: object, actual: object) -> None:
        self._errors.expect(self.path.name, what, stated, actual)

    def _error(self, text: str, topic: str = "", rule: str = "") -> None:
        self._errors.add(f"{self.path.name}: {topic}" if topic else self.path.name, text, rule)

    def _remark(self, text: str) -> None:
        self._remarks.add(self.path.name, text)


def _in_order(entries: bytes) -> np.ndarray[Any, np.dtype[np.uint64]]:
    """Return the entries of a message index by log time and place: each writer has its order."""
    pairs = np.frombuffer(entries, "<u8").reshape(-1, 2)
    return pairs[np.lexsort(pairs.T[::-1])]


def _crc(stream: IO[bytes], end: int) -> int:
    """Return the checksum of a file up to a place."""
    crc = at = stream.seek(0)
    while at < end and (block := stream.read(min(_BLOCK_SIZE, end - at))):
        crc, at = zlib.crc32(block, crc), at + len(block)
    return crc


def _number(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
