# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Topics as CSV and Parquet: any type, nothing lost, units where they are known."""

import csv
import math
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from tsobs_ros.bag import BagWriter
from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.errors import BagReadError, ExportError
from tsobs_ros.report.export import export_bag

TYPES = get_typestore(Stores.ROS2_JAZZY)
START = 1_700_000_000_000_000_000
STRING = "std_msgs/msg/String"
TEXT = b"\0\1\0\0\6\0\0\0hello\0"


def made(type_: str, **fields: Any) -> Any:
    """Return a message of rosbags."""
    return TYPES.types[type_](**fields)


def header(stamp: int = START) -> Any:
    sec, nanosec = divmod(stamp, 10**9)
    time = made("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return made("std_msgs/msg/Header", stamp=time, frame_id="base")


def vector(x: float) -> Any:
    return made("geometry_msgs/msg/Vector3", x=x, y=0.0, z=-x)


@pytest.fixture
def write_bag(tmp_path: Path) -> Callable[..., Path]:
    """Write messages of rosbags, a second apart, to `tmp_path/bag`."""

    def write(**topics: list[Any]) -> Path:
        with BagWriter(tmp_path / "bag") as writer:
            for name, messages in topics.items():
                type_ = messages[0].__msgtype__
                text, _ = TYPES.generate_msgdef(type_, ros_version=2)
                writer.add_topic(f"/{name}", type_, definition=MessageDefinition(type_, text, ""))
                for place, message in enumerate(messages):
                    time = START + place * 10**9
                    data = bytes(TYPES.serialize_cdr(message, type_))
                    writer.write(f"/{name}", data, time, time - 1)
        return tmp_path / "bag"

    return write


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def twist(x: float) -> Any:
    return made("geometry_msgs/msg/Twist", linear=vector(x), angular=vector(2 * x))


def joint_state(names: list[str], position: list[float]) -> Any:
    empty = np.zeros(0)
    return made(
        JOINT_STATE,
        header=header(),
        name=names,
        position=np.array(position, dtype=np.float64),
        velocity=empty,
        effort=empty,
    )


def test_nested_fields_have_columns_with_their_units(write_bag, tmp_path) -> None:
    (exported,) = export_bag(write_bag(cmd=[twist(0.5)]), tmp_path)

    assert exported.path == tmp_path / "cmd.csv"
    assert rows(exported.path) == [
        {
            "time [s]": "0.0",
            "log_time [ns]": str(START),
            "publish_time [ns]": str(START - 1),
            "linear.x [m/s]": "0.5",
            "linear.y [m/s]": "0.0",
            "linear.z [m/s]": "-0.5",
            "angular.x [rad/s]": "1.0",
            "angular.y [rad/s]": "0.0",
            "angular.z [rad/s]": "-1.0",
        }
    ]


def test_joints_keep_their_columns_whatever_their_order(write_bag, tmp_path) -> None:
    messages = [joint_state(["a", "b"], [1.0, 2.0]), joint_state(["b", "c"], [3.0, math.nan])]

    export_bag(write_bag(joints=messages), tmp_path)

    first, second = rows(tmp_path / "joints.csv")
    assert first["header.stamp [ns]"] == str(START)
    columns = [f"position.{joint} [rad]" for joint in "abc"]
    assert [first[column] for column in columns] == ["1.0", "2.0", ""]
    assert [second[column] for column in columns] == ["", "3.0", "nan"]


def test_arrays_of_varying_length(write_bag, tmp_path) -> None:
    layout = made("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    arrays = [
        made("std_msgs/msg/Float64MultiArray", layout=layout, data=np.arange(float(length)))
        for length in (2, 0, 3)
    ]

    export_bag(write_bag(data=arrays), tmp_path)

    assert [[row.get(f"data[{k}]") for k in range(3)] for row in rows(tmp_path / "data.csv")] == [
        ["0.0", "1.0", ""],
        ["", "", ""],
        ["0.0", "1.0", "2.0"],
    ]


@pytest.mark.parametrize("format_", ["csv", "parquet"])
def test_long_arrays_stay_in_one_column(write_bag, tmp_path, format_) -> None:
    layout = made("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    arrays = [
        made("std_msgs/msg/Float64MultiArray", layout=layout, data=np.arange(float(length)))
        for length in (2, 65)
    ]

    (exported,) = export_bag(write_bag(data=arrays), tmp_path, format=format_)

    if format_ == "csv":
        assert rows(exported.path)[0]["data"] == "[0.0, 1.0]"
        assert exported.columns == 5
    else:
        column = pq.read_table(exported.path)["data"].to_pylist()
        assert column == [[0.0, 1.0], [float(k) for k in range(65)]]


def test_texts_bytes_and_lists_of_messages(write_bag, tmp_path) -> None:
    value = made("diagnostic_msgs/msg/KeyValue", key='a "key", with', value="ü\nä")
    status = made(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=2,
        name="name",
        message="",
        hardware_id="",
        values=[value],
    )
    array = made("diagnostic_msgs/msg/DiagnosticArray", header=header(), status=[status])
    image = made(
        "sensor_msgs/msg/CompressedImage",
        header=header(),
        format="png",
        data=np.array([0, 255, 16], dtype=np.uint8),
    )

    export_bag(write_bag(diagnostics=[array], image=[image]), tmp_path)
    export_bag(tmp_path / "bag", tmp_path, topics=["/image"], format="parquet")

    (row,) = rows(tmp_path / "diagnostics.csv")
    assert row["status[0].level"] == "2"
    assert row["status[0].values[0].key"] == 'a "key", with'
    assert row["status[0].values[0].value"] == "ü\nä"
    assert rows(tmp_path / "image.csv")[0]["data"] == "00ff10"
    assert pq.read_table(tmp_path / "image.parquet")["data"].to_pylist() == [b"\0\xff\x10"]


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1"])
def test_texts_are_no_formulas_and_numbers_stay_numbers(write_bag, tmp_path, text) -> None:
    frame = header()
    frame.frame_id = text
    temperature = made("sensor_msgs/msg/Temperature", header=frame, temperature=-1.5, variance=0.0)

    export_bag(write_bag(t=[temperature]), tmp_path)
    export_bag(tmp_path / "bag", tmp_path, format="parquet")

    (row,) = rows(tmp_path / "t.csv")
    assert row["header.frame_id"] == f"'{text}"
    assert row["temperature [degC]"] == "-1.5"
    assert pq.read_table(tmp_path / "t.parquet")["header.frame_id"].to_pylist() == [text]


@given(st.lists(st.floats(allow_subnormal=True), min_size=1, max_size=5))
def test_numbers_come_back_to_the_last_bit(tmp_path_factory, numbers) -> None:
    folder = tmp_path_factory.mktemp("export")
    encode = JointStateEncoder([f"j{k}" for k in range(len(numbers))])
    definition = MessageDefinition(JOINT_STATE, "float64[] position\n", "")
    with BagWriter(folder / "bag") as writer:
        writer.add_topic("/joints", JOINT_STATE, definition=definition)
        writer.write("/joints", encode(7, numbers), 7, 7)

    export_bag(folder / "bag", folder)
    export_bag(folder / "bag", folder, format="parquet")

    (row,) = rows(folder / "joints.csv")
    table = pq.read_table(folder / "joints.parquet")
    for k, number in enumerate(numbers):
        text = row[f"position.j{k} [rad]"]
        stored = table[f"position.j{k}"][0].as_py()
        if math.isnan(number):
            assert math.isnan(float(text))
            assert math.isnan(stored)
        else:
            bits = struct.pack("<d", number)
            assert struct.pack("<d", float(text)) == struct.pack("<d", stored) == bits


def test_parquet_has_types_and_units(write_bag, tmp_path) -> None:
    battery = made("std_msgs/msg/UInt64", data=2**64 - 1)
    flag = made("std_msgs/msg/Bool", data=True)

    export_bag(write_bag(big=[battery], flag=[flag], cmd=[twist(1.0)]), tmp_path, format="parquet")

    big = pq.read_table(tmp_path / "big.parquet")
    assert big["data"].to_pylist() == [2**64 - 1]
    assert big.schema.metadata[b"topic"] == b"/big"
    assert pq.read_table(tmp_path / "flag.parquet")["data"].to_pylist() == [True]
    schema = pq.read_schema(tmp_path / "cmd.parquet")
    assert schema.field("linear.x").metadata == {b"unit": b"m/s"}
    assert schema.field("log_time").metadata == {b"unit": b"ns"}
    assert str(schema.field("log_time").type) == "int64"


def test_topics_become_paths_and_files_are_not_replaced(write_bag, tmp_path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        definition = MessageDefinition(JOINT_STATE, "float64[] position\n", "")
        for topic in ("/a", "/a/b", "/empty"):
            writer.add_topic(topic, JOINT_STATE, definition=definition)
        for topic in ("/a", "/a/b"):
            writer.write(topic, JointStateEncoder(["j"])(1, [1.0]), 1, 1)

    exported = export_bag(tmp_path / "bag", tmp_path / "out")

    assert [one.path for one in exported] == [tmp_path / "out/a.csv", tmp_path / "out/a/b.csv"]
    with pytest.raises(ExportError, match=r"a\.csv: exists already"):
        export_bag(tmp_path / "bag", tmp_path / "out")
    with pytest.raises(BagReadError, match="no topic /c; topics: /a, /a/b, /empty"):
        export_bag(tmp_path / "bag", tmp_path / "out", topics=["/c"])


@pytest.mark.parametrize(
    "name", ["/../../escaped", "/a/..", "/a/./b", "//a", "/", "", "/a\0b", "/a\nb", "/a\x1b[2Jb"]
)
def test_no_topic_leads_out_of_the_folder_or_into_anothers_file(tmp_path, name: str) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        definition = MessageDefinition(JOINT_STATE, "float64[] position\n", "")
        for topic in ("/a", name):
            writer.add_topic(topic, JOINT_STATE, definition=definition)
            writer.write(topic, JointStateEncoder(["j"])(1, [1.0]), 1, 1)

    with pytest.raises(ExportError, match="there is no file of such a name"):
        export_bag(tmp_path / "bag", tmp_path / "deep" / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]


def test_a_topic_with_too_long_a_name_is_told(tmp_path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        definition = MessageDefinition(JOINT_STATE, "float64[] position\n", "")
        writer.add_topic("/" + "a" * 300, JOINT_STATE, definition=definition)
        writer.write("/" + "a" * 300, JointStateEncoder(["j"])(1, [1.0]), 1, 1)

    with pytest.raises(ExportError, match=r"aaa\.csv: cannot write it: .*too long"):
        export_bag(tmp_path / "bag", tmp_path / "out")


def test_a_message_that_is_none_ends_its_file_and_is_told(tmp_path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        definition = MessageDefinition(JOINT_STATE, "float64[] position\n", "")
        writer.add_topic("/joints", JOINT_STATE, definition=definition)
        for time, data in ((1, JointStateEncoder(["j"])(1, [1.0])), (2, b"nothing")):
            writer.write("/joints", data, time, time)

    (exported,) = export_bag(tmp_path / "bag", tmp_path / "out")

    assert exported.rows == 1
    assert "at 2 ns is not a sensor_msgs/msg/JointState" in str(exported.damage)
    assert len(rows(exported.path)) == 1


def write_joints_and_text(
    bag: Path, definition: str, encoding: str = "ros2msg", last: bytes = TEXT
) -> Path:
    """Write a JointState, which needs no definition, and two texts, which do."""
    with BagWriter(bag) as writer:
        writer.add_topic("/joints", JOINT_STATE, definition=MessageDefinition(JOINT_STATE, "", ""))
        text = MessageDefinition(STRING, definition, "", encoding)
        writer.add_topic("/text", STRING, definition=text)
        writer.write("/joints", JointStateEncoder(["j"])(1, [1.0]), 1, 1)
        for time, data in ((1, TEXT), (2, last)):
            writer.write("/text", data, time, time)
    return bag


@pytest.mark.parametrize(
    ("definition", "encoding", "reason"),
    [
        ("module std_msgs {};", "ros2idl", "is defined in 'ros2idl', but only ros2msg can be"),
        ("what is this?\n", "ros2msg", "the definition of std_msgs/msg/String is malformed"),
    ],
)
def test_a_topic_that_cannot_be_decoded_is_refused_before_any_file(
    tmp_path, definition, encoding, reason
) -> None:
    bag = write_joints_and_text(tmp_path / "bag", definition, encoding)

    with pytest.raises(BagReadError, match=reason):
        export_bag(bag, tmp_path / "out")

    assert not (tmp_path / "out").exists()
    (exported,) = export_bag(bag, tmp_path / "out", topics=["/joints"])
    assert (exported.rows, exported.damage) == (1, None)


def test_without_the_decoder_only_joint_states_are_exported(tmp_path, monkeypatch) -> None:
    bag = write_joints_and_text(tmp_path / "bag", "string data\n")
    monkeypatch.setitem(sys.modules, "mcap_ros2.decoder", None)

    with pytest.raises(BagReadError, match="decoding needs the Python package mcap-ros2-support"):
        export_bag(bag, tmp_path / "out")

    assert not (tmp_path / "out").exists()
    (exported,) = export_bag(bag, tmp_path / "out", topics=["/joints"])
    assert (exported.rows, exported.damage) == (1, None)


def test_damage_keeps_what_was_decoded_before_it(tmp_path) -> None:
    bag = write_joints_and_text(tmp_path / "bag", "string data\n", last=TEXT[:6])

    joints, text = export_bag(bag, tmp_path / "out")

    assert (joints.rows, joints.damage) == (1, None)
    assert [row["data"] for row in rows(text.path)] == ["hello"]
    assert "at 2 ns is not a std_msgs/msg/String" in str(text.damage)
