# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Reading bags: a folder with its metadata.yaml, or a single MCAP file."""

from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator
from contextlib import redirect_stderr
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

from mcap.records import Schema

from tsobs_ros.bag.mcap.index import RECOVER_HINT, FileIndex, Span, read_index, read_span
from tsobs_ros.bag.mcap.messages import LOG_TIME, BagMessage, decode_messages
from tsobs_ros.bag.mcap.order import Load, in_log_order, last_of_each
from tsobs_ros.bag.mcap.records import RecordError
from tsobs_ros.bag.metadata import BagMetadata, read_metadata
from tsobs_ros.bag.topic_info import TopicInfo, describe_topic
from tsobs_ros.errors import BagReadError

__all__ = ["BagMessage", "BagReader", "DecodedMessage", "TopicInfo"]


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
        indexes: What the summary of each file tells.
        topics: The topics by name, in order of registration.
        metadata: What the folder says about itself; None for a single file.
        start_time: The smallest log time, ns since the epoch; None without messages.
        end_time: The largest log time, ns since the epoch; None without messages.

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
        self.indexes = tuple(read_index(file, rank) for rank, file in enumerate(self.files))
        for index in self.indexes:
            self._add_topics(index)

    def _read_metadata(self) -> BagMetadata:
        try:
            return read_metadata(self.path)
        except BagReadError as error:
            if any(self.path.glob("*.mcap")):
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
        return in_log_order(spans, self._loader(selected, start_ns, end_ns))

    def last_before(
        self, time_ns: int, topics: Collection[str] | None = None, depth: int = 1
    ) -> list[BagMessage]:
        """Return the last messages before a time: what a latched topic had to say by then.

        Args:
            time_ns: They are before this log time, ns since the epoch.
            topics: Of these topics; of all by default.
            depth: How many of each topic at most.

        Returns:
            The messages in order of log time.

        Raises:
            BagReadError: The bag has no such topic, or a file is damaged.
        """
        selected = self._select(topics)
        spans = [span for span in self._spans_with(selected) if span.start < time_ns]
        load = self._loader(selected, None, time_ns)
        return last_of_each(spans, load, lambda span: self._topics_of(span) & selected, depth)

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
        for index in self.indexes:
            for span in index.spans:
                if self._topics_of(span) & selected:
                    yield span

    def _topics_of(self, span: Span) -> set[str]:
        channels = self.indexes[span.rank].channels
        ids = channels.keys() if span.channels is None else span.channels & channels.keys()
        return {channels[id_].topic for id_ in ids}

    def _loader(self, selected: frozenset[str], start_ns: int | None, end_ns: int | None) -> Load:
        known = [
            {
                channel.id: (channel.topic, index.schemas[channel.schema_id].name)
                if channel.topic in selected
                else None
                for channel in index.channels.values()
            }
            for index in self.indexes
        ]

        def load(span: Span) -> list[BagMessage]:
            path = self.files[span.rank]
            try:
                with path.open("rb") as stream:
                    records = read_span(stream, span.frame)
                messages = decode_messages(records, known[span.rank])
                messages.sort(key=LOG_TIME)
                if messages and not (
                    span.start <= messages[0].log_time and messages[-1].log_time <= span.end
                ):
                    raise RecordError(f"the index states other times at byte {span.frame.start}")
            except (OSError, RecordError) as error:
                raise BagReadError(
                    f"{path}: the file is damaged: {error}; {RECOVER_HINT}"
                ) from error
            first = 0 if start_ns is None else bisect_left(messages, start_ns, key=LOG_TIME)
            last = None if end_ns is None else bisect_left(messages, end_ns, key=LOG_TIME)
            return messages[first:last]

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
        # Here, because whoever only copies or plays a bag does without the decoder.
        try:
            from mcap_ros2.decoder import DecoderFactory
        except ImportError as error:
            raise BagReadError(
                f"{self.path}: decoding needs the Python package mcap-ros2-support: {error}"
            ) from error
        topic = self.topics[name]
        schema = Schema(
            id=1,
            name=topic.type,
            encoding=topic.definition_encoding,
            data=topic.definition.encode(),
        )
        try:
            # The parser also prints what it raises, and with it the hostile text of a bag.
            with redirect_stderr(StringIO()):
                decoder = DecoderFactory().decoder_for("cdr", schema)
        except Exception as error:  # a parser's errors on a wrong definition are of any kind
            raise BagReadError(
                f"{self.path}: the definition of {topic.type} is malformed: {error}"
            ) from error
        if decoder is None:
            raise BagReadError(
                f"{self.path}: {topic.type} is defined in '{topic.definition_encoding}', "
                "but only ros2msg can be decoded"
            )
        return decoder

    def _add_topics(self, index: FileIndex) -> None:
        file, statistics = index.path, index.statistics
        if index.profile != "ros2":
            raise BagReadError(
                f"{file}: not a bag of ROS 2: its profile is '{index.profile}', expected 'ros2'"
            )
        for channel in index.channels.values():
            count = statistics.channel_message_counts.get(channel.id, 0)
            topic = describe_topic(file, channel, index.schemas.get(channel.schema_id), count)
            known = self.topics.setdefault(topic.name, replace(topic, count=0))
            if known.type != topic.type:
                raise BagReadError(
                    f"{file}: {topic.name} is {topic.type} here, but {known.type} before"
                )
            self.topics[topic.name] = replace(known, count=known.count + count)
        if statistics.message_count:
            start, end = statistics.message_start_time, statistics.message_end_time
            self.start_time = start if self.start_time is None else min(start, self.start_time)
            self.end_time = end if self.end_time is None else max(end, self.end_time)
