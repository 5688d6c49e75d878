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
from tsobs_ros.simulation.signals import EXCITATIONS, KINDS, Signal, signal_of
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


def component(entry: Entry) -> Signal:
    """Return the component of an output or a torque that an entry describes.

    Raises:
        ParameterError: The kind or a number's name is unknown, or a number is out of range.
    """
    return _signal(entry, KINDS)


def excitation(entry: Entry) -> Signal:
    """Return the signal of an input that an entry describes.

    Raises:
        ParameterError: As for `component`.
    """
    return _signal(entry, EXCITATIONS)


def number(entry: Entry) -> float:
    """Return the number of an entry.

    Raises:
        ParameterError: It is no finite number.
    """
    try:
        return finite(entry.target, entry.value)
    except ModelError as error:
        raise ParameterError(f"{entry.where}: {error}") from error


def _signal(entry: Entry, kinds: Mapping[str, type[Signal]]) -> Signal:
    try:
        found: Signal = signal_of(kinds, entry.value)
    except (ModelError, ValueError) as error:
        raise ParameterError(f"{entry.where}: {entry.target}: {error}") from error
    return found
