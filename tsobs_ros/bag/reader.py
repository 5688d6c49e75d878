# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Reading bags: a folder with its metadata.yaml, or a single MCAP file."""

import heapq
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Schema
from mcap.summary import Summary

from tsobs_ros.bag.metadata import BagMetadata, read_metadata
from tsobs_ros.bag.qos import QosProfile, profiles_from_yaml
from tsobs_ros.errors import BagReadError

_MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a bag.

    Attributes:
        name: The full topic name.
        type: The message type, `package/msg/Type`.
        count: How many messages of it the bag holds.
        qos_profiles: What its publishers offered when it was registered.
        type_hash: The RIHS01 hash of its type, or an empty string.
        definition: The text that defines its type.
        definition_encoding: The language of that text: `ros2msg` in most bags.
    """

    name: str
    type: str
    count: int
    qos_profiles: tuple[QosProfile, ...]
    type_hash: str
    definition: str
    definition_encoding: str


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


class BagReader:
    """Reads a finished bag; files are open only while messages are being read.

    Args:
        path: A bag folder, or one MCAP file.

    Attributes:
        path: The same, as a path.
        files: The MCAP files, in order of recording.
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
            self.metadata = read_metadata(self.path)
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
        for file in self.files:
            self._add_summary(file, _read_summary(file))

    @property
    def message_count(self) -> int:
        """The number of messages in the bag."""
        return sum(topic.count for topic in self.topics.values())

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield the messages in order of log time.

        Args:
            topics: Only those of these topics; of all by default.

        Raises:
            BagReadError: The bag has no such topic, or a file is damaged; the latter is raised
                where the damage is reached.
        """
        if topics is not None and (unknown := sorted(set(topics) - set(self.topics))):
            has = ", ".join(self.topics) or "none"
            raise BagReadError(f"{self.path}: no topic {', '.join(unknown)}; topics: {has}")
        # Files of a split bag may overlap by a few messages, hence no plain chain.
        sources = (_read_messages(file, topics) for file in self.files)
        return heapq.merge(*sources, key=attrgetter("log_time"))

    def decoded(self, topics: Collection[str] | None = None) -> Iterator[DecodedMessage]:
        """Yield the messages in order of log time, decoded by the definitions in the bag.

        Args:
            topics: Only those of these topics; of all by default.

        Raises:
            BagReadError: As for `messages`; or a definition is not in the `ros2msg` language,
                or `mcap-ros2-support` is not installed, or a message does not fit its type.
        """
        messages = self.messages(topics)
        decoders = {
            name: self._decoder(name) for name in (self.topics if topics is None else topics)
        }
        return self._decode(messages, decoders)

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

    def _add_summary(self, file: Path, summary: Summary) -> None:
        statistics = summary.statistics
        assert statistics is not None
        for channel in summary.channels.values():
            count = statistics.channel_message_counts.get(channel.id, 0)
            topic = _topic_info(file, channel, summary.schemas.get(channel.schema_id), count)
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


def _read_summary(path: Path) -> Summary:
    try:
        with path.open("rb") as stream:
            if stream.read(len(_MAGIC)) != _MAGIC:
                raise BagReadError(f"{path}: not an MCAP file")
            stream.seek(-len(_MAGIC), 2)
            if stream.read() != _MAGIC or stream.tell() < 2 * len(_MAGIC):
                raise BagReadError(
                    f"{path}: the file has no end: it is still being recorded, was truncated, or "
                    "its recorder was killed"
                )
            stream.seek(0)
            reader = SeekingReader(stream)
            profile = reader.get_header().profile
            summary = reader.get_summary()
    except (OSError, McapError, ValueError) as error:
        if isinstance(error, BagReadError):
            raise
        raise BagReadError(f"{path}: cannot read it: {error}") from error
    if profile != "ros2":
        raise BagReadError(f"{path}: not a bag of ROS 2: its profile is '{profile}'")
    if summary is None or summary.statistics is None:
        raise BagReadError(f"{path}: the file has no index")
    return summary


def _topic_info(file: Path, channel: Channel, schema: Schema | None, count: int) -> TopicInfo:
    if channel.message_encoding != "cdr":
        raise BagReadError(
            f"{file}: {channel.topic} is encoded in '{channel.message_encoding}', not in cdr"
        )
    if schema is None:
        raise BagReadError(f"{file}: {channel.topic} has no type")
    try:
        qos_profiles = profiles_from_yaml(channel.metadata.get("offered_qos_profiles", ""))
    except ValueError as error:
        raise BagReadError(f"{file}: {channel.topic}: {error}") from error
    return TopicInfo(
        name=channel.topic,
        type=schema.name,
        count=count,
        qos_profiles=qos_profiles,
        type_hash=channel.metadata.get("topic_type_hash", ""),
        definition=schema.data.decode(errors="replace"),
        definition_encoding=schema.encoding,
    )


def _read_messages(path: Path, topics: Collection[str] | None) -> Iterator[BagMessage]:
    try:
        with path.open("rb") as stream:
            reader = SeekingReader(stream, validate_crcs=True)
            for schema, channel, message in reader.iter_messages(topics):
                assert schema is not None
                yield BagMessage(
                    channel.topic,
                    schema.name,
                    message.data,
                    message.log_time,
                    message.publish_time,
                )
    except Exception as error:  # decompressors and parsers fail on damage with any kind
        raise BagReadError(f"{path}: the file is damaged: {error}") from error
