# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Delays of simulated plants: of torques on their way to the motor, and of measured angles."""

import math
from collections.abc import Sequence

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.model.torque_path import TorquePath


class TorqueDelay:
    """The path of a commanded torque to the motor, in every run of a batch.

    Args:
        path: Gain, offset and delay.
        rate: Samples a second [Hz].
    """

    def __init__(self, path: TorquePath, rate: float) -> None:
        self._path = path
        self._whole, self._share = _cut(path.delay, rate)
        self._past: Array | None = None

    def through(self, commands: Array) -> Array:
        """Return the mean torque at the motor from each sample to the next, shape (runs, samples).

        Each command is held for a period. The first one is taken to have been there always.

        Args:
            commands: Of the samples that follow those of the last call, shape (runs, samples).
        """
        samples = commands.shape[1]
        if self._past is None:
            self._past = np.repeat(commands[:, :1], self._whole + 1, axis=1)
        known = np.concatenate([self._past, commands], axis=1)
        self._past = known[:, samples:]
        older, newer = known[:, :samples], known[:, 1 : samples + 1]
        mean = newer + self._share * (older - newer)
        return np.asarray(self._path.gain * mean + self._path.offset)


class AngleDelay:
    """Angles as they were, in every run of a batch.

    Args:
        places: Places of the angles in a state, each followed by that of its velocity.
        delays: Of each [s]; a state of a delay of 0 is taken as it is, and need not be an angle.
        rate: Samples a second [Hz].
    """

    def __init__(self, places: Sequence[int], delays: Sequence[float], rate: float) -> None:
        self._places, self._period = list(places), 1.0 / rate
        self._cuts = [_cut(delay, rate) for delay in delays]
        self._longest = max((whole + 1 for whole, _ in self._cuts), default=0)
        self._is_late = any(delays)
        self._past: Array | None = None

    def measured(self, states: Array) -> Array:
        """Return what is measured at each sample, shape (runs, samples, p).

        Between samples the motion is a cubic polynomial of angles and velocities; before the first
        one the velocity is the first one's.

        Args:
            states: Of the samples that follow those of the last call, shape (runs, samples, n).
        """
        if not self._is_late:
            return np.asarray(states[..., self._places])
        samples, T = states.shape[1], self._period
        if self._past is None:
            ages = T * np.arange(self._longest, 0, -1)[:, np.newaxis]
            self._past = np.repeat(states[:, :1], self._longest, axis=1)
            self._past[..., 0::2] -= ages * self._past[..., 1::2]
        known = np.concatenate([self._past, states], axis=1)
        self._past = known[:, samples:]
        found = []
        for place, (whole, share) in zip(self._places, self._cuts, strict=True):
            now = self._longest - whole
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
