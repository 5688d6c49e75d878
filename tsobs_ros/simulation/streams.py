# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Random numbers, past values and delays of a batch of simulated runs.

There is one independent, reproducible stream of random numbers for each source and each run. A key
distinguishes the streams of one seed, not the order in which they were made. So switching one
source on, off or to another size does not change the numbers of the others.
"""

import enum
import math
from collections.abc import Iterable, Mapping

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.model.arm import TorquePath


class Source(enum.IntEnum):
    """The purpose of a stream; the codes are part of the meaning of every seed and never change."""

    INITIAL_STATE = 0
    PROCESS = 1
    MEASUREMENT = 2
    OUTLIER = 3
    DISTURBANCE = 4
    TAIL = 5
    TORQUE = 6


class RandomStream:
    """Normal numbers, or uniform ones in [0, 1), of every run, in order.

    The key has further integers that distinguish streams of the same source; the last one is the
    number of an output or torque, left out if it is 0.
    """

    def __init__(
        self, seeds: Iterable[int], source: Source, *key: int, uniform: bool = False
    ) -> None:
        spawn_key = (source, *(key if not key or key[-1] else key[:-1]))
        sequences = [np.random.SeedSequence(seed, spawn_key=spawn_key) for seed in seeds]
        generators = [np.random.Generator(np.random.Philox(each)) for each in sequences]
        self._draws = [each.random if uniform else each.standard_normal for each in generators]

    def take(self, *shape: int) -> Array:
        """Return the next numbers, shape (runs, *shape), the same for any size of blocks."""
        block = np.empty((len(self._draws), *shape))
        for draw, row in zip(self._draws, block, strict=True):
            draw(out=row)
        return block


class Past:
    """The last values of a series in every run of a batch, shape (runs, length, …)."""

    def __init__(self, length: int) -> None:
        self.length = length
        self.values: Array | None = None

    def joined(self, values: Array) -> Array:
        """Return the kept values and then the next ones; before the first, values were constant."""
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

        The commands, of the same shape, are those of the samples after the last call. Each is held
        for a period; the first one is assumed to have been in force always.
        """
        samples, known = commands.shape[1], self._past.joined(commands)
        older, newer = known[:, :samples], known[:, 1 : samples + 1]
        mean = newer + self._share * (older - newer)
        return np.asarray(self._path.gain * mean + self._path.offset)


class AngleDelay:
    """Measured states of an arm, with delayed angles.

    `delays` has the delay [s] of each measured state by its place. Only an angle may be late; its
    velocity is the next state.
    """

    def __init__(self, delays: Mapping[int, float], rate: float) -> None:
        self._period = 1.0 / rate
        self._cuts = {place: _cut(delay, rate) for place, delay in delays.items()}
        self._past = Past(max(whole + (share > 0.0) for whole, share in self._cuts.values()))

    def measured(self, states: Array) -> Array:
        """Return the measured values of the samples after the last call.

        Before the first sample, the angles are assumed to have moved at its velocities.
        """
        samples, past, T = states.shape[1], self._past, self._period
        if past.values is None:
            ages = T * np.arange(past.length, 0, -1)[:, np.newaxis]
            past.values = np.repeat(states[:, :1], past.length, axis=1)
            past.values[..., 0::2] -= ages * past.values[..., 1::2]
        known, found = past.joined(states), []
        for place, (whole, share) in self._cuts.items():
            now = past.length - whole
            newer = known[:, now : now + samples]
            angles = newer[..., place]
            if share > 0.0:  # a cubic between two samples
                older, t = known[:, now - 1 : now - 1 + samples], 1.0 - share
                rest = 1.0 - t
                angles = rest * rest * (1.0 + 2.0 * t) * older[..., place]
                angles = angles + t * t * (1.0 + 2.0 * rest) * newer[..., place]
                slopes = rest * older[..., place + 1] - t * newer[..., place + 1]
                angles = angles + T * t * rest * slopes
            found.append(angles)
        return np.stack(found, axis=-1)


def _cut(delay: float, rate: float) -> tuple[int, float]:
    """Return a delay [s] as whole periods and a fraction of another one."""
    periods = delay * rate
    # A whole number of periods must stay whole, however the product is rounded.
    whole = math.floor(periods + 1e-9)
    return whole, max(0.0, periods - whole)
