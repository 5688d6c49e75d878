# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The columns of a log that have time, angle and torque, and their units."""

import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from tsobs_ros.checks import shown
from tsobs_ros.errors import LogError

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180},
    "torque": {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "Ncm": 1e-2, "kNm": 1e3},
}
"""Each unit in ns, rad or N m."""

ISO = "ISO 8601"

# Blanks, dots, stars and hyphens in units do not matter, nor do capitals in these.
_OTHER_SPELLINGS = {
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("msec", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("μs", "usec", "micros", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("nsec", "nanos", "nanosec", "nanosecs", "nanosecond", "nanoseconds"), "ns"),
    **dict.fromkeys(("iso", "iso8601"), ISO),
    **dict.fromkeys(("radian", "radians", "rads"), "rad"),
    **dict.fromkeys(("°", "degree", "degrees", "degs"), "deg"),
    **dict.fromkeys(("newtonmeter", "newtonmeters", "newtonmetre", "newtonmetres"), "Nm"),
}

# In order of preference; the first are what `tsobs export` writes.
_GUESSES: Mapping[str, Sequence[str]] = {
    "time": (
        "header.stamp", "time", "t", "stamp", "timestamp", "log_time", "zeit", "datetime",
        "time_stamp", "elapsed",
    ),
    "angle": ("position", "angle", "q", "y", "theta", "pos", "phi", "winkel", "encoder"),
    "torque": ("effort", "torque", "tau", "u", "trq", "drehmoment", "moment"),
}  # fmt: skip
_TITLE = re.compile(r"(?P<name>.*?)\s*(?:[\[({](?P<unit>[^\])}]*\D[^\])}]*)[\])}])?")
_UNIT_AFTER_NAME = re.compile(r"(?P<name>.+?)(?:[\s_,]+|\s*/\s*)(?P<unit>[^\s_,/]+)")
# What has a number or the name of a joint, as in position[0], q1, position.elbow, elbow/position.
_INDEX = re.compile(r"(?P<name>.*?[^\W\d])[._]?(?:\[(?P<index>\d+)\]|(?P<number>\d+))")
_WORD = re.compile(r"[A-Z]?[^\W\d_A-Z]+|[A-Z]+")
_SECONDS = re.compile(r"(?P<stem>.*[\W_])(?P<unit>secs?|n(?:ano)?secs?)", re.IGNORECASE)

_MOST_SHOWN, _LONGEST = 20, 200
_LIKELY = 1000


class Column(NamedTuple):
    """A column.

    Attributes:
        place: Its place from 0.
        title: Its title, as it is written.
        name: The title without unit.
        unit: The title's unit, one of `UNITS`; empty if there is none.
    """

    place: int
    title: str
    name: str
    unit: str


def misread(what: str, line: int, column: Column, text: str) -> LogError:
    """Return the error of a cell that is not what was expected."""
    unit = f" in {column.unit}" if column.unit else ""
    hint = ""
    if text[:1] in "[(a":
        hint = ": write one number a cell, as in columns 'position[0]' and 'position[1]'"
    elif what == "time" and re.search(r"\d[:/]\d", text):
        hint = ": write seconds, HH:MM:SS.sss or ISO 8601, such as 2026-01-31T12:00:00.005"
    elif what == "time" and "," not in text and any(map(str.isdigit, text)):
        hint = ": a stamp holds 68 years; is its unit another, as in --units time=ns?"
    elif "," in text or "." in text:
        hint = ": write all with the same decimal sign, and thousands without one"
    return LogError(
        f"line {line}, column {column.title!r}: expected a {what}{unit}, got {shown(text)}{hint}"
    )


class Columns:
    """The titles of a log, in which columns are found by given or by usual names.

    Args:
        titles: Of all columns.
        line_of_units: Units below the titles, empty strings without.
        wanted: Titles by quantity: `time`, `angle`, `torque`, `angle.JOINT` or `torque.JOINT`.
        units: Units by quantity, for columns without one.

    Attributes:
        remarks: What was guessed, for the user.

    Raises:
        LogError: A given title is of no quantity.
    """

    def __init__(
        self,
        titles: Sequence[str],
        line_of_units: Sequence[str],
        wanted: Mapping[str, str],
        units: Mapping[str, str],
    ) -> None:
        for option, keys in (("--columns", wanted), ("--units", units)):
            for key in keys:
                quantity = key.partition(".")[0] if option == "--columns" else key
                if quantity not in UNITS:
                    raise LogError(f"{option}: expected time, angle or torque, got {key!r}")
        self._columns = []
        for place, title in enumerate(titles):
            title = title[:_LONGEST]
            match = _TITLE.fullmatch(title)
            own = match["name"] if match else title
            unit = (match and match["unit"]) or line_of_units[place].strip("[](){} ")
            self._columns.append(Column(place, title, own, unit))
        self._wanted, self._units = wanted, units
        more = ", …" if len(titles) > _MOST_SHOWN else ""
        self._has = f"columns: {', '.join(map(repr, titles[:_MOST_SHOWN]))}{more}"
        self.remarks: list[str] = []

    def time(self) -> tuple[Column, ...]:
        """Return the column of times, or those of seconds and of nanoseconds."""
        if "time" in self._wanted:
            return (self._named("time", self._wanted["time"]),)
        pairs: dict[str, list[Column]] = {}
        for one in self._columns:
            if match := _SECONDS.fullmatch(one.name):
                unit = "ns" if match["unit"].lower().startswith("n") else "s"
                pairs.setdefault(match["stem"], []).append(one._replace(unit=unit))
        for pair in sorted(pairs.values(), key=lambda pair: "header" not in pair[0].name):
            if [one.unit for one in pair] == ["s", "ns"]:
                return tuple(pair)
        found = self._found("time", "")
        if not found:
            raise LogError(f"no column looks like the time; name it: --columns time=…; {self._has}")
        return (next(iter(found.values())),)

    def of_joints(
        self, only: str, *, torque_needed: bool
    ) -> tuple[dict[str, Column], dict[str, Column]]:
        """Return angles and torques by joint, no torques if there are none and none is needed.

        Args:
            only: The joint of columns that name none.
            torque_needed: Whether each joint must have a torque.
        """
        angles, torques = self._found("angle", only), self._found("torque", only)
        if not angles:
            raise LogError(
                f"no column looks like an angle; name it: --columns angle=…; {self._has}"
            )
        if len(angles) == len(torques) == 1 and not set(self._wanted) & {"angle", "torque"}:
            # Of position[0] and effort, or elbow/position and effort.
            torques = dict(zip(angles, torques.values(), strict=True))
        missing = [name for name in angles if name not in torques]
        if missing and (torques or torque_needed):
            raise LogError(
                f"no column looks like the torque of {', '.join(missing)}; name it: --columns "
                f"angle=…,torque=…, or take it for 0: --param assume_zero_torque=true; {self._has}"
            )
        return angles, torques

    def _found(self, quantity: str, only: str) -> dict[str, Column]:
        """Return the columns of a quantity by joint; `only` is the joint of a plain name."""
        given = [(*key.partition(".")[::2], name) for key, name in self._wanted.items()]
        if own := [(of, name) for kind, of, name in given if kind == quantity]:
            return {of or only: self._named(quantity, name) for of, name in own}
        ranked = []
        for one in self._columns:
            column = _split_unit(quantity, one)
            rank, joint = _likeness(quantity, column)
            if rank is not None:
                ranked.append((rank, joint or only, column))
        best = min((rank for rank, _, _ in ranked), default=None)
        found = [(joint, column) for rank, joint, column in ranked if rank == best]
        if best is None:
            same = [_split_unit(quantity, one) for one in self._columns]
            same = [one for one in same if unit_of(quantity, one.unit)]
            found = [(only, one) for one in same] if len(same) == 1 else []
        if quantity == "time":
            found = found[:1]
        if len(found) == 1 and found[0][0].isdigit():
            found = [(only, found[0][1])]
        by_joint = dict(found)
        if len(by_joint) < len(found):
            names = ", ".join(repr(column.title) for _, column in found)
            raise LogError(
                f"several columns look like {quantity}: {names}; name one, or give its number: "
                f"--columns {quantity}={found[0][1].place + 1}"
            )
        if found and (best is None or best >= _LIKELY):
            names = ", ".join(repr(column.title) for _, column in found)
            self.remarks.append(
                f"note: {quantity} is taken from {names}; or --columns {quantity}=…"
            )
        return {joint: self._with_unit(quantity, column) for joint, column in found}

    def _named(self, quantity: str, name: str) -> Column:
        found = [one for one in self._columns if name in (one.title, one.name)]
        if not found and name.isdigit() and 0 < int(name) <= len(self._columns):
            found = [self._columns[int(name) - 1]]
        if len(found) != 1:
            what = "several columns are" if found else "no column is"
            raise LogError(f"{what} called {name!r}; a column's number will do, too; {self._has}")
        return self._with_unit(quantity, _split_unit(quantity, found[0]))

    def _with_unit(self, quantity: str, column: Column) -> Column:
        given = self._units.get(quantity, "")
        for text in (column.unit, given):
            if text and not unit_of(quantity, text):
                known = ", ".join(UNITS[quantity])
                raise LogError(
                    f"column {column.title!r}: unit {text!r} of {quantity} is not known; "
                    f"there are {known}"
                )
        unit = unit_of(quantity, column.unit)
        if unit and given and unit != unit_of(quantity, given):
            raise LogError(
                f"column {column.title!r}: its unit is {column.unit!r}, but --units says "
                f"{quantity}={given}"
            )
        return column._replace(unit=unit or unit_of(quantity, given))


def unit_of(quantity: str, text: str) -> str:
    """Return the name in `UNITS` of a unit, an empty string if it is none of the quantity."""
    unit = re.sub(r"[\s.*·⋅-]", "", unicodedata.normalize("NFKC", text))
    small = unit.lower()
    for name in (unit, _OTHER_SPELLINGS.get(small, ""), small, "Nm" if small == "nm" else ""):
        if name in UNITS[quantity] or (name == ISO and quantity == "time"):
            return name
    return ""


def is_unit(text: str) -> bool:
    """Return whether a text is a unit of any quantity."""
    return any(unit_of(quantity, text.strip("[](){} ")) for quantity in UNITS)


def _split_unit(quantity: str, column: Column) -> Column:
    """Return a column with the unit that its name ends in, as in `angle_deg` or `t / ms`."""
    match = None if column.unit else _UNIT_AFTER_NAME.fullmatch(column.name)
    if match is None or not unit_of(quantity, match["unit"]):
        return column
    return column._replace(name=match["name"], unit=match["unit"])


def _likeness(quantity: str, column: Column) -> tuple[int | None, str]:
    """Return the rank of a column among those of a quantity, None if unlike, and its joint."""
    guesses = _GUESSES[quantity]
    name = column.name.strip("/_% ")
    if name.lower() in guesses:
        return guesses.index(name.lower()), ""
    begin, _, joint = name.partition(".")
    if begin.lower() in guesses and joint and quantity != "time":
        return guesses.index(begin.lower()), joint
    joint = ""
    if (match := _INDEX.fullmatch(name)) and quantity != "time":
        name, joint = match["name"], match["index"] or match["number"]
    *above, last = re.split(r"[./]", name)
    if last.lower() in guesses:
        if "/" in name and above and not joint and quantity != "time":
            joint = above[-1]
        return guesses.index(last.lower()), joint
    words = {word.lower() for word in _WORD.findall(name)}
    if any(len(guess) > 1 and guess in words for guess in guesses):
        return _LIKELY, joint
    return None, ""
