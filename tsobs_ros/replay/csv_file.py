# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""CSV files of stamped numbers: titles with units, cells, and errors that name line and column."""

import csv
import math
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from decimal import Decimal
from io import TextIOWrapper
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array, shown
from tsobs_ros.errors import LogError
from tsobs_ros.files import naming_path, open_regular
from tsobs_ros.series import NANOSECONDS, Stamps

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180},
    "velocity": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": math.pi / 180, "rpm": math.pi / 30},
    "torque": {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "Ncm": 1e-2, "kNm": 1e3},
}
"""The size of each unit in ns, rad, rad/s or N m; the first unit is the usual one."""

MAX_LINE = 2**20
"""Largest number of characters in a line, which bounds the memory for any file."""

NO_TIME = -(2**62)
"""Stamp of a line without a time."""

_LATEST = 2**31 * NANOSECONDS  # beyond the stamp of any message
_NOTHING = frozenset(("", "nan", "n/a", "null"))
_FRACTION = re.compile(r"(?<=:\d\d)[.,](\d+)")
_UNIT = re.compile(r"(.*?)\s*[\[(]\s*([^\d\])][^\])]*)[\])]")


class Column(NamedTuple):
    """A column: its place from 0, its title, the title's name and unit, and the unit's size."""

    place: int
    title: str
    name: str
    unit: str
    factor: float = 1.0

    def in_units_of(self, quantity: str, given: str = "") -> "Column":
        """Return the column with the unit of its title, else the given one, else the usual one.

        Raises:
            LogError: A unit is unknown, or the given one differs from that of the title.
        """
        known = UNITS[quantity]
        plain = {plain_unit(name): name for name in known}
        for text in filter(None, (self.unit, given)):
            if plain_unit(text) not in plain:
                raise LogError(
                    f"column {self.title!r}: unit {text!r} of {quantity} is not known; "
                    f"there are {', '.join(known)}"
                )
        if self.unit and given and plain_unit(self.unit) != plain_unit(given):
            raise LogError(f"column {self.title!r}: its unit is not the given one, {given!r}")
        unit = plain.get(plain_unit(self.unit or given), next(iter(known)))
        return self._replace(unit=unit, factor=known[unit])


def plain_unit(text: str) -> str:
    """Return a unit in a form to compare: without signs of products, in lower case but for mega."""
    text = re.sub(r"[\s.*·⋅-]", "", text)
    text = text.replace("°", "deg").replace("µ", "u").replace("μ", "u")
    return text if re.match("M(Nm|s|rad|deg)", text) else text.lower()


@contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Turn errors of reading a file into `LogError`s that name the file."""
    with naming_path(path, LogError):
        try:
            yield
        except UnicodeDecodeError as error:
            raise LogError(f"{path}: expected text in UTF-8") from error
        except LogError as error:
            raise LogError(f"{path}: {error}") from error


class CsvFile:
    """A CSV file, read line by line; its first line has the titles.

    Attributes:
        columns: The columns.
        cut_off: Whether the last line that was read ends early, as after a kill of the logger.

    Raises:
        OSError: The file cannot be read.
        UnicodeDecodeError: It is not text in UTF-8.
        LogError: It is empty, or its first line is too long.
    """

    def __init__(self, path: Path) -> None:
        self._path, self.cut_off, self._is_unended = path, False, False
        first = next((line for line in self._lines() if line.strip()), "")
        self._delimiter = max(",;\t", key=first.count)
        _, titles = next(self._rows(), (0, []))
        if not titles:
            raise LogError("the file is empty")
        self.columns = []
        for place, title in enumerate(map(str.strip, titles)):
            match = _UNIT.fullmatch(title)
            name, unit = match.groups() if match else (title, "")
            self.columns.append(Column(place, title, name, unit))

    def find(self, name: str) -> Column | None:
        """Return the column with a name or title, ignoring case; None if there is none.

        Raises:
            LogError: There are several such columns.
        """
        each = ((one, {one.name.lower(), one.title.lower()}) for one in self.columns)
        found = [one for one, own in each if name.lower() in own]
        if len(found) > 1:
            raise LogError(f"several columns are called {name!r}; {self.described}")
        return found[0] if found else None

    @property
    def described(self) -> str:
        """The titles, for errors."""
        titles = ", ".join(repr(one.title) for one in self.columns[:20])
        return f"columns: {titles}{', …' if len(self.columns) > 20 else ''}"

    def read(self, time: Column, columns: Sequence[Column]) -> tuple[list[int], Stamps, Array]:
        """Return line numbers, times [ns] and values of n lines, shape (n, columns).

        Values are in the usual units, NaN for cells that are empty or have a word for nothing.

        Raises:
            OSError: The file cannot be read.
            LogError: A line or a cell is too long, has more cells than there are titles, or ends
                early but is not the last; or a cell is not a number, or not a time.
        """
        needed = 1 + max(one.place for one in (time, *columns))
        lines, stamps, values, rows = list[int](), array("q"), array("d"), self._rows()
        next(rows, None)
        for line, cells in rows:
            if len(cells) < needed:
                self.cut_off = next(rows, None) is None
                if not self.cut_off:
                    title = self.columns[len(cells)].title
                    raise LogError(f"line {line} ends before column {title!r}")
                break
            if any(cells[len(self.columns) :]):
                raise LogError(f"line {line}: {len(cells)} cells, but {len(self.columns)} titles")
            try:
                stamp = self._stamp(line, cells, time)
                numbers = [self._number(line, cells, one) for one in columns]
            except LogError:
                self.cut_off = self._is_unended
                if not self.cut_off:
                    raise
                break
            lines.append(line)
            stamps.append(stamp)
            values.extend(numbers)
        factors = np.array([one.factor for one in columns])
        table = np.array(values).reshape(-1, len(columns)) * factors
        return lines, np.array(stamps, np.int64), table

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        reader, last = csv.reader(self._lines(), delimiter=self._delimiter), 0
        try:
            for cells in reader:
                if reader.line_num > last + 1:
                    raise LogError(
                        f"line {last + 1}: a quote opens a cell that is not closed there"
                    )
                last = reader.line_num
                if any(map(str.strip, cells)):
                    yield last, cells
        except csv.Error as error:
            raise LogError(f"line {last + 1}: {error}") from error

    def _lines(self) -> Iterator[str]:
        """Yield the lines; a comment becomes an empty line."""
        with TextIOWrapper(open_regular(self._path), "utf-8-sig", newline="") as stream:
            lines = iter(lambda: stream.readline(MAX_LINE + 1), "")
            for number, line in enumerate(lines, 1):
                if len(line) > MAX_LINE:
                    raise LogError(f"line {number} is longer than {MAX_LINE:,} characters")
                self._is_unended = not line.endswith(("\n", "\r"))
                yield "" if line.lstrip().startswith("#") else line

    def _number(self, line: int, cells: Sequence[str], column: Column) -> float:
        try:
            text = self._pointed(cells[column.place])
            return math.nan if text.lower() in _NOTHING else float(text)
        except ValueError as error:
            what = f"number in {column.unit}" if column.unit else "number"
            raise _misread(what, line, cells, column) from error

    def _stamp(self, line: int, cells: Sequence[str], time: Column) -> int:
        """Return the time in a cell [ns], `NO_TIME` if it is empty; dates are ISO 8601, in UTC."""
        text = cells[time.place].strip()
        if text.lower() in _NOTHING:
            return NO_TIME
        try:
            if ":" in text:
                match = _FRACTION.search(text)
                moment = datetime.fromisoformat(_FRACTION.sub("", text, count=1))
                moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
                fraction = int(match[1][:9].ljust(9, "0")) if match else 0
                stamp = int(moment.timestamp()) * NANOSECONDS + fraction
            else:
                # A double cannot resolve nanoseconds at today's dates.
                stamp = round(Decimal(self._pointed(text)) * int(time.factor))
        except (ValueError, ArithmeticError) as error:
            raise _misread(f"time in {time.unit}, or ISO 8601", line, cells, time) from error
        if abs(stamp) >= _LATEST:
            problem = _misread(f"time in {time.unit} below 68 years", line, cells, time)
            raise LogError(f"{problem}; of another unit? --units time=ns")
        return stamp

    def _pointed(self, text: str) -> str:
        """Return a number with a decimal point; commas that separate no cells are decimal.

        Raises:
            ValueError: It has an underscore, which Python would leave out.
        """
        if "_" in text:
            raise ValueError
        return text.strip() if self._delimiter == "," else text.strip().replace(",", ".")


def _misread(what: str, line: int, cells: Sequence[str], column: Column) -> LogError:
    got = shown(cells[column.place].strip())
    return LogError(f"line {line}, column {column.title!r}: expected a {what}, got {got}")


def read_torques(path: str | Path) -> tuple[Array, Array]:
    """Return rising times since the first one [s] and torques [N m] of a CSV file, shape (n,).

    Its columns are called `time` and `torque`, as in the files of `tsobs excite`.

    Raises:
        LogError: The file cannot be read, lacks a column, or has a cell that is no finite number,
            or times that do not rise; the text names file and line.
    """
    with naming_file(Path(path)):
        file, columns = CsvFile(Path(path)), []
        for name in ("time", "torque"):
            if (column := file.find(name)) is None:
                raise LogError(f"no column is called {name!r}; {file.described}")
            columns.append(column.in_units_of(name))
        lines, times, values = file.read(columns[0], columns[1:])
        if not lines:
            raise LogError("no lines below the header")
        torques = values[:, 0]
        for wrong, text in (
            ((times == NO_TIME) | ~np.isfinite(torques), "expected a time and a finite torque"),
            (np.diff(times, prepend=NO_TIME) <= 0, "its time is not after that of the line before"),
        ):
            if wrong.any():
                raise LogError(f"line {lines[int(wrong.argmax())]}: {text}")
    return (times - times[0]) / NANOSECONDS, torques
