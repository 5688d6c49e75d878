# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Channels of simulated plants: sums of components, which can be exchanged while a plant runs.

A channel is the disturbance of an output, or of a torque. The time of its components, their
`start` included, counts from the sample at which they were put in.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array, Integers
from tsobs_ros.compiled import compiled
from tsobs_ros.simulation.signals import (
    GAUSS_MARKOV,
    ROW,
    Component,
    component_row,
    disturbance_at,
    is_stuck,
    markov_step,
)
from tsobs_ros.simulation.streams import RandomStream, Source


class Sums(NamedTuple):
    """The components of all channels, for compiled code.

    Attributes:
        rows: Of the components, one channel after another, shape (components, ROW).
        ends: Number of rows up to each channel, and of all, shape (channels + 1,).
        injected: Index of the first sample of each channel's components, shape (channels,).
        drifts: Present values of the drifts in the order of their rows, shape (runs, drifts).
        noise: Normal numbers of the drifts, shape (drifts, runs, block).
        drift_ends: Number of drifts up to each channel, and of all, shape (channels + 1,).
    """

    rows: Array
    ends: Integers
    injected: Integers
    drifts: Array
    noise: Array
    drift_ends: Integers


class Channels:
    """The components of several channels, those of every run of a batch.

    Args:
        seeds: One for each run.
        source: What the random numbers of drifts are for.
        count: Number of channels.
        block: Samples that random numbers are drawn for at a time.

    Attributes:
        sums: The components' numbers.
    """

    def __init__(self, seeds: Sequence[int], source: Source, count: int, block: int) -> None:
        self._seeds, self._source, self._block = seeds, source, block
        self._others: list[list[Component]] = [[]] * count
        self._generations = [-1] * count
        self._streams: list[list[RandomStream]] = [[]] * count
        self.sums = Sums(
            np.zeros((0, ROW)),
            np.zeros(count + 1, np.int64),
            np.zeros(count, np.int64),
            np.zeros((len(seeds), 0)),
            np.zeros((0, len(seeds), block)),
            np.zeros(count + 1, np.int64),
        )

    def exchange(
        self, channel: int, components: Sequence[Component], index: int, drawn: int
    ) -> None:
        """Put other components in the place of a channel's present ones.

        Args:
            channel: Its number.
            components: The others.
            index: Index of the first sample they are for.
            drawn: Its place in the blocks of random numbers.
        """
        generation = self._generations[channel] = self._generations[channel] + 1
        rows = [component_row(each) for each in components]
        pairs = list(zip(components, rows, strict=True))
        self._others[channel] = [each for each, row in pairs if row is None]
        key = () if channel == 0 else (channel,)
        streams = [
            RandomStream(self._seeds, self._source, (generation, place, *key))
            for place, row in enumerate(rows)
            if row is not None and row[0] == GAUSS_MARKOV
        ]
        runs = len(self._seeds)
        noise = np.empty((len(streams), runs, self._block))
        for stream, block in zip(streams, noise, strict=True):
            stream.fill(block[:, drawn:])
        kept = np.array([row for row in rows if row is not None]).reshape(-1, ROW)
        sums = self.sums
        first, last = sums.ends[channel : channel + 2]
        before, after = sums.drift_ends[channel : channel + 2]
        self.sums = sums._replace(
            rows=np.vstack([sums.rows[:first], kept, sums.rows[last:]]),
            drifts=np.hstack(
                [sums.drifts[:, :before], np.zeros((runs, len(streams))), sums.drifts[:, after:]]
            ),
            noise=np.concatenate([sums.noise[:before], noise, sums.noise[after:]]),
        )
        sums.injected[channel] = index
        sums.ends[channel + 1 :] += len(kept) - (last - first)
        sums.drift_ends[channel + 1 :] += len(streams) - (after - before)
        self._streams[channel] = streams

    def draw(self) -> None:
        """Draw the next random numbers."""
        streams = [stream for each in self._streams for stream in each]
        for stream, block in zip(streams, self.sums.noise, strict=True):
            stream.fill(block)

    def add_others(self, values: Array, index: int, rate: float) -> None:
        """Add the components that are not those of `signals`.

        Args:
            values: To add to, shape (runs, samples, channels).
            index: Index of the first sample.
            rate: Samples a second [Hz].
        """
        for channel, others in enumerate(self._others):
            first = index - int(self.sums.injected[channel])
            for other in others:
                places = range(first, first + values.shape[1])
                values[..., channel] += [other.value(place / rate) for place in places]


@compiled
def without_drifts(sums: Sums, channel: int, index: int, rate: float) -> tuple[float, bool]:
    """Return what a channel adds at a sample without its drifts, and whether it is stuck.

    Args:
        sums: The components of all channels.
        channel: Its number.
        index: Index of the sample.
        rate: Samples a second [Hz].
    """
    rows = sums.rows[sums.ends[channel] : sums.ends[channel + 1]]
    time = (index - int(sums.injected[channel])) / rate
    return disturbance_at(rows, time), is_stuck(rows, time)


@compiled
def add_drifts(values: Array, sums: Sums, channel: int, index: int, rate: float, draw: int) -> None:
    """Move the drifts of a channel on to a sample, in every run, and add them to values.

    Args:
        values: To add to, shape (runs,).
        sums: The components of all channels; their drifts are moved.
        channel: Its number.
        index: Index of the sample.
        rate: Samples a second [Hz].
        draw: Place of the sample in the block.
    """
    drift, since = sums.drift_ends[channel], index - int(sums.injected[channel])
    for row in range(sums.ends[channel], sums.ends[channel + 1]):
        if int(sums.rows[row, 0]) == GAUSS_MARKOV:
            has_begun = since > 0 and (since - 1) / rate >= float(sums.rows[row, 3])
            decay, strength = markov_step(1.0 / rate, float(sums.rows[row, 2]))
            strength *= float(sums.rows[row, 1])
            for run in range(values.shape[0]):
                now, number = float(sums.drifts[run, drift]), float(sums.noise[drift, run, draw])
                now = decay * now + strength * number if has_begun else 0.0
                sums.drifts[run, drift] = now
                values[run] += now
            drift += 1
