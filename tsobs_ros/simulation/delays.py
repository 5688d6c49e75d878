# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Delays of simulated plants: of commands on their way to the motor, and of measured values."""

import math
from collections.abc import Sequence

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.model.arm import TorquePath


class Past:
    """The last values of a series in every run of a batch, shape (runs, length, …)."""

    def __init__(self, length: int) -> None:
        self.length = length
        self.values: Array | None = None

    def joined(self, values: Array) -> Array:
        """Return the next values behind those that are kept; before the first it was the same."""
        if self.values is None:
            self.values = np.repeat(values[:, :1], self.length, axis=1)
        known = np.concatenate([self.values, values], axis=1)
        self.values = known[:, values.shape[1] :]
        return known


class TorqueDelay:
    """The path of a commanded torque to the motor, at a rate [Hz]."""

    def __init__(self, path: TorquePath, rate: float) -> None:
        self._path = path
        whole, self._share = _cut(path.delay, rate)
        self._past = Past(whole + 1)

    def through(self, commands: Array) -> Array:
        """Return the mean torque at the motor from each sample to the next, shape (runs, samples).

        Commands are of the samples that follow those of the last call, of the same shape. Each is
        held for a period; the first one is taken to have been there always.
        """
        samples, known = commands.shape[1], self._past.joined(commands)
        older, newer = known[:, :samples], known[:, 1 : samples + 1]
        mean = newer + self._share * (older - newer)
        return np.asarray(self._path.gain * mean + self._path.offset)


class AngleDelay:
    """Measured states of an arm, angles as they were some time ago.

    Args:
        places: Of the measured ones in a state; that of an angle is followed by its velocity's.
        delays: Of each [s]; only an angle may have one.
        rate: Samples per second [Hz].
    """

    def __init__(self, places: Sequence[int], delays: Sequence[float], rate: float) -> None:
        self._places, self._period = list(places), 1.0 / rate
        self._cuts = [_cut(delay, rate) for delay in delays]
        self._past = Past(max((whole + (share > 0.0) for whole, share in self._cuts), default=0))

    def measured(self, states: Array) -> Array:
        """Return the measured values of samples that follow those of the last call.

        Before the first one, angles moved at its velocities.
        """
        samples, T = states.shape[1], self._period
        if self._past.values is None:
            ages = T * np.arange(self._past.length, 0, -1)[:, np.newaxis]
            self._past.values = np.repeat(states[:, :1], self._past.length, axis=1)
            self._past.values[..., 0::2] -= ages * self._past.values[..., 1::2]
        known = self._past.joined(states)
        found = []
        for place, (whole, share) in zip(self._places, self._cuts, strict=True):
            now = self._past.length - whole
            newer = known[:, now : now + samples]
            if share > 0.0:
                older = known[:, now - 1 : now - 1 + samples]
                found.append(_hermite(older, newer, place, T, 1.0 - share))
            else:
                found.append(newer[..., place])
        return np.stack(found, axis=-1)


def _cut(delay: float, rate: float) -> tuple[int, float]:
    """Return a delay [s] in whole periods and the share of another one."""
    periods = delay * rate
    # A whole number of periods must stay one, whatever the product rounds to.
    whole = math.floor(periods + 1e-9)
    return whole, max(0.0, periods - whole)


def _hermite(older: Array, newer: Array, place: int, period: float, t: float) -> Array:
    """Return an angle within a period, at a share t of it, shape (runs, samples)."""
    rest = 1.0 - t
    angles = rest * rest * (1.0 + 2.0 * t) * older[..., place]
    angles = angles + t * t * (1.0 + 2.0 * rest) * newer[..., place]
    slopes = rest * older[..., place + 1] - t * newer[..., place + 1]
    return np.asarray(angles + period * t * rest * slopes)
