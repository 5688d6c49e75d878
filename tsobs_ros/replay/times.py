# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Times of a log as stamps: numbers in any unit, dates and clock times."""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from decimal import Decimal

import numpy as np

from tsobs_ros.bag.joint_series import Times
from tsobs_ros.errors import LogError
from tsobs_ros.replay.cells import Row, TextTable, is_nothing, plain_number
from tsobs_ros.replay.columns import ISO, UNITS, Column, misread, unit_of
from tsobs_ros.series import NANOSECONDS

NO_TIME = -(2**62)
"""Stamp of a line without a time."""

LATEST = 2**31 * NANOSECONDS
"""The first time that a message's stamp cannot hold [ns]."""

# Seconds since the epoch from 2001 on; in another unit they would be decades apart.
_MIN_EPOCH = 10**9
# No arm is measured more slowly, so the unit is another [s].
_MAX_PERIOD = 0.25
_MIN_TIMES = 10
_EXACT = 1e15
_HALF_DAY = 12 * 3600 * NANOSECONDS

_FRACTION = re.compile(r"(?<=:\d\d)[.,](\d+)")
_CLOCK = re.compile(r"(\d+):(\d\d):(\d\d)")
_DATES = ("%d.%m.%Y %H:%M:%S", "%d-%b-%Y %H:%M:%S", "%Y/%m/%d %H:%M:%S")
_WITH_UNIT = re.compile(r"([^A-Za-z]*\d) ?(sec|m?s)")


class TimeReader:
    """A reader of times; without a unit, the first of them decide.

    Args:
        columns: The column of times, or those of seconds and of nanoseconds.
        table: The log.
        decimal: Its decimal sign, an empty string if not known.

    Attributes:
        remarks: What was found, for the user.
        title: The column's title.
        guessed: Whether nobody stated a unit.

    Raises:
        LogError: The unit seems to be another than seconds.
    """

    def __init__(self, columns: Sequence[Column], table: TextTable, decimal: str) -> None:
        self._decimal, self.guessed = decimal, False
        self.title = columns[0].title
        self.remarks: list[str] = []
        self._readers = [self._reader(one, table.head(one.place)) for one in columns]
        (column, read), *others = self._readers
        plain = not others and column.unit in UNITS["time"] and read != self._read_clock
        self._factor = UNITS["time"][column.unit] if plain else None
        self.restart()

    def read(self, rows: Sequence[Row]) -> Times:
        """Return the stamps of lines [ns], `NO_TIME` for an empty cell, shape (n,).

        Args:
            rows: Lines whose first cells are those of the columns of times.

        Raises:
            LogError: A cell is no time.
        """
        if self._factor is not None and self._decimal != ",":
            with suppress(ValueError):
                times = np.array([float(cells[0]) for _, cells in rows])
                # So small that what was rounded is less than half a nanosecond.
                if (np.abs(times) < _EXACT / self._factor).all():
                    return np.rint(times * self._factor).astype(np.int64)
        return np.array([self._stamp(line, cells) for line, cells in rows], np.int64)

    def _stamp(self, line: int, cells: Sequence[str]) -> int:
        stamp = 0
        for (column, read), text in zip(self._readers, cells, strict=False):
            if is_nothing(text):
                return NO_TIME
            try:
                stamp += read(text.strip())
                if not abs(stamp) < LATEST:
                    raise ValueError("beyond what a stamp can hold")
            except (ValueError, ArithmeticError) as error:
                raise misread("time", line, column, text) from error
        return stamp

    def restart(self) -> None:
        """Begin at the first line again."""
        self._day, self._last = 0, 0

    def _reader(self, column: Column, texts: Sequence[str]) -> tuple[Column, Callable[[str], int]]:
        """Return a column with its unit, and what reads its cells."""
        first = texts[0] if texts else ""
        if column.unit == ISO or re.match(r"\d{4}-\d", first):
            return column._replace(unit=ISO), _read_iso
        if re.match(r"\d+([/.])\w+\1\d+ |\d+-[A-Za-z]+-\d+ ", first):
            return column, _read_date
        if _CLOCK.match(first):
            return column, self._read_clock
        if match := _WITH_UNIT.fullmatch(first):
            # MATLAB's durations.
            unit = unit_of("time", match[2])
            end = len(first) - len(match[1])
            return column, lambda text: self._number(text[:-end], unit)
        unit = column.unit
        if not unit:
            self.guessed = True
            unit = self._likely_unit(column, texts)
            column = column._replace(unit=unit)
        return column, lambda text: self._number(text, unit)

    def _number(self, text: str, unit: str) -> int:
        # A decimal, because a double has no nanoseconds left at today's dates.
        time = Decimal(plain_number(text, self._decimal)) * int(UNITS["time"][unit])
        if not abs(time) < LATEST:
            raise ValueError("beyond what a stamp can hold")
        return int(time.to_integral_value())

    def _likely_unit(self, column: Column, texts: Sequence[str]) -> str:
        times = []
        for text in texts:
            try:
                times.append(float(plain_number(text, self._decimal)))
            except ValueError:
                continue
        for unit, size in UNITS["time"].items():
            scale = NANOSECONDS / size
            if times and _MIN_EPOCH <= times[0] / scale < LATEST / NANOSECONDS:
                if unit != "s":
                    self.remarks.append(f"note: {column.title!r} is read as {unit} since the epoch")
                return unit
        apart = np.diff(times)
        if len(apart) >= _MIN_TIMES and (apart >= 0).all():
            check_period(column.title, float(np.median(apart[apart > 0] if apart.any() else [0])))
        return "s"

    def _read_clock(self, text: str) -> int:
        """Return the time since midnight of the first day."""
        match = _CLOCK.match(text)
        if match is None:
            raise ValueError("no hours, minutes and seconds")
        hours, minutes, seconds = map(int, match.groups())
        whole, fraction = _split_fraction(text)
        if whole != match[0]:
            raise ValueError("more than a clock time")
        time = (hours * 3600 + minutes * 60 + seconds) * NANOSECONDS + fraction
        if time + self._day < self._last - _HALF_DAY:
            self._day += 2 * _HALF_DAY
        self._last = time + self._day
        return self._last


def check_period(title: str, period: float) -> None:
    """Raise LogError if times that are so far apart [s] seem to have another unit."""
    if period < _MAX_PERIOD:
        return
    for unit, size in UNITS["time"].items():
        if period * size / NANOSECONDS < _MAX_PERIOD:
            raise LogError(
                f"column {title!r} has no unit, and its times are {period:g} apart: no arm is "
                f"measured every {period:g} s; if they are {unit}, write '{title} [{unit}]' or "
                f"--units time={unit}; if they are seconds, --units time=s"
            )


def _read_iso(text: str) -> int:
    """Return a date and time in nanoseconds, in UTC unless it has an offset."""
    whole, fraction = _split_fraction(text)
    return _since_epoch(datetime.fromisoformat(whole)) + fraction


def _read_date(text: str) -> int:
    whole, fraction = _split_fraction(text)
    for form in _DATES:
        try:
            return _since_epoch(datetime.strptime(whole, form)) + fraction
        except ValueError:
            continue
    raise ValueError("no date that has one meaning only")


def _since_epoch(moment: datetime) -> int:
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return int(moment.timestamp()) * NANOSECONDS


def _split_fraction(text: str) -> tuple[str, int]:
    """Return a time without the fraction of its second, and that [ns]."""
    match = _FRACTION.search(text)
    if match is None:
        return text, 0
    return text.replace(match[0], "", 1), int(match[1][:9].ljust(9, "0"))
