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
from tsobs_ros.bag.joint_series import Times
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.bag.metadata import QosProfile, TopicInfo
from tsobs_ros.bag.reader import BagMessage
from tsobs_ros.checks import Array, shown
from tsobs_ros.errors import LogError
from tsobs_ros.estimation.records import NANOSECONDS
from tsobs_ros.replay.source import MEASUREMENTS, Samples, Source, passes

_ISO = "ISO 8601"
_UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "µs": 1e3, "ns": 1.0},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "°": math.pi / 180},
    "torque": {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3},
}
"""Each unit in ns, rad or N m; spaces, dots and stars in units do not matter."""

# In order of preference; the first are what `tsobs export` writes.
_GUESSES: Mapping[str, Sequence[str]] = {
    "time": ("header.stamp", "time", "t", "stamp", "timestamp", "log_time"),
    "angle": ("position", "angle", "q", "y", "theta", "pos"),
    "torque": ("effort", "torque", "tau", "u"),
}
_HEADER = re.compile(r"\s*(?P<name>.*?)\s*(?:[\[(](?P<unit>[^\])]*)[\])])?\s*")

_BLOCK = 4096
_NO_TIME = -(2**63)
# What a message's stamp can hold.
_LATEST = 2**31 * NANOSECONDS
# Whole numbers from here on are nanoseconds since the epoch: as seconds they are no time at all.
_MIN_EPOCH_NS = 10**14
_FRACTION = re.compile(r"[.,](\d+)")


class _Column(NamedTuple):
    """A column: its place from 0, its header, and the header's name and unit."""

    place: int
    title: str
    name: str
    unit: str


class _Table(NamedTuple):
    """A log's numbers: stamps [ns], angles [rad] and torques [N m], NaN for an empty cell."""

    stamps: Times
    angles: Array
    torques: Array


class LogSource(Source):
    """A CSV log as a source of measurements.

    The first line has the columns' names. Cells that are empty or NaN are measurements that will
    be rejected, and counted. Lines need not be in order of time. A log whose times begin at zero
    or before is moved, so that it begins at 1 s: a stamp of zero means none.

    Args:
        path: The file.
        columns: Names of columns by quantity: `time`, `angle` and `torque`, or `angle.JOINT` and
            `torque.JOINT` for several joints; the others are found by their usual names.
        units: Units by quantity, for columns whose header has none.
        joints: Names of the joints to read; all of them if empty. One name renames the joint of
            columns that name none.
        assume_zero_torque: Take torque as 0 if there is no such column.

    Attributes:
        moved_by: Shift of the times [ns].

    Raises:
        LogError: The file cannot be read, lacks a column, or has a cell that is not a number; the
            text names line and column.
    """

    def __init__(
        self,
        path: Path,
        *,
        columns: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        joints: Sequence[str] = (),
        assume_zero_torque: bool = False,
    ) -> None:
        self.path, self.topic = path, path.name
        try:
            with path.open(encoding="utf-8-sig", newline="") as stream:
                lines = _lines(stream.read())
            header = _Header(next(lines, (0, []))[1], columns or {}, units or {})
            time = header.time()
            only = joints[0] if len(joints) == 1 else "elastic_joint"
            angles, torques = header.of_joints(only, torque_needed=not assume_zero_torque)
            if missing := [joint for joint in joints if joint not in angles]:
                raise LogError(
                    f"no angle of {', '.join(missing)}; there are angles of {', '.join(angles)}"
                )
            self.joints = tuple(joints) or tuple(angles)
            own = [[each[j] for j in self.joints] if each else [] for each in (angles, torques)]
            table = _read(lines, time, *own)
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise LogError(f"{path}: cannot read it: {error}") from error
        except LogError as error:
            raise LogError(f"{path}: {error}") from error
        if not len(table.stamps):
            raise LogError(f"{path}: no lines below the header")
        self.moved_by, stamps = _moved(table.stamps)
        self.samples = _samples(stamps, table)
        if self.moved_by:
            shift = f"{self.moved_by / NANOSECONDS:g} s"
            self.remarks = (f"note: {shift} was added to all times: 0 means no time",)

    @property
    def topics(self) -> tuple[TopicInfo, ...]:  # type: ignore[override]
        qos = (QosProfile(reliability="best_effort"),)
        definition = find_definition(JOINT_STATE)
        return (
            TopicInfo(f"/{MEASUREMENTS}", JOINT_STATE, qos_profiles=qos, definition=definition),
        )

    def messages(self) -> Iterator[BagMessage]:
        encode, samples = JointStateEncoder(self.joints), self.samples
        for begin in range(0, samples.count, _BLOCK):
            block = slice(begin, begin + _BLOCK)
            y, u = samples.y[block], samples.u[block]
            data = encode.encode_all(samples.stamps[block], y, y[:, :0], u)
            for one, time in zip(data, samples.log_times[block].tolist(), strict=True):
                yield BagMessage(f"/{MEASUREMENTS}", JOINT_STATE, one, time, time)


