# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Checking a bag folder's metadata.yaml key by key, and the files beside it."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tsobs_ros.bag.metadata import FILE_NAME, ROOT_KEY, TYPE_HASH, VERSION, BagMetadata, QosProfile
from tsobs_ros.bag.verification.findings import Findings
from tsobs_ros.yaml_files import load_yaml

TYPE_NAME = re.compile(r"[A-Za-z]\w*/(msg|srv|action)/[A-Za-z]\w*", re.ASCII)
_TOPIC_NAME = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
_NUMBERED = re.compile(r".+_\d+\.[^.]+")
_KEYS = tuple(BagMetadata((), ()).to_map())
_TOPIC_KEYS = (
    "name",
    "type",
    "serialization_format",
    "offered_qos_profiles",
    "type_description_hash",
)
_FILE_KEYS = ("path", "starting_time", "duration", "message_count")


def verify_folder(bag: Path, findings: Findings) -> BagMetadata | None:
    """Check what a bag folder says about itself, as far as that can be told without its files.

    Args:
        bag: The folder.
        findings: Where to add what is wrong.

    Returns:
        What metadata.yaml says; None if it cannot be read at all.
    """
    try:
        content: Any = load_yaml((bag / FILE_NAME).read_text(encoding="utf-8"))
        information = content[ROOT_KEY]
        if not isinstance(information, dict):
            raise TypeError(f"{ROOT_KEY} is not a map")
    except FileNotFoundError:
        findings.error(FILE_NAME, "there is none")
        return None
    except KeyError:
        findings.error(FILE_NAME, f"the key '{ROOT_KEY}' is missing")
        return None
    except (OSError, ValueError, TypeError) as error:
        findings.error(FILE_NAME, f"cannot be read: {error}")
        return None
    _MapCheck(findings).check(information)
    try:
        metadata = BagMetadata.from_map(information)
    except (KeyError, TypeError, ValueError) as error:
        if not findings.errors:
            findings.error(FILE_NAME, f"not the metadata of a bag: {error}")
        return None
    _verify_names(bag, metadata, findings)
    return metadata


def _verify_names(bag: Path, metadata: BagMetadata, findings: Findings) -> None:
    listed = [file.path for file in metadata.files]
    entries = sorted(bag.iterdir())
    # Looked up, as the system fails when it is asked for a name that is too long.
    files = {path.name for path in entries if path.is_file()}
    for number, name in enumerate(listed):
        if Path(name).name != name:
            findings.error(
                FILE_NAME, f"the file '{name}' is not given by its name in the bag's own folder"
            )
        elif name not in files:
            findings.error(FILE_NAME, f"the file '{name}' is not there")
        if name != (expected := f"{bag.resolve().name}_{number}.mcap"):
            findings.remark(FILE_NAME, f"the file '{name}' would be named '{expected}' by rosbag2")
    names = {Path(name).name for name in listed}
    for path in entries:
        if path.name in names or path.name == FILE_NAME:
            continue
        if _NUMBERED.fullmatch(path.name):
            findings.error(path.name, "metadata.yaml does not list it: a reindexing would stumble")
        else:
            findings.remark(path.name, "not part of a bag")


