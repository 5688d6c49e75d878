# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamped series of numbers, and their values at other stamps than their own."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from tsobs_ros.checks import Array

Stamps = NDArray[np.int64]
"""Integer nanoseconds, shape (n,)."""

LARGEST_GAP = 0.1
"""Series are not interpolated across longer gaps [s]: messages were lost there."""

_SECOND = 1e9


class Series(NamedTuple):
    """Values with their stamps.

    Attributes:
        stamps: [ns], shape (n,).
        values: Shape (n, k).
    """

    stamps: Stamps
    values: Array

    def ordered(self) -> "Series":
        """Return the series by ascending stamp; of equal stamps the first that came is kept."""
        stamps, places = np.unique(self.stamps, return_index=True)
        return Series(stamps, self.values[places])

    def seconds(self, origin: int) -> Array:
        """Return the stamps as seconds since `origin` [ns], shape (n,)."""
        return np.asarray((self.stamps - origin) / _SECOND, dtype=np.float64)


def align(series: Series, stamps: Stamps) -> Array:
    """Return the values that have exactly these stamps, NaN where there is none, (m, k)."""
    source = series.ordered()
    result = np.full((len(stamps), source.values.shape[1]), np.nan)
    if len(source.stamps):
        places = np.searchsorted(source.stamps, stamps).clip(max=len(source.stamps) - 1)
        found = source.stamps[places] == stamps
        result[found] = source.values[places[found]]
    return result


def interpolate_motion(series: Series, stamps: Stamps, largest_gap: float = LARGEST_GAP) -> Array:
    """Return [q₁, q̇₁, q₂, q̇₂] between its samples, NaN outside of them and in gaps.

    Angles follow the cubic that has the angles and velocities of both neighbours, velocities
    its derivative. Of a smooth motion the angle is off by at most h⁴/384 max|q⁗| and the
    velocity by at most √3 h³/216 max|q⁗|: 10⁻⁹ rad and 10⁻⁶ rad/s for the elastic-joint arm at
    h = 5 ms. A white acceleration of density s makes the truth between samples random; the cubic
    is then its conditional mean, with a 1σ of √(s h)/4 in velocity half way: 2·10⁻⁴ rad/s at
    s = 10⁻⁴ rad²/s³, a hundredth of the estimation error.

    Args:
        series: Samples in ascending order, values of shape (n, 4).
        stamps: Where to evaluate [ns], shape (m,).
        largest_gap: Distance of neighbouring samples that still counts as sampled [s].

    Returns:
        The motion, shape (m, 4).
    """
    result = np.full((len(stamps), 4), np.nan)
    if len(series.stamps) < 2:
        return result
    inside = _between_close_samples(series.stamps, stamps, largest_gap)
    origin = int(series.stamps[0])
    times, wanted = series.seconds(origin), (stamps[inside] - origin) / _SECOND
    spline = CubicHermiteSpline(times, series.values[:, 0::2], series.values[:, 1::2], axis=0)
    result[inside, 0::2] = spline(wanted)
    result[inside, 1::2] = spline(wanted, 1)
    return result


def hold(series: Series, stamps: Stamps, largest_gap: float = LARGEST_GAP) -> Array:
    """Return the newest value at or before each stamp, NaN if it is older than the gap, (m, k).

    A disturbance may jump, so nothing is assumed between its samples; of one that moves at a
    rate r this is late by at most one period h, an error of at most r h.
    """
    result = np.full((len(stamps), series.values.shape[1]), np.nan)
    places = np.searchsorted(series.stamps, stamps, side="right") - 1
    recent = places >= 0
    age = stamps[recent] - series.stamps[places[recent]]
    recent[recent] = age <= largest_gap * _SECOND
    result[recent] = series.values[places[recent]]
    return result


def _between_close_samples(known: Stamps, stamps: Stamps, largest_gap: float) -> NDArray[np.bool_]:
    inside = (stamps >= known[0]) & (stamps <= known[-1])
    right = np.searchsorted(known, stamps, side="right").clip(1, len(known) - 1)
    close = known[right] - known[right - 1] <= largest_gap * _SECOND
    return np.asarray(inside & close)
