# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sound bags pass verification, and each thing a reader would stumble over is an error."""

import os
import re
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from foreign import STRING, cdr, places, write_mcap
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import IndexType

from tsobs_ros.bag import BagWriter, QosProfile
from tsobs_ros.bag.container import MAGIC, parse_record
from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.verification import Verification, verify
from tsobs_ros.errors import BagReadError

HELLO = cdr("hello")
DEFINITION = find_definition(STRING)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A bag of two files, several chunks and a topic without messages."""
    with BagWriter(tmp_path / "bag", compression="none", max_duration_ns=10) as writer:
        writer.add_topic("/a", STRING, [QosProfile()])
        writer.add_topic("/b", STRING)
        writer.add_topic("/silent", STRING)
        for time in range(5, 25):
            writer.write("/a", HELLO, time, time)
            writer.write("/b", HELLO, time, time)
            if time % 4 == 0:
                writer.flush()
    return tmp_path / "bag"


def assert_error(verification: Verification, pattern: str) -> None:
    errors = verification.errors
    assert not verification.holds
    assert any(re.search(pattern, error) for error in errors), errors


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_bags_of_the_recorder_pass(tmp_path: Path, compression: str) -> None:
    with BagWriter(
        tmp_path / "bag", compression=compression, max_size=200_000, custom_data={"a": "b"}
    ) as writer:
        writer.add_topic("/a", STRING, [QosProfile(), QosProfile(reliability="best_effort")])
        for number in range(2_000):
            writer.write("/a", HELLO + bytes(number % 4), 9_000 - number, number)
            if number % 50 == 0:
                writer.flush()
    verification = verify(tmp_path / "bag")
    assert verification.errors == ()
    assert verification.text() == f"{tmp_path / 'bag'}: OK; files: 1, messages: 2000"
    assert verification.as_mapping()["messages"] == 2_000


def test_several_files_one_file_an_empty_bag_and_a_renamed_folder_pass(
    bag: Path, tmp_path: Path
) -> None:
    BagWriter(tmp_path / "empty").close()
    for path, files in ((bag, 2), (bag / "bag_1.mcap", 1), (tmp_path / "empty", 1)):
        assert (verify(path).files, verify(path).errors) == (files, ())
    assert verify(bag.rename(tmp_path / "other")).holds


def edit(bag: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = bag / "metadata.yaml"
    content = yaml.safe_load(path.read_text())
    change(content["rosbag2_bagfile_information"])
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def other_topic(values: dict[str, Any], **changes: object) -> None:
    values["topics_with_message_count"][0]["topic_metadata"].update(changes)


def list_first_as(values: dict[str, Any], name: str) -> None:
    values["files"][0].update(path=name)
    values["relative_file_paths"][0] = name


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        (lambda v: v.update(storage_identifier="sqlite3"), "is stated as sqlite3, but is mcap"),
        (lambda v: v.update(duration={"nanoseconds": 7}), "duration: .* is stated as 7, but is 19"),
        (lambda v: v["topics_with_message_count"].pop(0), "topics: /a is stated as None, but is"),
        (
            lambda v: v["files"][0].update(duration={"nanoseconds": 1}),
            r"files: bag_0.mcap: duration: .* is stated as 1, but is 10",
        ),
        (lambda v: other_topic(v, type="a/msg/B"), "/a: type is stated as a/msg/B"),
        (lambda v: other_topic(v, offered_qos_profiles=[]), "/a: offered_qos_profiles is stated"),
        (lambda v: list_first_as(v, "./bag_0.mcap"), r"'\./bag_0.mcap' is not given by its name"),
    ],
)
def test_metadata_that_does_not_agree_is_an_error(
    bag: Path, change: Callable[[dict[str, Any]], object], pattern: str
) -> None:
    edit(bag, change)
    assert_error(verify(bag), pattern)


@pytest.mark.parametrize("content", [b"rosbag2_bagfile_information: 1", None])
def test_without_metadata_the_files_are_checked(bag: Path, content: bytes | None) -> None:
    path = bag / "metadata.yaml"
    path.unlink() if content is None else path.write_bytes(content)
    verification = verify(bag)
    assert_error(verification, r"^metadata\.yaml: " + ("" if content else ".*it has no"))
    assert (len(verification.errors), verification.messages) == (1, 40)


def test_files_that_are_missing_or_too_many_are_errors(bag: Path) -> None:
    (bag / "bag_1.mcap").rename(bag / "bag_7.mcap")
    (bag / "notes.txt").write_text("")
    assert verify(bag).errors == (
        "metadata.yaml: the file 'bag_1.mcap' is not there",
        "bag_7.mcap: metadata.yaml does not list it: a reindexing would stumble over it",
    )
    with pytest.raises(BagReadError, match="none: there is no such file"):
        verify(bag / "none")


@pytest.mark.parametrize("name", ["../outside.mcap", "{parent}/outside.mcap"])
def test_no_file_outside_of_the_folder_is_read(bag: Path, name: str) -> None:
    file_with(bag.parent / "outside.mcap", data=b"")
    edit(bag, lambda v: list_first_as(v, name.format(parent=bag.parent)))
    verification = verify(bag)
    assert (verification.files, verification.messages) == (1, 18)
    assert not any("outside.mcap: " in error for error in verification.errors)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero")])
def test_what_is_no_regular_file_is_not_opened(bag: Path, make: Callable[[Path], object]) -> None:
    (bag / "bag_0.mcap").unlink()
    make(bag / "bag_0.mcap")
    verification = verify(bag)
    assert_error(verification, "bag_0.mcap: cannot read it: not a regular file")
    assert verification.messages == 18


def rewritten(opcode: Opcode, **values: object) -> Callable[[bytes], bytes]:
    """Change the first record of a kind, in place, and make the summary's checksum fit again."""

    def change(data: bytes) -> bytes:
        at, end = places(data, opcode)[0]
        record, builder = parse_record(data[at:end]), RecordBuilder()
        record.__dict__.update(values)
        record.write(builder)
        data = data[:at] + builder.end() + data[end:]
        summary, crc_at = places(data, Opcode.DATA_END)[0][1], len(data) - len(MAGIC) - 4
        crc = zlib.crc32(data[summary:crc_at]).to_bytes(4, "little")
        return data[:crc_at] + crc + data[crc_at + 4 :]

    return change


