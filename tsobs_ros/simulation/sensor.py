# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The sensors of a simulated plant, one for each output."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array, Flags, check_each, non_negative
from tsobs_ros.compiled import compiled, compiled_nogil
from tsobs_ros.errors import ModelError
from tsobs_ros.model.stepping import record_type
from tsobs_ros.simulation.channels import Channels, Sums, add_drifts, without_drifts
from tsobs_ros.simulation.series import Series, Span
from tsobs_ros.simulation.signals import Component, markov_step, recurs
from tsobs_ros.simulation.streams import RandomStream, Source

_SENSOR = record_type(
    [
        ("noise_std", np.float64),
        ("outlier_probability", np.float64),
        ("outlier_size", np.float64),
        ("dropout_interval", np.float64),
        ("dropout_duration", np.float64),
        ("outlier_is_uniform", np.bool_),
        ("noise_time_constant", np.float64),
        ("noise_degrees", np.int64),
        ("burst_interval", np.float64),
        ("burst_duration", np.float64),
        ("burst_factor", np.float64),
        ("latency", np.float64),
        ("resolution", np.float64),
        ("places", np.int64),
        ("fresh", np.int64),
        ("lost", np.bool_),
    ]
)
_SEEN = record_type([("noise", np.float64), ("frozen", np.float64), ("stuck", np.bool_)])


class _Numbers(NamedTuple):
    """What compiled code takes of all sensors.

    Attributes:
        sensors: Their numbers, shape (p,).
        seen: What they remember of each run, shape (p, runs).
        noise: Normal numbers, shape (p, runs, block).
        luck: Uniform numbers of the outliers, shape (p, runs, block).
        tail: Normal numbers of Student's t; rows have room for the sensor with the most.
        past: Last true values; rows have room for the sensor with the most.
    """

    sensors: Any
    seen: Any
    noise: Array
    luck: Array
    tail: Array
    past: Array


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

    def __post_init__(self) -> None:
        names = [item.name for item in fields(self)]
        check_each(non_negative, self, *(name for name in names if "outlier" not in name))
        if not 0.0 <= self.outlier_probability <= 1.0:
            raise ModelError(
                f"outlier_probability: expected 0 to 1, got {self.outlier_probability!r}"
            )
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
        self.channels = Channels(seeds, Source.DISTURBANCE, count, block)
        self._numbers = numbers = _Numbers(
            np.zeros(count, _SENSOR),
            np.zeros((count, runs), _SEEN),
            *np.empty((2, count, runs, block)),
            *np.empty((2, count, runs, 0)),
        )
        self._streams = []
        for output in range(count):
            key = () if output == 0 else (output,)
            normal = RandomStream(seeds, Source.MEASUREMENT, key)
            uniform = RandomStream(seeds, Source.OUTLIER, key, uniform=True)
            self._streams += [(normal, numbers.noise[output]), (uniform, numbers.luck[output])]
        self._tails: list[RandomStream | None] = [None] * count

    @property
    def lost(self) -> bool:
        """Whether the last sample of every output was lost in a dropout."""
        return bool(self._numbers.sensors["lost"].all())

    def exchange(self, output: int, sensor: Sensor, drawn: int) -> None:
        """Measure an output by another sensor.

        Of another latency, older values than the next one are not known; the next one is taken.

        Args:
            output: Its number.
            sensor: The other one.
            drawn: Place of the next sample in the blocks of random numbers.
        """
        record = self._numbers.sensors[output]
        degrees, places = sensor.noise_degrees, 1 + round(sensor.latency * self._rate)
        if degrees != record["noise_degrees"]:
            tail = _with_room(self._numbers.tail, degrees * self._block)
            stream = None
            if degrees:
                key = (degrees,) if output == 0 else (degrees, output)
                stream = RandomStream(self._seeds, Source.TAIL, key)
                stream.fill(tail[output][:, drawn * degrees : self._block * degrees])
            self._numbers, self._tails[output] = self._numbers._replace(tail=tail), stream
        if places != record["places"]:
            past = _with_room(self._numbers.past, places)
            self._numbers = self._numbers._replace(past=past)
            record["places"], record["fresh"] = places, 1
        for item in fields(sensor):
            record[item.name] = getattr(sensor, item.name)

    def disturb(self, output: int, components: Sequence[Component], index: int, drawn: int) -> None:
        """Exchange the disturbance of an output; see `Channels.exchange`."""
        self._numbers.seen["stuck"][output] = False
        self.channels.exchange(output, components, index, drawn)

    def draw(self) -> None:
        """Draw the next random numbers."""
        for stream, block in self._streams:
            stream.fill(block)
        for output, tail in enumerate(self._tails):
            if tail is not None:
                size = self._block * int(self._numbers.sensors["noise_degrees"][output])
                tail.fill(self._numbers.tail[output][:, :size])
        self.channels.draw()

    def measure(self, span: Span, series: Series, chosen: Flags) -> None:
        """Measure outputs of every run at the next samples.

        Args:
            span: The samples.
            series: With the truths; disturbances and measurements are written.
            chosen: Which outputs, shape (p,).
        """
        _measure(self._numbers, self.channels.sums, self._rate, span, series, chosen)


