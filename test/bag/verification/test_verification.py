# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A bag that is what rosbag2 writes passes; for every rule, one that breaks it is told so."""

import re
import zlib
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from tsobs_ros.bag import BagWriter, QosProfile
from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.mcap.records import FRAME, MAGIC, parse
from tsobs_ros.bag.metadata import profiles_to_yaml
from tsobs_ros.bag.verification import Verification, verify
from tsobs_ros.errors import BagReadError

STRING = "std_msgs/msg/String"
JOINTS = "sensor_msgs/msg/JointState"
DEFINITION = find_definition(STRING)
HELLO = b"\0\1\0\0\6\0\0\0hello\0"
# Of the names before the first joint: header, stamp, frame and an empty sequence of names.
EMPTY_JOINTS = b"\0\1\0\0" + bytes(8) + b"\1\0\0\0\0\0\0\0" + bytes(16)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A bag of two files, several chunks and a topic without messages."""
    with BagWriter(tmp_path / "bag", compression="none", max_duration_ns=10) as writer:
        writer.add_topic("/a", STRING, [QosProfile()])
        writer.add_topic("/joints", JOINTS)
        writer.add_topic("/silent", STRING)
        for time in range(5, 25):
            writer.write("/a", HELLO, time, time)
            writer.write("/joints", EMPTY_JOINTS, time, time)
            if time % 4 == 0:
                writer.flush()
    return tmp_path / "bag"


def texts(verification: Verification) -> tuple[list[str], list[str]]:
    return [str(f) for f in verification.errors], [str(f) for f in verification.remarks]


def assert_error(verification: Verification, pattern: str) -> None:
    errors, _ = texts(verification)
    assert not verification.holds
    assert any(re.search(pattern, error) for error in errors), errors


def assert_remark_only(verification: Verification, pattern: str) -> None:
    errors, remarks = texts(verification)
    assert errors == []
    assert verification.holds
    assert any(re.search(pattern, remark) for remark in remarks), remarks


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_bags_of_the_recorder_pass_without_a_remark(tmp_path: Path, compression: str) -> None:
    with BagWriter(
        tmp_path / "bag", compression=compression, max_size=200_000, custom_data={"a": "b"}
    ) as writer:
        writer.add_topic("/a", STRING, [QosProfile(), QosProfile(reliability="best_effort")])
        for number in range(2_000):
            writer.write("/a", HELLO + bytes(number % 4), 9_000 - number, number)
            if number % 50 == 0:
                writer.flush()
    verification = verify(tmp_path / "bag")
    assert texts(verification) == ([], [])
    assert verification.messages == 2_000
    assert verification.text() == f"{tmp_path / 'bag'}: OK, 2000 messages in 1 file"
    assert verification.as_mapping()["holds"]


def test_several_files_and_an_empty_bag_pass(bag: Path, tmp_path: Path) -> None:
    assert texts(verify(bag)) == ([], [])
    assert verify(bag).files == 2
    assert texts(verify(bag / "bag_1.mcap")) == ([], [])
    BagWriter(tmp_path / "empty").close()
    assert texts(verify(tmp_path / "empty")) == ([], [])


def test_bags_of_rosbags_pass_with_remarks(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    with RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/a", STRING, typestore=store)
        writer.write(connection, 5, HELLO)
    errors, remarks = texts(verify(tmp_path / "bag"))
    assert errors == []
    assert {remark.partition(": ")[2] for remark in remarks} == {
        "ros_distro is 'rosbags', not 'jazzy'",
        "the file 'bag.mcap' would be named 'bag_0.mcap' by rosbag2",
        "/a: the channel's metadata has no 'topic_type_hash'",
        "has 1 metadata records 'rosbag2', where rosbag2 writes 2",
    }


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(BagReadError, match="none: there is no such bag"):
        verify(tmp_path / "none")
    assert_error(verify(tmp_path), r"metadata\.yaml: there is none")


def edit(bag: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = bag / "metadata.yaml"
    content = yaml.safe_load(path.read_text())
    change(content["rosbag2_bagfile_information"])
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def topic(values: dict[str, Any]) -> dict[str, Any]:
    found = values["topics_with_message_count"][0]["topic_metadata"]
    assert isinstance(found, dict)
    return found


def other_topic(values: dict[str, Any], **changes: object) -> None:
    topic(values).update(changes)


QOS = QosProfile().to_map()


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        (lambda v: v.pop("version"), "the key 'version' is missing"),
        (lambda v: v.pop("ros_distro"), "the key 'ros_distro' is missing"),
        (lambda v: v.pop("custom_data"), "the key 'custom_data' is missing"),
        (lambda v: v.update(version=8), "version is 8, expected 9"),
        (lambda v: v.update(storage_identifier="sqlite3"), "storage_identifier is 'sqlite3'"),
        (lambda v: v.update(compression_mode="FILE"), "compression_mode is 'FILE'"),
        (lambda v: v.update(duration={"nanoseconds": 7}), "duration is stated as 7, but is 19"),
        (lambda v: v.update(duration={"nanoseconds": 7.5}), r"got `float` - at `\$\.duration"),
        (
            lambda v: v.update(starting_time={"nanoseconds_since_epoch": 4}),
            "starting_time is stated as 4, but is 5",
        ),
        (lambda v: v.update(message_count=3), "message_count is stated as 3, but is 40"),
        (
            lambda v: v["topics_with_message_count"][0].update(message_count=3),
            "message_count of /a is stated as 3, but is 20",
        ),
        (
            lambda v: v["topics_with_message_count"].append(
                deepcopy(v["topics_with_message_count"][0])
            ),
            "/a is listed more than once",
        ),
        (lambda v: v.update(topics_with_message_count={}), "is not a list of maps"),
        (lambda v: v["topics_with_message_count"].pop(0), "bag_0.mcap: /a: is not in metadata"),
        (lambda v: v["relative_file_paths"].reverse(), "relative_file_paths"),
        (lambda v: v["files"][0].update(path="../bag_0.mcap"), "relative_file_paths"),
        (lambda v: v["files"][1].update(message_count=1), "message_count of bag_1.mcap"),
        (
            lambda v: v["files"][0].update(starting_time={"nanoseconds_since_epoch": 1}),
            "starting_time_ns of bag_0.mcap is stated as 1, but is 5",
        ),
        (
            lambda v: v["files"][0].update(duration={"nanoseconds": 1}),
            "duration_ns of bag_0.mcap is stated as 1, but is 10",
        ),
        (
            lambda v: v["files"][0].update(message_count=-1),
            "`int` >= 0 - at .*message_count",
        ),
        (lambda v: v["files"][0].pop("duration"), "the key 'duration' is missing"),
        (lambda v: v.update(custom_data={"a": {"b": "c"}}), "custom_data is not a flat map"),
        (lambda v: v.update(custom_data=[1]), "custom_data is not a"),
        (lambda v: other_topic(v, name="no slash"), "'no slash' is not the name of a topic"),
        (lambda v: other_topic(v, type="String"), "'String' is not a type"),
        (lambda v: other_topic(v, type=JOINTS), f"type of /a is stated as {JOINTS}"),
        (lambda v: other_topic(v, serialization_format="json"), "is 'json', not 'cdr'"),
        (lambda v: other_topic(v, type_description_hash="RIHS01_12"), "'RIHS01_12', not RIHS01_"),
        (
            lambda v: other_topic(v, type_description_hash="RIHS01_" + "0" * 64),
            "/a: its type's hash is not the one in metadata",
        ),
        (lambda v: other_topic(v, offered_qos_profiles="- history: 1"), "is not a list"),
        (lambda v: other_topic(v, offered_qos_profiles=[]), "/a: its QoS is not the one in"),
        (
            lambda v: other_topic(v, offered_qos_profiles=[{**QOS, "depth": -1}]),
            "Expected `int` >= 0 - at .*depth",
        ),
        (
            lambda v: other_topic(v, offered_qos_profiles=[{**QOS, "history": "some"}]),
            "history is 'some'",
        ),
        (lambda v: topic(v).pop("type"), "the key 'type' is missing"),
    ],
)
def test_a_wrong_value_in_the_metadata_is_an_error(
    bag: Path, change: Callable[[dict[str, Any]], object], pattern: str
) -> None:
    edit(bag, change)
    assert_error(verify(bag), pattern)


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        (lambda v: v.update(ros_distro="kilted"), "ros_distro is 'kilted', not 'jazzy'"),
        (lambda v: v.update(compression_mode="NONE"), "are not empty"),
        (lambda v: v.update(novelty=1), "the key 'novelty' is none of rosbag2's"),
        (lambda v: v.update(custom_data={"a": "b"}), "its last record of metadata.yaml is another"),
    ],
)
def test_what_rosbag2_would_write_otherwise_is_a_remark(
    bag: Path, change: Callable[[dict[str, Any]], object], pattern: str
) -> None:
    edit(bag, change)
    assert_remark_only(verify(bag), pattern)


@pytest.mark.parametrize(
    "content", [b"", b"[", b"a: 1", b"rosbag2_bagfile_information: 1", b"\xff"]
)
def test_metadata_that_is_none_is_an_error(bag: Path, content: bytes) -> None:
    (bag / "metadata.yaml").write_bytes(content)
    verification = verify(bag)
    assert_error(verification, r"metadata\.yaml: (cannot be read|the key 'rosbag2_bagfile_inform)")
    assert verification.messages == 40


def test_files_that_are_missing_or_too_many_are_told(bag: Path) -> None:
    (bag / "bag_1.mcap").rename(bag / "bag_7.mcap")
    (bag / "notes.txt").write_text("")
    errors, remarks = texts(verify(bag))
    assert errors == [
        "metadata.yaml: the file 'bag_1.mcap' is not there",
        "bag_7.mcap: metadata.yaml does not list it: a reindexing would stumble",
    ]
    assert remarks == ["notes.txt: not part of a bag"]


@pytest.fixture
def short_bag(tmp_path: Path) -> Path:
    """A bag of one file."""
    with BagWriter(tmp_path / "short", compression="none") as writer:
        writer.add_topic("/a", STRING)
        writer.write("/a", HELLO, 5, 5)
    return tmp_path / "short"


def test_the_only_file_under_another_name_is_told(short_bag: Path) -> None:
    (short_bag / "short_0.mcap").rename(short_bag / "other.mcap")
    verification = verify(short_bag)
    assert texts(verification) == (
        ["metadata.yaml: the file 'short_0.mcap' is not there"],
        ["other.mcap: not part of a bag"],
    )
    assert verification.messages == 1


def list_as(bag: Path, name: str) -> None:
    """Let metadata.yaml call the bag's first file something else."""
    edit(bag, lambda v: (v["files"][0].update(path=name), v.update(relative_file_paths=[name])))


