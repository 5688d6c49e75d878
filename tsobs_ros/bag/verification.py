# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Verification of a bag: the questions whose answers decide what its readers give.

Can every tool open it, does each summary agree with the content of its file, do the checksums hold,
and does metadata.yaml agree with the files? An error is what makes a reader fail or lose something.
Messages are not decoded.
"""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Schema
from numpy.typing import NDArray

from tsobs_ros.bag.container import (
    INDEX_HEAD,
    MESSAGE,
    RECOVER_HINT,
    Records,
    Summary,
    read_summary,
)
from tsobs_ros.bag.metadata import (
    FILE_NAME,
    ROOT_KEY,
    BagMetadata,
    FileMetadata,
    TopicInfo,
    TopicReader,
    read_metadata,
)
from tsobs_ros.bag.walker import FileWalker, Part, Progress
from tsobs_ros.errors import BagReadError, printable
from tsobs_ros.files import open_regular
from tsobs_ros.yaml_files import read_yaml

_TYPE_NAME = re.compile(r"[A-Za-z]\w*/(msg|srv|action)/[A-Za-z]\w*", re.ASCII)
_NUMBERED = re.compile(r".+_\d+\.[^.]+")
_MAX_FINDINGS = 1_000
_MAX_TEXT = 1_000


@dataclass(frozen=True)
class Verification:
    """The result of a check.

    Attributes:
        path: The bag.
        files: The number of files checked.
        messages: The number of messages checked.
        errors: What makes readers fail or lose something, each with the file, and the topic.
        unchecked: The number of messages that no checksum covers, so that damage is not noticed.
    """

    path: Path
    files: int
    messages: int
    errors: tuple[str, ...]
    unchecked: int

    @property
    def holds(self) -> bool:
        """Whether there are no errors."""
        return not self.errors

    def as_mapping(self) -> dict[str, Any]:
        """Return plain data."""
        return {"bag": str(self.path), "holds": self.holds} | {
            name: getattr(self, name) for name in ("files", "messages", "unchecked", "errors")
        }

    def text(self) -> str:
        """Return the same for people to read."""
        lines = [f"error: {finding}" for finding in self.errors]
        verdict = f"OK, but {self.unchecked} UNCHECKED" if self.unchecked else "OK"
        verdict = verdict if self.holds else f"NOT sound, errors: {len(self.errors)}"
        lines.append(f"{self.path}: {verdict}; files: {self.files}, messages: {self.messages}")
        return "\n".join(map(printable, lines))


def verify(
    bag: str | Path, progress: Progress = lambda _: None, *, is_trusted: bool = False
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
    errors = _Findings()
    metadata, paths = _check_folder(path, errors) if path.is_dir() else (None, [path])
    files = [_File(file, errors) for file in paths]
    for file in files:
        file.check(progress, is_trusted)
    if metadata:
        for text in _differences(path, metadata, files):
            errors.add(FILE_NAME, text)
    messages = sum(file.counts.total() for file in files)
    unchecked = sum(file.unchecked for file in files)
    return Verification(path, len(files), messages, tuple(errors.values()), unchecked)


class _Findings(dict[tuple[str, str], str]):
    """Findings by place and rule: the first case of each."""

    def add(self, place: str, text: str, rule: str = "") -> None:
        """Add a case, unless there is one of the same rule in the same place."""
        if len(self) < _MAX_FINDINGS:
            self.setdefault((place, rule or text[:_MAX_TEXT]), f"{place}: {text}"[:_MAX_TEXT])


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


def _differences(bag: Path, metadata: BagMetadata, files: list["_File"]) -> Iterator[str]:
    """Yield in what metadata.yaml is not what it would be of the files."""
    stated = _by_name(read_yaml(bag / FILE_NAME, error=BagReadError)[ROOT_KEY])
    whole = [file for file in files if file.is_complete]
    counts = sum((file.counts_by_topic() for file in whole), Counter[str]())
    topics = {topic.name: topic for file in whole for topic in file.topics(metadata)}
    each = (replace(topic, count=counts[topic.name]) for topic in topics.values())
    found = BagMetadata(tuple(each), tuple(file.metadata() for file in whole))
    actual = _by_name(found.to_map())
    if len(whole) < len(metadata.files):  # the files that could be checked
        for topic in actual["topics"].values():
            del topic["message_count"]
        actual = {"topics": actual["topics"], "files": actual["files"]}
    else:
        silent = {name: one | {"message_count": 0} for name, one in stated["topics"].items()}
        actual["topics"] = silent | actual["topics"]
    yield from _compared(stated, actual)


def _by_name(information: dict[str, Any]) -> dict[str, Any]:
    totals = ["starting_time", "duration", "message_count", "storage_identifier"]
    totals += ["relative_file_paths"]
    topics = {}
    for each in information["topics_with_message_count"]:
        topic = each["topic_metadata"]
        topics[topic["name"]] = topic | {"message_count": each["message_count"]}
    files = {Path(each["path"]).name: each | {"path": ""} for each in information["files"]}
    return {key: information.get(key) for key in totals} | {"topics": topics, "files": files}


def _compared(stated: Any, actual: Any, *path: object) -> Iterator[str]:
    """Yield what is stated otherwise than it is, of all that it is."""
    if isinstance(stated, dict) and isinstance(actual, dict):
        for key in actual:
            yield from _compared(stated.get(key), actual[key], *path, key)
    elif stated != actual:
        yield f"{': '.join(map(str, path))} is stated as {stated}, but is {actual}"


class _File:
    """The check of one file: its content, and its summary against that."""

    def __init__(self, path: Path, errors: _Findings) -> None:
        self.path = path
        self.is_complete = False
        self.unchecked = 0
        self.counts = Counter[int]()
        self._errors = errors
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._start, self._end = 2**64, 0
        self._read_topic = TopicReader()
        self._topics: dict[int, TopicInfo] = {}
        self._names: set[str] = set()
        # What the summary should state of each chunk: size, times and index offsets.
        self._chunks: dict[int, tuple[int, int, int, dict[int, int]]] = {}
        self._last = 0
        # The entries that the message indexes behind the last chunk should have, by channel.
        self._entries: dict[int, NDArray[np.int64]] = {}

    def metadata(self) -> FileMetadata:
        """Return what metadata.yaml should state of it."""
        return FileMetadata.of(self.path.name, self._start, self._end, self.counts.total())

    def counts_by_topic(self) -> Counter[str]:
        """Return the number of messages of each topic."""
        each = self._channels.items()
        return Counter({channel.topic: self.counts[id_] for id_, channel in each})

    def topics(self, metadata: BagMetadata) -> Iterator[TopicInfo]:
        """Yield what metadata.yaml should state of its topics, or does if the file does not."""
        listed = {topic.name: topic.type_hash for topic in metadata.topics}
        for id_, topic in self._topics.items():
            hashes = self._channels[id_].metadata
            hash_ = hashes.get("topic_type_hash", listed.get(topic.name, ""))
            yield replace(topic, type_hash=hash_)

    def check(self, progress: Progress, is_trusted: bool) -> None:
        """Read the file once, from its start to its end."""
        try:
            summary = read_summary(self.path)
            with open_regular(self.path) as stream:
                walker = FileWalker(stream, stream.seek(0, 2), is_trusted=is_trusted)
                for part in walker.parts(progress):
                    if isinstance(part.record, DataEnd):
                        break
                    self._check_part(stream, part, is_whole=not walker.damage)
        except OSError as error:
            self._error(str(error).removeprefix(f"{self.path}: "))
            return
        self._check_indexed()
        for each in walker.damage:
            self._error(f"at byte {each.offset}: {each.reason}; {RECOVER_HINT}")
        self.is_complete = not walker.damage
        # Topics without messages are only in the summary.
        for record in (*summary.schemas.values(), *summary.channels.values()):
            self._describe(record)
        if self.is_complete:
            self._check_summary(summary)

    def _check_part(self, stream: IO[bytes], part: Part, *, is_whole: bool) -> None:
        for record in part.described():
            if record is None:
                self._error(f"at byte {part.at}: a record in it is malformed", rule="record")
            else:
                self._describe(record)
        if part.content is not None:
            self._check_messages(part.content)
            self.unchecked += 0 if part.is_checked else len(part.content.rows)
            if isinstance(part.record, Chunk):
                self._check_chunk(part, part.record, part.content)
        elif part.record is None:
            stream.seek(part.at)
            if (data := stream.read(part.size))[0] == Opcode.MESSAGE_INDEX:
                self._check_index(part.at, data, is_whole=is_whole)

    def _check_chunk(self, part: Part, chunk: Chunk, content: Records) -> None:
        self._check_indexed()
        times = content.rows["log_time"].view("u8")
        start, end = (int(times.min()), int(times.max())) if len(times) else (0, 0)
        if (chunk.message_start_time, chunk.message_end_time) != (start, end):
            self._error(f"the chunk at byte {part.at} states other log times than {start} to {end}")
        self._chunks[part.at], self._last = (part.size, start, end, {}), part.at
        entries = np.stack((times.view("i8"), content.rows["begin"] - MESSAGE.size), axis=1)
        of_each = content.rows["channel"]
        self._entries = {id_: entries[of_each == id_] for id_ in np.unique(of_each).tolist()}

    def _check_indexed(self) -> None:
        for id_ in self._entries:
            self._error(f"the chunk at byte {self._last} has no message index of channel {id_}")

    def _check_index(self, at: int, data: bytes, *, is_whole: bool) -> None:
        channel, entries = INDEX_HEAD.unpack_from(data)[2], data[INDEX_HEAD.size :]
        actual = self._entries.pop(channel, None)
        if actual is None and (not entries or not is_whole):
            return  # a writer may index channels without messages; the chunk may be damaged
        if actual is not None:
            self._chunks[self._last][3][channel] = at
        if (
            actual is None
            or len(entries) != 16 * len(actual)
            or not np.array_equal(
                _in_order(np.frombuffer(entries, "<i8").reshape(-1, 2)), _in_order(actual)
            )
        ):
            self._error(f"the index of channel {channel} at byte {at} is not that of its chunk")

    def _describe(self, record: McapRecord) -> None:
        """Check a schema or channel, unless it is a repeated one."""
        match record:
            case Schema() if self._is_new(record, self._schemas):
                if not _TYPE_NAME.fullmatch(record.name):
                    self._error(f"the schema '{record.name}' is not named as package/msg/Type")
                if record.encoding not in ("ros2msg", "ros2idl"):
                    self._error(f"{record.name} is defined in '{record.encoding}', not in ros2msg")
            case Channel() if self._is_new(record, self._channels):
                self._check_channel(record)

    def _is_new(self, record: Any, known: dict[int, Any]) -> bool:
        if known.setdefault(record.id, record) != record:
            self._error(f"two descriptions have the id {record.id}", rule="id")
        return known[record.id] is record

    def _check_channel(self, channel: Channel) -> None:
        name = channel.topic
        if name in self._names:
            self._error("has more than one channel", name)
        self._names.add(name)
        try:
            schema = self._schemas.get(channel.schema_id)
            self._topics[channel.id] = self._read_topic(channel, schema)
            self._read_topic.offers(channel)
        except ValueError as error:
            self._error(str(error), name)

    def _check_messages(self, content: Records) -> None:
        channels, times = content.rows["channel"], content.rows["log_time"].view("u8")
        if len(times):
            self._start = min(self._start, int(times.min()))
            self._end = max(self._end, int(times.max()))
        for id_ in np.unique(channels).tolist():
            own = content.rows[channels == id_]
            self.counts[id_] += len(own)
            if (channel := self._channels.get(id_)) is None:
                self._error(f"a message is of channel {id_}, which is not there before it")
                continue
            if min(own["log_time"].min(), own["publish_time"].min()) < 0:
                self._error("a time does not fit 63 bits", channel.topic)

    def _check_summary(self, summary: Summary) -> None:
        found, chunks = summary.statistics, {}
        for span in summary.spans:
            # Some writers also list channels of which a chunk has no messages.
            indexed = self._chunks.get(span.offset, (0, 0, 0, {}))[3]
            offsets = {id_: at for id_, at in span.index_offsets.items() if id_ in indexed}
            chunks[span.offset] = span.size, span.start, span.end, offsets
        stated = {
            "profile": summary.profile,
            "schemas": summary.schemas,
            "channels": summary.channels,
            "chunks (size, log times, places of indexes)": chunks,
            "number of chunks": len(chunks),
            "number of schemas": found.schema_count,
            "number of channels": found.channel_count,
            "number of messages": found.message_count,
            "messages by channel": {k: n for k, n in found.channel_message_counts.items() if n},
            "log times": (found.message_start_time, found.message_end_time),
        }
        actual = (
            "ros2",
            self._schemas,
            self._channels,
            self._chunks,
            len(self._chunks),
            len(self._schemas),
            len(self._channels),
            self.counts.total(),
            dict(self.counts),
            (self._start, self._end) if self.counts else (0, 0),
        )
        for text in _compared(stated, dict(zip(stated, actual, strict=True))):
            self._error(f"in the summary, {text}")

    def _error(self, text: str, topic: str = "", rule: str = "") -> None:
        self._errors.add(f"{self.path.name}: {topic}" if topic else self.path.name, text, rule)


def _in_order(entries: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the entries of a message index by log time and place: each writer has its order."""
    return entries[np.lexsort(entries.T[::-1])]