def overwritten(opcode: Opcode, place: int, new: bytes) -> Callable[[bytes], bytes]:
    """Overwrite some bytes of the first record of a kind."""

    def change(data: bytes) -> bytes:
        at = places(data, opcode)[0][0] + place
        return data[:at] + new + data[at + len(new) :]

    return change


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        (rewritten(Opcode.HEADER, profile="ros1"), "profile is stated as ros1, but is ros2"),
        (rewritten(Opcode.STATISTICS, message_count=9), "number of messages is stated as 9"),
        (
            rewritten(Opcode.STATISTICS, channel_message_counts={1: 9}),
            "by channel: 1 is stated as 9",
        ),
        (rewritten(Opcode.CHUNK_INDEX, message_start_time=1), "index of the file does not state"),
        (rewritten(Opcode.CHUNK_INDEX, chunk_length=1), "index of the file does not state"),
        (
            rewritten(Opcode.CHUNK_INDEX, message_index_offsets={1: 5, 2: 6}),
            "channel 1 at byte 5 is not that of its chunk",
        ),
        (rewritten(Opcode.CHUNK_INDEX, chunk_start_offset=1), "chunks .* is stated as None"),
        (rewritten(Opcode.MESSAGE_INDEX, channel_id=3), "channel 1 at .* is not that of"),
        (
            overwritten(Opcode.MESSAGE_INDEX, 15, b"\x07"),
            "channel 1 at .* is not that of its chunk",
        ),
        (rewritten(Opcode.SCHEMA, encoding="ros2xyz"), "two descriptions of schema 1"),
        (rewritten(Opcode.CHANNEL, topic="/b"), "two descriptions of channel 1"),
        (overwritten(Opcode.CHUNK, 6, b"\xff"), "at byte .* not a record"),
        (lambda d: d.replace(b"hello", b"HELLO"), "at byte .* checksum .*tsobs bag recover"),
        (lambda d: d[:-1], "has no end.*tsobs bag recover"),
        (lambda d: d[:-12] + b"abcd" + MAGIC, "checksum .* of its summary"),
    ],
)
def test_a_damaged_file_is_an_error(
    bag: Path, change: Callable[[bytes], bytes], pattern: str
) -> None:
    path = bag / "bag_0.mcap"
    path.write_bytes(change(path.read_bytes()))
    verification = verify(bag)
    assert_error(verification, pattern)
    assert not any(error.startswith("bag_1.mcap") for error in verification.errors)


CHANNEL = {"offered_qos_profiles": "[]", "topic_type_hash": DEFINITION.type_hash}
A = ("/a", "cdr", 1, CHANNEL)


def file_with(
    path: Path,
    *,
    schema: tuple[str, str, bytes] = (STRING, "ros2msg", DEFINITION.text.encode()),
    data: bytes = HELLO,
    log_time: int = 5,
    channel_id: int = 1,
    channels: Sequence[tuple[str, str, int, dict[str, str]]] = (A,),
    **options: Any,
) -> Path:
    messages = [(channel_id, log_time, data, 5)] * 3
    return write_mcap(path, messages, schemas=[schema], channels=channels, **options)


@pytest.mark.parametrize(
    ("options", "pattern"),
    [
        ({"schema": ("String", "ros2msg", b"string data\n")}, "'String' is not named as"),
        ({"schema": (STRING, "ros2xyz", b"")}, "is defined in 'ros2xyz', not in ros2msg"),
        ({"channels": [("/a", "json", 1, CHANNEL)]}, "/a: is encoded in 'json', not in cdr"),
        ({"channels": [("/a", "cdr", 7, CHANNEL)]}, "/a: has no type"),
        ({"channels": [("/a", "cdr", 1, {"offered_qos_profiles": "["})]}, "/a: not a list of QoS"),
        ({"channel_id": 7}, "channel 7 is not described before"),
        ({"log_time": 2**63}, "/a: times do not fit 63 bits"),
        ({"channels": [A, A]}, "more than one channel"),
        ({"repeat_schemas": False}, "schemas: 1 is stated as None"),
        ({"use_statistics": False}, "has no index; 'tsobs bag recover'"),
        ({"index_types": IndexType.CHUNK | IndexType.METADATA}, "has no message index of channel"),
    ],
)
def test_wrong_content_is_an_error(tmp_path: Path, options: dict[str, Any], pattern: str) -> None:
    assert verify(file_with(tmp_path / "good.mcap", attachment=True)).errors == ()
    assert_error(verify(file_with(tmp_path / "x.mcap", **options)), pattern)


def test_messages_without_a_checksum_are_counted(tmp_path: Path) -> None:
    found = verify(file_with(tmp_path / "x.mcap", enable_crcs=False))
    assert (found.errors, found.unchecked) == ((), 3)
    assert "OK, but 3 UNCHECKED" in found.text()
