# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Reading bags: a folder with its metadata.yaml, or a single MCAP file."""

import math
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr
from dataclasses import replace
from heapq import heappop, heappush
from io import StringIO
from itertools import chain, islice, pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from mcap.records import Schema

from tsobs_ros.bag.container import (
    RECOVER_HINT,
    RecordError,
    Span,
    Summary,
    read_span,
    read_summary,
    split_messages,
)
from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.bag.metadata import BagMetadata, OfferedQos, TopicInfo, read_metadata
from tsobs_ros.errors import BagReadError, missing_library
from tsobs_ros.files import open_regular
from tsobs_ros.yaml_files import MAX_BYTES

UNCHECKED = "messages have no checksum: damage in them is not noticed"
"""What follows if any message read is unchecked."""


class BagMessage(NamedTuple):
    """One message as recorded: `data` in CDR, times in ns since the epoch."""

    topic: str
    type: str
    data: bytes
    log_time: int
    publish_time: int


# Faster than the attribute, at millions of messages.
_LOG_TIME = itemgetter(3)

MAX_MESSAGES = 2**20
"""The largest number of messages of a chunk: as objects they take 300 MB."""

TOO_MANY_MESSAGES = f"a chunk has more than {MAX_MESSAGES} messages, too many to read"

MAX_HELD = 2**29
"""The largest size of messages that wait for later chunks, or are the last of a topic, bytes."""

OVERLAPPING = "too many chunks overlap in time to be read in order of log time"

OBJECT_SIZE = 400
"""What a message takes beside its data, bytes."""

_MAX_LATCHED = 1_000

_Load: TypeAlias = Callable[[Span], list[BagMessage]]
"""Returns the wanted messages of a span, in order of log time."""


class DecodedMessage(NamedTuple):
    """One message with its fields as attributes of `message`; times in ns since the epoch."""

    topic: str
    type: str
    message: Any
    log_time: int
    publish_time: int


