# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A reader of bags: a folder with its metadata.yaml, or a single MCAP file.

Until its bytes are needed, a message is only its position in the records of a chunk, so that topics
of millions of messages can be read as arrays.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import replace
from heapq import heappop, heappush
from io import StringIO
from itertools import chain, pairwise
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from mcap.records import Chunk, Schema
from numpy.typing import NDArray

from tsobs_ros.bag.container import (
    CHUNK_HEAD_SIZE,
    MAX_SIZE,
    RECOVER_HINT,
    ROW,
    RecordError,
    Records,
    Rows,
    Span,
    Summary,
    chunk_head,
    pieces,
    read_chunk,
    read_summary,
)
from tsobs_ros.bag.metadata import BagFiles, Descriptions, TopicInfo
from tsobs_ros.errors import BagReadError, missing_library
from tsobs_ros.files import open_regular
from tsobs_ros.series import Stamps
from tsobs_ros.yaml_files import MAX_BYTES

Read = TypeVar("Read")

UNCHECKED = "messages have no checksum: damage in them is not noticed"
"""The remark if any of the messages read is unchecked."""

_MAX_HELD = 2**29
"""Largest total size of messages that wait for later chunks, or are the last of topics [bytes]."""

_OBJECT_SIZE = 400
"""Memory of a message beyond its data [bytes]."""

_MAX_LATCHED = 1_000
_LAST = 2**63 - 1


class BagMessage(NamedTuple):
    """One message as recorded: `data` in CDR, times in ns since the epoch."""

    topic: str
    type: str
    data: bytes
    log_time: int
    publish_time: int


class DecodedMessage(NamedTuple):
    """One message with its fields as attributes of `message`; times in ns since the epoch."""

    topic: str
    type: str
    message: Any
    log_time: int
    publish_time: int


class RawMessages(NamedTuple):
    """A topic's messages as bytes in the order of log times, n of them; times in ns, shape (n,).

    Each of `groups` has messages of one size: their places, shape (k,), and bytes, shape (k, size).
    """

    log_times: Stamps
    publish_times: Stamps
    groups: list[tuple[NDArray[np.intp], NDArray[np.uint8]]]