def test_a_path_that_is_more_than_a_name_is_told_and_its_file_checked(short_bag: Path) -> None:
    list_as(short_bag, "./short_0.mcap")
    edit(short_bag, lambda v: v["files"][0].update(message_count=2))
    verification = verify(short_bag)
    assert_error(verification, "the file './short_0.mcap' is not.* in the bag's own folder")
    assert_error(verification, r"message_count of \./short_0.mcap is stated as 2, but is 1")
    assert not any("does not list it" in error for error in texts(verification)[0])
    assert verification.messages == 1


@pytest.mark.parametrize("name", ["../outside.mcap", "{parent}/outside.mcap"])
def test_no_file_outside_of_the_folder_is_read(bag: Path, name: str) -> None:
    file_with(bag.parent / "outside.mcap", data=b"")
    name = name.format(parent=bag.parent)
    edit(bag, lambda v: v["files"][0].update(path=name))
    edit(bag, lambda v: v["relative_file_paths"].__setitem__(0, name))
    verification = verify(bag)
    assert (verification.files, verification.messages) == (1, 18)
    assert_error(verification, re.escape(f"the file '{name}' is not given by its name in the bag"))
    assert not any("outside.mcap" in finding.place for finding in verification.errors)


def test_a_name_that_no_file_can_have_is_told(short_bag: Path) -> None:
    list_as(short_bag, "x" * 300)
    assert_error(verify(short_bag), "the file 'x{300}' is not there")