class _Header:
    """The header line, in which columns are found by given or by usual names.

    Raises:
        LogError: A given name is of no quantity.
    """

    def __init__(
        self, titles: Sequence[str], wanted: Mapping[str, str], units: Mapping[str, str]
    ) -> None:
        for option, keys in (("--columns", wanted), ("--units", units)):
            for key in keys:
                quantity = key.partition(".")[0] if option == "--columns" else key
                if quantity not in _UNITS:
                    raise LogError(f"{option}: expected time, angle or torque, got {key!r}")
        self._columns = []
        for place, title in enumerate(titles):
            match = _HEADER.fullmatch(title)
            assert match is not None, "everything matches"
            self._columns.append(_Column(place, title, match["name"], match["unit"] or ""))
        self._wanted, self._units = wanted, units
        self._has = f"columns: {', '.join(map(repr, titles))}"

    def time(self) -> _Column:
        if "time" in self._wanted:
            return self._named("time", self._wanted["time"])
        for guess in _GUESSES["time"]:
            for one in self._columns:
                if one.name.lower() == guess:
                    return self._with_unit("time", one)
        raise LogError(f"no column looks like the time; name it: --columns time=…; {self._has}")

    def of_joints(
        self, only: str, *, torque_needed: bool
    ) -> tuple[dict[str, _Column], dict[str, _Column]]:
        """Return angles and torques by joint, no torques if there are none and none is needed."""
        angles, torques = self._found("angle", only), self._found("torque", only)
        if not angles:
            raise LogError(
                f"no column looks like an angle; name it: --columns angle=…; {self._has}"
            )
        missing = [name for name in angles if name not in torques]
        if missing and (torques or torque_needed):
            raise LogError(
                f"no column looks like the torque of {', '.join(missing)}; name it: --columns "
                f"torque=…, or take it for 0: --param assume_zero_torque=true; {self._has}"
            )
        return angles, torques

    def _found(self, quantity: str, only: str) -> dict[str, _Column]:
        """Return the columns of a quantity by joint; `only` is the joint of a plain name."""
        given = [(*key.partition(".")[::2], name) for key, name in self._wanted.items()]
        if own := [(of, name) for kind, of, name in given if kind == quantity]:
            return {of or only: self._named(quantity, name) for of, name in own}
        for guess in _GUESSES[quantity]:
            found = {}
            for one in self._columns:
                name, _, of = one.name.partition(".")
                if name.lower() == guess:
                    found[of or only] = self._with_unit(quantity, one)
            if found:
                return found
        return {}

    def _named(self, quantity: str, name: str) -> _Column:
        found = [one for one in self._columns if name in (one.title.strip(), one.name)]
        if len(found) != 1:
            what = "several columns are" if found else "no column is"
            raise LogError(f"{what} called {name!r}; {self._has}")
        return self._with_unit(quantity, found[0])

    def _with_unit(self, quantity: str, column: _Column) -> _Column:
        unit = re.sub(r"[\s.*·⋅]", "", column.unit or self._units.get(quantity, ""))
        if quantity == "time" and unit.upper() in ("ISO", "ISO8601"):
            unit = _ISO
        elif unit and unit not in _UNITS[quantity]:
            known = ", ".join(_UNITS[quantity])
            raise LogError(
                f"column {column.title!r}: unit {unit!r} of {quantity} is not known; "
                f"there are {known}"
            )
        return column._replace(unit=unit)


