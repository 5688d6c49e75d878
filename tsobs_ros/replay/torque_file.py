# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Torques over time from a CSV file, such as that of `tsobs excite`."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.errors import LogError
from tsobs_ros.replay.columns import NO_TIME, UNITS, CsvFile, LogColumn, misread, unit_of
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
    try:
        return _read(CsvFile(path))
    except OSError as error:
        raise LogError(f"{path}: cannot read it: {error.strerror or error}") from error
    except LogError as error:
        raise LogError(f"{path}: {error}") from error


def _read(file: CsvFile) -> TorqueSeries:
    columns = [_column(file, name) for name in ("time", "torque")]
    time_unit, torque_unit = (
        _unit(quantity, column)
        for quantity, column in zip(("time", "torque"), columns, strict=True)
    )
    stamps, torques = list[int](), list[float]()
    for line, (time, torque) in file.rows([column.place for column in columns]):
        try:
            stamp = file.stamp(time, time_unit)
        except (ValueError, ArithmeticError) as error:
            raise misread("time", line, columns[0], time_unit, time) from error
        try:
            value = file.number(torque) * UNITS["torque"][torque_unit]
        except ValueError as error:
            raise misread("number", line, columns[1], torque_unit, torque) from error
        if stamp == NO_TIME or not np.isfinite(value):
            raise LogError(f"line {line}: expected a time and a finite torque")
        if stamps and stamp <= stamps[-1]:
            raise LogError(f"line {line}: its time is not after that of the line before")
        if len(stamps) == MAX_LINES:
            raise LogError(f"more than {MAX_LINES:,} lines")
        stamps.append(stamp)
        torques.append(value)
    if not stamps:
        raise LogError("no lines below the header")
    return TorqueSeries((np.array(stamps) - stamps[0]) / NANOSECONDS, np.array(torques))


def _column(file: CsvFile, name: str) -> LogColumn:
    found = [one for one in file.columns if one.name.lower() == name]
    if len(found) != 1:
        what = "several columns are" if found else "no column is"
        raise LogError(f"{what} called {name!r}; {file.described}")
    return found[0]


def _unit(quantity: str, column: LogColumn) -> str:
    unit = unit_of(quantity, column.unit) if column.unit else next(iter(UNITS[quantity]))
    if not unit:
        raise LogError(
            f"column {column.title!r}: unit {column.unit!r} of {quantity} is not known; there are "
            f"{', '.join(UNITS[quantity])}"
        )
    return unit
