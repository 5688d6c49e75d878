# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Topics as CSV and Parquet: any type, nothing lost, units where they are known."""

import csv
import math
import re
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from rosbags.typesys import Stores, get_typestore

from tsobs_ros.bag import BagWriter
from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.errors import BagReadError, OutputError
from tsobs_ros.report.export import Exported, export_bag

TYPES = get_typestore(Stores.ROS2_JAZZY)
START = 1_700_000_000_000_000_000
STRING = "std_msgs/msg/String"
TEXT = b"\0\1\0\0\6\0\0\0hello\0"


def made(type_: str, **fields: Any) -> Any:
    """Return a message of rosbags."""
    return TYPES.types[type_](**fields)


def header(frame_id: str = "base") -> Any:
    sec, nanosec = divmod(START, 10**9)
    time = made("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return made("std_msgs/msg/Header", stamp=time, frame_id=frame_id)


def array(length: int) -> Any:
    layout = made("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    return made("std_msgs/msg/Float64MultiArray", layout=layout, data=np.arange(float(length)))


def joint_state(names: list[str], position: list[float]) -> Any:
    numbers = {"position": np.array(position), "velocity": np.zeros(0), "effort": np.zeros(0)}
    return made(JOINT_STATE, header=header(), name=names, **numbers)


@pytest.fixture
def export(tmp_path: Path) -> Callable[..., list[Exported]]:
    """Write messages of rosbags, a second apart, to a bag, and export it to `tmp_path`."""

    def write(format: str = "csv", **topics: list[Any]) -> list[Exported]:
        with BagWriter(tmp_path / "bag") as writer:
            for name, messages in topics.items():
                type_ = messages[0].__msgtype__
                text, _ = TYPES.generate_msgdef(type_, ros_version=2)
                writer.add_topic(f"/{name}", type_, definition=MessageDefinition(type_, text, ""))
                for place, message in enumerate(messages):
                    time = START + place * 10**9
                    data = bytes(TYPES.serialize_cdr(message, type_))
                    writer.write(f"/{name}", data, time, time - 1)
        return export_bag(tmp_path / "bag", tmp_path, format=format)

    return write


def joint_bag(folder: Path, *topics: str, angles: list[float] | None = None) -> Path:
    """Write a bag with one JointState on each topic, and an empty topic `/empty`."""
    names = [f"j{k}" for k in range(len(angles or [1.0]))]
    with BagWriter(folder / "bag") as writer:
        definition = MessageDefinition(JOINT_STATE, "float64[] position\n", "")
        for topic in (*topics, "/empty"):
            writer.add_topic(topic, JOINT_STATE, definition=definition)
        for topic in topics:
            writer.write(topic, JointStateEncoder(names)(1, angles or [1.0]), 1, 1)
    return folder / "bag"


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def test_nested_fields_have_columns(export, tmp_path) -> None:
    x, zero = (made("geometry_msgs/msg/Vector3", x=one, y=0.0, z=0.0) for one in (0.5, 0.0))
    (exported,) = export(cmd=[made("geometry_msgs/msg/Twist", linear=x, angular=zero)])

    assert exported.path == tmp_path / "cmd.csv"
    (row,) = rows(exported.path)
    times = {"time [s]": "0.0", "log_time [ns]": str(START), "publish_time [ns]": str(START - 1)}
    fields = [f"{vector}.{axis}" for vector in ("linear", "angular") for axis in "xyz"]
    assert row == times | dict.fromkeys(fields, "0.0") | {"linear.x": "0.5"}


def test_joints_keep_their_columns_whatever_their_order(export, tmp_path) -> None:
    export(joints=[joint_state(["a", "b"], [1.0, 2.0]), joint_state(["b", "c"], [3.0, math.nan])])

    first, second = rows(tmp_path / "joints.csv")
    assert first["header.stamp [ns]"] == str(START)
    columns = [f"position.{joint} [rad]" for joint in "abc"]
    assert [first[column] for column in columns] == ["1.0", "2.0", ""]
    assert [second[column] for column in columns] == ["", "3.0", "nan"]


def test_arrays_have_a_column_each_entry_or_one_if_ever_long(export, tmp_path) -> None:
    export(short=[array(length) for length in (2, 0, 3)], long=[array(2), array(65)])
    export_bag(tmp_path / "bag", tmp_path, topics=["/long"], format="parquet")

    cells = [[row.get(f"data[{k}]") for k in range(3)] for row in rows(tmp_path / "short.csv")]
    assert cells == [["0.0", "1.0", ""], ["", "", ""], ["0.0", "1.0", "2.0"]]
    (first, _) = rows(tmp_path / "long.csv")
    assert first["data"] == "[0.0, 1.0]"
    assert not any(column.startswith("data[") for column in first)
    column = pq.read_table(tmp_path / "long.parquet")["data"].to_pylist()
    assert column == [[0.0, 1.0], [float(k) for k in range(65)]]


def test_texts_bytes_and_lists_of_messages(export, tmp_path) -> None:
    value = made("diagnostic_msgs/msg/KeyValue", key='a "key", with', value="ü\nä")
    texts = {"name": "name", "message": "", "hardware_id": ""}
    status = made("diagnostic_msgs/msg/DiagnosticStatus", level=2, values=[value], **texts)
    diagnostics = made("diagnostic_msgs/msg/DiagnosticArray", header=header(), status=[status])
    data = np.array([0, 255, 16], dtype=np.uint8)
    image = made("sensor_msgs/msg/CompressedImage", header=header(), format="png", data=data)

    export(diagnostics=[diagnostics], image=[image])
    export_bag(tmp_path / "bag", tmp_path, topics=["/image"], format="parquet")

    (row,) = rows(tmp_path / "diagnostics.csv")
    cells = [row[f"status[0].{name}"] for name in ("level", "values[0].key", "values[0].value")]
    assert cells == ["2", 'a "key", with', "ü\nä"]
    assert rows(tmp_path / "image.csv")[0]["data"] == "00ff10"
    assert pq.read_table(tmp_path / "image.parquet")["data"].to_pylist() == [b"\0\xff\x10"]


def test_texts_are_no_formulas_and_numbers_stay_numbers(export, tmp_path) -> None:
    texts = ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", "\n=1"]
    type_ = "sensor_msgs/msg/Temperature"
    export(t=[made(type_, header=header(text), temperature=-1.5, variance=0.0) for text in texts])
    export_bag(tmp_path / "bag", tmp_path, format="parquet")

    found = rows(tmp_path / "t.csv")
    assert [row["header.frame_id"] for row in found] == [f"'{text}" for text in texts]
    assert {row["temperature"] for row in found} == {"-1.5"}
    assert pq.read_table(tmp_path / "t.parquet")["header.frame_id"].to_pylist() == texts


def test_numbers_come_back_to_the_last_bit(tmp_path) -> None:
    special = [0.0, -0.0, 5e-324, 1e-310, 0.1, sys.float_info.max, math.inf, -math.inf, math.nan]
    numbers = [*special, *np.frombuffer(np.random.default_rng(1).bytes(8 * 50)).tolist()]
    bag = joint_bag(tmp_path, "/joints", angles=numbers)
    export_bag(bag, tmp_path)
    export_bag(bag, tmp_path, format="parquet")

    (row,) = rows(tmp_path / "joints.csv")
    table = pq.read_table(tmp_path / "joints.parquet")
    for k, number in enumerate(numbers):
        text, stored = float(row[f"position.j{k} [rad]"]), table[f"position.j{k}"][0].as_py()
        same = struct.pack("<d", text) == struct.pack("<d", stored) == struct.pack("<d", number)
        assert same or (math.isnan(number) and math.isnan(text) and math.isnan(stored))


def test_parquet_has_types_and_units(export, tmp_path) -> None:
    big = made("std_msgs/msg/UInt64", data=2**64 - 1)
    joints, flag = joint_state(["a"], [1.0]), made("std_msgs/msg/Bool", data=True)
    export("parquet", big=[big], flag=[flag], joints=[joints])

    table = pq.read_table(tmp_path / "big.parquet")
    assert table["data"].to_pylist() == [2**64 - 1]
    assert table.schema.metadata[b"topic"] == b"/big"
    assert pq.read_table(tmp_path / "flag.parquet")["data"].to_pylist() == [True]
    schema = pq.read_schema(tmp_path / "joints.parquet")
    assert schema.field("position.a").metadata == {b"unit": b"rad"}
    assert schema.field("log_time").metadata == {b"unit": b"ns"}
    assert str(schema.field("log_time").type) == "int64"


def test_topics_become_paths_and_files_are_not_replaced(tmp_path) -> None:
    bag, output = joint_bag(tmp_path, "/a", "/a/b"), tmp_path / "out"

    assert [one.path for one in export_bag(bag, output)] == [output / "a.csv", output / "a/b.csv"]
    with pytest.raises(OutputError, match=r"a\.csv: exists already"):
        export_bag(bag, output)
    with pytest.raises(BagReadError, match="no topic /c; topics: /a, /a/b, /empty"):
        export_bag(bag, output, topics=["/c"])


NAMES = [
    "/../../escaped", "/a/./b", "//a", "/a//", "/", "/a\0b", "/a\nb", "/a%0Ab", "/a\x1b[2Jb",
    "/a\u202eb", "/a.csv/b", "/a\\b",
]  # fmt: skip


def test_each_topic_has_a_plain_file_of_its_own_whatever_its_name(tmp_path) -> None:
    folder = tmp_path / "deep" / "out"
    exported = export_bag(joint_bag(tmp_path, "/a", *NAMES), folder)

    assert [one.topic for one in exported] == ["/a", *NAMES]
    files = sorted(tmp_path.rglob("*.csv"))
    assert sorted(one.path for one in exported) == files
    assert len(files) == 1 + len(NAMES)
    for file in files:
        assert file.resolve().is_relative_to(folder)
        assert re.fullmatch(r"[\w%~/-]+", str(file.relative_to(folder).with_suffix("")), re.ASCII)
    with pytest.raises(OutputError, match="File name too long"):
        export_bag(joint_bag(tmp_path / "long", f"/{'a' * 300}"), folder)


@pytest.fixture
def text_bag(tmp_path: Path) -> Callable[..., Path]:
    """Write a JointState, which needs no definition, and two texts, which do."""

    def write(definition: str, last: bytes = TEXT, joints: bytes | None = None) -> Path:
        with BagWriter(tmp_path / "bag") as writer:
            for topic, type_, text in (("/joints", JOINT_STATE, ""), ("/text", STRING, definition)):
                writer.add_topic(topic, type_, definition=MessageDefinition(type_, text, ""))
            writer.write("/joints", joints or JointStateEncoder(["j"])(1, [1.0]), 1, 1)
            for time, data in ((1, TEXT), (2, last)):
                writer.write("/text", data, time, time)
        return tmp_path / "bag"

    return write


@pytest.mark.parametrize(
    ("definition", "decoder", "reason"),
    [
        ("what is this?\n", True, "the definition of std_msgs/msg/String is malformed"),
        ("string data\n", False, "cannot decode messages: mcap_ros2 is not installed: "),
    ],
)
def test_a_topic_that_cannot_be_decoded_is_refused_before_any_file(
    tmp_path, monkeypatch, text_bag, definition, decoder, reason
) -> None:
    bag = text_bag(definition)
    if not decoder:
        monkeypatch.setitem(sys.modules, "mcap_ros2.decoder", None)

    with pytest.raises(BagReadError, match=reason):
        export_bag(bag, tmp_path / "out")

    assert not (tmp_path / "out").exists()
    (exported,) = export_bag(bag, tmp_path / "out", topics=["/joints"])
    assert (exported.rows, exported.damage) == (1, None)


@pytest.mark.parametrize(
    ("joints", "last", "kept"), [(b"nothing", TEXT, (0, 2)), (None, TEXT[:6], (1, 1))]
)
def test_damage_keeps_what_was_decoded_before_it(tmp_path, text_bag, joints, last, kept) -> None:
    exported = export_bag(text_bag("string data\n", last, joints), tmp_path / "out")

    assert tuple(one.rows for one in exported) == kept
    assert [len(rows(one.path)) for one in exported] == list(kept)
    (found,) = [str(one.damage) for one in exported if one.damage]
    assert "is not a" in found
