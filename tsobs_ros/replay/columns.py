# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Columns of CSV files as people and programs write them: text, cells, numbers, units and times."""

import codecs
import csv
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from decimal import Decimal
from itertools import islice
from pathlib import Path
from typing import NamedTuple, TextIO, TypeAlias

import numpy as np

from tsobs_ros.checks import Array, shown
from tsobs_ros.errors import LogError
from tsobs_ros.series import NANOSECONDS, Stamps

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180},
    "velocity": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": math.pi / 180, "rpm": math.pi / 30},
    "torque": {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "Ncm": 1e-2, "kNm": 1e3},
}
"""Each unit in ns, rad, rad/s or N m."""

MAX_LINE = 2**20
"""Largest number of characters in a line: bounds the memory, whatever the file is."""

NO_TIME = -(2**62)
"""Stamp of a line without a time."""

LATEST = 2**31 * NANOSECONDS
"""The first time that a message's stamp cannot hold [ns]."""

_BLOCK = 4096
_NOTHING = frozenset(("", "-", "na", "n/a", "nan", "null", "none"))
_COMMENTS = ("#", "%", "//")
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_FRACTION = re.compile(r"(?<=:\d\d)[.,](\d+)")
_BLANKS, _DELIMITERS = " ", ";\t|,"
_MAX_SHOWN = 20
_OPEN_QUOTE = "a quote opens a cell that is not closed there"

_Row: TypeAlias = tuple[int, Sequence[str]]
"""The number of a line, from 1, and its cells."""


class LogColumn(NamedTuple):
    """A column.

    Attributes:
        place: Its place from 0.
        title: Its title, as it is written.
        name: The title without unit.
        unit: The unit; empty if there is none.
        factor: Size of the unit in `UNITS`.
    """

    place: int
    title: str
    name: str
    unit: str
    factor: float = 1.0


@contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Make errors of reading a file `LogError`s that name it."""
    try:
        yield
    except OSError as error:
        raise LogError(f"{path}: cannot read it: {error.strerror or error}") from error
    except LogError as error:
        raise LogError(f"{path}: {error}") from error


class CsvFile:
    """A file of lines of cells, read line by line; its first line has the titles.

    Args:
        path: The file.

    Attributes:
        columns: The columns; if the first line has numbers, their titles are 1, 2 and so on.
        cut_off: Whether the last line that was read ends early, as of a logger that was killed.

    Raises:
        OSError: The file cannot be read.
        LogError: It is empty or no text, or its first line is too long.
    """

    def __init__(self, path: Path) -> None:
        self._path, self.cut_off = path, False
        with path.open("rb") as file:
            self._encoding = _encoding(file.read(2**16))
        with self._open() as stream:
            first = next((line for line in _lines(stream) if not _is_passed_over(line)), None)
        if first is None:
            raise LogError("the file is empty")
        counts = {sign: first.count(sign) for sign in _DELIMITERS}
        self._delimiter = max(counts, key=counts.__getitem__) if any(counts.values()) else _BLANKS
        if self._delimiter == _BLANKS:
            # Blanks before a unit do not end a title, nor do those in it.
            first = re.sub(r"\s+(?=[\[(])", "", first)
            first = re.sub(r"(?<=[\[(])[^\])]*", lambda match: "".join(match[0].split()), first)
        ((_, titles),) = self._split([first])
        self.has_titles = not any(_is_number(title, ",") for title in titles)
        if not self.has_titles:
            titles = [str(place + 1) for place in range(len(titles))]
        self.columns = [
            LogColumn(place, title.strip(), *_split_title(title.strip()))
            for place, title in enumerate(titles)
        ]

    @property
    def described(self) -> str:
        """The titles, for errors."""
        titles = ", ".join(repr(one.title) for one in self.columns[:_MAX_SHOWN])
        return f"columns: {titles}{', …' if len(self.columns) > _MAX_SHOWN else ''}"

    def called(self, name: str) -> LogColumn:
        """Return the column of a title, a name or a number from 1.

        Raises:
            LogError: There is none, or there are several.
        """
        found = [one for one in self.columns if name in (one.title, one.name)]
        if not found and name.isdigit() and 0 < int(name) <= len(self.columns):
            found = [self.columns[int(name) - 1]]
        if len(found) != 1:
            what = "several columns are" if found else "no column is"
            raise LogError(f"{what} called {name!r}; a column's number will do; {self.described}")
        return found[0]

    def named(self, name: str) -> list[LogColumn]:
        """Return the columns of a name, in capitals or not."""
        return [one for one in self.columns if one.name.lower() == name.lower()]

    def read(
        self, time: LogColumn, columns: Sequence[LogColumn]
    ) -> Iterator[tuple[list[int], Stamps, Array]]:
        """Yield line numbers, times [ns] and values of n lines each, shape (n, columns).

        Values are in the units of `UNITS` that are 1, NaN of cells that are empty or a word for it.

        Raises:
            OSError: The file cannot be read.
            LogError: A line or a cell is too long, has more cells than there are titles, or ends
                early but is not the last; or a cell is not what is expected.
        """
        rows = self._rows([column.place for column in (time, *columns)])
        while block := list(islice(rows, _BLOCK)):
            values = np.empty((len(block), len(columns)))
            for place, column in enumerate(columns):
                numbers = np.array(self._numbers(block, place + 1, column))
                values[:, place] = numbers * column.factor
            stamps = [self._stamp(line, cells[0], time) for line, cells in block]
            yield [line for line, _ in block], np.array(stamps, np.int64), values

    def _rows(self, places: Sequence[int]) -> Iterator[_Row]:
        """Yield the cells of some columns, line by line."""
        width, wanted = len(self.columns), max(places)
        with self._open() as stream:
            rows = self._split(_lines(stream))
            if self.has_titles:
                next(rows, None)
            for line, cells in rows:
                if len(cells) != width:
                    if not any(map(str.strip, cells)):
                        continue
                    if len(cells) <= wanted:
                        self.cut_off = next(rows, None) is None
                        if self.cut_off:
                            return
                        title = self.columns[len(cells)].title
                        raise LogError(f"line {line} ends before column {title!r}")
                    if any(cells[width:]):
                        hint = ""
                        if self._delimiter == ",":
                            hint = ": with decimal commas, separate cells by semicolons or tabs"
                        raise LogError(f"line {line}: {len(cells)} cells, but {width} titles{hint}")
                yield line, [cells[place] for place in places]

    def _numbers(self, rows: Sequence[_Row], place: int, column: LogColumn) -> list[float]:
        """Return the numbers in a column of some lines."""
        with suppress(ValueError):
            return [float(cells[place]) for _, cells in rows]
        found = []
        for line, cells in rows:
            text = cells[place].strip()
            try:
                known = text.lower() not in _NOTHING
                found.append(float(self._pointed(text)) if known else math.nan)
            except ValueError as error:
                raise _misread("number", line, column, text) from error
        return found

    def _stamp(self, line: int, text: str, time: LogColumn) -> int:
        """Return the time in a cell [ns], `NO_TIME` if it is empty; dates are ISO 8601, in UTC."""
        text = text.strip()
        if text.lower() in _NOTHING:
            return NO_TIME
        try:
            if ":" in text:
                match = _FRACTION.search(text)
                fraction = match[1][:9].ljust(9, "0") if match else "0"
                moment = datetime.fromisoformat(text.replace(match[0], "", 1) if match else text)
                moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
                stamp = int(moment.timestamp()) * NANOSECONDS + int(fraction)
            else:
                # A double has no nanoseconds left at today's dates.
                stamp = round(Decimal(self._pointed(text)) * int(time.factor))
        except (ValueError, ArithmeticError) as error:
            raise _misread("time", line, time, text) from error
        if abs(stamp) >= LATEST:  # beyond what a message can hold
            raise _misread("time", line, time, text)
        return stamp

    def _pointed(self, text: str) -> str:
        """Return a number with a decimal point."""
        is_comma = self._delimiter != "," and _COMMA.fullmatch(text) is not None
        return text.replace(",", ".") if is_comma else text

    def _open(self) -> TextIO:
        # Only titles may have other letters than ASCII.
        return self._path.open(encoding=self._encoding, errors="replace", newline="")

    def _split(self, lines: Iterable[str]) -> Iterator[_Row]:
        """Yield the number and the cells of every line that is not passed over."""
        if self._delimiter == _BLANKS:
            numbered = enumerate(lines, 1)
            yield from ((n, line.split()) for n, line in numbered if not _is_passed_over(line))
            return
        reader = csv.reader(lines, delimiter=self._delimiter, skipinitialspace=True)
        last = 0
        try:
            for cells in reader:
                if reader.line_num > last + 1:
                    raise LogError(f"line {last + 1}: {_OPEN_QUOTE}")
                last = reader.line_num
                if cells and not cells[0].startswith(_COMMENTS) and any(cells):
                    yield last, cells
        except csv.Error as error:
            raise LogError(f"line {last + 1}: {error}; perhaps {_OPEN_QUOTE}") from error


def with_unit(column: LogColumn, quantity: str, given: str = "") -> LogColumn:
    """Return a column with the unit of its title, else a given one, else the first of `UNITS`.

    Raises:
        LogError: A unit is unknown, or there are two.
    """
    known = UNITS[quantity]
    for text in (column.unit, given):
        if text and not _unit_of(quantity, text):
            raise LogError(
                f"column {column.title!r}: unit {text!r} of {quantity} is not known; "
                f"there are {', '.join(known)}"
            )
    stated, other = (_unit_of(quantity, text) for text in (column.unit, given))
    if stated and given and stated != other:
        raise LogError(
            f"column {column.title!r}: its unit is {column.unit!r}, but --units says "
            f"{quantity}={given}"
        )
    unit = stated or other or next(iter(known))
    return column._replace(unit=unit, factor=known[unit])


def _split_title(title: str) -> tuple[str, str]:
    """Return the name and the unit of a title such as "q [rad]"; "q[1]" has none."""
    start = max(title.rfind("["), title.rfind("("))
    unit = title[start + 1 : -1].strip()
    if start < 0 or title[-1] not in "])" or not unit or unit.isdigit():
        return title, ""
    return title[:start].rstrip(), unit


def _misread(what: str, line: int, column: LogColumn, text: str) -> LogError:
    """Return the error of a cell that is not what was expected."""
    hint = ""
    if what == "time":
        hint = ": write seconds, or ISO 8601 such as 2026-01-31T12:00:00.005"
        if not re.search(r"\d[:/]\d", text) and any(map(str.isdigit, text)):
            hint = ": a stamp holds 68 years; is its unit another, as in --units time=ns?"
    elif "," in text or "." in text:
        hint = ": write thousands without a sign"
    in_unit = f" in {column.unit}" if column.unit else ""
    return LogError(
        f"line {line}, column {column.title!r}: expected a {what}{in_unit}, got {shown(text)}{hint}"
    )


def _unit_of(quantity: str, text: str) -> str:
    """Return the name in `UNITS` of a unit, an empty string if it is none of the quantity."""
    unit = re.sub(r"[\s.*·-]", "", text).replace("°", "deg").replace("µ", "u").replace("μ", "u")
    known = {name.lower(): name for name in UNITS[quantity]}
    return unit if unit in UNITS[quantity] else known.get(unit.lower(), "")


def _is_number(text: str, delimiter: str) -> bool:
    try:
        float(text.replace(",", ".") if delimiter != "," else text)
    except ValueError:
        return False
    return True


def _is_passed_over(line: str) -> bool:
    return not line.strip() or line.lstrip().startswith(_COMMENTS)


def _encoding(head: bytes) -> str:
    """Return the encoding of a file that begins like this."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if b"\0" in head or head.startswith((b"\x1f\x8b", b"BZh", b"\xfd7zXZ", b"\x28\xb5\x2f\xfd")):
        raise LogError("it is no text: expected CSV, in UTF-8, UTF-16 or Windows-1252")
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def _lines(stream: TextIO) -> Iterator[str]:
    for number, line in enumerate(iter(lambda: stream.readline(MAX_LINE + 1), ""), 1):
        if len(line) > MAX_LINE:
            raise LogError(f"line {number} is longer than {MAX_LINE:,} characters")
        yield line
