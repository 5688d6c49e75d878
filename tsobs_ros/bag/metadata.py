# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics, QoS and files of a bag, and its `metadata.yaml` of version 9, which Jazzy writes."""

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from mcap.records import Channel, Schema

from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.errors import BagReadError, BagWriteError
from tsobs_ros.files import naming_path, write_whole
from tsobs_ros.yaml_files import MAX_BYTES, load_yaml, read_yaml

VERSION = 9
FILE_NAME = "metadata.yaml"
ROOT_KEY = "rosbag2_bagfile_information"
EMPTY_START_NS = 2**63 - 1

_NUMBER = re.compile(r"_(\d+)$")
_MAX_DESCRIPTIONS = 2**26
_OF_PUBLISHER = ("unknown", "best_available")
# In the order of the RMW's enumerations: bags from before Jazzy name a policy by its number.
_POLICIES: Mapping[str, tuple[str, ...]] = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", *_OF_PUBLISHER),
    "durability": ("system_default", "transient_local", "volatile", *_OF_PUBLISHER),
    "liveliness": (
        "system_default", "automatic", "manual_by_node", "manual_by_topic", *_OF_PUBLISHER
    ),
}  # fmt: skip

_Count = Annotated[int, msgspec.Meta(ge=0)]


class QosTime(msgspec.Struct, frozen=True):
    """A span of time: `sec` seconds and `nsec` nanoseconds."""

    sec: _Count
    nsec: _Count


INFINITE = QosTime(9223372036, 854775807)


class QosProfile(msgspec.Struct, frozen=True):
    """One publisher's offer; the defaults are those that Fast DDS reports for a default publisher.

    Attributes:
        history: `keep_last`, `keep_all`; `unknown` if discovery does not report it.
        depth: The history's depth in messages; 0 if discovery does not report it.
        reliability: `reliable`, `best_effort`, or another of rosbag2's names.
        durability: `transient_local`, `volatile`, or another of rosbag2's names.
        deadline: The longest time promised between two messages.
        lifespan: The age at which a message is dropped.
        liveliness: `automatic`, `manual_by_topic`, or another of rosbag2's names.
        liveliness_lease_duration: The longest time between two signs of life.
        avoid_ros_namespace_conventions: Whether the DDS topic is named without ROS prefixes.

    Raises:
        ValueError: A policy has a name that is not known.

    >>> QosProfile(reliability="best_effort").durability
    'volatile'
    """

    history: str = "unknown"
    depth: _Count = 0
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline: QosTime = INFINITE
    lifespan: QosTime = INFINITE
    liveliness: str = "automatic"
    liveliness_lease_duration: QosTime = INFINITE
    avoid_ros_namespace_conventions: bool = False

    def __post_init__(self) -> None:
        """Refuse names that a rosbag2 reader would refuse."""
        for policy, names in _POLICIES.items():
            if (name := getattr(self, policy)) not in names:
                raise ValueError(f"{policy} is '{name}', but must be one of {', '.join(names)}")


def profiles_to_yaml(profiles: Iterable[QosProfile]) -> str:
    """Return the offers as the YAML list for a channel's `offered_qos_profiles`."""
    return msgspec.yaml.encode(list(profiles)).decode().rstrip("\n")