def test_a_renamed_folder_is_a_remark(bag: Path) -> None:
    renamed = bag.rename(bag.with_name("other"))
    assert_remark_only(verify(renamed), "'bag_0.mcap' would be named 'other_0.mcap' by rosbag2")


def rewrite(path: Path, opcode: Opcode, change: Callable[[Any], object], nth: int = 0) -> None:
    """Change a record of a file, in place, and make the summary's checksum fit again."""
    data = bytearray(path.read_bytes())
    place, found, summary = len(MAGIC), 0, 0
    while place < len(data) - len(MAGIC):
        kind, length = FRAME.unpack_from(data, place)
        end = place + FRAME.size + length
        if kind == opcode:
            if found == nth:
                record = parse(kind, bytes(data[place + FRAME.size : end]))
                change(record)
                builder = RecordBuilder()
                record.write(builder)
                assert builder.count == end - place
                data[place:end] = builder.end()
            found += 1
        summary = end if kind == Opcode.DATA_END else summary
        place = end
    assert found > nth
    crc_place = len(data) - len(MAGIC) - 4
    data[crc_place : crc_place + 4] = zlib.crc32(data[summary:crc_place]).to_bytes(4, "little")
    path.write_bytes(data)


def setter(**values: object) -> Callable[[Any], object]:
    return lambda record: record.__dict__.update(values)


