# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""metadata.yaml has every key rosbag2 asks for, comes back as written, and is checked."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
import yaml
from rosbags.rosbag2.metadata import parse_qos

from tsobs_ros.bag.metadata import (
    EMPTY_START_NS,
    INFINITE,
    BagMetadata,
    FileMetadata,
    QosProfile,
    QosTime,
    TopicInfo,
    profiles_from_yaml,
    profiles_to_yaml,
    read_metadata,
    write_metadata,
)
from tsobs_ros.errors import BagReadError

TOPICS = (
    TopicInfo("/a", "std_msgs/msg/String", 3, (QosProfile(),), "RIHS01_" + "0" * 64),
    TopicInfo("/b", "std_msgs/msg/Empty"),
)
FILES = (
    FileMetadata.of("bag_0.mcap", 1_000, 1_500, 2),
    FileMetadata.of("bag_1.mcap", 1_400, 2_000, 1),
    FileMetadata("bag_2.mcap"),
)
METADATA = BagMetadata.of(TOPICS, FILES, {"why": "Prüfstand: 1"})


def test_every_key_of_the_format_is_written(tmp_path: Path) -> None:
    write_metadata(tmp_path, METADATA)
    content = yaml.safe_load((tmp_path / "metadata.yaml").read_text(encoding="utf-8"))
    found = content["rosbag2_bagfile_information"]
    topics, files = found.pop("topics_with_message_count"), found.pop("files")
    assert list(found.items()) == [
        ("version", 9),
        ("storage_identifier", "mcap"),
        ("duration", {"nanoseconds": 1_000}),
        ("starting_time", {"nanoseconds_since_epoch": 1_000}),
        ("message_count", 3),
        ("compression_format", ""),
        ("compression_mode", ""),
        ("relative_file_paths", ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"]),
        ("custom_data", {"why": "Prüfstand: 1"}),
        ("ros_distro", "jazzy"),
    ]
    topic = {"name": "/a", "type": "std_msgs/msg/String", "serialization_format": "cdr"}
    topic |= {"offered_qos_profiles": [msgspec.to_builtins(QosProfile())]}
    topic |= {"type_description_hash": "RIHS01_" + "0" * 64}
    assert topics[0] == {"topic_metadata": topic, "message_count": 3}
    for file, start, duration, count in zip(
        files, (1_000, 1_400, EMPTY_START_NS), (500, 600, 0), (2, 1, 0), strict=True
    ):
        assert file.pop("path") in found["relative_file_paths"]
        assert file == {
            "starting_time": {"nanoseconds_since_epoch": start},
            "duration": {"nanoseconds": duration},
            "message_count": count,
        }


def _set(*path: Any, to: Any) -> Callable[[Any], None]:
    def change(information: Any) -> None:
        *parents, last = path
        for key in parents:
            information = information[key]
        information[last] = to

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda information: information.pop("files"), "missing required field `files`"),
        (_set("version", to=8), "version is 8, only 9 is supported"),
        (_set("files", 0, "message_count", to=-1),
         r"Expected `int` >= 0 - at `\$\.files\[0\]\.message_count"),
        (_set("compression_mode", to="MESSAGE"), "Invalid enum value 'MESSAGE'"),
    ],
)  # fmt: skip
def test_what_is_no_metadata_is_refused(
    tmp_path: Path, change: Callable[[Any], None], message: str
) -> None:
    information = msgspec.to_builtins(METADATA)
    change(information)
    text = yaml.safe_dump({"rosbag2_bagfile_information": information})
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(BagReadError, match=rf"metadata\.yaml: .*{message}"):
        read_metadata(tmp_path)


@pytest.mark.parametrize("name", ["bag\0.mcap", "bag_1.mcap"])
def test_a_name_that_no_file_can_have_is_refused(tmp_path: Path, name: str) -> None:
    files = (FileMetadata(name), FileMetadata("bag_1.mcap"))
    write_metadata(tmp_path, BagMetadata.of((), files))
    with pytest.raises(BagReadError, match="needs a name that no other has"):
        read_metadata(tmp_path)


def test_the_yaml_is_the_one_jazzy_writes_and_rosbags_understands() -> None:
    forever = {"sec": 9223372036, "nsec": 854775807}
    assert yaml.safe_load(profiles_to_yaml([QosProfile()])) == [
        {"history": "unknown", "depth": 0, "reliability": "reliable", "durability": "volatile",
         "deadline": forever, "lifespan": forever, "liveliness": "automatic",
         "liveliness_lease_duration": forever, "avoid_ros_namespace_conventions": False}
    ]  # fmt: skip
    assert profiles_to_yaml([]) == "[]"
    assert profiles_from_yaml("") == ()
    offer = QosProfile(history="keep_last", depth=7, reliability="best_effort")
    (parsed,) = parse_qos(profiles_to_yaml([offer]))
    assert (parsed.history.name, parsed.depth) == ("KEEP_LAST", 7)
    assert (parsed.reliability.name, parsed.durability.name) == ("BEST_EFFORT", "VOLATILE")
    assert QosTime(parsed.deadline.sec, parsed.deadline.nsec) == INFINITE


def of(**changes: object) -> str:
    return yaml.safe_dump([msgspec.to_builtins(QosProfile()) | changes])


def test_profiles_survive_yaml_and_policies_by_number_are_those_of_the_rmw() -> None:
    offer = QosProfile("keep_last", 7, "best_effort", "transient_local", QosTime(3, 5))
    assert profiles_from_yaml(profiles_to_yaml([offer] * 2)) == (offer, offer)
    assert profiles_from_yaml(of(history=1, reliability=2, durability=1)) == (
        QosProfile(history="keep_last", reliability="best_effort", durability="transient_local"),
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (of(reliability=1.0), "Expected `str`, got `float`"),
        (of(reliability="sometimes"), "reliability is 'sometimes', but must be one of"),
        (of(depth=-1), "`int` >= 0 - at .*depth"),
        (of(deadline={"sec": math.inf, "nsec": 0}), "got `float` - at .*deadline.sec"),
        ("[", "not a"),
    ],
)
def test_what_is_no_list_of_profiles_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        profiles_from_yaml(text)