def profiles_from_yaml(text: str) -> tuple[QosProfile, ...]:
    """Return the offers that a channel's `offered_qos_profiles` lists; none for an empty text.

    Raises:
        ValueError: The text is not a YAML list of QoS profiles.
    """
    try:
        maps = msgspec.convert(load_yaml(text) or [], list[dict[str, Any]])
        for each in maps:
            for policy, names in _POLICIES.items():
                if isinstance(number := each.get(policy), int) and number in range(len(names)):
                    each[policy] = names[number]
        return msgspec.convert(maps, tuple[QosProfile, ...])
    except ValueError as error:
        raise ValueError(f"not a list of QoS profiles: {error}") from error


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a bag.

    Attributes:
        name: The full topic name.
        type: The message type, `package/msg/Type`.
        count: The number of its messages in the bag.
        qos_profiles: The offers of its publishers when it was registered.
        type_hash: The RIHS01 hash of its type, or an empty string.
        definition: The definition of its type; None if only metadata.yaml names the topic.
    """

    name: str
    type: str
    count: int = 0
    qos_profiles: tuple[QosProfile, ...] = ()
    type_hash: str = ""
    definition: MessageDefinition | None = field(default=None, compare=False, repr=False)


class Descriptions:
    """The topics that the schemas and channels of a file describe.

    Attributes:
        of_bag: The topics of the bag by name; those of the file are added to them.
        schemas: The first schema with each id.
        channels: The first channel with each id.
        topics: The topics by channel, without QoS if their QoS is malformed.
        problems: Problems of descriptions, by the id of a channel or by another key.
    """

    def __init__(self, of_bag: dict[str, TopicInfo]) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.topics: dict[int, TopicInfo] = {}
        self.problems: dict[int | str, str] = {}
        self._of_bag = of_bag
        self._texts: dict[int, str] = {}
        self._offers: dict[str, tuple[QosProfile, ...]] = {}
        self._room, self._offers_room = _MAX_DESCRIPTIONS, MAX_BYTES

    def add_all(self, schemas: Mapping[int, Schema], channels: Mapping[int, Channel]) -> None:
        """Add the descriptions of a summary."""
        each: list[Schema | Channel] = [*schemas.values(), *channels.values()]
        for record in each:
            self.add(record)

    def add(self, record: Schema | Channel) -> None:
        """Add a description; if it differs from an earlier one, the topic may be lost."""
        if isinstance(record, Schema):
            schema = self.schemas.get(record.id)
            if schema is None and self._has_room(len(record.data)):
                self.schemas[record.id] = record
                self._texts[record.id] = record.data.decode(errors="replace")
            elif schema not in (None, record) and f"schema {record.id}" not in self.problems:
                ids = [i for i, one in self.channels.items() if one.schema_id == record.id]
                self._contradict(
                    "schema", record.id, ids if schema and schema.name != record.name else []
                )
            return
        channel, texts = self.channels.get(record.id), record.metadata
        if channel is None and self._has_room(sum(map(len, (*texts, *texts.values())))):
            self.channels[record.id] = record
            try:
                self._add_topic(record, self.schemas.get(record.schema_id))
            except ValueError as error:
                self.problems[record.id] = f"{record.topic}: {error}"
        elif channel is not None and channel != record:
            is_other = replace(channel, metadata=texts) != record
            self._contradict("channel", record.id, [record.id] if is_other else [])

    def _add_topic(self, channel: Channel, schema: Schema | None) -> None:
        if channel.message_encoding != "cdr":
            raise ValueError(f"is encoded in '{channel.message_encoding}', not in cdr")
        if schema is None:
            raise ValueError("has no type")
        hash_ = channel.metadata.get("topic_type_hash", "")
        text = self._texts[schema.id]
        definition = MessageDefinition(schema.name, text, hash_, schema.encoding)
        qos: tuple[QosProfile, ...] = ()
        try:
            qos = self._offered(channel)
        except ValueError as error:
            self.problems[channel.id] = f"{channel.topic}: {error}"
        topic = TopicInfo(channel.topic, schema.name, 0, qos, hash_, definition)
        if (of_bag := self._of_bag.setdefault(topic.name, topic).type) != topic.type:
            raise ValueError(f"is {topic.type} here, but {of_bag} before")
        self.topics[channel.id] = topic

    def _offered(self, channel: Channel) -> tuple[QosProfile, ...]:
        text = channel.metadata.get("offered_qos_profiles", "")
        if text not in self._offers:
            self._offers_room -= len(text)  # parsing costs some microseconds per byte
            if self._offers_room < 0:
                raise ValueError(f"the file's QoS profiles are larger than {MAX_BYTES} bytes")
            self._offers[text] = profiles_from_yaml(text)
        return self._offers[text]

    def _contradict(self, what: str, id_: int, channels: Iterable[int]) -> None:
        """Note that descriptions differ, and drop channels that may be those of another file."""
        text = self.problems[f"{what} {id_}"] = f"two descriptions of {what} {id_} differ"
        for each in channels:
            self.topics.pop(each, None)
            self.problems[each] = text

    def _has_room(self, size: int) -> bool:
        self._room -= size
        return self._room >= 0


class _Duration(msgspec.Struct, frozen=True):
    nanoseconds: _Count = 0


class _Time(msgspec.Struct, frozen=True):
    nanoseconds_since_epoch: _Count = EMPTY_START_NS


class FileMetadata(msgspec.Struct, frozen=True):
    """One file of a bag: its name in the folder, first log time and duration [ns], messages."""

    path: str
    starting_time: _Time = _Time()
    duration: _Duration = _Duration()
    message_count: _Count = 0

    @classmethod
    def of(cls, path: str, start: int, end: int, count: int) -> "FileMetadata":
        """Return the entry of a file with `count` messages of log times `start` to `end` [ns]."""
        return cls(path, _Time(start), _Duration(end - start), count) if count else cls(path)


class _TopicMetadata(msgspec.Struct, frozen=True):
    name: str
    type: str
    serialization_format: str
    offered_qos_profiles: tuple[QosProfile, ...]
    type_description_hash: str


class _Topic(msgspec.Struct, frozen=True):
    topic_metadata: _TopicMetadata
    message_count: _Count


class BagMetadata(msgspec.Struct, frozen=True):
    """The content of the root key of a bag's metadata.yaml, in rosbag2's order."""

    version: int
    storage_identifier: str
    duration: _Duration
    starting_time: _Time
    message_count: _Count
    topics_with_message_count: tuple[_Topic, ...]
    compression_format: str
    compression_mode: Literal["", "NONE"]
    relative_file_paths: tuple[str, ...]
    files: tuple[FileMetadata, ...]
    custom_data: dict[str, str] | None
    ros_distro: str

    @classmethod
    def of(
        cls,
        topics: Iterable[TopicInfo],
        files: Sequence[FileMetadata],
        custom_data: Mapping[str, str] | None = None,
    ) -> "BagMetadata":
        """Return the metadata of a bag from its topics and files, both in order of recording."""
        filled = [file for file in files if file.message_count]
        starts = [file.starting_time.nanoseconds_since_epoch for file in filled]
        ends = [at + file.duration.nanoseconds for at, file in zip(starts, filled, strict=True)]
        start, end = min(starts, default=EMPTY_START_NS), max(ends, default=EMPTY_START_NS)
        known = (
            _Topic(
                _TopicMetadata(one.name, one.type, "cdr", one.qos_profiles, one.type_hash),
                one.count,
            )
            for one in topics
        )
        return cls(
            VERSION,
            "mcap",
            _Duration(end - start),
            _Time(start),
            sum(file.message_count for file in filled),
            tuple(known),
            "",  # also if chunks are compressed: that is MCAP's own compression
            "",
            tuple(file.path for file in files),
            tuple(files),
            dict(custom_data) if custom_data else None,
            "jazzy",
        )

    @classmethod
    def from_map(cls, information: object) -> "BagMetadata":
        """Return the metadata from the content of the root key."""
        version = information.get("version") if isinstance(information, dict) else None
        if not isinstance(information, dict) or version != VERSION:
            raise ValueError(f"version is {version}, only {VERSION} is supported")
        notes = information.get("custom_data")
        if isinstance(notes, dict):
            # rosbag2 writes texts without quotes, so YAML may parse them as numbers.
            notes = {str(key): str(value) for key, value in notes.items()}
        found = msgspec.convert(information | {"custom_data": notes}, cls)
        listed = [file.path for file in found.files]
        if len(set(listed)) < len(listed) or "\0" in "".join(listed):
            raise ValueError(f"files are {listed}: each needs a name that no other has")
        return found


def write_metadata(folder: Path, metadata: BagMetadata) -> None:
    """Replace a bag folder's metadata.yaml in one step, which a power cut cannot leave half done.

    Raises:
        BagWriteError: The file cannot be written.
    """
    text = msgspec.yaml.encode({ROOT_KEY: metadata}).decode()
    write_whole(folder / FILE_NAME, text, BagWriteError)


def read_metadata(folder: Path) -> BagMetadata:
    """Return the content of a bag folder's metadata.yaml.

    Raises:
        BagReadError: The file is missing or not metadata of version 9, or a key is missing or
            has a value that makes no sense.
    """
    path = folder / FILE_NAME
    if os.access(folder, os.X_OK) and not os.path.lexists(path):
        raise BagReadError(f"{folder}: not a bag folder, it has no {FILE_NAME}")
    root = read_yaml(path, BagReadError)
    try:
        if ROOT_KEY not in root:
            raise ValueError(f"not the metadata of a bag: it has no {ROOT_KEY}")
        return BagMetadata.from_map(root[ROOT_KEY])
    except ValueError as error:
        raise BagReadError(f"{path}: {error}") from error


class BagFiles:
    """The files of a bag in order of recording, and the metadata that lists them.

    Args:
        bag: A bag folder, with or without metadata.yaml, or one MCAP file.

    Attributes:
        listed: The files that metadata.yaml names, whether they exist or not; or the one file.
        others: The other files in the folder.
        metadata: The content of metadata.yaml; None without it.
        problem: What is wrong with metadata.yaml, if anything.

    Raises:
        BagReadError: There is no such folder or file.
    """

    def __init__(self, bag: Path) -> None:
        self.path, self.listed, self.others = bag, [bag], list[Path]()
        self.metadata: BagMetadata | None = None
        self.problem = ""
        if not bag.exists():
            raise BagReadError(f"{bag}: there is no such file or folder")
        if not bag.is_dir():
            return
        with naming_path(bag, BagReadError):
            # Not glob, which treats a folder that cannot be read as empty.
            present = sorted(bag.iterdir(), key=_by_number)
        try:
            self.metadata = read_metadata(bag)
        except BagReadError as error:
            self.problem = str(error)
        # No file outside of the folder is opened: readers, too, use only the last part of a path.
        files = self.metadata.files if self.metadata else ()
        self.listed = list(dict.fromkeys(bag / Path(file.path).name for file in files))
        self.others = [path for path in present if path not in self.listed]

    def to_recover(self) -> list[Path]:
        """Return the files that may hold messages.

        Raises:
            BagReadError: There are no such files.
        """
        if files := [*self.listed, *(path for path in self.others if path.suffix == ".mcap")]:
            return files
        raise BagReadError(f"{self.path}: not a bag, there is no .mcap file in it")


def _by_number(path: Path) -> tuple[int, str]:
    match = _NUMBER.search(path.stem)
    return (int(match[1]) if match else -1, path.name)
