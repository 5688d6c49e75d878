# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics, QoS and files of a bag, and its `metadata.yaml` of version 9, which Jazzy writes."""

import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import yaml
from mcap.records import Channel, Schema

from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.errors import BagReadError, BagWriteError
from tsobs_ros.files import write_whole
from tsobs_ros.yaml_files import MAX_BYTES, load_yaml, read_yaml

VERSION = 9
FILE_NAME = "metadata.yaml"
ROOT_KEY = "rosbag2_bagfile_information"
EMPTY_START_NS = 2**63 - 1

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

# libyaml's is ten times as fast, and metadata is written while messages arrive.
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

_Count = Annotated[int, msgspec.Meta(ge=0)]


class QosTime(msgspec.Struct, frozen=True):
    """A span of time: `sec` seconds and `nsec` nanoseconds."""

    sec: _Count
    nsec: _Count


INFINITE = QosTime(9223372036, 854775807)


class QosProfile(msgspec.Struct, frozen=True):
    """One publisher's offer; the defaults are those that Fast DDS reports of a default publisher.

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
        ValueError: A policy has no such name.

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
        """Refuse what a rosbag2 reader would refuse."""
        for policy, names in _POLICIES.items():
            if (name := getattr(self, policy)) not in names:
                raise ValueError(f"{policy} is '{name}', but must be one of {', '.join(names)}")

    def to_map(self) -> dict[str, Any]:
        """Return the profile as the map of metadata version 9."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain


def _profiles(maps: Iterable[dict[str, Any]]) -> tuple[QosProfile, ...]:
    """Return the profiles that maps describe, with policies by name or by number."""
    named = [
        each
        | {k: names[each[k]] for k, names in _POLICIES.items() if each.get(k) in range(len(names))}
        for each in maps
    ]
    return msgspec.convert(named, tuple[QosProfile, ...])


def profiles_to_yaml(profiles: Iterable[QosProfile]) -> str:
    """Return the offers as the YAML list that is a channel's `offered_qos_profiles`."""
    maps = [profile.to_map() for profile in profiles]
    return str(yaml.safe_dump(maps, sort_keys=False)).rstrip("\n")


def profiles_from_yaml(text: str) -> tuple[QosProfile, ...]:
    """Return the offers that a channel's `offered_qos_profiles` lists; none for an empty text.

    Raises:
        ValueError: The text is not a YAML list of QoS profiles.
    """
    try:
        return _profiles(msgspec.convert(load_yaml(text) or [], list[dict[str, Any]]))
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


class TopicReader:
    """The topics that channels and schemas of a file describe; each text is read once."""

    def __init__(self) -> None:
        self._definitions: dict[int, str] = {}
        self._offers: dict[str, tuple[QosProfile, ...]] = {}
        # Parsing costs some microseconds a byte.
        self._bytes_left = MAX_BYTES

    def __call__(self, channel: Channel, schema: Schema | None) -> TopicInfo:
        """Return the topic that a channel is of, without QoS if that makes no sense.

        Raises:
            ValueError: Its messages are not in CDR, or there is no schema.
        """
        if channel.message_encoding != "cdr":
            raise ValueError(f"is encoded in '{channel.message_encoding}', not in cdr")
        if schema is None:
            raise ValueError("has no type")
        if schema.id not in self._definitions:
            self._definitions[schema.id] = schema.data.decode(errors="replace")
        hash_ = channel.metadata.get("topic_type_hash", "")
        text, qos = self._definitions[schema.id], tuple[QosProfile, ...]()
        with suppress(ValueError):
            qos = self.offers(channel)
        definition = MessageDefinition(schema.name, text, hash_, schema.encoding)
        return TopicInfo(channel.topic, schema.name, 0, qos, hash_, definition)

    def offers(self, channel: Channel) -> tuple[QosProfile, ...]:
        """Return a channel's `offered_qos_profiles`; raise a `ValueError` if they make no sense."""
        text = channel.metadata.get("offered_qos_profiles", "")
        if text not in self._offers:
            self._bytes_left -= len(text)
            if self._bytes_left < 0:
                raise ValueError(f"the file's QoS profiles are larger than {MAX_BYTES} bytes")
            self._offers[text] = profiles_from_yaml(text)
        return self._offers[text]


class _Duration(msgspec.Struct, frozen=True):
    nanoseconds: _Count = 0


class _Time(msgspec.Struct, frozen=True):
    nanoseconds_since_epoch: _Count = EMPTY_START_NS