def _with_room(numbers: Array, size: int) -> Array:
    """Return numbers with rows of at least a size, the former ones first."""
    missing = size - numbers.shape[-1]
    return np.pad(numbers, [(0, 0), (0, 0), (0, missing)]) if missing > 0 else numbers


@compiled_nogil
def _measure(
    all_numbers: _Numbers, sums: Sums, rate: float, span: Span, series: Series, chosen: Flags
) -> None:
    """Measure each chosen output of every run, sample by sample; see `Sensors`."""
    sensors, seen, noise, luck, tail, past = all_numbers
    truths, disturbances = series.truths, series.disturbances
    present = np.empty(truths.shape[0])
    for output in range(sensors.shape[0]):
        if span.samples == 0 or not chosen[output]:
            continue
        numbers = sensors[output]
        places, degrees = int(numbers.places), int(numbers.noise_degrees)
        is_correlated, decay, strength = numbers.noise_time_constant > 0.0, 0.0, 1.0
        if is_correlated:
            decay, strength = markov_step(1.0 / rate, float(numbers.noise_time_constant))
        if numbers.fresh:
            numbers.fresh = 0
            for run in range(truths.shape[0]):
                past[output, run, :places] = truths[run, span.place, output]
        for step in range(span.samples):
            draw, place, index = span.drawn + step, span.place + step, span.start + step
            time = index / rate
            lost = is_within(time, numbers.dropout_interval, numbers.dropout_duration)
            loud = is_within(time, numbers.burst_interval, numbers.burst_duration)
            loudness = float(numbers.burst_factor) if loud else 1.0
            added, stuck = without_drifts(sums, output, index, rate)
            numbers.lost = lost
            for run in range(truths.shape[0]):
                present[run] = disturbances[run, place, output] + added
            add_drifts(present, sums, output, index, rate, draw)
            for run in range(truths.shape[0]):
                truth = float(truths[run, place, output])
                disturbance = float(present[run])
                memory = seen[output, run]
                number = float(noise[output, run, draw])
                if degrees > 0:
                    others = tail[output, run, draw * degrees : (draw + 1) * degrees]
                    number = student(number, others)
                if is_correlated and index > 0:
                    number = decay * float(memory.noise) + strength * number
                memory.noise = number
                past[output, run, index % places] = truth
                old = float(past[output, run, (index + 1) % places])
                measured = old + disturbance + float(numbers.noise_std) * loudness * number
                if stuck:
                    if not memory.stuck:
                        memory.frozen = measured
                    measured = float(memory.frozen)
                    disturbance = measured - truth
                memory.stuck = stuck
                if numbers.outlier_probability > 0.0:
                    measured += outlier(
                        luck[output, run, draw],
                        numbers.outlier_probability,
                        float(numbers.outlier_size),
                        numbers.outlier_is_uniform,
                    )
                resolution = float(numbers.resolution)
                if resolution > 0.0 and math.isfinite(measured):
                    measured = resolution * math.floor(measured / resolution + 0.5)
                disturbances[run, place, output] = disturbance
                series.measurements[run, place, output] = math.nan if lost else measured


@compiled
def is_within(time: float, interval: float, duration: float) -> bool:
    """Return whether a time [s] lies in a dropout or a burst, the first after one interval."""
    return interval > 0.0 and recurs(time - interval, duration, interval)


@compiled
def outlier(luck: float, probability: float, size: float, is_uniform: bool) -> float:
    """Return what an outlier adds [rad], 0 if it is none, by a number drawn from [0, 1)."""
    if not luck < probability:
        return 0.0
    if is_uniform:
        return size * (2.0 * luck / probability - 1.0)
    return -size if luck < 0.5 * probability else size


@compiled
def student(number: float, others: Array) -> float:
    """Return a number of Student's t from a normal one and as many as its degrees of freedom."""
    total = 0.0
    for i in range(others.shape[0]):
        total += float(others[i]) * float(others[i])
    return number / math.sqrt(total / others.shape[0])
