# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recorded torque as a signal of the simulated plant."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.errors import LogError, ModelError
from tsobs_ros.replay.torque_file import TorqueSeries, read_torques
from tsobs_ros.simulation.signals import EXCITATIONS, Signal

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
