# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Topics of a bag as CSV or Parquet files, one each; numbers read back to the same bits.

A topic becomes a table: columns with units, found in a first pass, and rows. Nested fields become
columns such as `pose.position.x` or `data[3]`. Units are those of REP 103 and of the messages'
definitions: a unit belongs to a field of a type and to all fields below it, so a Twist's `angular`
is a Vector3 in rad/s. A field that is not listed has no unit.
"""

import csv
import hashlib
import json
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from tsobs_ros.bag.estimate_topics import CONDITIONS, DESIGN
from tsobs_ros.bag.joint_states import JOINT_STATE, JointState, JointStateDecoder
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.design.file import parse_design
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.design.signals import signals
from tsobs_ros.errors import BagReadError, ExportError, MessageError, TsobsError
from tsobs_ros.files import written_whole
from tsobs_ros.replay.designs import recorded_observer

FORMATS = ("csv", "parquet")

_BLOCK = 16_384
_MAX_INT64 = 2**63 - 1
# A spreadsheet takes text with such a first character for a formula.
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")
# Characters of a topic that becomes a path, of a file's name, and of the start of a shortened one.
_MAX_TOPIC, _MAX_NAME, _MAX_START = 1000, 240, 100

MAX_COLUMNS = 64
"""Arrays that are ever longer stay in one column, as lists."""

_FIRST = (("time", "s"), ("log_time", "ns"), ("publish_time", "ns"))
_TIMES = ("builtin_interfaces/Time", "builtin_interfaces/Duration")
_NANOSECONDS = 1_000_000_000

_POINT = {"x": "m", "y": "m", "z": "m"}

_UNITS: Mapping[str, Mapping[str, str]] = {
    "builtin_interfaces/Time": {"sec": "s", "nanosec": "ns"},
    "builtin_interfaces/Duration": {"sec": "s", "nanosec": "ns"},
    "geometry_msgs/Accel": {"linear": "m/s^2", "angular": "rad/s^2"},
    "geometry_msgs/Inertia": {
        "m": "kg",
        "com": "m",
        **dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "kg m^2"),
    },
    "geometry_msgs/Point": _POINT,
    "geometry_msgs/Point32": _POINT,
    "geometry_msgs/Pose2D": {"x": "m", "y": "m", "theta": "rad"},
    "geometry_msgs/Transform": {"translation": "m", "rotation": ""},
    "geometry_msgs/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/Wrench": {"force": "N", "torque": "N m"},
    "nav_msgs/MapMetaData": {"resolution": "m"},
    "sensor_msgs/BatteryState": {
        "voltage": "V",
        "current": "A",
        "charge": "A h",
        "capacity": "A h",
        "design_capacity": "A h",
        "temperature": "degC",
        "cell_voltage": "V",
        "cell_temperature": "degC",
    },
    "sensor_msgs/FluidPressure": {"fluid_pressure": "Pa"},
    "sensor_msgs/Illuminance": {"illuminance": "lx"},
    "sensor_msgs/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s^2"},
    # Of revolute joints; bags do not distinguish prismatic ones.
    "sensor_msgs/JointState": {"position": "rad", "velocity": "rad/s", "effort": "N m"},
    "sensor_msgs/LaserScan": {
        "angle_min": "rad",
        "angle_max": "rad",
        "angle_increment": "rad",
        "time_increment": "s",
        "scan_time": "s",
        "range_min": "m",
        "range_max": "m",
        "ranges": "m",
    },
    "sensor_msgs/MagneticField": {"magnetic_field": "T"},
    "sensor_msgs/NavSatFix": {"latitude": "deg", "longitude": "deg", "altitude": "m"},
    "sensor_msgs/Range": {
        "field_of_view": "rad",
        "min_range": "m",
        "max_range": "m",
        "range": "m",
    },
    "sensor_msgs/Temperature": {"temperature": "degC"},
    "trajectory_msgs/JointTrajectoryPoint": {
        "positions": "rad",
        "velocities": "rad/s",
        "accelerations": "rad/s^2",
        "effort": "N m",
    },
}

# An observer's health is no angle, and the disturbance of a velocity is none.
_RATE = {"position": "rad/s", "velocity": "rad/s^2"}
_UNITS_OF_ENTRIES: Mapping[str, Mapping[str, str]] = {
    **{name: {"position": ""} for name in CONDITIONS},
    "measurement_age": {"position": "s"},
    "link_velocity": _RATE,
    "motor_velocity": _RATE,
}


class Cell(NamedTuple):
    """One value of a row.

    Attributes:
        column: Its column's name.
        unit: Its unit, empty for none.
        value: A number, text, bytes, or a list if the array stays in one column.
    """

    column: str
    unit: str
    value: Any


@dataclass
class Column:
    """A column.

    Attributes:
        name: Its name, without unit.
        unit: Its unit, empty for none.
        kind: The type of its values.
        item: The type of their items if they are lists.
        largest: The largest value if they are whole numbers.
    """

    name: str
    unit: str
    kind: type = float
    item: type = float
    largest: int = 0

    def see(self, value: Any) -> None:
        """Note the type and size of one of the values."""
        self.kind = type(value)
        if self.kind is int:
            self.largest = max(self.largest, value)
        elif self.kind is list and value:
            self.item = type(value[0])


class Table:
    """A topic as a table.

    The first columns are `time`, in seconds since the bag's first message, and the times at which
    the message was received and published. They are followed by the message's own, in the order
    in which they first appear.

    Args:
        reader: The bag.
        topic: The topic.
        units: Units of a JointState's entries that are none of a joint's, by field.

    Attributes:
        topic: The topic.
        columns: Its columns.
        count: Number of rows.
        damage: The place where reading ended early, if it did.

    Raises:
        BagReadError: The topic's messages cannot be decoded at all: their definition is malformed
            or not in `ros2msg`, or `mcap-ros2-support` is not installed.
    """

    def __init__(
        self, reader: BagReader, topic: str, units: Mapping[str, Mapping[str, str]] = {}
    ) -> None:
        self.topic, self._units = topic, units
        self.damage: BagReadError | None = None
        self.count = 0
        self._reader = reader
        self._whole: set[str] = set()
        self.columns = self._survey()

    def rows(self) -> Iterator[list[Any]]:
        """Yield the rows; None if a message has nothing for a column."""
        places = {column.name: place for place, column in enumerate(self.columns)}
        start = self._reader.start_time or 0
        for log_time, publish_time, cells in self._messages():
            row: list[Any] = [None] * len(places)
            row[:3] = (log_time - start) / 1e9, log_time, publish_time
            for column, _, value in cells:
                row[places[column]] = value
            yield row

    def _survey(self) -> list[Column]:
        """Read all messages once to find the columns."""
        found = {name: Column(name, unit) for name, unit in _FIRST}
        for log_time, publish_time, cells in self._messages():
            self.count += 1
            found["log_time"].see(log_time)
            found["publish_time"].see(publish_time)
            for name, unit, value in cells:
                found.setdefault(name, Column(name, unit)).see(value)
                if isinstance(value, list):
                    self._whole.add(name)
        # What was an array of several columns before it became too long is one column throughout.
        split = tuple(f"{name}[" for name in self._whole)
        return (
            [column for name, column in found.items() if not name.startswith(split)]
            if split
            else list(found.values())
        )

    def _messages(self) -> Iterator[tuple[int, int, Iterator[Cell]]]:
        # Outside of the `try`: without a decoder nothing is damaged, and there are no rows to keep.
        messages = self._decoded()
        try:
            yield from messages
        except BagReadError as error:
            self.damage = error

    def _decoded(self) -> Iterator[tuple[int, int, Iterator[Cell]]]:
        if self._reader.topics[self.topic].type == JOINT_STATE:
            return self._joint_states()
        messages = self._reader.decoded([self.topic])  # without a decoder it fails here
        return (
            (message.log_time, message.publish_time, _flatten_message(message.message, self._whole))
            for message in messages
        )

    def _joint_states(self) -> Iterator[tuple[int, int, Iterator[Cell]]]:
        decode = JointStateDecoder()
        for raw in self._reader.messages([self.topic]):
            try:
                state = decode(raw.data)
            except MessageError as error:
                raise BagReadError(
                    f"{self._reader.path}: the message of {self.topic} at {raw.log_time} ns is "
                    f"not a {JOINT_STATE}: {error}"
                ) from error
            yield raw.log_time, raw.publish_time, _flatten_joint_state(state, self._units)


def _flatten_message(message: Any, whole: Collection[str] = ()) -> Iterator[Cell]:
    """Yield the cells of a message as decoded, but for the arrays of the `whole` columns."""
    type_ = _type_of(message)
    for field in message.__slots__:
        unit = _unit_of(type_, field)
        yield from _flatten(getattr(message, field), field, unit, whole)


def _units_of_systems(reader: BagReader) -> dict[str, dict[str, str]]:
    """Return the units of the entries of T–S systems by field, as recorded designs have them."""
    units: dict[str, dict[str, str]] = {}
    for topic in reader.topics.values():
        if not topic.name.endswith(f"/{DESIGN}"):
            continue
        with suppress(TsobsError):  # without the design there are no units
            ran = recorded_observer(reader, topic.name.removesuffix(f"/{DESIGN}"))
            for joint, (design, *_) in ran.designs.items():
                if design.text is None:
                    continue
                request = parse_design(f"{design.file:.200}", design.text).request
                if isinstance(request, ArmRequest):
                    continue
                own = signals(request, joint, alone=len(ran.designs) == 1)
                for places, given in (
                    (own.states, request.state_units),
                    (own.inputs, request.input_units),
                    (own.outputs, request.output_units),
                ):
                    for place, unit in zip(places, given, strict=True):
                        rate = f"{unit}/s" if unit else ""
                        units[place.name] = {"position": unit, "velocity": rate}
    return units


def _flatten_joint_state(
    message: JointState, units: Mapping[str, Mapping[str, str]]
) -> Iterator[Cell]:
    """Yield the cells of a JointState; its numbers have the names of their joints."""
    yield Cell("header.stamp", "ns", message.stamp)
    yield Cell("header.frame_id", "", message.frame_id)
    names = message.names
    for field in ("position", "velocity", "effort"):
        usual = _unit_of("sensor_msgs/JointState", field)
        for place, value in enumerate(getattr(message, field)):
            name = names[place] if place < len(names) else ""
            column = f"{field}.{name}" if place < len(names) else f"{field}[{place}]"
            own = units.get(name) or _UNITS_OF_ENTRIES.get(name.rpartition("/")[2], {})
            yield Cell(column, own.get(field, usual), value)


def _flatten(value: Any, column: str, unit: str, whole: Collection[str]) -> Iterator[Cell]:
    if isinstance(value, list | tuple):
        yield from _flatten_array(value, column, unit, whole)
    elif (type_ := _type_of(value)) in _TIMES:
        yield Cell(column, "ns", value.sec * _NANOSECONDS + value.nanosec)
    elif type_:
        for field in value.__slots__:
            below = _unit_of(type_, field, unit)
            yield from _flatten(getattr(value, field), f"{column}.{field}", below, whole)
    elif isinstance(value, bytearray | memoryview):
        yield Cell(column, unit, bytes(value))
    else:
        yield Cell(column, unit, value)


def _flatten_array(
    values: Sequence[Any], column: str, unit: str, whole: Collection[str]
) -> Iterator[Cell]:
    nested = bool(values) and bool(_type_of(values[0]))
    if not nested and (len(values) > MAX_COLUMNS or column in whole):
        yield Cell(column, unit, list(values))
        return
    for place, value in enumerate(values):
        yield from _flatten(value, f"{column}[{place}]", unit, whole)


def _type_of(value: Any) -> str:
    """Return the type of a decoded message as `package/Type`, empty for anything else."""
    return str(getattr(value, "_type", ""))


def _unit_of(type_: str, field: str, inherited: str = "") -> str:
    """Return the unit of a field of a type `package/Type` that is part of something with a unit."""
    return "" if "covariance" in field else _UNITS.get(type_, {}).get(field, inherited)


class Exported(NamedTuple):
    """A file that was written.

    Attributes:
        topic: The topic.
        path: The file.
        rows: Number of messages.
        columns: Number of columns.
        damage: The place where reading ended early, if it did.
    """

    topic: str
    path: Path
    rows: int
    columns: int
    damage: BagReadError | None


def export_bag(
    bag: str | Path, output: str | Path, *, topics: Sequence[str] = (), format: str = "csv"
) -> list[Exported]:
    """Write each topic to a file of its name, below a folder.

    Args:
        bag: Bag folder or MCAP file.
        output: The folder; it is created, but no file in it is replaced.
        topics: The topics; all that have messages if empty.
        format: One of `FORMATS`.

    Raises:
        BagReadError: The bag cannot be read, has no such topic, or a topic cannot be decoded.
        ExportError: A file exists already or cannot be written.
        ModuleNotFoundError: Parquet is asked for, but pyarrow is not installed.
    """
    reader = BagReader(bag)
    if unknown := [topic for topic in topics if topic not in reader.topics]:
        has = ", ".join(reader.topics) or "none"
        raise BagReadError(f"{bag}: no topic {', '.join(unknown)}; topics: {has}")
    chosen = topics or [name for name, info in reader.topics.items() if info.count]
    write = _write_parquet if format == "parquet" else _write_csv
    paths = {topic: _file_of(topic, Path(output), format) for topic in chosen}
    for path in paths.values():
        if os.path.lexists(path):
            raise ExportError(f"{path}: exists already, files are not overwritten")
    # All topics before the first file: one that cannot be decoded leaves none behind.
    units = _units_of_systems(reader)
    tables = [(Table(reader, topic, units), path) for topic, path in paths.items()]
    exported = []
    with written_whole(Path(output), ExportError) as folder:
        for table, path in tables:
            partial = folder / path.relative_to(output)
            partial.parent.mkdir(parents=True, exist_ok=True)
            write(table, partial)
            counts = table.count, len(table.columns)
            exported.append(Exported(table.topic, path, *counts, table.damage))
    return exported


def _file_of(topic: str, output: Path, format: str) -> Path:
    """Return a topic's file, which is below the folder whatever the topic's name is."""
    names = topic.removeprefix("/").split("/") if len(topic) <= _MAX_TOPIC else [topic]
    parts = list(map(_file_name, names))
    return output.joinpath(*parts[:-1], f"{parts[-1]}.{format}")


def _file_name(name: str) -> str:
    """Return a part of a topic's name for a file: as it is if ROS allows it, else encoded."""
    encoded = quote(name, safe="", errors="surrogatepass").replace(".", "%2E") or "%"
    if len(encoded) <= _MAX_NAME:
        return encoded
    return f"{encoded[:_MAX_START]}~{hashlib.sha256(encoded.encode()).hexdigest()[:16]}"


