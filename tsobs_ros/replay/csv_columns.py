# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which column of a CSV log is what, in which unit."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from tsobs_ros.errors import LogError

ISO = "ISO 8601"

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "µs": 1e3, "ns": 1.0},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "°": math.pi / 180},
    "torque": {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3},
}
"""What a unit is in ns, rad or N m; spaces, dots and stars in units do not matter."""

# In order of preference; the first are what `tsobs export` writes.
_GUESSES: Mapping[str, Sequence[str]] = {
    "time": ("header.stamp", "time", "t", "stamp", "timestamp", "log_time"),
    "angle": ("position", "angle", "q", "y", "theta", "pos"),
    "torque": ("effort", "torque", "tau", "u"),
}
_HEADER = re.compile(r"\s*(?P<name>.*?)\s*(?:[\[(](?P<unit>[^\])]*)[\])])?\s*")


class Column(NamedTuple):
    """A column to read.

    Attributes:
        place: Which one it is, from 0.
        title: What its header says.
        unit: Its unit, a key of `UNITS[quantity]`; empty where nothing says.
    """

    place: int
    title: str
    unit: str


class Columns(NamedTuple):
    """What to read of every line.

    Attributes:
        time: When it was sampled.
        angles: By the joints' names.
        torques: By the joints' names; None for all of them if there are none.
    """

    time: Column
    angles: dict[str, Column]
    torques: dict[str, Column] | None


class _Header(NamedTuple):
    """A header's name without its unit, and the unit."""

    place: int
    title: str
    name: str
    unit: str


def find_columns(
    header: Sequence[str],
    wanted: Mapping[str, str],
    units: Mapping[str, str],
    joint: str,
    *,
    torque_needed: bool,
) -> Columns:
    """Return where time, angles and torques are.

    Args:
        header: The first line's cells.
        wanted: Columns by what they are: `time`, `angle` and `torque`, or `angle.JOINT` and
            `torque.JOINT` for several joints; what is left out is guessed.
        units: By `time`, `angle` and `torque`, where the header has none.
        joint: Name of the joint of a column that names none.
        torque_needed: Whether there must be torques.

    Raises:
        LogError: A column is missing, stands for two things or has an unknown unit.
    """
    headers = [_parsed(place, title) for place, title in enumerate(header)]
    for key in wanted:
        if key.partition(".")[0] not in UNITS:
            raise LogError(f"--columns: expected time, angle or torque, got {key!r}")
    for quantity in units:
        if quantity not in UNITS:
            raise LogError(f"--units: expected time, angle or torque, got {quantity!r}")
    time = _time(headers, wanted, units)
    angles = _of_joints("angle", headers, wanted, units, joint)
    torques = _of_joints("torque", headers, wanted, units, joint)
    has = ", ".join(repr(title) for title in header)
    if not angles:
        raise LogError(f"no column looks like an angle; name it: --columns angle=…; columns: {has}")
    if not torques and not torque_needed:
        return Columns(time, angles, None)
    if missing := [name for name in angles if name not in torques]:
        raise LogError(
            f"no column looks like the torque of {', '.join(missing)}; name it: --columns "
            f"torque=…, or take it for 0: --param assume_zero_torque=true; columns: {has}"
        )
    return Columns(time, angles, {name: torques[name] for name in angles})


def _parsed(place: int, title: str) -> _Header:
    match = _HEADER.fullmatch(title)
    assert match is not None, "everything matches"
    return _Header(place, title, match["name"], match["unit"] or "")


def _time(
    headers: Sequence[_Header], wanted: Mapping[str, str], units: Mapping[str, str]
) -> Column:
    if "time" in wanted:
        return _column("time", _named(wanted["time"], headers), units)
    for guess in _GUESSES["time"]:
        for one in headers:
            if one.name.lower() == guess:
                return _column("time", one, units)
    has = ", ".join(repr(one.title) for one in headers)
    raise LogError(f"no column looks like the time; name it: --columns time=…; columns: {has}")


def _of_joints(
    quantity: str,
    headers: Sequence[_Header],
    wanted: Mapping[str, str],
    units: Mapping[str, str],
    joint: str,
) -> dict[str, Column]:
    """Return the columns of a quantity by joint, as they are named or else guessed."""
    own = {key: name for key, name in wanted.items() if key.partition(".")[0] == quantity}
    if own:
        return {
            key.partition(".")[2] or joint: _column(quantity, _named(name, headers), units)
            for key, name in own.items()
        }
    for guess in _GUESSES[quantity]:
        found = {}
        for one in headers:
            name, _, of = one.name.partition(".")
            if name.lower() == guess:
                found[of or joint] = _column(quantity, one, units)
        if found:
            return found
    return {}


def _named(name: str, headers: Sequence[_Header]) -> _Header:
    found = [one for one in headers if name in (one.title.strip(), one.name)]
    if len(found) != 1:
        has = ", ".join(repr(one.title) for one in headers)
        what = "several columns are" if found else "no column is"
        raise LogError(f"{what} called {name!r}; columns: {has}")
    return found[0]


def _column(quantity: str, header: _Header, units: Mapping[str, str]) -> Column:
    unit = re.sub(r"[\s.*·⋅]", "", header.unit or units.get(quantity, ""))
    if quantity == "time" and unit.upper() in ("ISO", "ISO8601"):
        return Column(header.place, header.title, ISO)
    if unit and unit not in UNITS[quantity]:
        known = ", ".join(UNITS[quantity])
        raise LogError(
            f"column {header.title!r}: unit {unit!r} of {quantity} is not known; there are {known}"
        )
    return Column(header.place, header.title, unit)