@pytest.mark.parametrize(
    ("opcode", "change", "pattern"),
    [
        (Opcode.HEADER, setter(profile="ros1"), "its profile is 'ros1', not 'ros2'"),
        (Opcode.STATISTICS, setter(message_count=9), "number of messages is stated as 9"),
        (Opcode.STATISTICS, setter(schema_count=9), "number of schemas is stated as 9"),
        (Opcode.STATISTICS, setter(channel_count=9), "number of channels is stated as 9"),
        (Opcode.STATISTICS, setter(chunk_count=9), "number of chunks is stated as 9"),
        (Opcode.STATISTICS, setter(metadata_count=9), "number of metadata records is stated as 9"),
        (Opcode.STATISTICS, setter(attachment_count=9), "number of attachments is stated as 9"),
        (Opcode.STATISTICS, setter(message_start_time=9), "smallest log time is stated as 9"),
        (Opcode.STATISTICS, setter(message_end_time=9), "largest log time is stated as 9"),
        (
            Opcode.STATISTICS,
            setter(channel_message_counts={1: 9, 2: 9}),
            "messages by channel is stated as",
        ),
        (Opcode.CHUNK_INDEX, setter(message_start_time=1), "message_start_time of the chunk"),
        (Opcode.CHUNK_INDEX, setter(message_end_time=1), "message_end_time of the chunk"),
        (Opcode.CHUNK_INDEX, setter(chunk_length=1), "chunk_length of the chunk"),
        (Opcode.CHUNK_INDEX, setter(compressed_size=1), "compressed_size of the chunk"),
        (Opcode.CHUNK_INDEX, setter(uncompressed_size=1), "uncompressed_size of the chunk"),
        (Opcode.CHUNK_INDEX, setter(message_index_length=1), "message_index_length of the chunk"),
        (
            Opcode.CHUNK_INDEX,
            setter(message_index_offsets={1: 5, 2: 6}),
            "message_index_offsets of the chunk",
        ),
        (Opcode.CHUNK_INDEX, setter(chunk_start_offset=1), "no index of the chunk at byte"),
        (Opcode.CHUNK_INDEX, setter(chunk_start_offset=1), "chunk at byte 1, where none is"),
        (
            Opcode.MESSAGE_INDEX,
            lambda r: r.records.__setitem__(0, (6, r.records[0][1])),
            "the index of channel 1 at byte .* is not that of its chunk",
        ),
        (Opcode.MESSAGE_INDEX, setter(channel_id=3), "has no message index of channel 1"),
        (Opcode.METADATA_INDEX, setter(offset=5), "metadata at byte 5, as is none"),
        (Opcode.METADATA_INDEX, setter(offset=5), "no index of the metadata record at byte"),
        (Opcode.SCHEMA, setter(encoding="ros2xyz"), "does not repeat the schema of std_msgs"),
        (Opcode.CHANNEL, setter(topic="/b"), "does not repeat the channel of /a"),
        (Opcode.SUMMARY_OFFSET, setter(group_start=5), "records of kind 0x03 are not at"),
        (Opcode.FOOTER, setter(summary_offset_start=5), "beginning of the summary offsets is"),
        (Opcode.DATA_END, setter(data_section_crc=5), "checksum of the data section is wrong"),
        (
            Opcode.METADATA,
            lambda r: setattr(r, "metadata", {"serialized_metadatA": _only(r.metadata)}),
            "has the keys 'serialized_metadatA'",
        ),
        (
            Opcode.METADATA,
            lambda r: setattr(r, "metadata", {"serialized_metadata": "[" * len(_only(r.metadata))}),
            "serialized_metadata cannot be read",
        ),
    ],
)
def test_a_wrong_record_is_an_error(
    bag: Path, opcode: Opcode, change: Callable[[Any], object], pattern: str
) -> None:
    rewrite(bag / "bag_0.mcap", opcode, change)
    assert_error(verify(bag), pattern)


def _only(values: dict[str, str]) -> str:
    (value,) = values.values()
    return value


def replace(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new))


