# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamped rows of numbers, of which runs are made, recorded, replayed and simulated ones."""

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array

Stamps: TypeAlias = NDArray[np.int64]

NANOSECONDS = 1_000_000_000
"""Stamps are integer nanoseconds, so that differences of them are exact."""


class Series(NamedTuple):
    """Values with their stamps.

    Attributes:
        stamps: [ns], shape (n,).
        values: NaN where there is none, shape (n, k).
    """

    stamps: Stamps
    values: Array

    def ordered(self) -> "Series":
        """Return the series by ascending stamp; of equal stamps the first row is kept."""
        if (np.diff(self.stamps) > 0).all():
            return self
        stamps, places = np.unique(self.stamps, return_index=True)
        return self._replace(stamps=stamps, values=self.values[places])

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.intp] | slice) -> "Series":
        """Return some of the rows."""
        return self._replace(stamps=self.stamps[chosen], values=self.values[chosen])

    def column(self, place: int) -> "Series":
        """Return one column."""
        return Series(self.stamps, self.values[:, place : place + 1])

    def seconds(self, origin: int = 0) -> Array:
        """Return the stamps as seconds since `origin` [ns], shape (n,)."""
        return np.asarray((self.stamps - origin) / NANOSECONDS, dtype=np.float64)
