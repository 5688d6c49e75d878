# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Random numbers: one independent, reproducible stream for each source of a plant and each run.

The streams of one seed are told apart by a key, not by the order in which they were made, so that
switching one source on, off or to another size leaves the numbers of all others as they were.
"""

import enum
from collections.abc import Sequence

import numpy as np

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
    """Standard normal numbers, or uniform ones in [0, 1), drawn in order, `width` a sample.

    Args:
        seeds: A seed, for samples of shape (width,), or a sequence, for (runs, width).
        source: What the numbers are for.
        width: Numbers a sample.
        key: Further integers that tell streams of the same source apart.
        uniform: Draw uniform numbers.

    Raises:
        ModelError: A seed is not an integer of at least zero, or there is none.
    """

    def __init__(
        self,
        seeds: Seeds,
        source: Source,
        width: int,
        key: tuple[int, ...] = (),
        *,
        uniform: bool = False,
    ) -> None:
        self._batched = batch_shape(seeds) != ()
        self._generators = [
            np.random.Generator(
                np.random.Philox(np.random.SeedSequence(seed, spawn_key=(source, *key)))
            )
            for seed in checked_seeds(seeds)
        ]
        self._width = width
        self._uniform = uniform
        self._block = np.empty((0,))
        self._next = 0

    def draw(self) -> Array:
        """Return the next sample, shape (width,) or (runs, width)."""
        if self._next == len(self._block):
            self._refill()
        sample = self._block[self._next]
        self._next += 1
        return np.asarray(sample)

    def _refill(self) -> None:
        shape = (_BLOCK, self._width)
        blocks = [
            generator.random(shape) if self._uniform else generator.standard_normal(shape)
            for generator in self._generators
        ]
        self._block = np.stack(blocks, axis=1) if self._batched else blocks[0]
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