def _write_csv(table: Table, path: Path) -> None:
    with path.open("x", encoding="utf-8", newline="") as stream:
        plain = csv.writer(stream, lineterminator="\n")
        quoted = csv.writer(stream, lineterminator="\n", quoting=csv.QUOTE_ALL)
        heads = [f"{one.name} [{one.unit}]" if one.unit else one.name for one in table.columns]
        for row in chain([heads], table.rows()):
            cells = [_csv_cell(value) for value in row]
            # The csv module leaves a lone carriage return unquoted, which ends a line for readers.
            broken = any(isinstance(cell, str) and "\r" in cell for cell in cells)
            (quoted if broken else plain).writerow(cells)


def _csv_cell(value: Any) -> Any:
    match value:
        case None:
            return ""
        case bool():
            return "true" if value else "false"
        case bytes():
            return value.hex()
        case list():
            return json.dumps(value)
        case float():
            return repr(value)
        case str() if value.startswith(_FORMULA):
            return f"'{value}"
        case _:
            return value


def _write_parquet(table: Table, path: Path) -> None:
    # Here, so that pyarrow is needed only for Parquet.
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {
        bool: pa.bool_(),
        int: pa.int64(),
        float: pa.float64(),
        str: pa.string(),
        bytes: pa.binary(),
    }

    def field(column: Column) -> Any:
        if column.kind is list:
            kind = pa.list_(kinds[column.item])
        else:
            kind = pa.uint64() if column.largest > _MAX_INT64 else kinds[column.kind]
        return pa.field(column.name, kind, metadata={"unit": column.unit} if column.unit else None)

    fields = [field(column) for column in table.columns]
    schema = pa.schema(fields).with_metadata({"topic": table.topic})
    rows = table.rows()
    with path.open("xb") as stream, pq.ParquetWriter(stream, schema) as writer:
        while block := list(islice(rows, _BLOCK)):
            columns = zip(*block, strict=True)
            arrays = [pa.array(one, kind.type) for one, kind in zip(columns, schema, strict=True)]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