class BagReader:
    """Reads a finished bag; files are open only while messages are being read.

    Args:
        path: A bag folder, or one MCAP file.

    Attributes:
        path: The path of the bag.
        files: The MCAP files, in order of recording.
        summaries: The summary of each file.
        topics: The topics by name, in order of registration.
        metadata: The content of metadata.yaml; None for a single file.
        start_time: The smallest log time, ns since the epoch; None without messages.
        end_time: The largest log time, ns since the epoch; None without messages.
        unchecked: The number of messages read so far that no checksum covers.

    Raises:
        BagReadError: There is no bag; or it is not of ROS 2, was not finished, or has messages in
            an encoding other than CDR.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        there = BagFiles(self.path)
        self.metadata, self.files = there.metadata, tuple(there.listed)
        if there.problem:
            is_bag = any(path.suffix == ".mcap" for path in there.others)
            raise BagReadError(f"{there.problem}; {RECOVER_HINT}" if is_bag else there.problem)
        if self.metadata and (storage := self.metadata.storage_identifier) != "mcap":
            raise self._error(f"storage '{storage}' is not supported, only mcap is")
        self.topics: dict[str, TopicInfo] = {}
        self.unchecked = 0
        self.summaries = tuple(read_summary(file, rank) for rank, file in enumerate(self.files))
        for file, summary in zip(self.files, self.summaries, strict=True):
            try:
                self._add_topics(summary)
            except ValueError as error:
                raise BagReadError(f"{file}: {error}") from error
        filled = [s.statistics for s in self.summaries if s.statistics.message_count]
        self.start_time = min((each.message_start_time for each in filled), default=None)
        self.end_time = max((each.message_end_time for each in filled), default=None)

    def _error(self, text: str) -> BagReadError:
        return BagReadError(f"{self.path}: {text}")

    @property
    def message_count(self) -> int:
        """The number of messages in the bag."""
        return sum(topic.count for topic in self.topics.values())

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[BagMessage]:
        """Yield the messages in order of log time; equal ones in order of recording.

        Only chunks that overlap in time are in memory together, usually one.

        Args:
            topics: Only messages of these topics; of all topics by default.
            start_ns: Only messages at or after this log time, ns since the epoch.
            end_ns: Only messages before this log time, ns since the epoch.
        """
        names = list(self.topics if topics is None else topics)
        self.require(names)
        parts = self.rows(names, start_ns, end_ns)
        return chain.from_iterable(self._messages(names, *part) for part in parts)

    def rows(
        self, topics: Sequence[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[tuple[Rows, dict[int, bytes]]]:
        """Yield the messages of some topics as rows, in the order of `messages`.

        The channel of a row is the place of its topic in `topics`. With the rows come the records
        that contain them, by their keys. A chunk is read when the first of its messages may be
        due.
        """
        self.require(topics)
        start, end = start_ns or 0, _LAST if end_ns is None else end_ns
        names = set(topics)
        spans = [s for s in self.spans if s.end >= start and s.start < end]
        spans = [span for span in spans if not names.isdisjoint(self.topics_of(span))]
        spans.sort(key=attrgetter("start", "rank", "offset"))
        numbers = self._numbers(topics)
        # A heap of the messages due after the start of the next span, by the first of each span.
        waiting: list[tuple[int, int, Rows]] = []
        records: dict[int, bytes] = {}
        sizes: dict[int, int] = {}
        held = 0
        for key, span in enumerate(spans):
            rows, data = self._load(span, numbers, start, end)
            if len(rows):
                rows["chunk"] = key
                records[key], sizes[key] = data, len(data) + _OBJECT_SIZE * len(rows)
                held += sizes[key]
                heappush(waiting, (int(rows["log_time"][0]), key, rows))
            horizon = min(spans[key + 1].start, _LAST) if key + 1 < len(spans) else _LAST
            due: list[tuple[int, int, Rows]] = []
            spent = []
            while waiting and waiting[0][0] < horizon:
                _, one, rows = heappop(waiting)
                count = int(np.searchsorted(rows["log_time"], horizon))
                due.append((spans[one].rank, spans[one].offset, rows[:count]))
                if count < len(rows):
                    heappush(waiting, (int(rows["log_time"][count]), one, rows[count:]))
                else:
                    spent.append(one)
            if due:
                due.sort(key=itemgetter(0, 1))  # equal times in order of recording
                found = np.concatenate([rows for *_, rows in due])
                yield found[np.argsort(found["log_time"], kind="stable")], records
            for one in spent:
                del records[one]
                held -= sizes.pop(one)
            del data
            if held > _MAX_HELD:
                raise self._error("too many chunks overlap in time to be read in order of log time")

    def _load(
        self, span: Span, numbers: Sequence[NDArray[np.int64]], start: int, end: int
    ) -> tuple[Rows, bytes]:
        """Return the wanted messages of a span, in order of log time, and its records."""
        (data, rows), chunk = self.read(span)
        rows["channel"] = numbers[span.rank].take(rows["channel"], mode="clip")
        times = rows["log_time"]
        rows = rows[(rows["channel"] >= 0) & (times >= start) & (times < end)]
        self.unchecked += 0 if chunk.uncompressed_crc else len(rows)
        return rows[np.argsort(rows["log_time"], kind="stable")], data

    def _numbers(self, topics: Sequence[str]) -> list[NDArray[np.int64]]:
        """Return, by file, each channel's place in `topics`, else -1; one more -1 is at the end."""
        place, found = {name: number for number, name in enumerate(topics)}, []
        for channels in (summary.channels for summary in self.summaries):
            found.append(np.full(max(channels, default=0) + 2, -1))
            for id_, channel in channels.items():
                found[-1][id_] = place.get(channel.topic, -1)
        return found

    def _messages(
        self, topics: Sequence[str], rows: Rows, records: Mapping[int, bytes]
    ) -> Iterator[BagMessage]:
        named = [(name, self.topics[name].type) for name in topics]
        new = tuple.__new__  # twice as fast as the class itself
        for topic, log_time, publish_time, begin, size, key in rows.tolist():
            data = records[key][begin : begin + size]
            yield new(BagMessage, (*named[topic], data, log_time, publish_time))

    def read(self, span: Span) -> tuple[Records, Chunk]:
        """Return the records of a chunk, and the chunk."""
        path, known = self.files[span.rank], self.summaries[span.rank].channels
        try:
            if span.size > MAX_SIZE:
                raise RecordError(f"{span.size} bytes, too many to read")
            with open_regular(path) as stream:
                stream.seek(span.offset)
                record = stream.read(span.size)
            chunk, data_at, size = chunk_head(record[:CHUNK_HEAD_SIZE])
            if size != span.size:
                raise RecordError("the index states another size")
            chunk.data = record[data_at:]
            found = read_chunk(chunk)
            for id_ in np.unique(found.rows["channel"]).tolist():
                if id_ not in known:
                    raise RecordError(f"a message is of channel {id_}, which is not described")
            times = found.rows["log_time"]
            if len(times) and not span.start <= times.min() <= times.max() <= span.end:
                raise RecordError("the index states other times")
        except (OSError, RecordError) as error:
            text = f"the file is damaged: at byte {span.offset}: {error}; {RECOVER_HINT}"
            raise BagReadError(f"{path}: {text}") from error
        return found, chunk

    def last_before(
        self, time_ns: int, topics: Collection[str] | None = None, depth: int = 1
    ) -> list[BagMessage]:
        """Return the last messages before a time, such as those of latched topics.

        Args:
            time_ns: Only messages before this log time, ns since the epoch.
            topics: Only messages of these topics; of all topics by default.
            depth: Largest number of messages per topic; a thousand if it is more.

        Returns:
            The messages in order of log time.

        Raises:
            BagReadError: The bag has no such topic, or a file is damaged.
        """
        names, depth = list(self.topics if topics is None else topics), min(depth, _MAX_LATCHED)
        self.require(names)
        found: list[BagMessage] = []
        for name in names:
            last = list[BagMessage]()
            spans = [s for s in self.spans if s.start < time_ns and name in self.topics_of(s)]
            for span in sorted(spans, key=attrgetter("end", "rank", "offset"), reverse=True):
                if len(last) == depth and last[0].log_time >= span.end:
                    break
                rows, data = self._load(span, self._numbers([name]), 0, time_ns)
                both = [*self._messages([name], rows[-depth:], {0: data}), *last]
                last = sorted(both, key=itemgetter(3))[-depth:]
            found += last
            if sum(_OBJECT_SIZE + len(message.data) for message in found) > _MAX_HELD:
                raise self._error("the last messages of the topics are too large to be held")
        return sorted(found, key=itemgetter(3))

    def decoded(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[DecodedMessage]:
        """Return the messages as `messages` does, decoded by the definitions in the bag."""
        names = self.topics if topics is None else topics
        # Made before the first message, so that a caller can distinguish their errors from damage.
        decoders = {name: self.decoder(name) for name in names}
        messages = self.messages(topics, start_ns, end_ns)
        return (self._decoded(message, decoders[message.topic]) for message in messages)

    def _decoded(self, message: BagMessage, decode: Callable[[bytes], Any]) -> DecodedMessage:
        topic, type_, data, log_time, publish_time = message
        try:
            return DecodedMessage(topic, type_, decode(data), log_time, publish_time)
        except Exception as error:  # a decoder may raise any error on wrong bytes
            text = f"the message of {topic} at {log_time} ns is not a {type_}: {error}"
            raise self._error(text) from error

    def decoder(self, name: str) -> Callable[[bytes], Any]:
        """Return a function that decodes the messages of a topic; it may raise any error."""
        # Imported here: copying or playing a bag needs no decoder.
        try:
            from mcap_ros2.decoder import DecoderFactory
        except ModuleNotFoundError as error:
            advice = missing_library(error.name) or error
            raise self._error(f"cannot decode messages: {advice}") from error
        definition = self.topics[name].definition
        assert definition is not None
        type_, text, _, encoding = definition
        if len(text) > MAX_BYTES:
            raise self._error(f"the definition of {type_} is too large")
        try:
            # The parser also prints its errors, and with them text of a bag that may be hostile.
            with redirect_stderr(StringIO()):
                schema = Schema(id=1, name=type_, encoding=encoding, data=text.encode())
                decoder = DecoderFactory().decoder_for("cdr", schema)
        except Exception as error:  # a parser may raise any error on a wrong definition
            raise self._error(f"the definition of {type_} is malformed: {error}") from error
        if decoder is None:
            text = f"{type_} is defined in '{encoding}', but only ros2msg can be decoded"
            raise self._error(text)
        return decoder

    def blocks(
        self,
        topics: Collection[str],
        size: int | None = None,
        *,
        on_damage: Callable[[BagReadError], None] | None = None,
    ) -> Iterator[dict[str, RawMessages]]:
        """Yield the messages of some topics in blocks of at least `size`, or in one block.

        If the bag is damaged, `on_damage` is called; all messages before the damage are yielded.
        """
        names, found, records = list(topics), [np.zeros(0, ROW)], dict[int, bytes]()

        def block() -> dict[str, RawMessages]:
            rows = np.concatenate(found)
            each = enumerate(names)
            return {name: _raw(rows[rows["channel"] == place], records) for place, name in each}

        for rows, new in until_damage(self.rows(names), on_damage):
            found.append(rows)
            records |= new
            if size is not None and sum(map(len, found)) >= size:
                yield block()
                found, records = [rows[:0]], {}
        yield block()

    def require(self, topics: Collection[str], type_: str = "") -> None:
        """Raise `BagReadError` unless the bag has all topics, of type `type_` if that is given."""
        if unknown := sorted(set(topics) - set(self.topics)):
            has = ", ".join(self.topics) or "none"
            raise self._error(f"no topic {', '.join(unknown)}; topics: {has}")
        for name in topics if type_ else ():
            if (found := self.topics[name].type) != type_:
                raise self._error(f"{name} is {found}, expected {type_}")

    @property
    def spans(self) -> list[Span]:
        """The chunks in the order of the index."""
        return [span for summary in self.summaries for span in summary.spans]

    def topics_of(self, span: Span) -> set[str]:
        """Return the topics that a chunk may have messages of."""
        channels = self.summaries[span.rank].channels
        ids = channels.keys() & span.index_offsets.keys() if span.places else channels.keys()
        return {channels[id_].topic for id_ in ids}

    def _add_topics(self, summary: Summary) -> None:
        """Add the topics of a file; raise a ValueError if they cannot be those of a bag."""
        statistics = summary.statistics
        if summary.profile != "ros2":
            profile = f"its profile is '{summary.profile}', expected 'ros2'"
            raise ValueError(f"not a bag of ROS 2: {profile}")
        if statistics.message_count and not summary.spans:
            raise ValueError(f"its messages are in no chunks, and have no index; {RECOVER_HINT}")
        if statistics.channel_count > (count := len(summary.channels)):
            counts = f"{statistics.channel_count} channels, but {count} in the index"
            raise ValueError(f"the file is damaged: {counts}; {RECOVER_HINT}")
        described = Descriptions(self.topics)
        described.add_all(summary.schemas, summary.channels)
        for id_ in summary.channels:
            if id_ not in described.topics:
                raise ValueError(described.problems.get(id_, "its topics are too large to read"))
            topic = self.topics[described.topics[id_].name]
            count = statistics.channel_message_counts.get(id_, 0)
            self.topics[topic.name] = replace(topic, count=topic.count + count)


def until_damage(
    messages: Iterable[Read], on_damage: Callable[[BagReadError], None] | None
) -> Iterator[Read]:
    """Yield messages up to any damage to the bag; then call `on_damage` with the error."""
    try:
        yield from messages
    except BagReadError as error:
        if on_damage is None:
            raise
        on_damage(error)


def _raw(rows: Rows, records: Mapping[int, bytes]) -> RawMessages:
    groups = []
    for size in np.unique(rows["size"]).tolist():
        places = np.flatnonzero(rows["size"] == size)
        groups.append((places, _gather(rows[places], records, size)))
    return RawMessages(rows["log_time"].copy(), rows["publish_time"].copy(), groups)


def _gather(rows: Rows, records: Mapping[int, bytes], size: int) -> NDArray[np.uint8]:
    """Return the bytes of messages of one size, shape (n, size)."""
    gathered = np.empty((len(rows), size), np.uint8)
    edges = np.flatnonzero(np.diff(rows["chunk"], prepend=-1, append=-1))
    for begin, end in pairwise(edges.tolist() if size else ()):
        data = np.frombuffer(records[int(rows["chunk"][begin])], np.uint8)
        own = pieces(data, size)[rows["begin"][begin:end]]
        gathered[begin:end] = own.view(np.uint8).reshape(-1, size)
    return gathered