class FileMetadata(msgspec.Struct, frozen=True):
    """One file of a bag: its name in the folder, its first log time and what follows [ns]."""

    path: str
    starting_time: _Time = _Time()
    duration: _Duration = _Duration()
    message_count: _Count = 0

    @classmethod
    def of(cls, path: str, start: int, end: int, count: int) -> "FileMetadata":
        """Return that of a file with messages from and to a log time [ns]."""
        return cls(path, _Time(start), _Duration(end - start), count) if count else cls(path)


class _Topic(msgspec.Struct):
    name: str
    type: str
    offered_qos_profiles: list[dict[str, Any]]
    type_description_hash: str


class _TopicEntry(msgspec.Struct):
    topic_metadata: _Topic
    message_count: _Count


class _Information(msgspec.Struct):
    """What is read of the content of the root key."""

    storage_identifier: str
    compression_mode: Literal["", "NONE"]
    topics_with_message_count: list[_TopicEntry]
    files: list[FileMetadata]
    custom_data: dict[Any, Any] | None
    ros_distro: str


@dataclass(frozen=True)
class BagMetadata:
    """The content of a bag's metadata.yaml.

    Attributes:
        topics: The recorded topics, in order of registration.
        files: The files, in order of recording.
        custom_data: The user's notes.
        ros_distro: The ROS distribution it was recorded with.
        storage_identifier: The storage format of the files.
    """

    topics: tuple[TopicInfo, ...]
    files: tuple[FileMetadata, ...]
    custom_data: Mapping[str, str] | None = None
    ros_distro: str = "jazzy"
    storage_identifier: str = "mcap"

    def to_map(self) -> dict[str, Any]:
        """Return the content of the root key, with every key in rosbag2's order."""
        filled = [file for file in self.files if file.message_count]
        starts = [file.starting_time.nanoseconds_since_epoch for file in filled]
        ends = [at + file.duration.nanoseconds for at, file in zip(starts, filled, strict=True)]
        start, end = min(starts, default=EMPTY_START_NS), max(ends, default=EMPTY_START_NS)
        return {
            "version": VERSION,
            "storage_identifier": self.storage_identifier,
            "duration": {"nanoseconds": end - start},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": sum(file.message_count for file in filled),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": [qos.to_map() for qos in topic.qos_profiles],
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": topic.count,
                }
                for topic in self.topics
            ],
            "compression_format": "",  # also with compressed chunks: those are MCAP's
            "compression_mode": "",
            "relative_file_paths": [file.path for file in self.files],
            "files": [msgspec.to_builtins(file) for file in self.files],
            "custom_data": dict(self.custom_data) if self.custom_data else None,
            "ros_distro": self.ros_distro,
        }

    def to_yaml(self) -> str:
        """Return the content of the root key as YAML: the text that an MCAP file carries."""
        return _dump(self.to_map())

    @classmethod
    def from_map(cls, information: object) -> "BagMetadata":
        """Return the metadata that the content of the root key states."""
        version = information.get("version") if isinstance(information, dict) else None
        if version != VERSION:
            raise ValueError(f"version is {version}, only {VERSION} is supported")
        stated = msgspec.convert(information, _Information)
        listed = [file.path for file in stated.files]
        if len(set(listed)) < len(listed) or "\0" in "".join(listed):
            raise ValueError(f"files are {listed}: each needs a name that no other has")
        # rosbag2 writes texts without quotes, so that YAML may take them for numbers.
        notes = stated.custom_data and {str(k): str(v) for k, v in stated.custom_data.items()}
        topics = [
            TopicInfo(
                each.topic_metadata.name,
                each.topic_metadata.type,
                each.message_count,
                _profiles(each.topic_metadata.offered_qos_profiles),
                each.topic_metadata.type_description_hash,
            )
            for each in stated.topics_with_message_count
        ]
        files, storage = tuple(stated.files), stated.storage_identifier
        return cls(tuple(topics), files, notes, stated.ros_distro, storage)


def write_metadata(folder: Path, metadata: BagMetadata) -> None:
    """Replace a bag folder's metadata.yaml in one step that a power cut cannot halve.

    Raises:
        BagWriteError: The file cannot be written.
    """
    write_whole(folder / FILE_NAME, _dump({ROOT_KEY: metadata.to_map()}), BagWriteError)


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


def _dump(content: Mapping[str, Any]) -> str:
    return str(yaml.dump(content, Dumper=_DUMPER, sort_keys=False, allow_unicode=True))
