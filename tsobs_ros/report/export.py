# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Topics of a bag as CSV or Parquet files, one file each; numbers read back to the same bits.

A topic becomes a table, whose columns are found in a first pass. Nested fields become columns such
as `pose.position.x` or `data[3]`. Times and the numbers of a JointState have units.
"""

import csv
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias
from urllib.parse import quote

from tsobs_ros.bag.joint_states import JOINT_STATE, JointState, JointStateDecoder
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.design.file import parse_design
from tsobs_ros.design.request import TSRequest
from tsobs_ros.errors import BagReadError, MessageError, OutputError, TsobsError
from tsobs_ros.files import written_whole
from tsobs_ros.replay.designs import recorded_observers
from tsobs_ros.replay.places import CONDITIONS
from tsobs_ros.series import NANOSECONDS

MAX_COLUMNS = 64
"""An array that is longer in any message stays in one column, as lists."""

_BLOCK = 16_384
_MAX_INT64 = 2**63 - 1
# A spreadsheet takes text with such a first character for a formula.
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")

Units: TypeAlias = Mapping[str, Mapping[str, str]]
"""Units of a JointState's fields by entry."""

Cell: TypeAlias = tuple[str, str, Any]
"""Column, unit and value: a number, text, bytes, or a list if the array stays in one column."""

_TIMES = ("builtin_interfaces/Time", "builtin_interfaces/Duration")
# Units of revolute joints; bags do not distinguish prismatic ones.
_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}
# An observer's health is no angle, nor is the disturbance of a velocity.
_RATES = {"position": "rad/s", "velocity": "rad/s^2"}
_UNITS_OF_ENTRIES: Units = {
    **{name: {"position": ""} for name in CONDITIONS},
    "measurement_age": {"position": "s"},
    "link_velocity": _RATES,
    "motor_velocity": _RATES,
}


@dataclass
class _Column:
    """A column: its name without unit, its unit, one of its values, and the largest number."""

    name: str
    unit: str
    example: Any = 0.0
    largest: int = 0


