# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sensors and disturbances of simulated plants, which can be exchanged while a plant runs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from tsobs_ros.checks import Array, Flags, check_each, non_negative
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
from tsobs_ros.simulation.signals import GaussMarkov, Signal, StuckSensor, markov_step, recurs
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


class Disturbance:
    """The disturbance of an output or a torque, in every run of a batch: a sum of signals.

    Args:
        seeds: One for each run.
        source: What the random numbers of drifts are for.
        channel: Number of the output or torque.
        rate: Samples per second [Hz].
        signals: What it is the sum of.
    """

    def __init__(
        self,
        seeds: Sequence[int],
        source: Source,
        channel: int,
        rate: float,
        signals: Sequence[Signal],
    ) -> None:
        self._seeds, self._source, self._rate = seeds, source, rate
        self._key, self._generation = (channel,) if channel else (), 0
        self.exchange(signals, 0)

    def exchange(self, signals: Sequence[Signal], index: int) -> None:
        """Put other signals in the place of the present ones, whose time counts from `index` on."""
        self._signals, self._begin = tuple(signals), index
        # The stream and the present values of every drift.
        self._drifts = []
        for place, each in enumerate(signals):
            if isinstance(each, GaussMarkov):
                key = self._generation, place, *self._key
                stream = RandomStream(self._seeds, self._source, key)
                self._drifts.append((each, stream, np.zeros(len(self._seeds))))
        self._generation += 1

    def values(self, start: int, samples: int) -> Array:
        """Move on over samples and return their values, shape (runs, samples)."""
        times, total = self._times(start, samples), np.zeros(samples)
        for each in self._signals:
            total += each.values(times)
        values = np.zeros((len(self._seeds), samples)) + total
        for drift, stream, now in self._drifts:
            # A drift leaves zero one sample after its start.
            before = self._times(start - 1, samples)
            first = samples - int(np.count_nonzero((before >= 0.0) & (before >= drift.start)))
            numbers = stream.take(samples)[:, first:].copy()
            decay, strength = markov_step(1.0 / self._rate, drift.time_constant)
            native.gauss_markov(decay, strength * drift.std, now, numbers)
            values[:, first:] += numbers
        return values

    def stuck(self, start: int, samples: int) -> Flags:
        """Return at which samples a signal holds the measured value, shape (samples,)."""
        times = self._times(start, samples)
        holds = [each.holds(times) for each in self._signals if isinstance(each, StuckSensor)]
        return np.asarray(np.any([np.zeros(samples, np.bool_), *holds], axis=0))

    def _times(self, start: int, samples: int) -> Array:
        first = start - self._begin
        return np.arange(first, first + samples) / self._rate


