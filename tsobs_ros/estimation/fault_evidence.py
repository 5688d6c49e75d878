# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a fault is told from, in bounded memory: repeats, innovations, the last estimates."""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from tsobs_ros.estimation.fault_shapes import FaultKind, Shape, shape_of

_STUCK_TIME = 0.1
_STUCK_SAMPLES = 10

_MEMORY = 1.0
_CLIP = 5.0
_LARGE = 2.0
_COLOURED = 0.3

_BLOCK = 100_000_000
_BLOCKS = 150
_LEAST_BLOCKS = 10
_RECOVERY_BLOCKS = 100
_EVERY = 3
_LONGEST_GAP = 1.0
_OPEN = 3.0


class Repeats:
    """Notices raw samples that stay where noisy ones would not.

    Args:
        tolerance: Samples that differ by no more than this count as the same [rad].

    Attributes:
        stuck: Whether the samples of the last tenth of a second, at least ten, are the same.
    """

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._anchor, self._since, self._count = math.nan, 0, 0
        self.stuck = False

    def update(self, stamp: int, y: float) -> None:
        """Take in a raw sample [rad] at a stamp [ns]."""
        if abs(y - self._anchor) <= self._tolerance:
            self._count += 1
            lasted = stamp - self._since >= _STUCK_TIME * 1e9
            self.stuck = lasted and self._count >= _STUCK_SAMPLES
        else:
            self._anchor, self._since, self._count, self.stuck = y, stamp, 1, False


class Whiteness:
    """One-second averages of the normalised innovation: its square, and times the one before.

    Attributes:
        square: 1 when the model fits; each sample is clipped at 5σ.
        period: Time between the last two samples [s].
    """

    def __init__(self) -> None:
        self._stamp: int | None = None
        self._last = 0.0
        self.square, self._product = 1.0, 0.0
        self.period = 0.0

    def update(self, stamp: int, normalised: float) -> None:
        """Take in an innovation divided by its expected 1σ, at a stamp [ns]; late ones pass by."""
        value = max(-_CLIP, min(_CLIP, normalised))
        if self._stamp is not None:
            if stamp <= self._stamp:
                return
            self.period = (stamp - self._stamp) * 1e-9
            weight = -math.expm1(-self.period / _MEMORY)
            self.square += weight * (value * value - self.square)
            self._product += weight * (value * self._last - self._product)
        self._stamp, self._last = stamp, value

    @property
    def large(self) -> bool:
        """Whether the innovations are too large."""
        return self.square > _LARGE

    @property
    def white(self) -> bool:
        """Whether an innovation says little about the next one."""
        return abs(self._product) <= _COLOURED * self.square

    @property
    def widening(self) -> float:
        """By how much the sensor's noise widens a bound: √square if white, else unknown, so 1."""
        return math.sqrt(max(1.0, self.square)) if self.white else 1.0

    @property
    def relative_error(self) -> float:
        """1σ of √square relative to itself: 2·`_MEMORY` of samples are in the average."""
        return math.sqrt(0.25 * self.period / _MEMORY)


class _Block(NamedTuple):
    time: float
    disturbance: float
    motion: float
    bound: float


class History:
    """Means over tenths of a second of the last quarter of a minute, and their shape.

    Args:
        after_fault: Whether the estimate has to recover first: then the shape is unknown for 10 s.

    Attributes:
        shape: As of the last look at it, three times a second.
    """

    def __init__(self, after_fault: bool = False) -> None:
        self._least = _RECOVERY_BLOCKS if after_fault else _LEAST_BLOCKS
        self._blocks: deque[_Block] = deque(maxlen=_BLOCKS)
        self._begun: int | None = None
        self._stamp = 0
        self._block = self._count = 0
        self._sums = (0.0, 0.0, 0.0)
        self.shape = Shape(FaultKind.UNKNOWN if after_fault else FaultKind.NONE, 0.0)

    def broken_at(self, stamp: int) -> bool:
        """Return whether an estimate at a stamp [ns] comes after a gap."""
        return self._begun is not None and stamp - self._stamp > _LONGEST_GAP * 1e9

    def add(
        self, stamp: int, disturbance: float, motion: float, bound: float, widening: float
    ) -> bool:
        """Take in an estimate.

        Args:
            stamp: Of the estimate, later than the one before [ns].
            disturbance: [rad].
            motion: Estimated angle of the arm [rad].
            bound: 1σ of the disturbance [rad].
            widening: Factor of the bound.

        Returns:
            Whether a block is complete.
        """
        if self._begun is None:
            self._begun = stamp
        self._stamp = stamp
        a, b, c = self._sums
        self._sums = a + disturbance, b + motion, c + bound
        self._count += 1
        elapsed = stamp - self._begun
        if elapsed < (self._block + 1) * _BLOCK:
            return False
        means = (total / self._count for total in self._sums)
        self._blocks.append(_Block(elapsed * 1e-9, *means))
        self._sums, self._count = (0.0, 0.0, 0.0), 0
        self._block = elapsed // _BLOCK
        if len(self._blocks) >= self._least and self._block % _EVERY == 0:
            self._look(widening)
        return True

    def _look(self, widening: float) -> None:
        """See the shape since the bound was last wide open, if that is long enough ago."""
        blocks = np.array(self._blocks)
        bound = float(blocks[-1, 3])
        opened = np.flatnonzero(blocks[:, 3] > _OPEN * bound)
        times, values, motion, _ = (blocks[opened[-1] + 1 :] if len(opened) else blocks).T
        if len(times) >= _LEAST_BLOCKS:
            self.shape = shape_of(times, values, motion, bound * widening)
