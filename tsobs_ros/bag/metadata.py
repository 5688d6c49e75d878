# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `metadata.yaml` of a bag folder, version 9: the one Jazzy writes."""

import os
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tsobs_ros.bag.qos import QosProfile
from tsobs_ros.errors import BagReadError, BagWriteError
from tsobs_ros.yaml_files import load_yaml, whole_number

VERSION = 9
FILE_NAME = "metadata.yaml"
ROOT_KEY = "rosbag2_bagfile_information"
EMPTY_START_NS = 2**63 - 1
TYPE_HASH = re.compile(r"RIHS01_[0-9a-f]{64}")
# libyaml's is ten times faster, and metadata is written while messages arrive.
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


@dataclass(frozen=True)
class TopicMetadata:
    """One recorded topic.

    Attributes:
        name: The full topic name.
        type: The message type, `package/msg/Type`.
        message_count: How many messages of it the bag holds.
        offered_qos_profiles: What its publishers offered when it was registered.
        type_description_hash: The RIHS01 hash of its type, or an empty string.
        serialization_format: How messages are encoded.
    """

    name: str
    type: str
    message_count: int = 0
    offered_qos_profiles: tuple[QosProfile, ...] = ()
    type_description_hash: str = ""
    serialization_format: str = "cdr"


@dataclass(frozen=True)
class FileMetadata:
    """One file of a bag.

    Attributes:
        path: Its name in the bag's folder.
        starting_time_ns: The smallest log time in it, ns since the epoch.
        duration_ns: From there to the largest log time, ns.
        message_count: How many messages it holds.
    """

    path: str
    starting_time_ns: int = EMPTY_START_NS
    duration_ns: int = 0
    message_count: int = 0


@dataclass(frozen=True)
class BagMetadata:
    """What a bag folder says about itself.

    Attributes:
        topics: The recorded topics, in order of registration.
        files: The files, in order of recording.
        custom_data: What the user wants remembered.
        ros_distro: The ROS distribution it was recorded with.
        storage_identifier: The storage format of the files.
    """

    topics: tuple[TopicMetadata, ...]
    files: tuple[FileMetadata, ...]
    custom_data: Mapping[str, str] | None = None
    ros_distro: str = "jazzy"
    storage_identifier: str = "mcap"

    @property
    def message_count(self) -> int:
        """The number of messages in all files."""
        return sum(file.message_count for file in self.files)

    @property
    def starting_time_ns(self) -> int:
        """The smallest log time, ns since the epoch; `EMPTY_START_NS` without messages."""
        return min((f.starting_time_ns for f in self._filled()), default=EMPTY_START_NS)

    @property
    def duration_ns(self) -> int:
        """The time from the smallest to the largest log time, ns."""
        ends = [file.starting_time_ns + file.duration_ns for file in self._filled()]
        return max(ends) - self.starting_time_ns if ends else 0

    def _filled(self) -> list[FileMetadata]:
        return [file for file in self.files if file.message_count]

    def to_map(self) -> dict[str, Any]:
        """Return the content of the root key, every key of it in rosbag2's order."""
        return {
            "version": VERSION,
            "storage_identifier": self.storage_identifier,
            "duration": {"nanoseconds": self.duration_ns},
            "starting_time": {"nanoseconds_since_epoch": self.starting_time_ns},
            "message_count": self.message_count,
            "topics_with_message_count": [_topic_map(topic) for topic in self.topics],
            # Empty even with compressed chunks: those are MCAP's own business.
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file.path for file in self.files],
            "files": [_file_map(file) for file in self.files],
            "custom_data": dict(self.custom_data) if self.custom_data else None,
            "ros_distro": self.ros_distro,
        }

    def to_yaml(self) -> str:
        """Return the content of the root key as YAML: the text an MCAP file carries."""
        return _dump(self.to_map())

    @classmethod
    def from_map(cls, information: Mapping[str, Any]) -> "BagMetadata":
        """Return the metadata that the content of the root key states.

        Raises:
            KeyError: A key is missing.
            TypeError: The content is not a map.
            ValueError: It is of another version than 9, or a value makes no sense.
        """
        if information["version"] != VERSION:
            raise ValueError(f"version is {information['version']}, only {VERSION} is supported")
        if information["compression_mode"] not in ("", "NONE"):
            raise ValueError("bags compressed by file or by message are not supported")
        return cls(
            topics=tuple(map(_topic_from, information["topics_with_message_count"])),
            files=_files_from(information["relative_file_paths"], information["files"]),
            custom_data=_custom_data_from(information["custom_data"]),
            ros_distro=str(information["ros_distro"]),
            storage_identifier=str(information["storage_identifier"]),
        )

    @classmethod
    def from_yaml(cls, text: str) -> "BagMetadata":
        """Return the metadata that an MCAP file carries.

        Raises:
            ValueError: The text is not YAML or not the metadata of a bag.
        """
        content: Any = load_yaml(text)
        try:
            return cls.from_map(content)
        except KeyError as error:
            raise ValueError(f"the key {error} is missing") from error
        except TypeError as error:
            raise ValueError(f"not the metadata of a bag: {error}") from error


