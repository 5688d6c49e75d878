# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Entries of list parameters of the plant simulator, such as "elbow/motor_angle: {kind: ramp}".

ROS parameters hold lists of texts only. So what concerns one signal of one joint is a line of YAML:
the signal's name and, after a colon, a number or the kind of a signal with its numbers.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from tsobs_ros.checks import finite, shown
from tsobs_ros.errors import ModelError, ParameterError
from tsobs_ros.schema import decode
from tsobs_ros.simulation.signals import EXCITATIONS, KINDS, Component, Excitation
from tsobs_ros.yaml_files import load_yaml


class Entry(NamedTuple):
    """One entry of a list.

    Attributes:
        target: What it is about.
        value: What follows the colon, as plain data.
        where: Parameter and place, for errors.
    """

    target: str
    value: Any
    where: str


def entries_of(parameter: str, lines: Iterable[str]) -> list[Entry]:
    """Return the entries of a list parameter.

    Raises:
        ParameterError: A line is not YAML, or not one name with a value.
    """
    entries = []
    for place, line in enumerate(lines):
        where = f"parameter '{parameter}[{place}]'"
        try:
            data = load_yaml(line)
        except ValueError as error:
            raise ParameterError(f"{where}: not valid YAML: {error}") from error
        if not isinstance(data, dict) or len(data) != 1:
            raise ParameterError(f"{where}: expected one 'name: value', got {shown(line)}")
        ((target, value),) = data.items()
        entries.append(Entry(str(target), value, where))
    return entries


def component(entry: Entry) -> Component:
    """Return the component of an output or a torque that an entry describes.

    A start that is left out is 0.

    Raises:
        ParameterError: The kind or a number's name is unknown, or a number is out of range.
    """
    kind, numbers = _kind(entry, KINDS)
    made: Component = _made(entry, {"start": 0.0, **numbers}, type(KINDS[kind]))
    return made


def excitation(entry: Entry) -> Excitation:
    """Return the signal of an input that an entry describes.

    Raises:
        ParameterError: As for `component`.
    """
    kind, numbers = _kind(entry, EXCITATIONS)
    made: Excitation = _made(entry, numbers, EXCITATIONS[kind])
    return made


def number(entry: Entry) -> float:
    """Return the number of an entry.

    Raises:
        ParameterError: It is no finite number.
    """
    try:
        return finite(entry.target, entry.value)
    except ModelError as error:
        raise ParameterError(f"{entry.where}: {error}") from error


def _kind(entry: Entry, kinds: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    numbers = dict(entry.value) if isinstance(entry.value, dict) else {"kind": entry.value}
    kind = numbers.pop("kind", None)
    if kind not in kinds:
        raise ParameterError(
            f"{entry.where}: {entry.target}: kind: expected one of {', '.join(kinds)}, "
            f"got {shown(kind)}"
        )
    return str(kind), numbers


def _made(entry: Entry, numbers: dict[str, Any], kind: type[Any]) -> Any:
    try:
        return decode(numbers, kind)
    except (ModelError, ValueError) as error:
        raise ParameterError(f"{entry.where}: {entry.target}: {error}") from error