class _MapCheck:
    def __init__(self, findings: Findings) -> None:
        self._findings = findings

    def check(self, values: Mapping[str, Any]) -> None:
        self._check_keys("", values, _KEYS)
        self._expect("version", values, VERSION)
        self._expect("storage_identifier", values, "mcap")
        if (mode := values.get("compression_mode")) not in ("", "NONE"):
            self._error(f"compression_mode is {mode!r}, but chunks are compressed by MCAP itself")
        elif mode or values.get("compression_format"):
            self._remark("compression_format and compression_mode are not empty")
        if "ros_distro" in values and values["ros_distro"] != "jazzy":
            self._remark(f"ros_distro is '{values['ros_distro']}', not 'jazzy'")
        self._check_custom_data(values.get("custom_data"))
        topics = self._list_of_maps("topics_with_message_count", values)
        files = self._list_of_maps("files", values)
        for topic in topics:
            self._check_topic(topic)
        for file in files:
            self._check_keys(f"file '{file.get('path')}'", file, _FILE_KEYS)
        names = [str(topic.get("topic_metadata", {}).get("name")) for topic in topics]
        for name in sorted({name for name in names if names.count(name) > 1}):
            self._error(f"{name} is listed more than once")
        self._check_sums(values, topics, files)

    def _check_sums(
        self, values: Mapping[str, Any], topics: list[dict[str, Any]], files: list[dict[str, Any]]
    ) -> None:
        try:
            metadata = BagMetadata.from_map(
                {**values, "version": VERSION, "topics_with_message_count": []}
            )
            start = values["starting_time"]["nanoseconds_since_epoch"]
            duration = values["duration"]["nanoseconds"]
            of_topics = sum(topic["message_count"] for topic in topics)
        except (KeyError, TypeError, ValueError):
            return  # told where the metadata is read as a whole
        expect = self._findings.expect
        expect(FILE_NAME, "starting_time", start, metadata.starting_time_ns)
        expect(FILE_NAME, "duration", duration, metadata.duration_ns)
        expect(FILE_NAME, "message_count", values.get("message_count"), metadata.message_count)
        expect(FILE_NAME, "message_count of all topics", of_topics, metadata.message_count)

    def _check_topic(self, entry: Mapping[str, Any]) -> None:
        self._check_keys("a topic", entry, ("topic_metadata", "message_count"))
        topic = entry.get("topic_metadata")
        if not isinstance(topic, dict):
            self._error(f"topic_metadata is not a map: {topic!r}")
            return
        name = str(topic.get("name"))
        self._check_keys(f"topic {name}", topic, _TOPIC_KEYS)
        if not _TOPIC_NAME.fullmatch(name):
            self._error(f"'{name}' is not the name of a topic")
        if not TYPE_NAME.fullmatch(type_ := str(topic.get("type"))):
            self._error(f"{name}: '{type_}' is not a type such as package/msg/Type")
        if (encoding := topic.get("serialization_format")) != "cdr":
            self._error(f"{name}: serialization_format is '{encoding}', not 'cdr'")
        hash_ = str(topic.get("type_description_hash"))
        if not hash_:
            self._remark(f"{name}: type_description_hash is empty")
        elif not TYPE_HASH.fullmatch(hash_):
            self._error(f"{name}: type_description_hash is '{hash_}', not RIHS01_<64 hex digits>")
        self._check_qos(name, topic.get("offered_qos_profiles"))

    def _check_qos(self, name: str, profiles: object) -> None:
        if not isinstance(profiles, list):
            self._error(
                f"{name}: offered_qos_profiles is not a list, as version 9 has it: {profiles!r:.60}"
            )
            return
        for profile in profiles:
            try:
                QosProfile.from_map(profile)
            except ValueError as error:
                self._error(f"{name}: {error}")

    def _check_custom_data(self, values: object) -> None:
        if values is None:
            return
        if not isinstance(values, dict) or any(
            isinstance(item, dict | list | None) for item in values.values()
        ):
            self._error(f"custom_data is not a flat map of strings: {values!r:.60}")

    def _check_keys(self, place: str, values: Mapping[str, Any], expected: tuple[str, ...]) -> None:
        prefix = f"{place}: " if place else ""
        for key in expected:
            if key not in values:
                self._error(f"{prefix}the key '{key}' is missing")
        for key in values:
            if key not in expected:
                self._remark(f"{prefix}the key '{key}' is none of rosbag2's")

    def _list_of_maps(self, key: str, values: Mapping[str, Any]) -> list[dict[str, Any]]:
        entries = values.get(key, [])
        if not isinstance(entries, list) or not all(isinstance(item, dict) for item in entries):
            self._error(f"{key} is not a list of maps")
            return []
        return entries

    def _expect(self, key: str, values: Mapping[str, Any], expected: object) -> None:
        if key in values and values[key] != expected:
            self._error(f"{key} is {values[key]!r}, expected {expected!r}")

    def _error(self, text: str) -> None:
        self._findings.error(FILE_NAME, text)

    def _remark(self, text: str) -> None:
        self._findings.remark(FILE_NAME, text)