class Output:
    """An output with its sensor and its disturbance, in every run of a batch.

    Args:
        seeds: One for each run.
        number: Number of the output.
        rate: Samples per second [Hz].
        sensor: Its sensor.
        signals: Its disturbance.
    """

    def __init__(
        self,
        seeds: Sequence[int],
        number: int,
        rate: float,
        sensor: Sensor,
        signals: Sequence[Signal],
    ) -> None:
        self._disturbance = Disturbance(seeds, Source.DISTURBANCE, number, rate, signals)
        self._seeds, self._rate, self._sensor, self._latency = seeds, rate, Sensor(), 0
        self._key = (number,) if number else ()
        self._normal = RandomStream(seeds, Source.MEASUREMENT, self._key)
        self._uniform = RandomStream(seeds, Source.OUTLIER, self._key, uniform=True)
        # Of Student's t, with as many numbers a sample as its degrees of freedom.
        self._tail: RandomStream | None = None
        # True values of the last samples, as many as the latency has; None if not known.
        self._past: Array | None = None
        self._last, self._frozen = np.zeros((2, len(seeds)))
        self._was_stuck = False
        self.exchange(sensor)

    def exchange(self, sensor: Sensor) -> None:
        """Measure by another sensor.

        Of another latency, older values than the next one are not known; the next one is taken.
        """
        degrees, latency = sensor.noise_degrees, round(sensor.latency * self._rate)
        if degrees != self._sensor.noise_degrees:
            key = (degrees, *self._key)
            self._tail = RandomStream(self._seeds, Source.TAIL, key) if degrees else None
        if latency != self._latency:
            self._past = None
        self._sensor, self._latency = sensor, latency

    def disturb(self, signals: Sequence[Signal], index: int) -> None:
        """Exchange the disturbance; see `Disturbance.exchange`."""
        self._was_stuck = False
        self._disturbance.exchange(signals, index)

    @np.errstate(all="ignore")
    def measure(self, start: int, truth: Array) -> tuple[Array, Array]:
        """Return what the measurement has beyond the truth, and the measurement, NaN if lost.

        Args:
            start: Index of the first sample.
            truth: True values, shape (runs, samples).
        """
        sensor, samples = self._sensor, truth.shape[1]
        times = np.arange(start, start + samples) / self._rate
        added = self._disturbance.values(start, samples)
        is_loud = _is_within(times, sensor.burst_interval, sensor.burst_duration)
        loudness = sensor.noise_std * np.where(is_loud, sensor.burst_factor, 1.0)
        values = self._late(truth) + added + loudness * self._noise(start, samples)
        stuck = self._disturbance.stuck(start, samples)
        if stuck.any():
            values = self._freeze(values, stuck)
            added[:, stuck] = (values - truth)[:, stuck]
        self._was_stuck = bool(stuck[-1])
        luck = self._uniform.take(samples)
        if sensor.outlier_probability > 0.0:
            values += _outliers(luck, sensor)
        if sensor.resolution > 0.0:
            rounded = sensor.resolution * np.floor(values / sensor.resolution + 0.5)
            values = np.where(np.isfinite(values), rounded, values)
        lost = _is_within(times, sensor.dropout_interval, sensor.dropout_duration)
        if sensor.loss_probability > 0.0:  # by the numbers that make outliers, from the other end
            lost = lost | (luck >= 1.0 - sensor.loss_probability)
        return added, np.where(lost, np.nan, values)

    def _late(self, truth: Array) -> Array:
        """Return the true values that are measured, as old as the latency."""
        if self._past is None:
            self._past = np.repeat(truth[:, :1], self._latency, axis=1)
        known = np.concatenate([self._past, truth], axis=1)
        self._past = known[:, truth.shape[1] :]
        return known[:, : truth.shape[1]]

    def _noise(self, start: int, samples: int) -> Array:
        """Return the noise in units of its 1σ."""
        sensor, last, noise = self._sensor, self._last, self._normal.take(samples)
        if self._tail is not None:
            total = np.zeros_like(noise)
            for others in np.moveaxis(self._tail.take(samples, sensor.noise_degrees), -1, 0):
                total += others * others
            noise /= np.sqrt(total / sensor.noise_degrees)
        if sensor.noise_time_constant > 0.0:
            decay, strength = markov_step(1.0 / self._rate, sensor.noise_time_constant)
            first = 0
            if start == 0:  # the first one is stationary already
                first, last[:] = 1, noise[:, 0]
            moving = noise[:, first:].copy()
            native.gauss_markov(decay, strength, last, moving)
            noise[:, first:] = moving
        else:
            last[:] = noise[:, -1]
        return noise

    def _freeze(self, values: Array, stuck: Flags) -> Array:
        """Return values that stay as they were where the sensor began to be stuck."""
        before = np.concatenate([[self._was_stuck], stuck[:-1]])
        began = np.maximum.accumulate(np.where(stuck & ~before, np.arange(len(stuck)), -1))
        held = np.where(began >= 0, values[:, began], self._frozen[:, np.newaxis])
        self._frozen = held[:, -1]
        return np.where(stuck, held, values)


def _is_within(times: Array, interval: float, duration: float) -> Flags:
    """Return whether times [s] lie in a dropout or a burst, the first after one interval."""
    if not interval > 0.0:
        return np.zeros(len(times), np.bool_)
    return recurs(times - interval, duration, interval)


def _outliers(luck: Array, sensor: Sensor) -> Array:
    """Return what outliers add [rad], 0 if there is none, by numbers drawn from [0, 1)."""
    probability, size = sensor.outlier_probability, sensor.outlier_size
    if sensor.outlier_is_uniform:
        sizes = size * (2.0 * luck / probability - 1.0)
    else:
        sizes = np.where(luck < 0.5 * probability, -size, size)
    return np.where(luck < probability, sizes, 0.0)