def write_metadata(folder: Path, metadata: BagMetadata) -> None:
    """Replace a bag folder's metadata.yaml in one step that a power cut cannot halve.

    Args:
        folder: The bag folder, which must exist.
        metadata: What to write.

    Raises:
        BagWriteError: The file could not be written.
    """
    path = folder / FILE_NAME
    temporary = path.with_suffix(".yaml.tmp")
    try:
        with temporary.open("w", encoding="utf-8") as stream:
            stream.write(_dump({ROOT_KEY: metadata.to_map()}))
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
        fsync_folder(folder)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise BagWriteError(f"{path}: cannot write it: {error}") from error


def read_metadata(folder: Path) -> BagMetadata:
    """Return what a bag folder's metadata.yaml says.

    Args:
        folder: The bag folder.

    Raises:
        BagReadError: The file is missing or not metadata of version 9, or a key is missing or
            has a value that makes no sense.
    """
    path = folder / FILE_NAME
    try:
        content: Any = load_yaml(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise BagReadError(f"{folder}: not a bag folder, it has no {FILE_NAME}") from error
    except (OSError, ValueError) as error:  # not UTF-8 is a ValueError as well
        raise BagReadError(f"{path}: cannot read it: {error}") from error
    try:
        return BagMetadata.from_map(content[ROOT_KEY])
    except KeyError as error:
        raise BagReadError(f"{path}: the key {error} is missing") from error
    except (TypeError, ValueError) as error:
        raise BagReadError(f"{path}: not the metadata of a bag: {error}") from error


def fsync_folder(folder: Path) -> None:
    """Force a folder's entries to the disk: a new file is lost without its name.

    Raises:
        OSError: The folder cannot be opened or the disk fails.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _dump(content: Mapping[str, Any]) -> str:
    return str(yaml.dump(content, Dumper=_DUMPER, sort_keys=False, allow_unicode=True))


def _topic_map(topic: TopicMetadata) -> dict[str, Any]:
    return {
        "topic_metadata": {
            "name": topic.name,
            "type": topic.type,
            "serialization_format": topic.serialization_format,
            "offered_qos_profiles": [qos.to_map() for qos in topic.offered_qos_profiles],
            "type_description_hash": topic.type_description_hash,
        },
        "message_count": topic.message_count,
    }


def _file_map(file: FileMetadata) -> dict[str, Any]:
    return {
        "path": file.path,
        "starting_time": {"nanoseconds_since_epoch": file.starting_time_ns},
        "duration": {"nanoseconds": file.duration_ns},
        "message_count": file.message_count,
    }


def _topic_from(values: Mapping[str, Any]) -> TopicMetadata:
    topic = values["topic_metadata"]
    return TopicMetadata(
        name=str(topic["name"]),
        type=str(topic["type"]),
        message_count=whole_number(values, "message_count"),
        offered_qos_profiles=tuple(map(QosProfile.from_map, topic["offered_qos_profiles"])),
        type_description_hash=str(topic["type_description_hash"]),
        serialization_format=str(topic["serialization_format"]),
    )


def _files_from(
    paths: Iterable[str], entries: Iterable[Mapping[str, Any]]
) -> tuple[FileMetadata, ...]:
    files = tuple(
        FileMetadata(
            path=str(entry["path"]),
            starting_time_ns=whole_number(entry["starting_time"], "nanoseconds_since_epoch"),
            duration_ns=whole_number(entry["duration"], "nanoseconds"),
            message_count=whole_number(entry, "message_count"),
        )
        for entry in entries
    )
    if (listed := [file.path for file in files]) != list(paths):
        raise ValueError(f"files are {listed}, but relative_file_paths {list(paths)}")
    for name in listed:
        if "\0" in name:
            raise ValueError(f"{name!r} cannot be a file's name")
    return files


def _custom_data_from(values: object) -> dict[str, str] | None:
    if values is None:
        return None
    if not isinstance(values, dict):
        raise ValueError(f"custom_data is not a map: {values!r}")
    return {str(key): str(value) for key, value in values.items()}
