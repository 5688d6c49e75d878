# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The columns of a log that have time, outputs and inputs, and their units."""

import math
import re
import unicodedata
from collections.abc import Container, Mapping, Sequence
from typing import NamedTuple

from tsobs_ros.checks import shown
from tsobs_ros.errors import LogError

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180},
    "velocity": {
        "rad/s": 1.0,
        "mrad/s": 1e-3,
        "deg/s": math.pi / 180,
        "rpm": math.pi / 30,
    },
    "torque": {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "Ncm": 1e-2, "kNm": 1e3},
}
"""Each unit in ns, rad, rad/s or N m."""

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
    **dict.fromkeys(("radian/s", "radians/s", "rad/sec", "radps", "1/s"), "rad/s"),
    **dict.fromkeys(("°/s", "degree/s", "degrees/s", "deg/sec", "degps", "dps"), "deg/s"),
    **dict.fromkeys(("r/min", "rev/min", "u/min"), "rpm"),
    **dict.fromkeys(("newtonmeter", "newtonmeters", "newtonmetre", "newtonmetres"), "Nm"),
}

# In order of preference; the first are what `tsobs export` writes.
_GUESSES: Mapping[str, Sequence[str]] = {
    "time": (
        "header.stamp", "time", "t", "stamp", "timestamp", "log_time", "zeit", "datetime",
        "time_stamp", "elapsed",
    ),
    "angle": ("position", "angle", "q", "y", "theta", "pos", "phi", "winkel", "encoder"),
    "velocity": ("velocity", "vel", "speed", "dq", "qd", "omega", "geschwindigkeit"),
    "torque": ("effort", "torque", "tau", "u", "trq", "drehmoment", "moment"),
}  # fmt: skip
_TITLE = re.compile(r"(?P<name>.*?)\s*(?:[\[({](?P<unit>[^\])}]*\D[^\])}]*)[\])}])?")
_UNIT_AFTER_NAME = re.compile(r"(?P<name>.+?)(?:[\s_,]+|\s*/\s*)(?P<unit>[^\s_,/]+)")
# What has a number or the name of a joint, as in position[0], q1, position.elbow, elbow/position.
_INDEX = re.compile(r"(?P<name>.*?[^\W\d])[._]?(?:\[(?P<index>\d+)\]|(?P<number>\d+))")
# A side of an arm in the title of a column that names no joint, as in motor_angle and q_link.
_SIDE = re.compile(
    r"(?i:(?P<side>link|motor))(?:[\W_]+|(?=[A-Z])|$)|[\W_]+(?i:(?P<last>link|motor))$"
)
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
        wanted: Titles by quantity: `time`, `torque`, `angle` or `velocity`, or the name of an
            output or input, with a joint as in `angle.JOINT` or without.
        units: Units by quantity, for columns without one.

    Attributes:
        remarks: What was guessed, for the user.
    """

    def __init__(
        self,
        titles: Sequence[str],
        line_of_units: Sequence[str],
        wanted: Mapping[str, str],
        units: Mapping[str, str],
    ) -> None:
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

    def require_known(self, names: Sequence[str], quantities: Sequence[str]) -> None:
        """Raise `LogError` if what is given is for something else.

        Args:
            names: What there may be columns of.
            quantities: What there may be units of.
        """
        for option, keys, known in (
            ("--columns", [key.partition(".")[0] for key in self._wanted], names),
            ("--units", list(self._units), quantities),
        ):
            for key in keys:
                if key not in known:
                    expected = f"{', '.join(known[:-1])} or {known[-1]}"
                    raise LogError(f"{option}: expected {expected}, got {key!r}")

    def joints(self, only: str) -> tuple[str, ...]:
        """Return the joints that columns name, `only` for one of columns that name none."""
        named = (key.partition(".")[2] for key in self._wanted)
        if joints := tuple(dict.fromkeys(joint for joint in named if joint)):
            return joints
        remarks = list(self.remarks)
        try:
            found = self._found("angle", only) or self._found("velocity", only)
        except LogError:
            found = {}
        self.remarks = remarks
        return tuple(joint for joint in found if not _is_motor_of(joint, found)) or (only,)

    def of_output(self, output: str, outputs: Sequence[str], only: str) -> dict[str, Column]:
        """Return the columns of an arm's output by joint.

        Args:
            output: Its name, such as `motor_angle`.
            outputs: The names of all outputs of the design.
            only: The joint of columns that name none.
        """
        side, _, kind = output.partition("_")
        alone = sum(name.endswith(kind) for name in outputs) == 1
        given = {}
        for key, name in self._wanted.items():
            of, _, joint = key.partition(".")
            if of == output or (of == kind and alone):
                given[joint or only] = self._named(kind, name)
        if given:
            return given
        sides = {name.partition("_")[0] for name in outputs}
        found = self._found(kind, only, side, one_sided=len(sides) == 1)
        if not found:
            what, key = ("an angle", kind) if alone and kind == "angle" else (output, output)
            if len(outputs) > 1:
                what, key = output, output
            raise LogError(f"no column looks like {what}; name it: --columns {key}=…; {self._has}")
        return found

    def of_torque(self, joints: Sequence[str], only: str, *, needed: bool) -> dict[str, Column]:
        """Return the torques by joint, of some motors too; none if none is there or needed.

        Args:
            joints: Those that must have one, if any has.
            only: The joint of columns that name none.
            needed: Whether each joint must have a torque.
        """
        torques = self._found("torque", only)
        if len(joints) == len(torques) == 1 and not {"angle", "torque"} & set(self._wanted):
            # Of position[0] and effort, or elbow/position and effort.
            torques = dict(zip(joints, torques.values(), strict=True))
        for joint in joints:
            # As exported, if the motor has an entry of its own.
            if (motor := torques.get(f"{joint}_motor")) is not None:
                torques.setdefault(joint, motor)
        missing = [name for name in joints if name not in torques]
        if missing and (torques or needed):
            raise LogError(
                f"no column looks like the torque of {', '.join(missing)}; name it: --columns "
                f"angle=…,torque=…, or take it for 0: --param assume_zero_torque=true; {self._has}"
            )
        return torques

    def of_signal(self, name: str, unit: str, joint: str, quantity: str) -> Column:
        """Return the column of a T–S system's signal, which has its name.

        Args:
            name: The signal's name.
            unit: Its unit in the design, empty for none.
            joint: Name of the system.
            quantity: What the signal is, for the error.
        """
        wanted = self._wanted.get(f"{name}.{joint}", self._wanted.get(name))
        names = (f"{joint}/{name}", f"position.{joint}/{name}", name, f"position.{name}")
        found = [one for own in names for one in self._columns if one.name == own]
        if wanted is not None:
            found = self._called(wanted)
        elif not found:
            raise LogError(
                f"no column is called {name!r}, which is an {quantity} of {joint}; name it: "
                f"--columns {name}=…; {self._has}"
            )
        column = found[0]
        if column.name.startswith("position."):
            # Of an exported JointState, whose units are those of a joint.
            return column._replace(unit="")
        given = column.unit or self._units.get(name, "")
        if unit and given and _plain_unit(given) != _plain_unit(unit):
            raise LogError(
                f"column {column.title!r}: its unit is {given!r}, but {name} of the design is in "
                f"{unit!r}"
            )
        return column._replace(unit=given)

    def _found(
        self, quantity: str, only: str, side: str = "", *, one_sided: bool = True
    ) -> dict[str, Column]:
        """Return the columns of a quantity by joint; `only` is the joint of a plain name.

        Of an arm's side, columns that name the side come first, and such of the other side are
        none; if both sides are measured, columns that name no side are the link's.
        """
        given = [(*key.partition(".")[::2], name) for key, name in self._wanted.items()]
        if not side and (own := [(of, name) for kind, of, name in given if kind == quantity]):
            return {of or only: self._named(quantity, name) for of, name in own}
        ranked = []
        for one in self._columns:
            column = _split_unit(quantity, one)
            own_side, plain = _split_side(column) if side else ("", column)
            rank, joint = _likeness(quantity, plain)
            if rank is not None:
                ranked.append((rank, own_side, joint or only, column))
        if side:
            ranked = _of_side(ranked, side, one_sided=one_sided)
        best = min((rank for rank, _, _, _ in ranked), default=None)
        found = [(joint, column) for rank, _, joint, column in ranked if rank == best]
        if best is None and one_sided:
            same = [_split_unit(quantity, one) for one in self._columns]
            same = [one for one in same if unit_of(quantity, one.unit)]
            same = [one for one in same if not side or _split_side(one)[0] in ("", side)]
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
        return self._with_unit(quantity, _split_unit(quantity, self._called(name)[0]))

    def _called(self, name: str) -> list[Column]:
        """Return the column of a name or number that is given."""
        found = [one for one in self._columns if name in (one.title, one.name)]
        if not found and name.isdigit() and 0 < int(name) <= len(self._columns):
            found = [self._columns[int(name) - 1]]
        if len(found) != 1:
            what = "several columns are" if found else "no column is"
            raise LogError(f"{what} called {name!r}; a column's number will do, too; {self._has}")
        return found

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


def _split_side(column: Column) -> tuple[str, Column]:
    """Return the side of an arm that a title names, and the column as if it did not.

    What names a joint, as in position.motor_1, names no side.
    """
    if re.search(r"[./]", column.name):
        return "", column
    match = _SIDE.search(column.name)
    if match is None:
        return "", column
    rest = column.name[: match.start()] + column.name[match.end() :]
    side = (match["side"] or match["last"]).lower()
    return side, column._replace(name=rest or column.name)


_Ranked = tuple[int, str, str, Column]
"""Rank, side, joint and column."""


def _of_side(ranked: Sequence[_Ranked], side: str, *, one_sided: bool) -> list[_Ranked]:
    """Return the columns of a side of an arm; of those that name it, if there are such."""
    joints = {joint for _, _, joint, _ in ranked}
    sided = []
    for rank, own, joint, column in ranked:
        if _is_motor_of(joint, joints):
            own, joint = "motor", joint.removesuffix("_motor")
        sided.append((rank, own, joint, column))
    if specific := [one for one in sided if one[1] == side]:
        return specific
    return [one for one in sided if not one[1]] if one_sided or side == "link" else []


def _is_motor_of(joint: str, joints: Container[str]) -> bool:
    """Return whether a name is that of the motor of another joint's name."""
    return joint.endswith("_motor") and joint.removesuffix("_motor") in joints


def _plain_unit(text: str) -> str:
    return re.sub(r"[\s.*·⋅]", "", unicodedata.normalize("NFKC", text))


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
