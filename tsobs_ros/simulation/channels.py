# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Channels of simulated plants: sums of components, which can be exchanged while a plant runs.

A channel is the disturbance of an output, or of a torque. The time of its components, their
`start` included, counts from the sample at which they were put in.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled
from tsobs_ros.simulation.signals import (
    GAUSS_MARKOV,
    ROW,
    Component,
    component_row,
    drifted,
)
from tsobs_ros.simulation.streams import RandomStream, Source

Counts = NDArray[np.int64]
Flags = NDArray[np.bool_]


class Channels:
    """The components of several channels, those of every run of a batch.

    Args:
        seeds: One for each run.
        source: What the random numbers of drifts are for.
        count: Number of channels.
        block: Samples that random numbers are drawn for at a time.

    Attributes:
        rows: Of the components, one channel after another, shape (components, ROW).
        ends: Number of rows up to the end of each channel, shape (channels,).
        injected: Index of the first sample of each channel's components, shape (channels,).
        drifts: Present values of the drifts in the order of their rows, shape (runs, drifts).
        noise: Normal numbers of the drifts, shape (drifts, runs, block).
    """

    def __init__(self, seeds: Sequence[int], source: Source, count: int, block: int) -> None:
        self._seeds, self._source, self._block = seeds, source, block
        self._others: list[list[Component]] = [[]] * count
        self._generations = [-1] * count
        self._streams: list[list[RandomStream]] = [[]] * count
        self.rows = np.zeros((0, ROW))
        self.ends = np.zeros(count, np.int64)
        self.injected = np.zeros(count, np.int64)
        self.drifts = np.zeros((len(seeds), 0))
        self.noise = np.zeros((0, len(seeds), block))

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
        self.injected[channel] = index
        rows = [component_row(each) for each in components]
        pairs = list(zip(components, rows, strict=True))
        self._others[channel] = [each for each, row in pairs if row is None]
        key = () if channel == 0 else (channel,)
        streams = [
            RandomStream(self._seeds, self._source, (generation, place, *key))
            for place, row in enumerate(rows)
            if row is not None and row[0] == GAUSS_MARKOV
        ]
        noise = np.empty((len(streams), len(self._seeds), self._block))
        for stream, block in zip(streams, noise, strict=True):
            stream.fill(block[:, drawn:])
        first = int(self.ends[channel - 1]) if channel else 0
        kept = [row for row in rows if row is not None]
        rest = np.s_[int(self.ends[channel]) :]
        self.rows = np.vstack([self.rows[:first], *kept, self.rows[rest]])
        self.ends[channel:] += first + len(kept) - rest.start
        before = sum(map(len, self._streams[:channel]))
        after = np.s_[before + len(self._streams[channel]) :]
        self.drifts = np.hstack(
            [
                self.drifts[:, :before],
                np.zeros((len(self._seeds), len(streams))),
                self.drifts[:, after],
            ]
        )
        self.noise = np.concatenate([self.noise[:before], noise, self.noise[after]])
        self._streams[channel] = streams

    def draw(self) -> None:
        """Draw the next random numbers."""
        streams = [stream for each in self._streams for stream in each]
        for stream, block in zip(streams, self.noise, strict=True):
            stream.fill(block)

    def add_others(self, values: Array, index: int, rate: float) -> None:
        """Add the components that are not those of `signals`.

        Args:
            values: To add to, shape (runs, samples, channels).
            index: Index of the first sample.
            rate: Samples a second [Hz].
        """
        for channel, others in enumerate(self._others):
            first = index - int(self.injected[channel])
            for other in others:
                places = range(first, first + values.shape[1])
                values[..., channel] += [other.value(place / rate) for place in places]


@compiled
def with_drifts(
    value: float,
    rows: Array,
    first: int,
    last: int,
    since: int,
    rate: float,
    drifts: Array,
    noise: Array,
    drift: int,
    run: int,
    draw: int,
) -> float:
    """Move the drifts of a channel on to a sample and return their sum with a value.

    Args:
        value: What they are added to.
        rows: Of all channels, shape (rows, ROW).
        first: The channel's first row.
        last: The row after its last.
        since: Samples since its components were put in.
        rate: Samples a second [Hz].
        drifts: Of all channels, shape (runs, drifts), which are moved.
        noise: Their normal numbers, shape (drifts, runs, block).
        drift: Number of drifts of the channels before.
        run: The run.
        draw: Place of the sample in the block.
    """
    for row in range(first, last):
        if int(rows[row, 0]) == GAUSS_MARKOV:
            now = 0.0
            if since > 0 and (since - 1) / rate >= float(rows[row, 3]):
                number = float(noise[drift, run, draw])
                now = drifted(rows[row], float(drifts[run, drift]), number, 1.0 / rate)
            drifts[run, drift] = now
            value += now
            drift += 1
    return value


@compiled
def drifts_in(rows: Array, first: int, last: int) -> int:
    """Return how many rows of a channel are drifts."""
    count = 0
    for row in range(first, last):
        if int(rows[row, 0]) == GAUSS_MARKOV:
            count += 1
    return count
