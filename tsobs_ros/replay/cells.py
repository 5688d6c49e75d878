# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The cells of a text table in any of the forms in which programs write one.

The csv module splits lines into cells. What a CSV file does not state is found from its first
lines: encoding, separator, and which of them are remarks, titles, units and numbers.
"""

import codecs
import csv
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import itemgetter
from pathlib import Path
from typing import TextIO

from tsobs_ros.errors import LogError

MAX_LINE = 2**20
"""Largest number of characters in a line: bounds the memory, whatever the file is."""

_MAX_CELL = 1000
_MAX_COLUMNS = 10_000
_HEAD_LINES = 100
_HEAD_CELLS = 1000
_HEAD_BYTES = 2**16

_FORMATS: Sequence[tuple[bytes, str]] = (
    (b"\x1f\x8b", "gzip data: unpack it first"),
    (b"BZh", "bzip2 data: unpack it first"),
    (b"\xfd7zXZ\0", "xz data: unpack it first"),
    (b"\x28\xb5\x2f\xfd", "Zstandard data: unpack it first"),
    (b"PK\x03\x04", "a zip archive or an Excel workbook: unpack it first, or save it as CSV"),
    (b"\xd0\xcf\x11\xe0", "an Excel workbook: save it as CSV"),
    (b"PAR1", "a Parquet file: write it as CSV"),
    (b"\x89HDF", "an HDF5 or MATLAB file: write it as CSV"),
    (b"MATLAB ", "a MATLAB file: write it with writetable"),
    (b"SQLite format", "an SQLite file: convert it with ros2 bag convert"),
)
_MARKS: Sequence[tuple[bytes, str]] = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_SEPARATORS = "\t;|, "
_SEPARATOR_LINE = re.compile(r'"?sep=(.)"?\s*')
_BRACKETS = re.compile(r"\s{0,3}[\[({][^\])}]{0,20}[\])}]")
_COMMENTS = ("#", "%", "//")
_NOTHING = frozenset(("", "-", "na", "n/a", "#n/a", "nan", "-nan", "null", "none"))
_TIME = re.compile(r"\d+([-/.])\w+\1\d+([T ].*)?|\d+:\d+(:[\d.,]+)?|[+-]?[\d.,]+ ?m?s(ec)?")
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_GROUPS = {
    sign: re.compile(rf"[+-]?\d{{1,3}}([{other}'’\s]\d{{3}})+[{sign}]\d+")
    for sign, other in (".,", ",.")
}

Row = tuple[int, Sequence[str]]
"""The number of a line, from 1, and its cells."""


class TextTable:
    """A file of lines of cells; never more than the first lines and one other are in memory.

    Args:
        path: The file.
        is_unit: Whether a cell is a unit.

    Attributes:
        titles: Titles of the columns; their numbers, from 1, if there is no line of titles.
        has_titles: Whether there is one.
        units: Cells of a line of units below the titles, empty strings without.
        cut_off: Whether the last line that was read ends early, as of a logger that was killed.

    Raises:
        OSError: The file cannot be read.
        LogError: It is empty or no text, or a line is longer than `MAX_LINE`.
    """

    def __init__(self, path: Path, is_unit: Callable[[str], bool]) -> None:
        self._path = path
        with path.open("rb") as file:
            self._encoding = _encoding(file.read(_HEAD_BYTES))
        with self._open() as stream:
            lines = list(_first(_lines(stream)))
        stated = _SEPARATOR_LINE.fullmatch(lines[0]) if lines else None
        self._separator = stated[1] if stated else _separator(lines)
        rows = _stripped(_split(lines, self._separator))[1 if stated else 0 :]
        if not rows:
            raise LogError("the file is empty")
        most = max(map(_excess_of_numbers, rows))
        numbers = (k for k, row in enumerate(rows) if _excess_of_numbers(row) >= min(most, 1))
        begin = next(numbers) if most > -math.inf else len(rows)
        width = len(rows[begin][1]) if begin < len(rows) else 0
        texts = [k for k in range(begin) if _is_of_text(rows[k])]
        fitting = [k for k in texts if not width or _fits(rows[k], rows[begin])]
        # A line of remarks has one cell.
        fitting = fitting or [k for k in texts if len(rows[k][1]) > 1]
        self.has_titles, self.units = bool(fitting), [""] * width
        if fitting:
            last = fitting[-1] if width else fitting[0]
            place = last
            if last - 1 in fitting and _is_of_units(rows[last], is_unit):
                self.units, place = list(rows[last][1]), last - 1
            self.titles = [cell.lstrip("#%/ ") for cell in rows[place][1]]
        else:
            last = begin - 1
            self.titles = [str(number + 1) for number in range(width)]
        self.units += [""] * (len(self.titles) - len(self.units))
        if len(self.titles) > _MAX_COLUMNS:
            raise LogError(f"{len(self.titles):,} columns, more than {_MAX_COLUMNS:,}")
        self._head = [row for row in rows[last + 1 :] if not _is_comment(row[1])]
        self._last_above = rows[last][0] if last >= 0 else 0
        self.cut_off = False

    def head(self, place: int) -> list[str]:
        """Return the cells of a column in the first lines, but for those without."""
        cells = [row[1][place] for row in self._head if place < len(row[1])]
        return [cell for cell in cells if not is_nothing(cell)]

    def rows(self, places: Sequence[int]) -> Iterator[Row]:
        """Yield the lines of numbers.

        Args:
            places: Columns whose cells are wanted, in this order, from 0.

        Raises:
            OSError: The file cannot be read.
            LogError: A line or a cell is too long, a line has more cells than there are titles, or
                one other than the last ends early.
        """
        width, wanted = len(self.titles), itemgetter(*places)
        with self._open() as stream:
            rows = _split(_lines(stream), self._separator)
            for line, cells in rows:
                if line <= self._last_above or _is_comment(cells):
                    continue
                odd = len(cells) != width
                # Of blanks, or of separators only.
                if (odd or not cells[places[0]]) and not any(map(str.strip, cells)):
                    continue
                if odd:
                    self._check_length(line, cells, max(places), rows)
                    if self.cut_off:
                        return
                found = wanted(cells)
                if max(map(len, found)) > _MAX_CELL:
                    raise LogError(f"line {line}: a cell of more than {_MAX_CELL:,} characters")
                yield line, found

    def _check_length(
        self, line: int, cells: Sequence[str], last: int, following: Iterator[Row]
    ) -> None:
        width = len(self.titles)
        if len(cells) <= last:
            self.cut_off = next(following, None) is None
            if not self.cut_off:
                raise LogError(f"line {line} ends before column {self.titles[len(cells)]!r}")
        elif any(cells[width:]):
            hint = ""
            if self._separator == ",":
                hint = ": with decimal commas, separate cells by semicolons or tabs"
            raise LogError(f"line {line}: {len(cells)} cells, but {width} titles{hint}")

    def decimal(self, places: Sequence[int]) -> str:
        """Return the decimal sign of some columns, an empty string if the first lines show none."""
        cells = [cell for place in places for cell in self.head(place)]
        points = sum("." in cell and _is_float(cell) for cell in cells)
        signs = (_COMMA, _GROUPS[","])
        commas = sum(any(sign.fullmatch(cell) for sign in signs) for cell in cells)
        return "," if commas > points else "." if points else ""

    def _open(self) -> TextIO:
        # Only titles can have other letters than ASCII that matter.
        return self._path.open(encoding=self._encoding, errors="replace")


def is_nothing(cell: str) -> bool:
    """Return whether a cell is empty, or a word for that."""
    return cell.strip().lower() in _NOTHING


def plain_number(cell: str, decimal: str) -> str:
    """Return a number with a decimal point and without separators of thousands.

    Args:
        cell: The number.
        decimal: Decimal sign of the column, an empty string if not known.

    Raises:
        ValueError: It is not clear where the decimals begin.
    """
    cell = cell.strip()
    if decimal != "." and _COMMA.fullmatch(cell):
        return cell.replace(",", ".")
    for sign in decimal or ".,":
        if _GROUPS[sign].fullmatch(cell):
            whole, _, decimals = cell.rpartition(sign)
            return f"{re.sub(r'[^0-9+-]', '', whole)}.{decimals}"
    if decimal == "," and "." in cell:
        raise ValueError(f"{cell!r} may be of thousands")
    return cell


def _encoding(head: bytes) -> str:
    """Return the encoding of a file that begins like this."""
    if not head:
        raise LogError("the file is empty")
    for magic, what in _FORMATS:
        if head.startswith(magic):
            raise LogError(f"it is {what}")
    for mark, name in _MARKS:
        if head.startswith(mark):
            return name
    if b"\0" in head:
        # Digits in UTF-16 have a zero byte each.
        for name, zeros in (("utf-16-le", head[1::2]), ("utf-16-be", head[::2])):
            if zeros.count(0) > 0.9 * len(zeros):
                return name
        raise LogError("it is no text: it has bytes of zero")
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _lines(stream: TextIO) -> Iterator[str]:
    number = 0
    while line := stream.readline(MAX_LINE + 1):
        number += 1
        if len(line) > MAX_LINE:
            raise LogError(
                f"line {number} is longer than {MAX_LINE:,} characters; expected a line for each "
                "measurement"
            )
        yield line


def _first(lines: Iterable[str]) -> Iterator[str]:
    """Yield the first lines, but not many more characters than a line may have."""
    size = 0
    for number, line in enumerate(lines, 1):
        yield line
        size += len(line)
        if number == _HEAD_LINES or size > MAX_LINE:
            return


def _split(lines: Iterable[str], separator: str) -> Iterator[Row]:
    """Yield the number and the cells of every line that is not empty."""
    if separator == " ":
        lines = map(_single_blanks, lines)
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=separator != " ")
    try:
        last = 0
        for cells in reader:
            if reader.line_num > last + 1:
                _check_quotes(last + 1, cells, separator)
            last = reader.line_num
            if cells:
                yield last, cells
    except csv.Error as error:
        raise LogError(f"line {reader.line_num}: {error}") from error


def _check_quotes(line: int, cells: Sequence[str], separator: str) -> None:
    """Raise `LogError` if a cell of several lines has whole lines of the log in it."""
    for inner in (inner for cell in cells for inner in cell.splitlines()[1:-1]):
        if inner.count(separator) + 1 >= len(cells):
            raise LogError(f"line {line}: a quote opens a cell that is not closed there")


def _stripped(rows: Iterable[Row]) -> list[Row]:
    """Return the lines that are not empty, without blanks around their cells."""
    found = [(line, [cell.strip() for cell in cells]) for line, cells in rows]
    return [row for row in found if any(row[1])]


def _single_blanks(line: str) -> str:
    """Return a line with one blank between words, none before units, in them or after a #."""
    if line.lstrip().startswith(_COMMENTS):
        line = "#" + line.lstrip("#%/ \t")
    if "[" in line or "(" in line:
        line = _BRACKETS.sub(lambda match: "".join(match[0].split()), line)
    return " ".join(line.split())


