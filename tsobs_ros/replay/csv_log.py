# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements from an arm's own log: a CSV file of time, angle and torque."""

import csv
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.messages.joint_series import Times
from tsobs_ros.bag.messages.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.bag.qos import QosProfile
from tsobs_ros.bag.reader import BagMessage
from tsobs_ros.checks import Array, shown
from tsobs_ros.errors import BagReadError, LogError
from tsobs_ros.estimation.records import NANOSECONDS
from tsobs_ros.replay.csv_columns import ISO, UNITS, Column, Columns, find_columns
from tsobs_ros.replay.samples import Samples, passes
from tsobs_ros.replay.source import MEASUREMENTS, Live, TopicToCopy, Truth

_BLOCK = 4096
_NO_TIME = -(2**63)
# What a message's stamp can hold.
_LATEST = 2**31 * NANOSECONDS
# Whole numbers from here on are nanoseconds since the epoch: as seconds they are no time at all.
_LEAST_EPOCH_NS = 10**14
_FRACTION = re.compile(r"[.,](\d+)")


class _Table(NamedTuple):
    """A log's numbers: stamps [ns], angles [rad] and torques [N m], NaN where a cell is empty."""

    stamps: Times
    angles: Array
    torques: Array


class CsvSource:
    """A CSV log as a source of measurements.

    The first line has the columns' names. Cells that are empty or NaN are measurements that will
    be rejected, and counted. Lines need not be in order of time. A log whose times begin at zero
    or before is moved, so that it begins at 1 s: a stamp of zero means none.

    Args:
        path: The file.
        columns: See `find_columns`.
        units: See `find_columns`.
        joints: Names of the joints to read; all of them if empty. One name renames the joint of
            columns that name none.
        assume_zero_torque: Whether there may be no torque.

    Attributes:
        path: The file.
        joints: Whose measurements.
        namespace: Empty: the topics in a new bag have no namespace.
        samples: The measurements, in the order of the lines.
        moved_by: What was added to the times [ns].
        live: None: nothing was estimated.
        damage: None: a log is read as a whole, or not at all.

    Raises:
        LogError: The file cannot be read, lacks a column, or has a cell that is not a number; the
            text names line and column.
    """

    namespace = ""
    live: Live | None = None
    damage: BagReadError | None = None

    def __init__(
        self,
        path: Path,
        *,
        columns: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        joints: Sequence[str] = (),
        assume_zero_torque: bool = False,
    ) -> None:
        self.path = path
        only = joints[0] if len(joints) == 1 else "elastic_joint"
        needed = not assume_zero_torque
        try:
            with path.open(encoding="utf-8-sig", newline="") as stream:
                lines = _lines(stream.read())
                header = next(lines, (0, []))[1]
                found = find_columns(header, columns or {}, units or {}, only, torque_needed=needed)
                self.joints = tuple(joints) or tuple(found.angles)
                table = _read(lines, _chosen(found, self.joints))
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise LogError(f"{path}: cannot read it: {error}") from error
        except LogError as error:
            raise LogError(f"{path}: {error}") from error
        if not len(table.stamps):
            raise LogError(f"{path}: no lines below the header")
        self.moved_by, stamps = _moved(table.stamps)
        self.samples = _samples(stamps, table)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return that the times were moved, if they were."""
        if not self.moved_by:
            return ()
        return (f"note: {self.moved_by * 1e-9:g} s was added to all times: 0 means no time",)

    @property
    def topics(self) -> tuple[TopicToCopy, ...]:
        """The measurements."""
        qos = (QosProfile(reliability="best_effort"),)
        name = f"/{MEASUREMENTS}"
        return (TopicToCopy(name, JOINT_STATE, qos, find_definition(JOINT_STATE)),)

    def messages(self) -> Iterator[BagMessage]:
        """Yield the measurements as the messages of an arm's driver."""
        encode, samples = JointStateEncoder(self.joints), self.samples
        for begin in range(0, samples.count, _BLOCK):
            block = slice(begin, begin + _BLOCK)
            y, u = samples.y[block], samples.u[block]
            data = encode.encode_all(samples.stamps[block], y, y[:, :0], u)
            for one, time in zip(data, samples.log_times[block].tolist(), strict=True):
                yield BagMessage(f"/{MEASUREMENTS}", JOINT_STATE, one, time, time)

    def truth(self) -> Truth:
        """Return nothing: an arm does not know the truth."""
        return Truth(None, None)


