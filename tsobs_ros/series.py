# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamped rows of numbers, in memory or, for long recordings, in temporary files."""

from tempfile import TemporaryFile
from typing import Any, NamedTuple, TypeAlias
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array

Stamps: TypeAlias = NDArray[np.int64]

NANOSECONDS = 1_000_000_000
"""Stamps are integer nanoseconds, so that their differences are exact."""


def stamps_of(times: Array) -> Stamps:
    """Return stamps [ns] of times since the start of a run [s]; it starts at 1 s."""
    return NANOSECONDS + np.round(times * NANOSECONDS).astype(np.int64)


class Series(NamedTuple):
    """Values with their stamps.

    Attributes:
        stamps: [ns], shape (n,).
        values: NaN where there is none, shape (n, k).
        log_times: Times of recording [ns], shape (n,); empty if they do not matter.
    """

    stamps: Stamps
    values: Array
    log_times: Stamps = np.zeros(0, np.int64)

    def ordered(self) -> "Series":
        """Return the series by ascending stamp; of equal stamps the first row is kept."""
        if (np.diff(self.stamps) > 0).all():
            return self
        return self.take(np.unique(self.stamps, return_index=True)[1])

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.intp] | slice) -> "Series":
        """Return some of the rows."""
        log_times = self.log_times[chosen] if len(self.log_times) else self.log_times
        return Series(self.stamps[chosen], self.values[chosen], log_times)

    def seconds(self, origin: int = 0) -> Array:
        """Return the stamps as seconds since `origin` [ns], shape (n,)."""
        return np.asarray((self.stamps - origin) / NANOSECONDS, dtype=np.float64)


class Spool:
    """Records that grow in a temporary file, so that long recordings need little memory.

    Attributes:
        type: Data type of a record.

    >>> spool = Spool(np.dtype(np.int64))
    >>> spool.add(np.arange(2))
    >>> spool.add(np.arange(3))
    >>> spool.read().tolist()
    [0, 1, 0, 1, 2]
    """

    def __init__(self, type_: np.dtype[Any]) -> None:
        self.type = type_
        self._file = TemporaryFile()  # noqa: SIM115
        finalize(self, self._file.close)

    def add(self, records: NDArray[Any]) -> None:
        """Add records, shape (n,)."""
        self._file.write(records.tobytes())

    def read(self) -> Any:
        """Return all records, which are paged in as they are used, shape (n,)."""
        self._file.flush()
        size = self._file.tell()  # an empty file cannot be mapped
        found = np.memmap(self._file, self.type, "r+") if size else np.zeros(0, self.type)
        return found.view(np.recarray) if self.type.names else found


class SeriesSpool:
    """A series of some columns with log times that grows in a temporary file."""

    def __init__(self, columns: int) -> None:
        times = [("stamps", np.int64), ("log_times", np.int64)]
        self._spool = Spool(np.dtype([*times, ("values", np.float64, (columns,))]))

    def add(self, stamps: Stamps, log_times: Stamps, values: Array) -> None:
        """Add rows, values of shape (n, columns)."""
        self._spool.add(np.rec.fromarrays([stamps, log_times, values], self._spool.type))

    def read(self) -> Series:
        """Return all rows, which are paged in as they are used."""
        rows = self._spool.read()
        return Series(rows.stamps, rows.values, rows.log_times)