class _Table:
    """A topic as a table: three times, then the columns in the order in which they first appear.

    Raises:
        BagReadError: The topic's messages cannot be decoded at all: their definition is malformed
            or not in `ros2msg`, or `mcap-ros2-support` is not installed.
    """

    def __init__(self, reader: BagReader, topic: str, units: Units) -> None:
        self.topic, self.count = topic, 0
        self.damage: BagReadError | None = None
        self._reader, self._units = reader, units
        self._whole: set[str] = set()
        found: dict[str, _Column] = {}
        for cells in self._messages():
            self.count += 1
            for name, unit, value in cells:
                column = found.setdefault(name, _Column(name, unit))
                if isinstance(value, list):
                    self._whole.add(name)
                    value = value or column.example
                if isinstance(value, int):
                    column.largest = max(column.largest, value)
                column.example = value
        # An array that becomes too long in a later message is one column throughout.
        split = tuple(f"{name}[" for name in self._whole)
        self.columns = [one for one in found.values() if not (split and one.name.startswith(split))]

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield each row as values by column; a message may lack some columns."""
        for cells in self._messages():
            yield {name: value for name, _, value in cells}

    def _messages(self) -> Iterator[Iterator[Cell]]:
        decode, start = JointStateDecoder(), self._reader.start_time or 0
        is_joint_state = self._reader.topics[self.topic].type == JOINT_STATE
        # Outside of the `try`: without a decoder nothing is damaged, and there are no rows to keep.
        messages: Any = (
            self._reader.messages([self.topic])
            if is_joint_state
            else self._reader.decoded([self.topic])
        )
        try:
            for one in messages:
                times = (
                    ("time", "s", (one.log_time - start) / NANOSECONDS),
                    ("log_time", "ns", one.log_time),
                    ("publish_time", "ns", one.publish_time),
                )
                if is_joint_state:
                    yield chain(times, self._flatten_joint_state(decode(one.data)))
                else:
                    yield chain(times, self._flatten(one.message))
        except BagReadError as error:
            self.damage = error
        except MessageError as error:
            self.damage = BagReadError(
                f"{self._reader.path}: the message of {self.topic} at {one.log_time} ns is not a "
                f"{JOINT_STATE}: {error}"
            )

    def _flatten_joint_state(self, message: JointState) -> Iterator[Cell]:
        """Yield the cells of a JointState; the columns of numbers name their joints."""
        yield "header.stamp", "ns", message.stamp
        yield "header.frame_id", "", message.frame_id
        names = message.names
        for field, usual in _UNITS.items():
            for place, value in enumerate(getattr(message, field)):
                name = names[place] if place < len(names) else ""
                column = f"{field}.{name}" if place < len(names) else f"{field}[{place}]"
                own = self._units.get(name) or _UNITS_OF_ENTRIES.get(name.rpartition("/")[2], {})
                yield column, own.get(field, usual), value

    def _flatten(self, value: Any, column: str = "") -> Iterator[Cell]:
        """Yield the cells of a message, of an array or of a value."""
        type_ = _type_of(value)
        if isinstance(value, list | tuple):
            nested = bool(value) and bool(_type_of(value[0]))
            if not nested and (len(value) > MAX_COLUMNS or column in self._whole):
                yield column, "", list(value)
                return
            for place, one in enumerate(value):
                yield from self._flatten(one, f"{column}[{place}]")
        elif type_ in _TIMES:
            yield column, "ns", value.sec * NANOSECONDS + value.nanosec
        elif type_:
            for field in value.__slots__:
                path = f"{column}.{field}" if column else field
                yield from self._flatten(getattr(value, field), path)
        else:
            yield column, "", bytes(value) if isinstance(value, bytearray | memoryview) else value


def _type_of(value: Any) -> str:
    """Return the type of a decoded message as `package/Type`, empty for anything else."""
    return str(getattr(value, "_type", ""))


def _units_of_systems(reader: BagReader) -> dict[str, dict[str, str]]:
    """Return the units of the entries of T–S systems by field, from the recorded designs."""
    units: dict[str, dict[str, str]] = {}
    with suppress(TsobsError):  # without the design there are no units
        for ran in recorded_observers(reader).values():
            for joint, (design, *_) in ran.designs.items():
                request = parse_design(design.file, design.text).request
                if isinstance(request, TSRequest):
                    own = request.signals(joint, alone=len(ran.designs) == 1)
                    places = (*own.states, *own.inputs, *own.outputs)
                    given = (*request.state_units, *request.input_units, *request.output_units)
                    for place, unit in zip(places, given, strict=True):
                        rate = f"{unit}/s" if unit else ""
                        units[place.name] = {"position": unit, "velocity": rate}
    return units


class Exported(NamedTuple):
    """A file that was written, and the damage to the bag that ended reading early, if any."""

    topic: str
    path: Path
    rows: int
    columns: int
    damage: BagReadError | None


def export_bag(
    bag: str | Path, output: str | Path, *, topics: Sequence[str] = (), format: str = "csv"
) -> list[Exported]:
    """Write topics, by default all that have messages, to files below a folder, named by topic.

    No file is replaced. The format is "csv" or "parquet".

    Raises:
        BagReadError: The bag cannot be read, has no such topic, or a topic cannot be decoded.
        OutputError: A file exists already or cannot be written.
        ModuleNotFoundError: Parquet is asked for, but pyarrow is not installed.
    """
    reader, output = BagReader(bag), Path(output)
    reader.require(topics)
    chosen = topics or [name for name, info in reader.topics.items() if info.count]
    write = _write_parquet if format == "parquet" else _write_csv
    paths = {topic: _file_of(topic, output, format) for topic in chosen}
    for path in paths.values():
        if os.path.lexists(path):
            raise OutputError(f"{path}: exists already, files are not overwritten")
    # Read all topics before the first file is written: an error then leaves no file behind.
    units = _units_of_systems(reader)
    tables = {path: _Table(reader, topic, units) for topic, path in paths.items()}
    with written_whole(output) as folder:
        for path, table in tables.items():
            partial = folder / path.relative_to(output)
            partial.parent.mkdir(parents=True, exist_ok=True)
            write(table, partial)
    return [
        Exported(table.topic, path, table.count, len(table.columns), table.damage)
        for path, table in tables.items()
    ]


def _file_of(topic: str, output: Path, format: str) -> Path:
    """Return a topic's file, which is below the folder for any name of the topic."""
    names = topic.removeprefix("/").split("/")
    parts = [
        quote(one, safe="", errors="surrogatepass").replace(".", "%2E") or "%" for one in names
    ]
    return output.joinpath(*parts[:-1], f"{parts[-1]}.{format}")


def _write_csv(table: _Table, path: Path) -> None:
    with path.open("x", encoding="utf-8", newline="") as stream:
        plain = csv.writer(stream, lineterminator="\n")
        quoted = csv.writer(stream, lineterminator="\n", quoting=csv.QUOTE_ALL)
        titles = {
            one.name: f"{one.name} [{one.unit}]" if one.unit else one.name for one in table.columns
        }
        for row in chain([titles], table.rows()):
            cells = [_csv_cell(row.get(name)) for name in titles]
            # The csv module leaves a lone carriage return unquoted, which ends a line for readers.
            broken = any(isinstance(cell, str) and "\r" in cell for cell in cells)
            (quoted if broken else plain).writerow(cells)


def _csv_cell(value: Any) -> Any:
    match value:
        case bool() | list():
            return json.dumps(value)
        case bytes():
            return value.hex()
        case str() if value.startswith(_FORMULA):
            return f"'{value}"
        case _:
            return value


def _write_parquet(table: _Table, path: Path) -> None:
    # Imported here, so that pyarrow is needed only for Parquet.
    import pyarrow as pa
    import pyarrow.parquet as pq

    def field(column: _Column) -> Any:
        kind = pa.uint64() if column.largest > _MAX_INT64 else pa.scalar(column.example).type
        return pa.field(column.name, kind, metadata={"unit": column.unit} if column.unit else None)

    schema = pa.schema(map(field, table.columns)).with_metadata({"topic": table.topic})
    rows = table.rows()
    with path.open("xb") as stream, pq.ParquetWriter(stream, schema) as writer:
        while block := list(islice(rows, _BLOCK)):
            writer.write_table(pa.Table.from_pylist(block, schema))
