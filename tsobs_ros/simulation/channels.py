# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Channels of simulated plants: sums of components, which can be exchanged while a plant runs.

A channel is the disturbance of an output, or of a torque. The time of its components, their
`start` included, counts from the sample at which they were put in.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tsobs_ros.checks import Array, Flags
from tsobs_ros.core import native
from tsobs_ros.simulation.series import Span
from tsobs_ros.simulation.signals import GaussMarkov, Signal, StuckSensor, markov_step
from tsobs_ros.simulation.streams import RandomStream, Source


@dataclass
class _Drift:
    """The random part of a component.

    Attributes:
        component: Its numbers.
        stream: Of its normal numbers.
        noise: The present ones, shape (runs, block).
        now: Present values, shape (runs,).
    """

    component: GaussMarkov
    stream: RandomStream
    noise: Array
    now: Array


class Channels:
    """The components of several channels, those of every run of a batch.

    Args:
        seeds: One for each run.
        source: What the random numbers of drifts are for.
        count: Number of channels.
        block: Samples that random numbers are drawn for at a time.
        rate: Samples a second [Hz].
    """

    def __init__(
        self, seeds: Sequence[int], source: Source, count: int, block: int, rate: float
    ) -> None:
        self._seeds, self._source, self._block, self._rate = seeds, source, block, rate
        self._components: list[tuple[Signal, ...]] = [()] * count
        self._drifts: list[list[_Drift]] = [[]] * count
        self._generations = [-1] * count
        self._injected = [0] * count

    def exchange(self, channel: int, components: Sequence[Signal], index: int, drawn: int) -> None:
        """Put other components in the place of a channel's present ones.

        Args:
            channel: Its number.
            components: The others.
            index: Index of the first sample they are for.
            drawn: Its place in the blocks of random numbers.
        """
        generation = self._generations[channel] = self._generations[channel] + 1
        key, runs = () if channel == 0 else (channel,), len(self._seeds)
        drifts = []
        for place, each in enumerate(components):
            if isinstance(each, GaussMarkov):
                stream = RandomStream(self._seeds, self._source, (generation, place, *key))
                noise = np.empty((runs, self._block))
                stream.fill(noise[:, drawn:])
                drifts.append(_Drift(each, stream, noise, np.zeros(runs)))
        self._components[channel], self._drifts[channel] = tuple(components), drifts
        self._injected[channel] = index

    def draw(self) -> None:
        """Draw the next random numbers."""
        for drifts in self._drifts:
            for drift in drifts:
                drift.stream.fill(drift.noise)

    def _times(self, channel: int, index: int, samples: int) -> Array:
        """Return the times since a channel's components were put in [s]."""
        first = index - self._injected[channel]
        return np.arange(first, first + samples) / self._rate

    def add_means(self, values: Array, index: int) -> None:
        """Add the components without their random parts.

        Args:
            values: To add to, shape (runs, samples, channels).
            index: Index of the first sample.
        """
        for channel, components in enumerate(self._components):
            if components:
                times = self._times(channel, index, values.shape[1])
                total = np.zeros(len(times))
                for each in components:
                    total += each.values(times)
                values[..., channel] += total

    def add_drifts(self, values: Array, channel: int, span: Span) -> None:
        """Move the drifts of a channel on over samples, in every run, and add them.

        Args:
            values: To add to, shape (runs, samples).
            channel: Its number.
            span: The samples.
        """
        for drift in self._drifts[channel]:
            # A drift leaves zero one sample after its start.
            before = self._times(channel, span.start - 1, span.samples)
            has_begun = (before >= 0.0) & (before >= drift.component.start)
            first = span.samples - int(np.count_nonzero(has_begun))
            decay, strength = markov_step(1.0 / self._rate, drift.component.time_constant)
            numbers = drift.noise[:, span.drawn + first : span.drawn + span.samples].copy()
            native.gauss_markov(decay, strength * drift.component.std, drift.now, numbers)
            values[:, first:] += numbers

    def stuck(self, channel: int, span: Span) -> Flags:
        """Return at which samples a component holds the measured value, shape (samples,)."""
        found = np.zeros(span.samples, np.bool_)
        for each in self._components[channel]:
            if isinstance(each, StuckSensor):
                found |= each.holds(self._times(channel, span.start, span.samples))
        return found
