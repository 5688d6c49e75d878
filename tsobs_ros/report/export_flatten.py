# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages as rows: nested fields become columns such as `pose.position.x` or `data[3]`."""

from collections.abc import Collection, Iterator, Sequence
from typing import Any, NamedTuple

from tsobs_ros.bag.messages.joint_states import JointState
from tsobs_ros.report.export_units import NONE, unit_of

LONGEST_ROW = 64
"""Arrays that are ever longer stay in one column, as lists."""

_TIMES = ("builtin_interfaces/Time", "builtin_interfaces/Duration")
_NANOSECONDS = 1_000_000_000


class Cell(NamedTuple):
    """One value of a row.

    Attributes:
        column: Its column's name.
        unit: Its unit, empty for none.
        value: A number, text, bytes, or a list where the array stays in one column.
    """

    column: str
    unit: str
    value: Any


def flatten(message: Any, whole: Collection[str] = ()) -> Iterator[Cell]:
    """Yield the cells of a decoded message.

    Times are whole nanoseconds.

    Args:
        message: As `BagReader.decoded` has them.
        whole: Columns of arrays that stay as they are.
    """
    type_ = _type_of(message)
    for field in message.__slots__:
        unit = unit_of(type_, field, NONE)
        yield from _flatten(getattr(message, field), field, unit, whole)


def flatten_joint_state(message: JointState) -> Iterator[Cell]:
    """Yield the cells of a JointState, whose numbers are named after their joints."""
    yield Cell("header.stamp", "ns", message.stamp)
    yield Cell("header.frame_id", NONE, message.frame_id)
    names = message.names
    for field in ("position", "velocity", "effort"):
        unit = unit_of("sensor_msgs/JointState", field, NONE)
        for place, value in enumerate(getattr(message, field)):
            column = f"{field}.{names[place]}" if place < len(names) else f"{field}[{place}]"
            yield Cell(column, unit, value)


def _flatten(value: Any, column: str, unit: str, whole: Collection[str]) -> Iterator[Cell]:
    if isinstance(value, list | tuple):
        yield from _flatten_array(value, column, unit, whole)
    elif (type_ := _type_of(value)) in _TIMES:
        yield Cell(column, "ns", value.sec * _NANOSECONDS + value.nanosec)
    elif type_:
        for field in value.__slots__:
            below = unit_of(type_, field, unit)
            yield from _flatten(getattr(value, field), f"{column}.{field}", below, whole)
    elif isinstance(value, bytearray | memoryview):
        yield Cell(column, unit, bytes(value))
    else:
        yield Cell(column, unit, value)


def _flatten_array(
    values: Sequence[Any], column: str, unit: str, whole: Collection[str]
) -> Iterator[Cell]:
    nested = bool(values) and bool(_type_of(values[0]))
    if not nested and (len(values) > LONGEST_ROW or column in whole):
        yield Cell(column, unit, list(values))
        return
    for place, value in enumerate(values):
        yield from _flatten(value, f"{column}[{place}]", unit, whole)


def _type_of(value: Any) -> str:
    """Return the type of a decoded message as `package/Type`, empty for anything else."""
    return str(getattr(value, "_type", ""))