def _separator(lines: Sequence[str]) -> str:
    """Return the separator that makes most numbers of some lines, and is in the first of them."""

    def numbers(separator: str) -> int:
        try:
            return sum(_counts(row)[0] for row in _stripped(_split(lines, separator)))
        except LogError:
            return 0

    return max(
        _SEPARATORS, key=lambda one: (numbers(one), sum(line.count(one) for line in lines[:1]))
    )


def _is_float(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _is_number(cell: str) -> bool:
    """Return whether a cell is a number, a date or a time."""
    patterns = (_COMMA, *_GROUPS.values(), _TIME)
    return not is_nothing(cell) and (
        _is_float(cell) or any(pattern.fullmatch(cell) for pattern in patterns)
    )


def _is_comment(cells: Sequence[str]) -> bool:
    return cells[0].startswith(_COMMENTS)


def _counts(row: Row) -> tuple[int, int]:
    """Return how many of the first cells are numbers, and how many are other text."""
    there = [cell for cell in row[1][:_HEAD_CELLS] if not is_nothing(cell)]
    numbers = sum(map(_is_number, there))
    return numbers, len(there) - numbers


def _excess_of_numbers(row: Row) -> float:
    """Return how many cells more are numbers than are text, -∞ without numbers."""
    numbers, texts = _counts(row)
    return -math.inf if not numbers or _is_comment(row[1]) else numbers - texts


def _is_of_text(row: Row) -> bool:
    numbers, texts = _counts(row)
    return texts > 0 and not numbers


def _fits(above: Row, below: Row) -> bool:
    """Return whether two lines have as many cells, or would without empty ones at their ends."""
    widths = [max(k for k, cell in enumerate(cells) if cell) for _, cells in (above, below)]
    return widths[0] == widths[1] or len(above[1]) == len(below[1])


def _is_of_units(row: Row, is_unit: Callable[[str], bool]) -> bool:
    there = [cell for cell in row[1] if not is_nothing(cell)]
    return 2 * sum(map(is_unit, there)) > len(there)
