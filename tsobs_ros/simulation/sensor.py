# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The sensors of a simulated plant, one for each output."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from tsobs_ros.checks import Array, Flags, check_each, non_negative
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
from tsobs_ros.simulation.channels import Channels
from tsobs_ros.simulation.series import Series, Span
from tsobs_ros.simulation.signals import Signal, markov_step, recurs
from tsobs_ros.simulation.streams import RandomStream, Source


@dataclass(frozen=True)
class Sensor:
    """Numbers of a sensor; the default noise is Example 3's 5 % of the largest angle.

    Units are those of an angle; a sensor of another output has that output's unit in place of rad.

    Attributes:
        noise_std: σ of the noise of a sample [rad].
        outlier_probability: Probability that a sample is an outlier.
        outlier_size: What an outlier adds, with either sign [rad].
        dropout_interval: Time from the beginning of a dropout to that of the next, the first one
            after one interval [s]; 0 for none.
        dropout_duration: Length of a dropout [s].
        outlier_is_uniform: Whether an outlier adds anything up to its size, and not just its size.
        noise_time_constant: τ of the noise's correlation e^(−t/τ) [s]; 0 for white noise.
        noise_degrees: Degrees of freedom of Student's t, which σ multiplies; 0 for normal noise.
        burst_interval: Time from the beginning of louder noise to that of the next, the first one
            after one interval [s]; 0 for none.
        burst_duration: Length of a burst [s].
        burst_factor: What multiplies the noise in a burst.
        latency: Age of the value that is measured [s], rounded to whole samples; a disturbance is
            that of the sample.
        resolution: Step of the measured value [rad]; 0 for none.
        loss_probability: Probability that a sample is lost, each by itself.
    """

    noise_std: float = 0.028
    outlier_probability: float = 0.0
    outlier_size: float = 1.0
    dropout_interval: float = 0.0
    dropout_duration: float = 0.5
    outlier_is_uniform: bool = False
    noise_time_constant: float = 0.0
    noise_degrees: int = 0
    burst_interval: float = 0.0
    burst_duration: float = 1.5
    burst_factor: float = 4.0
    latency: float = 0.0
    resolution: float = 0.0
    loss_probability: float = 0.0

    def __post_init__(self) -> None:
        names = [item.name for item in fields(self)]
        check_each(non_negative, self, *(name for name in names if "outlier" not in name))
        for name in ("outlier_probability", "loss_probability"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ModelError(f"{name}: expected 0 to 1, got {getattr(self, name)!r}")
        if not math.isfinite(self.outlier_size):
            raise ModelError(f"outlier_size: expected a finite number, got {self.outlier_size!r}")


class Sensors:
    """The sensors of a plant's outputs, in every run of a batch.

    Args:
        seeds: One for each run.
        count: Number of outputs.
        block: Samples that random numbers are drawn for at a time.
        rate: Samples a second [Hz].

    Attributes:
        channels: The disturbances of the outputs.
    """

    def __init__(self, seeds: Sequence[int], count: int, block: int, rate: float) -> None:
        self._seeds, self._block, self._rate = seeds, block, rate
        runs = len(seeds)
        self.channels = Channels(seeds, Source.DISTURBANCE, count, block, rate)
        self._sensors = [Sensor()] * count
        self._noise, self._luck = np.empty((2, count, runs, block))
        self._streams = []
        for output in range(count):
            key = () if output == 0 else (output,)
            normal = RandomStream(seeds, Source.MEASUREMENT, key)
            uniform = RandomStream(seeds, Source.OUTLIER, key, uniform=True)
            self._streams += [(normal, self._noise[output]), (uniform, self._luck[output])]
        # Of Student's t, with as many numbers a sample as its degrees of freedom.
        self._tails: list[tuple[RandomStream, Array] | None] = [None] * count
        # True values of the last samples, as many as the latency has; None if not known.
        self._past: list[Array | None] = [None] * count
        self._last, self._frozen = np.zeros((2, count, runs))
        self._was_stuck, self._was_lost = np.zeros((2, count), np.bool_)

    @property
    def lost(self) -> bool:
        """Whether the last sample of every output was lost in a dropout."""
        return bool(self._was_lost.all())

    def _delay(self, sensor: Sensor) -> int:
        return round(sensor.latency * self._rate)

    def exchange(self, output: int, sensor: Sensor, drawn: int) -> None:
        """Measure an output by another sensor.

        Of another latency, older values than the next one are not known; the next one is taken.

        Args:
            output: Its number.
            sensor: The other one.
            drawn: Place of the next sample in the blocks of random numbers.
        """
        former, degrees = self._sensors[output], sensor.noise_degrees
        if degrees != former.noise_degrees:
            self._tails[output] = None
            if degrees:
                key = (degrees,) if output == 0 else (degrees, output)
                stream = RandomStream(self._seeds, Source.TAIL, key)
                tail = np.empty((len(self._seeds), self._block, degrees))
                stream.fill(tail[:, drawn:])
                self._tails[output] = stream, tail
        if self._delay(sensor) != self._delay(former):
            self._past[output] = None
        self._sensors[output] = sensor

    def disturb(self, output: int, components: Sequence[Signal], index: int, drawn: int) -> None:
        """Exchange the disturbance of an output; see `Channels.exchange`."""
        self._was_stuck[output] = False
        self.channels.exchange(output, components, index, drawn)

    def draw(self) -> None:
        """Draw the next random numbers."""
        for stream, block in (*self._streams, *filter(None, self._tails)):
            stream.fill(block)
        self.channels.draw()

    def measure(self, span: Span, series: Series, chosen: Flags) -> None:
        """Measure outputs of every run at the next samples.

        Args:
            span: The samples, at least one.
            series: With the truths; disturbances and measurements are written.
            chosen: Which outputs, shape (p,).
        """
        with np.errstate(all="ignore"):
            for output in np.flatnonzero(chosen).tolist():
                truths, disturbances = span.of(series.truths), span.of(series.disturbances)
                span.of(series.measurements)[..., output] = self._measured(
                    output, span, truths[..., output], disturbances[..., output]
                )

    def _measured(self, output: int, span: Span, truth: Array, disturbance: Array) -> Array:
        """Return what a sensor measures, and complete its disturbance; all (runs, samples)."""
        sensor, times = self._sensors[output], span.times(self._rate)
        self.channels.add_drifts(disturbance, output, span)
        is_loud = is_within(times, sensor.burst_interval, sensor.burst_duration)
        loudness = sensor.noise_std * np.where(is_loud, sensor.burst_factor, 1.0)
        values = self._late(output, truth) + disturbance + loudness * self._noise_of(output, span)
        stuck = self.channels.stuck(output, span)
        if stuck.any():
            values = self._freeze(output, values, stuck)
            disturbance[:, stuck] = (values - truth)[:, stuck]
        self._was_stuck[output] = stuck[-1]
        if sensor.outlier_probability > 0.0:
            values += outliers(span.drawn_for(self._luck[output]), sensor)
        if sensor.resolution > 0.0:
            rounded = sensor.resolution * np.floor(values / sensor.resolution + 0.5)
            values = np.where(np.isfinite(values), rounded, values)
        lost = is_within(times, sensor.dropout_interval, sensor.dropout_duration)
        self._was_lost[output] = lost[-1]
        if sensor.loss_probability > 0.0:  # by the numbers that make outliers, from the other end
            lost = lost | (span.drawn_for(self._luck[output]) >= 1.0 - sensor.loss_probability)
        return np.where(lost, np.nan, values)

    def _late(self, output: int, truth: Array) -> Array:
        """Return the true values that are measured, as old as the latency."""
        past = self._past[output]
        if past is None:
            past = np.repeat(truth[:, :1], self._delay(self._sensors[output]), axis=1)
        known = np.concatenate([past, truth], axis=1)
        self._past[output] = known[:, truth.shape[1] :]
        return known[:, : truth.shape[1]]

    def _noise_of(self, output: int, span: Span) -> Array:
        """Return the noise in units of its 1σ."""
        sensor, last, tail = self._sensors[output], self._last[output], self._tails[output]
        noise = span.drawn_for(self._noise[output]).copy()
        if tail is not None:
            others, total = span.drawn_for(tail[1]), np.zeros_like(noise)
            for place in range(sensor.noise_degrees):
                total += others[..., place] * others[..., place]
            noise /= np.sqrt(total / sensor.noise_degrees)
        if sensor.noise_time_constant > 0.0:
            decay, strength = markov_step(1.0 / self._rate, sensor.noise_time_constant)
            first = 0
            if span.start == 0:  # the first one is stationary already
                first, last[:] = 1, noise[:, 0]
            moving = noise[:, first:].copy()
            native.gauss_markov(decay, strength, last, moving)
            noise[:, first:] = moving
        else:
            last[:] = noise[:, -1]
        return noise

    def _freeze(self, output: int, values: Array, stuck: Flags) -> Array:
        """Return values that stay as they were where the sensor began to be stuck."""
        before = np.concatenate([self._was_stuck[output : output + 1], stuck[:-1]])
        began = np.where(stuck & ~before, np.arange(len(stuck)), -1)
        began = np.maximum.accumulate(began)
        held = np.where(began >= 0, values[:, began], self._frozen[output][:, np.newaxis])
        self._frozen[output] = held[:, -1]
        return np.where(stuck, held, values)


def is_within(times: Array, interval: float, duration: float) -> Flags:
    """Return whether times [s] lie in a dropout or a burst, the first after one interval."""
    if not interval > 0.0:
        return np.zeros(len(times), np.bool_)
    return recurs(times - interval, duration, interval)


def outliers(luck: Array, sensor: Sensor) -> Array:
    """Return what outliers add [rad], 0 if there is none, by numbers drawn from [0, 1)."""
    probability, size = sensor.outlier_probability, sensor.outlier_size
    if sensor.outlier_is_uniform:
        sizes = size * (2.0 * luck / probability - 1.0)
    else:
        sizes = np.where(luck < 0.5 * probability, -size, size)
    return np.where(luck < probability, sizes, 0.0)
