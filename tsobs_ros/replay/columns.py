# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A CSV file as columns with declared names and units, and lines of cells."""

import codecs
import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple, TextIO

from tsobs_ros.checks import shown
from tsobs_ros.errors import LogError
from tsobs_ros.series import NANOSECONDS

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

_NOTHING = frozenset(("", "-", "na", "n/a", "nan", "null", "none"))
_COMMENTS = ("#", "%", "//")
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_FRACTION = re.compile(r"(?<=:\d\d)[.,](\d+)")
_BLANKS, _DELIMITERS = " ", ";\t|,"
# Below it a time in seconds is exact to the nanosecond as a double [s].
_EXACT = 1e6
_MAX_SHOWN = 20
_OPEN_QUOTE = "a quote opens a cell that is not closed there"


class LogColumn(NamedTuple):
    """A column.

    Attributes:
        place: Its place from 0.
        title: Its title, as it is written.
        name: The title without unit.
        unit: The title's unit; empty if there is none.
    """

    place: int
    title: str
    name: str
    unit: str


Row = tuple[int, Sequence[str]]
"""The number of a line, from 1, and its cells."""


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
            lines = (line for line in _lines(stream) if not _is_passed_over(line))
            first = next(lines, None)
        if first is None:
            raise LogError("the file is empty")
        counts = {sign: first.count(sign) for sign in _DELIMITERS}
        self._delimiter = max(counts, key=counts.__getitem__) if any(counts.values()) else _BLANKS
        if self._delimiter == _BLANKS:
            # Blanks before a unit do not end a title.
            first = re.sub(r"\s+(?=[\[(])", "", re.sub(r"(?<=[\[(])[^\])]*", _packed, first))
        ((_, titles),) = self._split([first])
        self.has_titles = not any(_is_number(title, ",") for title in titles)
        if not self.has_titles:
            titles = [str(place + 1) for place in range(len(titles))]
        self.columns = []
        for place, title in enumerate(titles):
            name, unit = _split_title(title.strip())
            self.columns.append(LogColumn(place, title.strip(), name, unit))

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

    def rows(self, places: Sequence[int]) -> Iterator[Row]:
        """Yield the cells of some columns, line by line.

        Raises:
            OSError: The file cannot be read.
            LogError: A line or a cell is too long, has more cells than there are titles, or ends
                early but is not the last.
        """
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

    def number(self, text: str) -> float:
        """Return the number in a cell, NaN if it is empty or a word for that.

        Raises:
            ValueError: It is no number.
        """
        text = text.strip()
        if text.lower() in _NOTHING:
            return math.nan
        return float(self._pointed(text))

    def stamp(self, text: str, unit: str) -> int:
        """Return the time in a cell [ns], `NO_TIME` if it is empty; dates are ISO 8601, in UTC.

        Raises:
            ValueError: It is no time.
        """
        text = text.strip()
        if text.lower() in _NOTHING:
            return NO_TIME
        if ":" in text:
            match = _FRACTION.search(text)
            fraction = match[1][:9].ljust(9, "0") if match else "0"
            moment = datetime.fromisoformat(text.replace(match[0], "", 1) if match else text)
            moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
            stamp = int(moment.timestamp()) * NANOSECONDS + int(fraction)
        else:
            # A double has no nanoseconds left at today's dates.
            number, size = self._pointed(text), UNITS["time"][unit]
            stamp = round(float(number) * size) if abs(float(number)) * size < _EXACT else 0
            stamp = stamp or round(Decimal(number) * int(size))
        if abs(stamp) >= LATEST:
            raise ValueError("beyond what a stamp can hold")
        return stamp

    def _pointed(self, text: str) -> str:
        """Return a number with a decimal point."""
        is_comma = self._delimiter != "," and _COMMA.fullmatch(text) is not None
        return text.replace(",", ".") if is_comma else text

    def _open(self) -> TextIO:
        # Only titles may have other letters than ASCII.
        return self._path.open(encoding=self._encoding, errors="replace", newline="")

    def _split(self, lines: "Iterator[str] | Sequence[str]") -> Iterator[Row]:
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


def _split_title(title: str) -> tuple[str, str]:
    """Return the name and the unit of a title such as "q [rad]"; "q[1]" has none."""
    start = max(title.rfind("["), title.rfind("("))
    unit = title[start + 1 : -1].strip()
    if start < 0 or title[-1] not in "])" or not unit or unit.isdigit():
        return title, ""
    return title[:start].rstrip(), unit


def misread(what: str, line: int, column: LogColumn, unit: str, text: str) -> LogError:
    """Return the error of a cell that is not what was expected."""
    hint = ""
    if what == "time":
        hint = ": write seconds, or ISO 8601 such as 2026-01-31T12:00:00.005"
        if not re.search(r"\d[:/]\d", text) and any(map(str.isdigit, text)):
            hint = ": a stamp holds 68 years; is its unit another, as in --units time=ns?"
    elif "," in text or "." in text:
        hint = ": write thousands without a sign"
    return LogError(
        f"line {line}, column {column.title!r}: expected a {what}{unit and f' in {unit}'}, got "
        f"{shown(text)}{hint}"
    )


def unit_of(quantity: str, text: str) -> str:
    """Return the name in `UNITS` of a unit, an empty string if it is none of the quantity."""
    unit = re.sub(r"[\s.*·-]", "", text).replace("°", "deg").replace("µ", "u").replace("μ", "u")
    known = {name.lower(): name for name in UNITS[quantity]}
    return unit if unit in UNITS[quantity] else known.get(unit.lower(), "")


def _packed(match: "re.Match[str]") -> str:
    return "".join(match[0].split())


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