def _lines(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the cells of every line that is not empty."""
    first = text.partition("\n")[0]
    delimiter = max(",;\t", key=first.count)
    reader = csv.reader(text.splitlines(), delimiter=delimiter, skipinitialspace=True)
    for cells in reader:
        if any(cell.strip() for cell in cells):
            yield reader.line_num, cells


def _chosen(columns: Columns, joints: Sequence[str]) -> Columns:
    if missing := [joint for joint in joints if joint not in columns.angles]:
        raise LogError(
            f"no angle of {', '.join(missing)}; there are angles of {', '.join(columns.angles)}"
        )
    torques = columns.torques
    return Columns(
        columns.time,
        {joint: columns.angles[joint] for joint in joints},
        None if torques is None else {joint: torques[joint] for joint in joints},
    )


def _read(lines: Iterator[tuple[int, list[str]]], columns: Columns) -> _Table:
    stamps: list[int] = []
    rows: list[list[float]] = []
    numbers = [("angle", column) for column in columns.angles.values()]
    if columns.torques is not None:
        numbers += [("torque", column) for column in columns.torques.values()]
    factors = [UNITS[quantity].get(column.unit, 1.0) for quantity, column in numbers]
    read_time: Callable[[str], int] | None = None
    for line, cells in lines:
        text = _cell(line, cells, columns.time)
        try:
            if read_time is None and text:
                read_time = _time_reader(columns.time, text)
            stamps.append(read_time(text) if read_time and text else _NO_TIME)
        except (ValueError, InvalidOperation, OverflowError) as error:
            raise _not_a("time", line, columns.time, text) from error
        row = []
        for (_, column), factor in zip(numbers, factors, strict=True):
            text = _cell(line, cells, column)
            try:
                row.append(float(text) * factor if text else math.nan)
            except ValueError as error:
                raise _not_a("number", line, column, text) from error
        rows.append(row)
    count = len(columns.angles)
    values = np.array(rows, dtype=np.float64).reshape(len(rows), len(numbers))
    torques = values[:, count:] if columns.torques is not None else np.zeros((len(rows), count))
    return _Table(np.array(stamps, dtype=np.int64), values[:, :count], torques)


def _cell(line: int, cells: Sequence[str], column: Column) -> str:
    if column.place >= len(cells):
        raise LogError(
            f"line {line}: {len(cells)} cells, but column {column.title!r} is number "
            f"{column.place + 1}"
        )
    return cells[column.place].strip()


def _not_a(what: str, line: int, column: Column, text: str) -> LogError:
    unit = f" in {column.unit}" if column.unit else ""
    return LogError(
        f"line {line}, column {column.title!r}: expected a {what}{unit}, got {shown(text)}"
    )


def _time_reader(column: Column, first: str) -> Callable[[str], int]:
    """Return what reads times in the column's unit, or in the one that its first cell looks of."""
    if column.unit == ISO or (not column.unit and re.match(r"\d{4}-\d", first)):
        return _iso_time
    unit = column.unit
    if not unit:
        unit = "ns" if first.isdigit() and int(first) >= _LEAST_EPOCH_NS else "s"
    factor = Decimal(UNITS["time"][unit])

    def read(text: str) -> int:
        # A decimal, because a double has no nanoseconds left at today's dates.
        time = int((Decimal(text) * factor).to_integral_value())
        if abs(time) >= _LATEST:
            raise ValueError("beyond what a stamp can hold")
        return time

    return read


def _iso_time(text: str) -> int:
    """Return a date and time, in UTC unless it says otherwise, to the nanosecond."""
    fraction = _FRACTION.search(text)
    digits = fraction[1] if fraction else ""
    whole = text.replace(fraction[0], "", 1) if fraction else text
    moment = datetime.fromisoformat(whole)
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return int(moment.timestamp()) * NANOSECONDS + int(digits[:9].ljust(9, "0") if digits else 0)


def _moved(stamps: Times) -> tuple[int, Times]:
    """Return stamps that are all after zero, or zero where there is none, and what was added."""
    there = stamps != _NO_TIME
    first = int(stamps[there].min()) if there.any() else 1
    moved_by = 0 if first > 0 else NANOSECONDS - first
    return moved_by, np.where(there, stamps + np.where(there, moved_by, 0), 0)


def _samples(stamps: Times, table: _Table) -> Samples:
    there = np.ones(table.angles.shape, np.bool_)
    # A late line keeps its place: it is recorded when it comes, a moment after the one before it.
    times = np.concatenate([_increasing(stamps[a:b]) for a, b in passes(stamps.tolist())])
    return Samples(stamps, times, times, table.angles, table.torques, there, there)


def _increasing(stamps: Times) -> Times:
    """Return the stamps where each is later than all before it, else the next nanosecond."""
    place = np.arange(len(stamps))
    return np.asarray(np.maximum.accumulate(stamps - place) + place)
