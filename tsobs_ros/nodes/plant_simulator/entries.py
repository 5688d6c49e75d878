# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Entries of the plant simulator's lists, by the signals that they name; torques of files."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from tsobs_ros.checks import Array, shown
from tsobs_ros.errors import LogError, ModelError, ParameterError
from tsobs_ros.replay.csv_file import TorqueSeries, read_torques
from tsobs_ros.simulation.signals import EXCITATIONS, Signal
from tsobs_ros.yaml_files import load_yaml

Readers = Mapping[str, Callable[[Any], Any]]
"""What an entry may name of one joint, each with the function that reads the entry's value."""

# A sample at a line's time gets this line's torque, whatever their last bits are [s].
_LATE = 1e-6


@dataclass(frozen=True)
class TorqueFile(Signal, kind="file"):
    """The torque of a CSV file with columns `time` and `torque`, held from line to line.

    The first line belongs to t = 0; after the last one's time the torque is 0.

    Raises:
        ModelError: There is no path, or the file cannot be used.
    """

    file: str = ""
    _series: TorqueSeries = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.file:
            raise ModelError("file: expected a CSV file of time and torque")
        path = Path(self.file)
        try:
            series = _read(path, path.stat().st_mtime_ns if path.exists() else 0)
        except LogError as error:
            raise ModelError(str(error)) from error
        object.__setattr__(self, "_series", series)

    def _at(self, times: Array) -> Array:
        series = self._series
        places = np.searchsorted(series.time, times + _LATE, side="right") - 1
        is_on = (places >= 0) & (times <= series.time[-1] + _LATE)
        return np.where(is_on, series.torque[places], 0.0)


@lru_cache(maxsize=16)
def _read(path: Path, _modified: int) -> TorqueSeries:
    return read_torques(path)


PLAYED: Mapping[str, type[Signal]] = {**EXCITATIONS, TorqueFile.kind: TorqueFile}
"""Every kind of signal of an input that the node can play, under its name."""


def by_joint(
    parameter: str, lines: Iterable[str], readers: Mapping[str, Readers]
) -> dict[str, dict[str, list[Any]]]:
    """Return the values of a list parameter by joint and by what they are about.

    ROS parameters hold lists of texts only, so an entry is a line of YAML:
    "elbow/motor_angle: {kind: ramp}"; without "elbow/" it is for all joints that have one.

    Raises:
        ParameterError: An entry is malformed, or names none of them.
    """
    found: dict[str, dict[str, list[Any]]] = {joint: {} for joint in readers}
    for place, line in enumerate(lines):
        where = f"parameter '{parameter}[{place}]'"
        try:
            data: Any = load_yaml(line)
            ((target, value),) = data.items()
        except (AttributeError, ValueError) as error:
            raise ParameterError(f"{where}: expected 'name: value', got {shown(line)}") from error
        joint, _, name = str(target).rpartition("/")
        joints = [each for each in found if name in readers[each] and joint in ("", each)]
        if not joints:
            known = ", ".join(f"{each}/{one}" for each in found for one in readers[each])
            raise ParameterError(f"{where}: expected one of {known}, got {str(target)!r}")
        try:
            for each in joints:
                found[each].setdefault(name, []).append(readers[each][name](value))
        except (ModelError, ValueError) as error:
            raise ParameterError(f"{where}: {target}: {error}") from error
    return found
