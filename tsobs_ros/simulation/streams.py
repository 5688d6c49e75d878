# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The random numbers of simulated plants.

There is one independent, reproducible stream for each source of randomness and each run. The
streams of one seed are distinguished by a key, not by the order in which they were made, so that
switching one source on, off or to another size leaves the numbers of all others as they were.
"""

import enum
from collections.abc import Iterable

import numpy as np

from tsobs_ros.checks import Array


class Source(enum.IntEnum):
    """What a stream is for; the numbers are part of every seed's meaning and never change."""

    INITIAL_STATE = 0
    PROCESS = 1
    MEASUREMENT = 2
    OUTLIER = 3
    DISTURBANCE = 4
    TAIL = 5
    TORQUE = 6


def key_of(number: int) -> tuple[int, ...]:
    """Return the key of one of several outputs or torques, that of the first without a number."""
    return (number,) if number else ()


class RandomStream:
    """Normal numbers, or uniform ones in [0, 1), of every run, in order.

    Args:
        seeds: One for each run.
        source: What the numbers are for.
        key: Further integers that distinguish streams of the same source.
        uniform: Draw uniform numbers.
    """

    def __init__(
        self, seeds: Iterable[int], source: Source, key: tuple[int, ...] = (), uniform: bool = False
    ) -> None:
        sequences = [np.random.SeedSequence(seed, spawn_key=(source, *key)) for seed in seeds]
        generators = [np.random.Generator(np.random.Philox(each)) for each in sequences]
        self._draws = [each.random if uniform else each.standard_normal for each in generators]

    def take(self, *shape: int) -> Array:
        """Return the next numbers, shape (runs, *shape); how many at a time does not matter."""
        block = np.empty((len(self._draws), *shape))
        for draw, row in zip(self._draws, block, strict=True):
            draw(out=row)
        return block