def _lines(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the cells of every line that is not empty."""
    first = text.partition("\n")[0]
    delimiter = max(",;\t", key=first.count)
    reader = csv.reader(text.splitlines(), delimiter=delimiter, skipinitialspace=True)
    for cells in reader:
        if any(cell.strip() for cell in cells):
            yield reader.line_num, cells


def _read(
    lines: Iterator[tuple[int, list[str]]],
    time: _Column,
    angles: Sequence[_Column],
    torques: Sequence[_Column],
) -> _Table:
    stamps: list[int] = []
    rows: list[list[float]] = []
    numbers = [(one, _UNITS["angle"].get(one.unit, 1.0)) for one in angles]
    numbers += [(one, _UNITS["torque"].get(one.unit, 1.0)) for one in torques]
    read_time: Callable[[str], int] | None = None
    for line, cells in lines:
        text = _cell(line, cells, time)
        try:
            if read_time is None and text:
                read_time = _time_reader(time, text)
            stamps.append(read_time(text) if read_time and text else _NO_TIME)
        except (ValueError, InvalidOperation, OverflowError) as error:
            raise _not_a("time", line, time, text) from error
        row = []
        for column, factor in numbers:
            text = _cell(line, cells, column)
            try:
                row.append(float(text) * factor if text else math.nan)
            except ValueError as error:
                raise _not_a("number", line, column, text) from error
        rows.append(row)
    count = len(angles)
    values = np.array(rows, dtype=np.float64).reshape(len(rows), len(numbers))
    u = values[:, count:] if torques else np.zeros((len(rows), count))
    return _Table(np.array(stamps, dtype=np.int64), values[:, :count], u)


def _cell(line: int, cells: Sequence[str], column: _Column) -> str:
    if column.place >= len(cells):
        raise LogError(
            f"line {line}: {len(cells)} cells, but column {column.title!r} is number "
            f"{column.place + 1}"
        )
    return cells[column.place].strip()


def _not_a(what: str, line: int, column: _Column, text: str) -> LogError:
    unit = f" in {column.unit}" if column.unit else ""
    return LogError(
        f"line {line}, column {column.title!r}: expected a {what}{unit}, got {shown(text)}"
    )


def _time_reader(column: _Column, first: str) -> Callable[[str], int]:
    """Return a reader of times in the column's unit; without one, the first cell decides."""
    unit = column.unit
    if unit == _ISO or (not unit and re.match(r"\d{4}-\d", first)):
        return _iso_time
    if not unit:
        unit = "ns" if first.isdigit() and int(first) >= _MIN_EPOCH_NS else "s"
    factor = Decimal(_UNITS["time"][unit])

    def read(text: str) -> int:
        # A decimal, because a double has no nanoseconds left at today's dates.
        time = int((Decimal(text) * factor).to_integral_value())
        if abs(time) >= _LATEST:
            raise ValueError("beyond what a stamp can hold")
        return time

    return read


def _iso_time(text: str) -> int:
    """Return a date and time in nanoseconds, in UTC unless it has an offset."""
    fraction = _FRACTION.search(text)
    digits = fraction[1] if fraction else ""
    whole = text.replace(fraction[0], "", 1) if fraction else text
    moment = datetime.fromisoformat(whole)
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return int(moment.timestamp()) * NANOSECONDS + int(digits[:9].ljust(9, "0") if digits else 0)


def _moved(stamps: Times) -> tuple[int, Times]:
    """Return the shift, and stamps that are all after zero, or zero for an empty cell."""
    there = stamps != _NO_TIME
    first = int(stamps[there].min()) if there.any() else 1
    moved_by = 0 if first > 0 else NANOSECONDS - first
    return moved_by, np.where(there, stamps + np.where(there, moved_by, 0), 0)


def _samples(stamps: Times, table: _Table) -> Samples:
    there = np.ones(table.angles.shape, np.bool_)
    # A late line keeps its place: its log time is a moment after that of the line before it.
    times = np.concatenate([_increasing(stamps[a:b]) for a, b in passes(stamps.tolist())])
    return Samples(stamps, times, times, table.angles, table.torques, there, there)


def _increasing(stamps: Times) -> Times:
    """Return the stamps, each that is not later than all before it as the next nanosecond."""
    place = np.arange(len(stamps))
    return np.asarray(np.maximum.accumulate(stamps - place) + place)
