# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Random numbers: one independent, reproducible stream for each source of a plant and each run.

The streams of one seed are told apart by a key, not by the order in which they were made, so that
switching one source on, off or to another size leaves the numbers of all others as they were.
"""

import enum
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array
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
        key: Further integers that tell streams of the same source apart.
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
        # Samples are handed out as views, so nobody may write into them.
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
