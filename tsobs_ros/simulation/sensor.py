# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sensors and disturbances of simulated plants, which can be exchanged while a plant runs."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any

import numpy as np

from tsobs_ros.checks import Array, Flags, non_negative
from tsobs_ros.core.functions import evaluate
from tsobs_ros.model.arm import QUANTITIES
from tsobs_ros.schema import decode
from tsobs_ros.settings import live_setting
from tsobs_ros.simulation.signals import GaussMarkov, Numbers, Signal, StuckSensor, recurs, seconds
from tsobs_ros.simulation.streams import Past, RandomStream, Source


@dataclass(frozen=True)
class Sensor(Numbers, kind="sensor"):
    """Numbers of a sensor; the default noise is Example 3's 5 % of the largest angle.

    Units are those of an angle; a sensor of another output has that output's unit in place of rad.
    Dropouts and bursts begin after one interval. The latency does not delay a disturbance.
    """

    noise_std: float = 0.028  # of a sample [rad]; not a setting, because designs have it
    outlier_probability: float = live_setting(
        0.0, "Probability that a sample is an outlier", minimum=0.0, maximum=1.0
    )
    outlier_size: float = live_setting(1.0, "What an outlier adds, with either sign", unit="rad")
    dropout_interval: float = seconds(0.0, "Time between the beginnings of dropouts; 0: none")
    dropout_duration: float = seconds(0.5, "Length of a dropout")
    outlier_is_uniform: bool = live_setting(False, "Outliers of any size up to this one")
    noise_time_constant: float = seconds(0.0, "Time constant of the noise's correlation; 0: white")
    noise_degrees: int = live_setting(
        0,
        "Degrees of freedom of Student's t, times the standard deviation; 0: normal",
        minimum=0,
        maximum=1000,
    )
    burst_interval: float = seconds(0.0, "Time between the beginnings of louder noise; 0: none")
    burst_duration: float = seconds(1.5, "Length of a burst")
    burst_factor: float = live_setting(4.0, "What multiplies the noise in a burst", minimum=0.0)
    latency: float = live_setting(
        0.0, "Age of the measured value, in whole samples", unit="s", minimum=0.0, maximum=1.0
    )
    resolution: float = live_setting(
        0.0, "Step of the measured value; 0: none", unit="rad", minimum=0.0
    )
    loss_probability: float = live_setting(
        0.0, "Probability that a sample is lost", minimum=0.0, maximum=1.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        non_negative("sensor noise_std", self.noise_std)


def sensor_numbers(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return some numbers of a sensor, given as plain data.

    Raises:
        DesignFileError: A name is unknown, or a value is not a number.
        ModelError: A number is out of range.
    """
    sensor = decode(entry, Sensor)
    return {name: getattr(sensor, name) for name in entry}


@dataclass(frozen=True)
class SimulatedOutput:
    """A measured output of a plant.

    Attributes:
        measures: The quantity: link_angle, link_velocity, motor_angle or motor_velocity (rad,
            rad/s), or the name of a T–S system's output.
        sensor: Its noise, outliers and dropouts.
        disturbance: Components of its disturbance, added up.
        delay: Delay of an arm's angle that designs model [s], unlike `Sensor.latency`. It is not
            rounded to samples, because the true motion is interpolated.
    """

    measures: str = QUANTITIES[0]
    sensor: Sensor = field(default_factory=Sensor)
    disturbance: tuple[Signal, ...] = ()
    delay: float = 0.0

    def __post_init__(self) -> None:
        non_negative("delay", self.delay)


class Disturbance:
    """The disturbance of the output or torque of a given number, in every run of a batch.

    `exchange` sets its signals, also the first ones.
    """

    def __init__(self, seeds: Sequence[int], rate: float, source: Source, number: int) -> None:
        self._seeds, self._rate, self._source, self._number = seeds, rate, source, number
        self._signals: tuple[Signal, ...] | None = None
        self._generation = 0

    def exchange(self, signals: Sequence[Signal], index: int) -> None:
        """Set other signals, whose time counts from a sample on; equal signals change nothing."""
        if self._signals == tuple(signals):
            return
        self._signals, self._begin = tuple(signals), index
        # The value at which the sensor is stuck.
        self.frozen: Array | None = None
        # The stream and the present values of every drift.
        self._drifts = []
        for place, each in enumerate(signals):
            if isinstance(each, GaussMarkov):
                key = self._generation, place, self._number
                stream = RandomStream(self._seeds, self._source, *key)
                self._drifts.append((each, stream, np.zeros(len(self._seeds))))
        self._generation += 1

    def values(self, start: int, samples: int) -> Array:
        """Move on over samples and return their values, shape (runs, samples)."""
        times, values = self._times(start, samples), np.zeros((len(self._seeds), samples))
        for each in self._signals or ():
            values += each.values(times)
        for drift, stream, now in self._drifts:
            # A drift leaves zero one sample after its start.
            moves = self._times(start - 1, samples) >= max(0.0, drift.start)
            numbers, period = stream.take(samples)[:, moves], 1.0 / self._rate
            values[:, moves] += _moved(now, numbers, period, drift.time_constant, drift.std)
        return values

    def stuck(self, start: int, samples: int) -> Flags:
        """Return for each sample whether a signal holds the measured value, shape (samples,)."""
        times = self._times(start, samples)
        holds = [each.holds(times) for each in self._signals or () if isinstance(each, StuckSensor)]
        return np.asarray(np.any([np.zeros(samples, np.bool_), *holds], axis=0))

    def _times(self, start: int, samples: int) -> Array:
        first = start - self._begin
        return np.arange(first, first + samples) / self._rate


class Output:
    """The output of a given number, in every run of a batch; `exchange` sets its properties."""

    def __init__(self, seeds: Sequence[int], rate: float, number: int) -> None:
        self._disturbance = Disturbance(seeds, rate, Source.DISTURBANCE, number)
        self._seeds, self._rate, self._number = seeds, rate, number
        self._sensor, self._past = Sensor(), Past(0)
        self._normal = RandomStream(seeds, Source.MEASUREMENT, number)
        self._uniform = RandomStream(seeds, Source.OUTLIER, number, uniform=True)
        self._last = np.zeros(len(seeds))

    def exchange(self, asked: SimulatedOutput, index: int) -> None:
        """Set another sensor and disturbance; see `Disturbance.exchange`.

        With another latency, values before the next one are unknown; the next one stands for them.
        """
        sensor = asked.sensor
        degrees, latency = sensor.noise_degrees, round(sensor.latency * self._rate)
        if degrees != self._sensor.noise_degrees:
            # For Student's t, with as many numbers per sample as degrees of freedom.
            self._tail = RandomStream(self._seeds, Source.TAIL, degrees, self._number)
        if latency != self._past.length:
            self._past = Past(latency)
        self._sensor = sensor
        self._disturbance.exchange(asked.disturbance, index)

    def measure(self, start: int, truth: Array) -> tuple[Array, Array]:
        """Return the disturbance of the measurements, and the measurements, NaN if lost.

        The true values are those of the samples from an index on, shape (runs, samples).
        """
        sensor, samples = self._sensor, truth.shape[1]
        times = np.arange(start, start + samples) / self._rate
        added = self._disturbance.values(start, samples)
        is_loud = _is_within(times, sensor.burst_interval, sensor.burst_duration)
        loudness = sensor.noise_std * np.where(is_loud, sensor.burst_factor, 1.0)
        late = self._past.joined(truth)[:, :samples]
        values = late + added + loudness * self._noise(start, samples)
        stuck, frozen = self._disturbance.stuck(start, samples), self._disturbance.frozen
        for k in np.flatnonzero(stuck).tolist():
            if frozen is None or (k and not stuck[k - 1]):
                frozen = values[:, k].copy()
            values[:, k] = frozen
        added[:, stuck] = (values - truth)[:, stuck]
        self._disturbance.frozen = frozen if stuck[-1] else None
        luck = self._uniform.take(samples)
        if (probability := sensor.outlier_probability) > 0.0:
            sizes = np.where(luck < 0.5 * probability, -1.0, 1.0)
            if sensor.outlier_is_uniform:
                sizes = 2.0 * luck / probability - 1.0
            values += np.where(luck < probability, sensor.outlier_size * sizes, 0.0)
        if sensor.resolution > 0.0:
            rounded = sensor.resolution * np.floor(values / sensor.resolution + 0.5)
            values = np.where(np.isfinite(values), rounded, values)
        lost = _is_within(times, sensor.dropout_interval, sensor.dropout_duration)
        if sensor.loss_probability > 0.0:  # by the outliers' random numbers, from their upper end
            lost = lost | (luck >= 1.0 - sensor.loss_probability)
        return added, np.where(lost, np.nan, values)

    def _noise(self, start: int, samples: int) -> Array:
        """Return the noise in units of its 1σ."""
        sensor, last, noise = self._sensor, self._last, self._normal.take(samples)
        if sensor.noise_degrees:
            total = np.zeros_like(noise)
            for others in np.moveaxis(self._tail.take(samples, sensor.noise_degrees), -1, 0):
                total += others * others
            noise /= np.sqrt(total / sensor.noise_degrees)
        if sensor.noise_time_constant > 0.0:
            first, period = 0, 1.0 / self._rate
            if start == 0:  # the first value is stationary already
                first, last[:] = 1, noise[:, 0]
            noise[:, first:] = _moved(last, noise[:, first:], period, sensor.noise_time_constant)
        else:
            last[:] = noise[:, -1]
        return noise


def _is_within(times: Array, interval: float, duration: float) -> Flags:
    """Return whether times [s] lie in a dropout or a burst, the first after one interval."""
    if not interval > 0.0:
        return np.zeros(len(times), np.bool_)
    return recurs(times - interval, duration, interval)


def _moved(now: Array, numbers: Array, period: float, time: float, std: float = 1.0) -> Array:
    """Return Gauss–Markov processes after each period [s]; `now` becomes their last values."""
    decay = evaluate("exponential", -period / time).item()
    strength, values = math.sqrt(1.0 - decay * decay) * std, np.empty_like(numbers)
    for run, own in enumerate(numbers.tolist()):
        first = now[run].item()
        moved = [*accumulate(own, lambda x, w: decay * x + strength * w, initial=first)]
        values[run], now[run] = moved[1:], moved[-1]
    return values
