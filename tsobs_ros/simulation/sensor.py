# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The angle sensor of a simulated plant, and the random numbers of the plant.

There is one independent, reproducible stream for each source of randomness and each run. The
streams of one seed are distinguished by a key, not by the order in which they were made, so that
switching one source on, off or to another size leaves the numbers of all others as they were.
"""

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, non_negative
from tsobs_ros.errors import ModelError

Seeds = int | Sequence[int]
"""One seed for a single plant, or a sequence of seeds for a batch of runs."""

_BLOCK = 256
"""Samples drawn at a time: a call of the generator costs as much as fifty numbers."""


class Source(enum.IntEnum):
    """What a stream is for; the numbers are part of every seed's meaning and never change."""

    INITIAL_STATE = 0
    PROCESS = 1
    MEASUREMENT = 2
    OUTLIER = 3
    DISTURBANCE = 4


class RandomStream:
    """Normal numbers, or uniform ones in [0, scale), drawn in order, an array a sample.

    Args:
        seeds: A seed, for samples of the given shape, or a sequence, for (runs, *shape).
        source: What the numbers are for.
        shape: Shape of a sample.
        scale: Standard deviations, broadcast to the shape: a whole block is scaled at once.
        key: Further integers that distinguish streams of the same source.
        uniform: Draw uniform numbers.

    Raises:
        ModelError: A seed is not an integer of at least zero, or there is none.
    """

    def __init__(
        self,
        seeds: Seeds,
        source: Source,
        shape: tuple[int, ...],
        *,
        scale: ArrayLike = 1.0,
        key: tuple[int, ...] = (),
        uniform: bool = False,
    ) -> None:
        self._batched = batch_shape(seeds) != ()
        self._generators = [
            np.random.Generator(
                np.random.Philox(np.random.SeedSequence(seed, spawn_key=(source, *key)))
            )
            for seed in checked_seeds(seeds)
        ]
        self._shape = (_BLOCK, *shape)
        self._scale = np.asarray(scale, dtype=np.float64)
        self._uniform = uniform
        self._block = np.empty((0,))
        self._next = 0

    def draw(self) -> Array:
        """Return the next sample, of the given shape or (runs, *shape)."""
        if self._next == len(self._block):
            self._refill()
        sample: Array = self._block[self._next]
        self._next += 1
        return sample

    def _refill(self) -> None:
        blocks = [
            generator.random(self._shape)
            if self._uniform
            else generator.standard_normal(self._shape)
            for generator in self._generators
        ]
        block = np.stack(blocks, axis=1) if self._batched else blocks[0]
        # Samples are handed out as views, so they are read-only.
        self._block = block * self._scale
        self._block.setflags(write=False)
        self._next = 0


def checked_seeds(seeds: Seeds) -> list[int]:
    """Return the seeds as a list.

    Raises:
        ModelError: A seed is not an integer of at least zero, or there is none.
    """
    # NumPy's integers are not instances of int, but a seed may well come out of an array.
    listed = [int(seeds)] if isinstance(seeds, int | np.integer) else [int(seed) for seed in seeds]
    if not listed or min(listed) < 0:
        raise ModelError(f"seeds: expected integers of at least 0, at least one, got {seeds!r}")
    return listed


def batch_shape(seeds: Seeds) -> tuple[int, ...]:
    """Return () for a single seed, (runs,) for a sequence."""
    return () if isinstance(seeds, int | np.integer) else (len(seeds),)


@dataclass(frozen=True)
class Sensor:
    """Numbers of the sensor; the default noise is Example 3's 5 % of the largest angle.

    Attributes:
        noise_std: σ of the white noise of a sample [rad].
        outlier_probability: Probability that a sample is an outlier.
        outlier_size: What an outlier adds, with either sign [rad].
        dropout_interval: Time from the beginning of a dropout to that of the next, the first one
            after one interval [s]; 0 for none.
        dropout_duration: Length of a dropout [s].
    """

    noise_std: float = 0.028
    outlier_probability: float = 0.0
    outlier_size: float = 1.0
    dropout_interval: float = 0.0
    dropout_duration: float = 0.5

    def __post_init__(self) -> None:
        for name in ("noise_std", "dropout_interval", "dropout_duration"):
            non_negative(name, getattr(self, name))
        if not 0.0 <= self.outlier_probability <= 1.0:
            raise ModelError(
                f"outlier_probability: expected 0 to 1, got {self.outlier_probability!r}"
            )
        if not math.isfinite(self.outlier_size):
            raise ModelError(f"outlier_size: expected a finite number, got {self.outlier_size!r}")

    def drops(self, time: float) -> bool:
        """Return whether a sample at a time [s] is lost."""
        if self.dropout_interval == 0.0 or time < self.dropout_interval:
            return False
        # The margin keeps a sample that lies on a border on its side, whatever % rounds to.
        return (time + 1e-9) % self.dropout_interval < self.dropout_duration - 1e-9


class SensorNoise:
    """The random part of the samples, drawn once a sample and in order.

    Args:
        seeds: One seed, or one for each run.
    """

    def __init__(self, seeds: Seeds) -> None:
        self._noise = RandomStream(seeds, Source.MEASUREMENT, (1,))
        self._luck = RandomStream(seeds, Source.OUTLIER, (1,), uniform=True)

    def sample(self, sensor: Sensor) -> tuple[Array, Array | None]:
        """Return white noise and outliers [rad] of the next sample, each (1,) or (runs, 1).

        The outliers are None if there cannot be any. Both streams move on whatever the
        sensor's numbers are, so that these may change at any sample without a change of the
        others.
        """
        noise = sensor.noise_std * self._noise.draw()
        luck, probability = self._luck.draw(), sensor.outlier_probability
        if probability == 0.0:
            return noise, None
        sign = np.where(luck < 0.5 * probability, -1.0, 1.0)
        return noise, np.where(luck < probability, sensor.outlier_size * sign, 0.0)
