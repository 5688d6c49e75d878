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
    """The torque of a CSV file, held from line to line; 0 after its last line's time.

    The file's first line belongs to t = 0.

    Attributes:
        file: Path of the file, with columns `time` and `torque`.

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

    Args:
        parameter: Its name.
        lines: ROS parameters hold lists of texts only, so an entry is a line of YAML:
            "elbow/motor_angle: {kind: ramp}", without "elbow/" if there is one joint.
        readers: What an entry may name of each joint.

    Raises:
        ParameterError: An entry is malformed, or names none of them.
    """
    found: dict[str, dict[str, list[Any]]] = {joint: {} for joint in readers}
    known = {f"{joint}/{name}": (joint, name) for joint, own in readers.items() for name in own}
    if len(found) == 1:
        known |= {name: (joint, name) for joint, name in known.values()}
    for place, line in enumerate(lines):
        where = f"parameter '{parameter}[{place}]'"
        try:
            data = load_yaml(line)
        except ValueError as error:
            raise ParameterError(f"{where}: not valid YAML: {error}") from error
        if not isinstance(data, dict) or len(data) != 1:
            raise ParameterError(f"{where}: expected one 'name: value', got {shown(line)}")
        ((target, value),) = data.items()
        if target not in known:
            expected = ", ".join(known)
            raise ParameterError(f"{where}: expected one of {expected}, got {str(target)!r}")
        joint, name = known[target]
        try:
            found[joint].setdefault(name, []).append(readers[joint][name](value))
        except (ModelError, ValueError) as error:
            raise ParameterError(f"{where}: {target}: {error}") from error
    return found
