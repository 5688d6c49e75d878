# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""metadata.yaml has every key rosbag2 asks for, comes back as written, and is checked."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tsobs_ros.bag.metadata import (
    EMPTY_START_NS,
    BagMetadata,
    FileMetadata,
    TopicMetadata,
    read_metadata,
    write_metadata,
)
from tsobs_ros.bag.qos import QosProfile
from tsobs_ros.errors import BagReadError, BagWriteError

METADATA = BagMetadata(
    topics=(
        TopicMetadata("/a", "std_msgs/msg/String", 3, (QosProfile(),), "RIHS01_" + "0" * 64),
        TopicMetadata("/b", "std_msgs/msg/Empty"),
    ),
    files=(
        FileMetadata("bag_0.mcap", 1_000, 500, 2),
        FileMetadata("bag_1.mcap", 1_400, 600, 1),
        FileMetadata("bag_2.mcap"),
    ),
    custom_data={"why": "Prüfstand: 1"},
)


def test_every_key_of_the_format_is_written(tmp_path: Path) -> None:
    write_metadata(tmp_path, METADATA)
    content = yaml.safe_load((tmp_path / "metadata.yaml").read_text(encoding="utf-8"))
    information = content.pop("rosbag2_bagfile_information")
    assert content == {}
    assert list(information) == [
        "version",
        "storage_identifier",
        "duration",
        "starting_time",
        "message_count",
        "topics_with_message_count",
        "compression_format",
        "compression_mode",
        "relative_file_paths",
        "files",
        "custom_data",
        "ros_distro",
    ]
    assert information["version"] == 9
    assert information["storage_identifier"] == "mcap"
    assert information["duration"] == {"nanoseconds": 1_000}
    assert information["starting_time"] == {"nanoseconds_since_epoch": 1_000}
    assert information["message_count"] == 3
    assert information["compression_format"] == information["compression_mode"] == ""
    assert information["relative_file_paths"] == ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"]
    assert information["files"][1] == {
        "path": "bag_1.mcap",
        "starting_time": {"nanoseconds_since_epoch": 1_400},
        "duration": {"nanoseconds": 600},
        "message_count": 1,
    }
    assert information["topics_with_message_count"][0] == {
        "topic_metadata": {
            "name": "/a",
            "type": "std_msgs/msg/String",
            "serialization_format": "cdr",
            "offered_qos_profiles": [QosProfile().to_map()],
            "type_description_hash": "RIHS01_" + "0" * 64,
        },
        "message_count": 3,
    }
    assert (
        information["topics_with_message_count"][1]["topic_metadata"]["offered_qos_profiles"] == []
    )
    assert information["custom_data"] == {"why": "Prüfstand: 1"}
    assert information["ros_distro"] == "jazzy"


def test_an_empty_bag_starts_at_the_end_of_time() -> None:
    empty = BagMetadata(topics=(), files=(FileMetadata("bag_0.mcap"),))
    assert (empty.starting_time_ns, empty.duration_ns, empty.message_count) == (
        9223372036854775807,
        0,
        0,
    )
    assert empty.to_map()["custom_data"] is None


names = st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), min_size=1, max_size=9)
texts = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), max_size=20)


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    max_examples=50,
)
@given(
    topics=st.lists(st.builds(TopicMetadata, names, names, st.integers(0, 10**12))),
    files=st.lists(
        st.builds(FileMetadata, names, st.integers(0, EMPTY_START_NS), st.integers(0, 2**60))
    ),
    custom_data=st.none() | st.dictionaries(texts, texts, min_size=1),
)
def test_metadata_comes_back_as_written(
    tmp_path: Path,
    topics: list[TopicMetadata],
    files: list[FileMetadata],
    custom_data: dict[str, str] | None,
) -> None:
    metadata = BagMetadata(tuple(topics), tuple(files), custom_data)
    write_metadata(tmp_path, metadata)
    assert read_metadata(tmp_path) == metadata


def test_writing_again_replaces_and_leaves_nothing_else(tmp_path: Path) -> None:
    write_metadata(tmp_path, replace(METADATA, custom_data=None))
    write_metadata(tmp_path, METADATA)
    assert [path.name for path in tmp_path.iterdir()] == ["metadata.yaml"]
    assert read_metadata(tmp_path) == METADATA


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(BagWriteError, match=r"gone/metadata\.yaml: cannot write it"):
        write_metadata(tmp_path / "gone", METADATA)
    with pytest.raises(BagReadError, match=r"gone: not a bag folder, it has no metadata\.yaml"):
        read_metadata(tmp_path / "gone")


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
        (lambda information: information.pop("files"), "the key 'files' is missing"),
        (lambda information: information.pop("custom_data"), "the key 'custom_data' is missing"),
        (_set("version", to=8), "version is 8, only 9 is supported"),
        (
            _set("files", 0, "message_count", to=-1),
            "message_count is -1, but must be a whole number",
        ),
        (_set("files", 0, "duration", "nanoseconds", to=0.5), "nanoseconds is 0.5, but must be"),
        (_set("files", 0, "path", to="other.mcap"), "but relative_file_paths"),
        (_set("files", to=None), "not the metadata of a bag"),
        (_set("topics_with_message_count", 0, "message_count", to="3"), "must be a whole number"),
        (
            _set("topics_with_message_count", 0, "topic_metadata", "offered_qos_profiles", to="x"),
            "not the metadata of a bag",
        ),
        (_set("compression_mode", to="MESSAGE"), "compressed by file or by message"),
    ],
)
def test_what_is_no_metadata_is_refused(
    tmp_path: Path, change: Callable[[Any], None], message: str
) -> None:
    information = yaml.safe_load(METADATA.to_yaml())
    change(information)
    path = tmp_path / "metadata.yaml"
    path.write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
    with pytest.raises(BagReadError, match=rf"metadata\.yaml: .*{message}"):
        read_metadata(tmp_path)


@pytest.mark.parametrize("content", [b"", b"[]", b"a: b", b"{", b"\xff\xfe\xff"])
def test_what_is_no_yaml_of_a_bag_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "metadata.yaml").write_bytes(content)
    with pytest.raises(BagReadError, match=r"metadata\.yaml: "):
        read_metadata(tmp_path)


def test_a_name_that_no_file_can_have_is_refused(tmp_path: Path) -> None:
    write_metadata(tmp_path, replace(METADATA, files=(FileMetadata("bag\0.mcap"),)))
    with pytest.raises(BagReadError, match=r"'bag\\x00.mcap' cannot be a file's name"):
        read_metadata(tmp_path)
