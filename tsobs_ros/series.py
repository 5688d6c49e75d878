# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamped rows with named columns: the one form of data from bag, CSV, replay and simulation."""

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array

Stamps: TypeAlias = NDArray[np.int64]

NANOSECONDS = 1_000_000_000
"""Stamps are integer nanoseconds, so that differences of them are exact."""


class Column(NamedTuple):
    """A column: its name without unit, and its unit, empty for none."""

    name: str
    unit: str = ""


class Series(NamedTuple):
    """Values with their stamps.

    Attributes:
        stamps: [ns], shape (n,).
        values: NaN where there is none, shape (n, k).
        columns: What the values are, k of them; empty if the reader knows.
    """

    stamps: Stamps
    values: Array
    columns: tuple[Column, ...] = ()

    @classmethod
    def empty(cls, width: int) -> "Series":
        """Return a series without rows."""
        return cls(np.zeros(0, np.int64), np.zeros((0, width)))

    def ordered(self) -> "Series":
        """Return the series by ascending stamp; of equal stamps the first row is kept."""
        if (np.diff(self.stamps) > 0).all():
            return self
        stamps, places = np.unique(self.stamps, return_index=True)
        return self._replace(stamps=stamps, values=self.values[places])

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.intp] | slice) -> "Series":
        """Return some of the rows."""
        return self._replace(stamps=self.stamps[chosen], values=self.values[chosen])

    def followed_by(self, other: "Series") -> "Series":
        """Return these rows and others behind them."""
        return self._replace(
            stamps=np.concatenate((self.stamps, other.stamps)),
            values=np.concatenate((self.values, other.values)),
        )

    def column(self, place: int | str) -> "Series":
        """Return one column, by its place or its name.

        Raises:
            ValueError: No column has this name.
        """
        if isinstance(place, str):
            place = [column.name for column in self.columns].index(place)
        chosen = slice(place, place + 1)
        return Series(self.stamps, self.values[:, chosen], self.columns[chosen])

    def seconds(self, origin: int = 0) -> Array:
        """Return the stamps as seconds since `origin` [ns], shape (n,)."""
        return np.asarray((self.stamps - origin) / NANOSECONDS, dtype=np.float64)