@pytest.mark.parametrize(
    ("damage", "pattern"),
    [
        (lambda p: replace(p, b"hello", b"HELLO"), "checksum .*tsobs bag recover"),
        (lambda p: p.write_bytes(p.read_bytes()[:-1]), "has no end, .*tsobs bag recover"),
        (lambda p: p.write_bytes(b""), "not an MCAP file"),
        (lambda p: p.write_bytes(MAGIC * 2), "the file is damaged: the record at byte 8"),
        (
            lambda p: p.write_bytes(p.read_bytes()[:-8] + b"more" + MAGIC),
            "4 bytes follow the footer",
        ),
        (
            lambda p: p.write_bytes(p.read_bytes()[:-12] + b"abcd" + MAGIC),
            "the checksum of the summary is wrong",
        ),
        (
            lambda p: p.write_bytes(MAGIC + p.read_bytes()[p.read_bytes().index(b"\x0c") :]),
            "expected a header at byte 8",
        ),
    ],
)
def test_a_damaged_file_is_an_error(
    bag: Path, damage: Callable[[Path], object], pattern: str
) -> None:
    damage(bag / "bag_0.mcap")
    verification = verify(bag)
    assert_error(verification, pattern)
    assert not any(error.startswith("bag_1.mcap") for error in texts(verification)[0])


CHANNEL = {
    "offered_qos_profiles": profiles_to_yaml([QosProfile()]),
    "topic_type_hash": DEFINITION.type_hash,
}


def file_with(
    path: Path,
    *,
    schema: tuple[str, str, bytes] = (STRING, "ros2msg", DEFINITION.text.encode()),
    channel: tuple[str, str] = ("/a", "cdr"),
    schema_id: int = 1,
    metadata: dict[str, str] | None = None,
    data: bytes = HELLO,
    log_time: int = 5,
    publish_time: int = 5,
    sequence: int = 0,
    channel_id: int = 1,
    add: Callable[[Writer], object] = lambda _: None,
    **options: Any,
) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, **options)
        writer.start(profile="ros2")
        for _ in range(2):
            writer.add_metadata(
                "rosbag2",
                {"serialized_metadata": EMPTY_METADATA},
            )
        writer.register_schema(*schema)
        writer.register_channel(*channel, schema_id, CHANNEL if metadata is None else metadata)
        add(writer)
        writer.add_message(channel_id, log_time, data, publish_time, sequence)
        writer.finish()
    return path


EMPTY_METADATA = yaml.safe_dump(
    {
        "version": 9,
        "compression_mode": "",
        "topics_with_message_count": [],
        "relative_file_paths": [],
        "files": [],
        "custom_data": None,
        "ros_distro": "jazzy",
        "storage_identifier": "mcap",
    }
)


def defined(text: str) -> tuple[str, str, bytes]:
    return (STRING, "ros2msg", text.encode())


SEPARATOR = "=" * 80


@pytest.mark.parametrize(
    ("options", "pattern"),
    [
        ({"schema": ("String", "ros2msg", b"string data\n")}, "'String' is not named as"),
        ({"schema": (STRING, "jsonschema", b"{}")}, "defined in 'jsonschema', not in ros2msg"),
        ({"schema": defined("what is this?\n")}, "definition of std_msgs/msg/String is malformed"),
        ({"schema": defined("Other data\n")}, "std_msgs/Other is used, but not defined"),
        ({"schema": defined(f"int8 a\n\n{SEPARATOR}\nX: a/B\n")}, "is not 'MSG: package/Type'"),
        (
            {"schema": defined(f"A a\n\n{SEPARATOR}\nMSG: std_msgs/A\nA a\n")},
            "std_msgs/A contains itself",
        ),
        ({"schema": (STRING, "ros2msg", b"string \xff\n")}, "is malformed"),
        ({"channel": ("/a", "json")}, "/a: is encoded in 'json', not in cdr"),
        ({"schema_id": 7}, "/a: has the schema 7, which is not there before it"),
        ({"metadata": {**CHANNEL, "topic_type_hash": "x"}}, "topic_type_hash is 'x'"),
        ({"metadata": {**CHANNEL, "offered_qos_profiles": "["}}, "/a: not a list of QoS profiles"),
        ({"channel_id": 7}, "a message is of channel 7, which is not there before it"),
        ({"log_time": 2**63}, "/a: a time does not fit 63 bits: log 9223372036854775808 ns"),
        ({"publish_time": 2**63}, "/a: a time does not fit 63 bits"),
        ({"data": HELLO[:-3]}, "/a: the message at 5 ns is not whole: its values need 14 bytes"),
        ({"data": HELLO[:6]}, "/a: the message at 5 ns is not whole"),
        ({"data": b""}, "not begin with the header of plain CDR"),
        ({"data": b"\0\3" + HELLO[2:]}, "not begin with the header of plain CDR"),
        ({"data": HELLO[:-1] + b"x"}, "the text at byte 8 does not end in a zero byte"),
        ({"data": HELLO + bytes(4)}, "/a: the message at 5 ns is not whole: 4 bytes follow"),
        (
            {"add": lambda w: w.register_channel("/a", "cdr", 1, CHANNEL)},
            "/a: has more than one channel",
        ),
        ({"repeat_schemas": False}, "does not repeat the schema"),
        ({"repeat_channels": False}, "does not repeat the channel"),
        ({"use_statistics": False}, "has no statistics"),
        ({"index_types": IndexType.NONE}, "has no index of the chunk"),
        ({"index_types": IndexType.CHUNK | IndexType.METADATA}, "has no message index of channel"),
        (
            {
                "repeat_schemas": False,
                "repeat_channels": False,
                "use_statistics": False,
                "use_summary_offsets": False,
                "index_types": IndexType.NONE,
            },
            "has no summary",
        ),
    ],
)
def test_wrong_content_is_an_error(tmp_path: Path, options: dict[str, Any], pattern: str) -> None:
    assert texts(verify(file_with(tmp_path / "good.mcap"))) == ([], [])
    assert_error(verify(file_with(tmp_path / "x.mcap", **options)), pattern)


