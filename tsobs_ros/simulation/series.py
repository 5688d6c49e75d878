# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Series of samples that a plant writes, and the spans in which it writes them."""

from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array


class Span(NamedTuple):
    """Samples in a row, which are drawn, moved and measured in one call.

    Attributes:
        start: Index of the first one.
        drawn: Its place in the blocks of random numbers.
        place: Its place in the series.
        samples: Their number.
    """

    start: int
    drawn: int
    place: int
    samples: int

    def times(self, rate: float) -> Array:
        """Return the samples' times since the start [s], shape (samples,)."""
        return np.arange(self.start, self.start + self.samples) / rate

    def of(self, series: Array) -> Array:
        """Return the samples of a series, shape (runs, samples, ...)."""
        return series[:, self.place : self.place + self.samples]

    def drawn_for(self, block: Array) -> Array:
        """Return the random numbers of the samples, shape (runs, samples, ...)."""
        return block[:, self.drawn : self.drawn + self.samples]


class Series(NamedTuple):
    """All samples of a call, to be written span by span.

    Attributes:
        states: Physical states, shape (runs, samples, n).
        truths: True values of the outputs, shape (runs, samples, p).
        disturbances: What the measurements have beyond the truth, shape (runs, samples, p);
            before, without random parts and stuck sensors.
        measurements: Measured outputs, NaN if lost, shape (runs, samples, p).
        inputs: Inputs and scheduled signals, shape (runs, samples, inputs).
        torques: Torques that an undisturbed plant would need to move so, shape (runs, samples, t);
            before, those that disturb it, without random parts.
    """

    states: Array
    truths: Array
    disturbances: Array
    measurements: Array
    inputs: Array
    torques: Array