class BagReader:
    """Reads a finished bag; files are open only while messages are being read.

    Args:
        path: A bag folder, or one MCAP file.

    Attributes:
        path: The same, as a path.
        files: The MCAP files, in order of recording.
        summaries: The summary of each file.
        topics: The topics by name, in order of registration.
        metadata: The content of metadata.yaml; None for a single file.
        start_time: The smallest log time, ns since the epoch; None without messages.
        end_time: The largest log time, ns since the epoch; None without messages.
        unchecked: The number of messages read so far that no checksum covers.

    Raises:
        BagReadError: There is no bag, it is not of ROS 2, was not finished, or has messages in
            another encoding than CDR.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.metadata: BagMetadata | None = None
        if self.path.is_dir():
            self.metadata = self._read_metadata()
            if self.metadata.storage_identifier != "mcap":
                raise BagReadError(
                    f"{self.path}: storage '{self.metadata.storage_identifier}' is not supported, "
                    "only mcap is"
                )
            self.files = tuple(self.path / Path(f.path).name for f in self.metadata.files)
        else:
            self.files = (self.path,)
        self.topics: dict[str, TopicInfo] = {}
        self.start_time: int | None = None
        self.end_time: int | None = None
        self.unchecked = 0
        self.summaries = tuple(read_summary(file, rank) for rank, file in enumerate(self.files))
        for summary in self.summaries:
            self._add_topics(summary)

    def _read_metadata(self) -> BagMetadata:
        try:
            return read_metadata(self.path)
        except BagReadError as error:
            denied = isinstance(error.__cause__, PermissionError)
            if not denied and any(self.path.glob("*.mcap")):
                raise BagReadError(f"{error}; {RECOVER_HINT}") from error
            raise

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

        In memory are the chunks that overlap in time, usually one.

        Args:
            topics: Only those of these topics; of all by default.
            start_ns: Only those at or after this log time, ns since the epoch.
            end_ns: Only those before this log time, ns since the epoch.

        Raises:
            BagReadError: The bag has no such topic, or a file is damaged; the latter is raised
                where the damage is reached.
        """
        selected = self._select(topics)
        spans = [
            span
            for span in self._spans_with(selected)
            if (start_ns is None or span.end >= start_ns)
            and (end_ns is None or span.start < end_ns)
        ]
        return _in_log_order(spans, self._loader(selected, start_ns, end_ns))

    def records(self, topics: Collection[str]) -> Iterator[tuple[Span, float, bytes, bool]]:
        """Yield the parts of the files that may have messages of some topics, by their begin.

        Yields:
            The part, the smallest log time of what follows it [ns], the records in it, and whether
            a checksum covers them.

        Raises:
            BagReadError: As for `messages`, but that nobody has looked into the records.
        """
        spans = sorted(
            self._spans_with(self._select(topics)),
            key=lambda span: (span.start, span.rank, span.offset),
        )
        for span, following in pairwise(chain[Span | None](spans, (None,))):
            assert span is not None
            with self._damage(span), open_regular(self.files[span.rank]) as stream:
                records, is_checked = read_span(stream, span)
            horizon = math.inf if following is None else following.start
            yield span, horizon, records, is_checked

    @contextmanager
    def _damage(self, span: Span) -> Iterator[None]:
        try:
            yield
        except (OSError, RecordError) as error:
            path = self.files[span.rank]
            raise BagReadError(f"{path}: the file is damaged: {error}; {RECOVER_HINT}") from error

    def last_before(
        self, time_ns: int, topics: Collection[str] | None = None, depth: int = 1
    ) -> list[BagMessage]:
        """Return the last messages before a time, such as those of latched topics.

        Args:
            time_ns: They are before this log time, ns since the epoch.
            topics: Of these topics; of all by default.
            depth: How many of each topic at most; a thousand if it is more.

        Returns:
            The messages in order of log time.

        Raises:
            BagReadError: The bag has no such topic, or a file is damaged.
        """
        selected = self._select(topics)
        spans = [span for span in self._spans_with(selected) if span.start < time_ns]
        load = self._loader(selected, None, time_ns)
        return _last_of_each(
            spans, load, lambda span: self._topics_of(span) & selected, min(depth, _MAX_LATCHED)
        )

    def decoded(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[DecodedMessage]:
        """Yield the messages in order of log time, decoded by the definitions in the bag.

        Args:
            topics: Only those of these topics; of all by default.
            start_ns: Only those at or after this log time, ns since the epoch.
            end_ns: Only those before this log time, ns since the epoch.

        Raises:
            BagReadError: As for `messages`; or a definition is missing or not in the `ros2msg`
                language, or `mcap-ros2-support` is not installed, or a message does not fit its
                type.
        """
        messages = self.messages(topics, start_ns, end_ns)
        decoders = {
            name: self._decoder(name) for name in (self.topics if topics is None else topics)
        }
        return self._decode(messages, decoders)

    def _select(self, topics: Collection[str] | None) -> frozenset[str]:
        selected = frozenset(self.topics if topics is None else topics)
        if unknown := sorted(selected - set(self.topics)):
            has = ", ".join(self.topics) or "none"
            raise BagReadError(f"{self.path}: no topic {', '.join(unknown)}; topics: {has}")
        return selected

    def _spans_with(self, selected: frozenset[str]) -> Iterator[Span]:
        for summary in self.summaries:
            for span in summary.spans:
                if self._topics_of(span) & selected:
                    yield span

    def _topics_of(self, span: Span) -> set[str]:
        channels = self.summaries[span.rank].channels
        ids = channels.keys() if span.channels is None else span.channels & channels.keys()
        return {channels[id_].topic for id_ in ids}

    def _loader(self, selected: frozenset[str], start_ns: int | None, end_ns: int | None) -> _Load:
        # Topic and type by channel; None for channels to leave out.
        known = [
            {
                id_: (channel.topic, self.topics[channel.topic].type)
                if channel.topic in selected
                else None
                for id_, channel in summary.channels.items()
            }
            for summary in self.summaries
        ]

        def load(span: Span) -> list[BagMessage]:
            with self._damage(span):
                with open_regular(self.files[span.rank]) as stream:
                    records, is_checked = read_span(stream, span)
                messages = _messages(records, known[span.rank])
                messages.sort(key=_LOG_TIME)
                if messages:
                    span.check(messages[0].log_time, messages[-1].log_time)
            first = 0 if start_ns is None else bisect_left(messages, start_ns, key=_LOG_TIME)
            last = None if end_ns is None else bisect_left(messages, end_ns, key=_LOG_TIME)
            messages = messages[first:last]
            self.unchecked += 0 if is_checked else len(messages)
            return messages

        return load

    def _decode(
        self, messages: Iterator[BagMessage], decoders: dict[str, Callable[[bytes], Any]]
    ) -> Iterator[DecodedMessage]:
        for topic, type_, data, log_time, publish_time in messages:
            try:
                message = decoders[topic](data)
            except Exception as error:  # the decoder's errors on wrong bytes are of any kind
                raise BagReadError(
                    f"{self.path}: the message of {topic} at {log_time} ns is not a {type_}: "
                    f"{error}"
                ) from error
            yield DecodedMessage(topic, type_, message, log_time, publish_time)

    def _decoder(self, name: str) -> Callable[[bytes], Any]:
        # Imported here: copying or playing a bag needs no decoder.
        try:
            from mcap_ros2.decoder import DecoderFactory
        except ModuleNotFoundError as error:
            advice = missing_library(error.name) or error
            raise BagReadError(f"{self.path}: cannot decode messages: {advice}") from error
        definition = self.topics[name].definition
        assert definition is not None
        if len(definition.text) > MAX_BYTES:
            raise BagReadError(f"{self.path}: the definition of {definition.type} is too large")
        schema = Schema(
            id=1,
            name=definition.type,
            encoding=definition.encoding,
            data=definition.text.encode(),
        )
        try:
            # The parser also prints what it raises, and with it the hostile text of a bag.
            with redirect_stderr(StringIO()):
                decoder = DecoderFactory().decoder_for("cdr", schema)
        except Exception as error:  # a parser's errors on a wrong definition are of any kind
            raise BagReadError(
                f"{self.path}: the definition of {definition.type} is malformed: {error}"
            ) from error
        if decoder is None:
            raise BagReadError(
                f"{self.path}: {definition.type} is defined in '{definition.encoding}', "
                "but only ros2msg can be decoded"
            )
        return decoder

    def _add_topics(self, summary: Summary) -> None:
        file, statistics = summary.path, summary.statistics
        if summary.profile != "ros2":
            raise BagReadError(
                f"{file}: not a bag of ROS 2: its profile is '{summary.profile}', expected 'ros2'"
            )
        if statistics.channel_count > (described := len(summary.channels)):
            raise BagReadError(
                f"{file}: the file is damaged: {statistics.channel_count} channels, but "
                f"{described} in the index; {RECOVER_HINT}"
            )
        offered, texts = OfferedQos(), dict[int, str]()
        for id_, each in summary.schemas.items():
            texts[id_] = each.data.decode(errors="replace")
        for channel in summary.channels.values():
            if channel.message_encoding != "cdr":
                raise BagReadError(
                    f"{file}: {channel.topic} is encoded in '{channel.message_encoding}', "
                    "not in cdr"
                )
            if (schema := summary.schemas.get(channel.schema_id)) is None:
                raise BagReadError(f"{file}: {channel.topic} has no type")
            try:
                offers = offered[channel]
            except ValueError as error:
                raise BagReadError(f"{file}: {channel.topic}: {error}") from error
            hash_ = channel.metadata.get("topic_type_hash", "")
            definition = MessageDefinition(schema.name, texts[schema.id], hash_, schema.encoding)
            topic = TopicInfo(channel.topic, schema.name, 0, offers, hash_, definition)
            known = self.topics.setdefault(topic.name, topic)
            if known.type != topic.type:
                raise BagReadError(
                    f"{file}: {topic.name} is {topic.type} here, but {known.type} before"
                )
            count = statistics.channel_message_counts.get(channel.id, 0)
            self.topics[topic.name] = replace(known, count=known.count + count)
        if statistics.message_count:
            start, end = statistics.message_start_time, statistics.message_end_time
            self.start_time = start if self.start_time is None else min(start, self.start_time)
            self.end_time = end if self.end_time is None else max(end, self.end_time)


def _messages(records: bytes, channels: Mapping[int, tuple[str, str] | None]) -> list[BagMessage]:
    # Twice as fast as the class itself.
    new = tuple.__new__
    found = split_messages(records)
    try:
        messages = [
            new(BagMessage, (*known, data, log_time, publish_time))
            for channel, log_time, publish_time, _, data in islice(found, MAX_MESSAGES)
            if (known := channels[channel])
        ]
    except KeyError as error:
        raise RecordError(f"a message is of channel {error}, which is not described") from error
    if next(found, None):
        raise RecordError(TOO_MANY_MESSAGES)
    return messages


def _in_log_order(spans: Iterable[Span], load: _Load) -> Iterator[BagMessage]:
    """Yield the messages of spans in order of log time; equal ones in order of recording.

    Each span is loaded when its first message may be due.
    """
    ordered = sorted(spans, key=lambda span: (span.start, span.rank, span.offset))
    # Spans with messages that are due after the start of the next one, in a heap by the first of
    # them: its time, what orders the spans, its place, all messages, and what they take.
    waiting: list[tuple[int, int, int, int, list[BagMessage], int]] = []
    held = 0
    for span, following in pairwise(chain[Span | None](ordered, (None,))):
        assert span is not None
        horizon = math.inf if following is None else following.start
        messages = load(span)
        end = bisect_left(messages, horizon, key=_LOG_TIME)
        due = [(span.rank, span.offset, messages[:end])]
        while waiting and waiting[0][0] < horizon:
            _, rank, offset, first, others, size = heappop(waiting)
            last = bisect_left(others, horizon, first, key=_LOG_TIME)
            due.append((rank, offset, others[first:last]))
            if last < len(others):
                entry = others[last].log_time, rank, offset, last, others, size
                heappush(waiting, entry)
            else:
                held -= size
        if len(due) > 1:
            # Sorting is merging, as each is in order.
            due.sort(key=itemgetter(0, 1))
            yield from sorted(chain.from_iterable(each for *_, each in due), key=_LOG_TIME)
        else:
            yield from messages[:end]
        if end < len(messages):
            size = sum(map(_size, messages))
            held += size
            first_time = messages[end].log_time
            heappush(waiting, (first_time, span.rank, span.offset, end, messages, size))
        if held > MAX_HELD:
            raise BagReadError(OVERLAPPING)


def _size(message: BagMessage) -> int:
    return OBJECT_SIZE + len(message.data)


def _last_of_each(
    spans: Iterable[Span], load: _Load, topics_of: Callable[[Span], Collection[str]], depth: int
) -> list[BagMessage]:
    """Return the last messages of each topic, in order of log time.

    Args:
        spans: Each is loaded only if it can matter.
        load: Returns the messages of a span.
        topics_of: Returns the topics that a span may have messages of.
        depth: The largest number of messages of a topic.
    """
    last: dict[str, list[BagMessage]] = {}

    def matters(span: Span, topic: str) -> bool:
        known = last.get(topic, [])
        return len(known) < depth or known[0].log_time < span.end

    for span in sorted(spans, key=lambda span: (span.end, span.rank, span.offset), reverse=True):
        if any(matters(span, topic) for topic in topics_of(span)):
            earlier: dict[str, list[BagMessage]] = {}
            for message in load(span):
                earlier.setdefault(message.topic, []).append(message)
            for topic, messages in earlier.items():
                both = sorted(messages[-depth:] + last.get(topic, []), key=_LOG_TIME)
                last[topic] = both[-depth:]
            if sum(map(_size, chain.from_iterable(last.values()))) > MAX_HELD:
                raise BagReadError("the last messages of the topics are too large to be held")
    return sorted(chain.from_iterable(last.values()), key=_LOG_TIME)