@pytest.mark.parametrize(
    ("options", "pattern"),
    [
        ({"metadata": {}}, "/a: the channel's metadata has no 'topic_type_hash'"),
        ({"metadata": {**CHANNEL, "more": ""}}, "metadata has 'more', which is none of rosbag2's"),
        ({"schema": (STRING, "ros2idl", b"x")}, "is defined in IDL: its messages are not looked"),
        ({"schema": defined("wstring a\n")}, "has a wstring: its messages are not looked into"),
        ({"log_time": 0}, "/a: a message has the log time 0"),
        ({"sequence": 3}, "/a: a message has the sequence 3, rosbag2 writes 0"),
        ({"use_chunking": False}, "has 1 messages outside of chunks"),
        ({"add": lambda w: w.add_metadata("other", {})}, "has the metadata record 'other'"),
        ({"add": lambda w: w.add_attachment(1, 1, "a", "b", b"c")}, "has an attachment"),
        (
            {"add": lambda w: w.add_metadata("rosbag2", {"serialized_metadata": EMPTY_METADATA})},
            "has 3 metadata records 'rosbag2', where rosbag2 writes 2",
        ),
        ({"data": HELLO + bytes(3)}, ""),
        ({"enable_data_crcs": True, "enable_crcs": False}, ""),
    ],
)
def test_unusual_content_is_a_remark_at_most(
    tmp_path: Path, options: dict[str, Any], pattern: str
) -> None:
    verification = verify(file_with(tmp_path / "x.mcap", **options))
    if pattern:
        assert_remark_only(verification, pattern)
    else:
        assert texts(verification) == ([], [])


def test_all_reasons_are_told_and_like_ones_counted(bag: Path) -> None:
    edit(bag, lambda v: (v.update(version=8), v.update(message_count=1)))
    rewrite(bag / "bag_0.mcap", Opcode.STATISTICS, setter(message_count=9, chunk_count=9))
    assert len(verify(bag).errors) >= 4
    path = bag.parent / "many.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        writer.register_schema(STRING, "ros2msg", DEFINITION.text.encode())
        writer.register_channel("/a", "cdr", 1, CHANNEL)
        for time in range(9):
            writer.add_message(1, time + 1, HELLO[:-1], 0)
        writer.finish()
    (error,) = verify(path).errors
    assert (error.place, error.cases) == ("many.mcap: /a", 9)
    assert str(error).endswith("(and 8 more)")
    assert "NOT sound, 1 error, 9 messages in 1 file" in verify(path).text()


def test_records_of_other_kinds_are_refused_where_they_do_not_belong(tmp_path: Path) -> None:
    builder = RecordBuilder()
    records.Header(profile="ros2", library="").write(builder)
    records.Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0).write(builder)
    path = tmp_path / "x.mcap"
    path.write_bytes(MAGIC + builder.end() + MAGIC)
    assert_error(verify(path), "the record at byte .* belongs behind the data")
