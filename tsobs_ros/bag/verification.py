# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Verification of a bag: checks of everything that decides the result of reading it.

Can every tool open it? Does each summary agree with the content of its file? Do the checksums hold?
Does metadata.yaml agree with the files? An error is a problem that makes a reader fail or lose
data. Messages are not decoded.
"""

import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import msgspec
from mcap.records import Chunk, DataEnd

from tsobs_ros.bag.container import (
    INDEX_HEAD,
    RECOVER_HINT,
    Rows,
    Span,
    Summary,
    message_indexes,
    read_summary,
)
from tsobs_ros.bag.damaged import DamagedFile, Part, Progress
from tsobs_ros.bag.metadata import FILE_NAME, BagFiles, BagMetadata, FileMetadata, TopicInfo
from tsobs_ros.errors import printable
from tsobs_ros.files import open_regular

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
        errors: Problems that make readers fail or lose data, each with the file, and the topic.
        unchecked: The number of messages that no checksum covers: damage in them is not noticed.
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
        """Return the result as plain data."""
        return {"bag": str(self.path), "holds": self.holds} | {
            name: getattr(self, name) for name in ("files", "messages", "unchecked", "errors")
        }

    def text(self) -> str:
        """Return the result as text for people."""
        lines = [f"error: {finding}" for finding in self.errors]
        verdict = f"OK, but {self.unchecked} UNCHECKED" if self.unchecked else "OK"
        verdict = verdict if self.holds else f"NOT sound, errors: {len(self.errors)}"
        lines.append(f"{self.path}: {verdict}; files: {self.files}, messages: {self.messages}")
        return "\n".join(map(printable, lines))


def verify(
    bag: str | Path, progress: Progress = lambda _: None, *, is_trusted: bool = False
) -> Verification:
    """Check a bag: its folder, the structure of its files, and each message.

    `progress` is called with the number of bytes checked since its last call. If `is_trusted`,
    chunks of any decompressed size are read.

    Raises:
        BagReadError: There is no such folder or file.
    """
    path = Path(bag)
    there, errors, topics = BagFiles(path), _Findings(), dict[str, TopicInfo]()
    if there.problem:
        errors.add(FILE_NAME, there.problem.removeprefix(f"{path / FILE_NAME}: "))
    elif there.metadata:
        _check_names(there, there.metadata, errors)
    present = [each for each in there.listed if os.path.lexists(each)]
    others = [each for each in there.others if each.suffix == ".mcap"]
    files = [_Check(file, topics, errors) for file in present or others]
    for file in files:
        file.run(progress, is_trusted)
    if there.metadata:
        for text in _differences(there.metadata, files):
            errors.add(FILE_NAME, text)
    messages = sum(file.counts.total() for file in files)
    unchecked = sum(file.unchecked for file in files)
    return Verification(path, len(files), messages, tuple(errors), unchecked)


class _Findings(dict[str, None]):
    """Findings, each once."""

    def add(self, place: str, text: str) -> None:
        if len(self) < _MAX_FINDINGS:
            self.setdefault(f"{place}: {text}"[:_MAX_TEXT])


def _check_names(there: BagFiles, metadata: BagMetadata, errors: _Findings) -> None:
    for file in metadata.files:
        path = there.path / Path(file.path).name
        if file.path != path.name:
            text = f"the file '{file.path}' is not given by its name in the bag's own folder"
            errors.add(FILE_NAME, text)
        if not os.path.lexists(path):
            errors.add(FILE_NAME, f"the file '{path.name}' is not there")
    for path in there.others:
        if _NUMBERED.fullmatch(path.name):
            text = f"{FILE_NAME} does not list it: a reindexing would stumble over it"
            errors.add(path.name, text)


def _differences(metadata: BagMetadata, files: list["_Check"]) -> Iterator[str]:
    """Yield the differences of metadata.yaml from the metadata that the files imply."""
    stated = _by_name(metadata)
    whole = [file for file in files if file.is_complete]
    counts = sum((file.kept for file in whole), Counter[str]())
    hashes = {name: one["type_description_hash"] for name, one in stated["topics"].items()}
    topics = {topic.name: topic for file in whole for topic in file.described.topics.values()}
    each = [
        replace(one, count=counts[name], type_hash=one.type_hash or hashes.get(name, ""))
        for name, one in topics.items()
    ]
    own = [FileMetadata.of(one.name, *(one.span or (0, 0)), one.kept.total()) for one in whole]
    actual = _by_name(BagMetadata.of(each, own))
    if len(whole) < len(metadata.files):  # compare only the files that could be checked
        for topic in actual["topics"].values():
            del topic["message_count"]
        actual = {"topics": actual["topics"], "files": actual["files"]}
    else:
        silent = {name: one | {"message_count": 0} for name, one in stated["topics"].items()}
        actual["topics"] = silent | actual["topics"]
    yield from _compared(stated, actual)


def _by_name(metadata: BagMetadata) -> dict[str, Any]:
    information = msgspec.to_builtins(metadata)
    totals = ["starting_time", "duration", "message_count", "storage_identifier"]
    totals += ["relative_file_paths"]
    topics = {}
    for each in information["topics_with_message_count"]:
        topic = each["topic_metadata"]
        topics[topic["name"]] = topic | {"message_count": each["message_count"]}
    files = {Path(each["path"]).name: each | {"path": ""} for each in information["files"]}
    return {key: information.get(key) for key in totals} | {"topics": topics, "files": files}


def _compared(stated: Any, actual: Any, *path: object) -> Iterator[str]:
    """Yield the differences of `stated` from `actual`, for all keys of `actual`."""
    if isinstance(stated, dict) and isinstance(actual, dict):
        for key in actual:
            yield from _compared(stated.get(key), actual[key], *path, key)
    elif stated != actual:
        yield f"{': '.join(map(str, path))} is stated as {stated}, but is {actual}"


class _Check(DamagedFile):
    """The check of one file: its content, and its summary against this content."""

    def __init__(self, path: Path, of_bag: dict[str, TopicInfo], errors: _Findings) -> None:
        super().__init__(path, of_bag)
        self.is_complete = False
        self._errors = errors
        # Size and log times of each chunk, by its offset, which the summary should state.
        self._chunks: dict[int, tuple[int, int, int]] = {}

    def run(self, progress: Progress, is_trusted: bool) -> None:
        """Read the file once, from its start to its end."""
        try:
            summary = read_summary(self.path)
            parts = self.parts(progress, is_trusted=is_trusted, described_by_summary=False)
            spans = {span.offset: span for span in summary.spans}
            with open_regular(self.path) as stream:
                for part, _ in parts:
                    if isinstance(part.record, DataEnd):
                        break
                    if part.content is not None and isinstance(part.record, Chunk):
                        self._check_chunk(stream, part, part.content.rows, spans.get(part.at))
        except OSError as error:
            self._error(str(error).removeprefix(f"{self.path}: "))
            return
        # Only the summary describes topics without messages.
        self.described.add_all(summary.schemas, summary.channels)
        for schema in self.described.schemas.values():
            if not _TYPE_NAME.fullmatch(schema.name):
                self._error(f"the schema '{schema.name}' is not named as package/msg/Type")
            if schema.encoding not in ("ros2msg", "ros2idl"):
                self._error(f"{schema.name} is defined in '{schema.encoding}', not in ros2msg")
        names = Counter(channel.topic for channel in self.described.channels.values())
        for name, count in names.items():
            if count > 1:
                self._error(f"{name}: has more than one channel")
        for text in (*self.described.problems.values(), *self.dropped):
            self._error(text)
        for each in self.damage:
            self._error(f"at byte {each.offset}: {each.reason}; {RECOVER_HINT}")
        self.is_complete = not (self.damage or self.dropped)
        if self.is_complete:
            self._check_summary(summary)

    def _check_chunk(self, stream: IO[bytes], part: Part, rows: Rows, span: Span | None) -> None:
        times = rows["log_time"].view("u8")
        start, end = (int(times.min()), int(times.max())) if len(times) else (0, 0)
        self._chunks[part.at] = part.size, start, end
        offsets = span.index_offsets if span else {}
        for id_, _, index in message_indexes(rows):
            if (at := offsets.get(id_)) is None:
                self._error(f"the chunk at byte {part.at} has no message index of channel {id_}")
                continue
            stream.seek(min(at, self.bytes_read))
            found = stream.read(len(index))
            if found != index and _in_order(found) != _in_order(index):
                self._error(f"the index of channel {id_} at byte {at} is not that of its chunk")

    def _check_summary(self, summary: Summary) -> None:
        found, own = summary.statistics, self.described
        chunks = {span.offset: (span.size, span.start, span.end) for span in summary.spans}
        counts = {id_: count for id_, count in found.channel_message_counts.items() if count}
        for what, stated, actual in (
            ("profile", summary.profile, "ros2"),
            ("schemas", summary.schemas, own.schemas),
            ("channels", summary.channels, own.channels),
            ("chunks (size, log times)", chunks, self._chunks),
            ("number of chunks", len(chunks), len(self._chunks)),
            ("number of schemas", found.schema_count, len(own.schemas)),
            ("number of channels", found.channel_count, len(own.channels)),
            ("number of messages", found.message_count, self.counts.total()),
            ("messages by channel", counts, dict(self.counts)),
            ("log times", (found.message_start_time, found.message_end_time), self.span or (0, 0)),
        ):
            for text in _compared(stated, actual, what):
                self._error(f"in the summary, {text}")

    def _error(self, text: str) -> None:
        self._errors.add(self.name, text)


def _in_order(index: bytes) -> list[bytes]:
    """Return the head of a message index and its sorted entries: each writer has its own order."""
    begins = range(INDEX_HEAD.size, len(index), 16)
    return [index[: INDEX_HEAD.size], *sorted(index[begin : begin + 16] for begin in begins)]
