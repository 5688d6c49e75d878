# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Torques over time from a CSV file, such as that of `tsobs excite`."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.errors import LogError
from tsobs_ros.replay.columns import NO_TIME, CsvFile, LogColumn, naming_file, with_unit
from tsobs_ros.series import NANOSECONDS

MAX_LINES = 2_000_000
"""Largest number of torques: an hour at 500 Hz."""


class TorqueSeries(NamedTuple):
    """Torques, each held from its time to the next.

    Attributes:
        time: Since the first one [s], rising, shape (n,).
        torque: [N m], shape (n,).
    """

    time: Array
    torque: Array


def read_torques(path: str | Path) -> TorqueSeries:
    """Return the columns `time` and `torque` of a CSV file; others are passed over.

    Units are s and N m if the titles name none.

    Raises:
        LogError: The file cannot be read, lacks a column, or has a cell that is no finite number,
            or times that do not rise; the text names file and line.
    """
    path = Path(path)
    with naming_file(path):
        return _read(CsvFile(path))


def _read(file: CsvFile) -> TorqueSeries:
    time, torque = (with_unit(_column(file, name), name) for name in ("time", "torque"))
    stamps, torques = np.zeros(0, np.int64), np.zeros(0)
    for lines, more, values in file.read(time, [torque]):
        known = (more != NO_TIME) & np.isfinite(values[:, 0])
        rising = np.diff(more, prepend=stamps[-1:] if len(stamps) else NO_TIME) > 0
        for holds, text in (
            (known, "expected a time and a finite torque"),
            (rising, "its time is not after that of the line before"),
        ):
            if not holds.all():
                raise LogError(f"line {lines[int(holds.argmin())]}: {text}")
        stamps, torques = np.append(stamps, more), np.append(torques, values)
        if len(stamps) > MAX_LINES:
            raise LogError(f"more than {MAX_LINES:,} lines")
    if not len(stamps):
        raise LogError("no lines below the header")
    return TorqueSeries((stamps - stamps[0]) / NANOSECONDS, torques)


def _column(file: CsvFile, name: str) -> LogColumn:
    found = file.named(name)
    if len(found) != 1:
        what = "several columns are" if found else "no column is"
        raise LogError(f"{what} called {name!r}; {file.described}")
    return found[0]
