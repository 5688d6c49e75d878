# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Series of samples that a plant writes, and the spans in which it writes them."""

from typing import NamedTuple

from tsobs_ros.checks import Array, Flags


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


class Series(NamedTuple):
    """All samples of a call, to be written span by span.

    Attributes:
        states: Physical states, shape (runs, samples, n).
        truths: True values of the outputs, shape (runs, samples, p).
        disturbances: What the measurements have beyond the truth, shape (runs, samples, p);
            before, those of components that `signals` does not evaluate.
        measurements: Measured outputs, NaN if lost, shape (runs, samples, p).
        inputs: Inputs and scheduled signals, shape (runs, samples, inputs).
        given: Which of these are not to be written, shape (inputs,).
        torques: Torques that an undisturbed plant would need to move so, shape (runs, samples, t);
            before, those of components that `signals` does not evaluate.
    """

    states: Array
    truths: Array
    disturbances: Array
    measurements: Array
    inputs: Array
    given: Flags
    torques: Array
