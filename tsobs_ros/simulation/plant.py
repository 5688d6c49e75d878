# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulated plant: a pure, deterministic machine that is stepped by sample index.

Sample k belongs to the time k/rate. A step measures at that time, then moves the arm on to the
next sample with the torque held. No clock is read: the same scenario, seed and torques give the
same numbers, to the bit, for one arm and for a batch, sample by sample and many at a time.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, non_negative, positive
from tsobs_ros.compiled import compiled_nogil
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.model.stepping import record_type
from tsobs_ros.simulation.integrator import ArmIntegrator, Friction, advance_arm
from tsobs_ros.simulation.sensor import Sensor, correlated, is_within, outlier, student
from tsobs_ros.simulation.signals import (
    GAUSS_MARKOV,
    ROW,
    Component,
    Excitation,
    Sine,
    component_row,
    disturbance_at,
    drifted,
    excitation_row,
    is_stuck,
    torque_at,
)
from tsobs_ros.simulation.streams import RandomStream, Seeds, Source, checked_seeds

_BLOCK = 256
"""Samples drawn at a time, fewer of many runs."""

_LARGEST_BLOCK = 2**16
"""Samples of all runs drawn at a time, so that the memory stays bounded."""

_PLANT = record_type(
    [
        ("rate", np.float64),
        ("injected", np.int64),
        ("excitation", np.float64, (ROW,)),
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
        ("link_kick", np.float64),
        ("motor_kick", np.float64),
        ("lost", np.bool_),
    ]
)
_RUN = record_type(
    [
        ("physical", np.float64, (4,)),
        ("noise", np.float64),
        ("frozen", np.float64),
        ("stuck", np.bool_),
    ],
)


@dataclass(frozen=True)
class Mismatch:
    """Relative changes that turn the nominal arm into the true one: +0.2 means 20 % more."""

    link_inertia: float = 0.0
    motor_inertia: float = 0.0
    stiffness: float = 0.0
    gravity_torque: float = 0.0
    link_damping: float = 0.0
    motor_damping: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            change = getattr(self, item.name)
            if not (math.isfinite(change) and change > -1.0):
                raise ModelError(
                    f"mismatch {item.name}: expected a finite number above -1, got {change!r}"
                )

    def apply(self, nominal: ElasticJointArm) -> ElasticJointArm:
        """Return the true arm."""
        return ElasticJointArm(
            **{
                item.name: getattr(nominal, item.name) * (1.0 + getattr(self, item.name))
                for item in fields(self)
            }
        )


@dataclass(frozen=True)
class Scenario:
    """How a plant is built, moved, disturbed and measured.

    Attributes:
        arm: The nominal arm, the one an estimator knows.
        mismatch: How the true arm differs from it.
        friction: What the true arm has besides.
        rate: Samples a second [Hz].
        duration: How long a campaign simulates [s].
        initial_state: Mean of x(0) in the nominal arm's design coordinates.
        initial_spread: 1σ of x(0) in the same coordinates.
        process_noise: Densities of the random accelerations.
        excitation: Torque in the absence of a command.
        disturbance: Components of the sensor's disturbance, added up.
        sensor: Noise, outliers and dropouts.
        torque_error: What the reported torque has beyond the applied one, as signals of
            `signals` in N m, added up; of a drift its mean.

    Raises:
        ModelError: A number is not finite, of the wrong sign, or a state has not four entries.
    """

    arm: ElasticJointArm = field(default_factory=ElasticJointArm)
    mismatch: Mismatch = field(default_factory=Mismatch)
    friction: Friction = field(default_factory=Friction)
    rate: float = 200.0
    duration: float = 60.0
    initial_state: tuple[float, ...] = (0.3, 0.0, 2.0, 0.0)
    initial_spread: tuple[float, ...] = (0.05, 0.1, 0.5, 0.5)
    process_noise: ProcessNoise = field(default_factory=ProcessNoise)
    excitation: Excitation = field(default_factory=Sine)
    disturbance: tuple[Component, ...] = ()
    sensor: Sensor = field(default_factory=Sensor)
    torque_error: tuple[Component, ...] = ()

    def __post_init__(self) -> None:
        positive("rate", self.rate)
        non_negative("duration", self.duration)
        for name in ("initial_state", "initial_spread"):
            values = getattr(self, name)
            if len(values) != 4 or not all(math.isfinite(value) for value in values):
                raise ModelError(f"{name}: expected four finite numbers, got {values!r}")

    @property
    def true_arm(self) -> ElasticJointArm:
        """The arm that really moves."""
        return self.mismatch.apply(self.arm)

    @property
    def sample_count(self) -> int:
        """Samples in `duration`: those at 0, 1/rate, … up to and including the end."""
        return math.floor(self.duration * self.rate + 1e-9) + 1


@dataclass(frozen=True, slots=True)
class Sample:
    """What is true and what is measured at one sampling time; (...) is () or (runs,).

    Attributes:
        index: k, from 0.
        time: k/rate, since the start [s].
        state: True state in the nominal arm's design coordinates, shape (..., 4).
        physical: True [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (..., 4).
        disturbance: What the measurement has beyond q₁, its latency, noise and outliers [rad],
            shape (..., 1). Of a stuck sensor it is the frozen value minus q₁.
        measurement: y [rad], shape (..., 1); NaN if the sample was lost.
        torque: Torque reported from this time to the next sample [N m], shape (..., 1): the one
            applied, and its error.
        lost: Whether the sample was lost in a dropout.
    """

    index: int
    time: float
    state: Array
    physical: Array
    disturbance: Array
    measurement: Array
    torque: Array
    lost: bool


class Trajectories(NamedTuple):
    """A batch of runs; without the first axis a single one.

    Attributes:
        times: [s], shape (samples,).
        states: True states in the nominal arm's design coordinates, shape (runs, samples, 4).
        disturbances: True disturbances [rad], shape (runs, samples, 1).
        measurements: y [rad], NaN if lost, shape (runs, samples, 1).
        torques: Torque reported from each sample to the next [N m]: the one applied, and its
            error, shape (runs, samples, 1).
        physical: True [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (runs, samples, 4).
    """

    times: Array
    states: Array
    disturbances: Array
    measurements: Array
    torques: Array
    physical: Array


class Plant:
    """An elastic-joint arm with its excitation, its sensor and everything random about them.

    Args:
        scenario: How it is built, moved, disturbed and measured.
        seeds: One seed for a single arm, or a sequence of seeds for a batch of runs. A run of a
            batch is the same as the single arm with its seed.

    Raises:
        ModelError: A seed is not an integer of at least zero.
    """

    def __init__(self, scenario: Scenario, seeds: Seeds = 0) -> None:
        self._seeds = checked_seeds(seeds)
        self._is_batch = not isinstance(seeds, int | np.integer)
        self.scenario = scenario
        self._integrator = ArmIntegrator(scenario.true_arm, 1.0 / scenario.rate, scenario.friction)
        self.reset()

    def reset(self) -> None:
        """Start again, exactly as a new plant of the same scenario and seeds."""
        scenario, runs = self.scenario, len(self._seeds)
        spread = np.empty((runs, 4))
        RandomStream(self._seeds, Source.INITIAL_STATE).fill(spread)
        start = np.array(scenario.initial_state) + spread * np.array(scenario.initial_spread)
        self._runs = np.zeros(runs, _RUN)
        self._runs["physical"] = scenario.arm.to_physical(start)
        self._index = 0
        self._plant = np.zeros(1, _PLANT)
        numbers, noise, substep = self._plant[0], scenario.process_noise, self._integrator.substep
        numbers.rate = scenario.rate
        numbers.link_kick = math.sqrt(noise.link * substep)
        numbers.motor_kick = math.sqrt(noise.motor * substep)
        self._block = min(_BLOCK, max(1, _LARGEST_BLOCK // runs))
        self._drawn = self._block
        self._tail = np.empty((runs, self._block, 0))
        self._tail_streams: list[tuple[RandomStream, Array]] = []
        self._past = np.empty((runs, 0))
        kicks = 2 * self._integrator.substeps if noise.link or noise.motor else 0
        self._kicks = np.empty((runs, self._block, kicks))
        self._noise = np.empty((runs, self._block))
        self._luck = np.empty((runs, self._block))
        self._streams: list[tuple[RandomStream, Array]] = [
            (RandomStream(self._seeds, Source.MEASUREMENT), self._noise),
            (RandomStream(self._seeds, Source.OUTLIER, uniform=True), self._luck),
        ]
        if kicks:
            self._streams.append((RandomStream(self._seeds, Source.PROCESS), self._kicks))
        self.exchange_excitation(scenario.excitation)
        self.exchange_sensor(scenario.sensor)
        self._generation = -1
        self.exchange_disturbance(scenario.disturbance)
        # So that the code is compiled, or loaded, and the first block drawn, before the first step.
        self._advance(0)

    @property
    def index(self) -> int:
        """Index of the sample that the next step returns."""
        return self._index

    @property
    def time(self) -> float:
        """Time of the sample that the next step returns, since the start [s]."""
        return self._index / self.scenario.rate

    def exchange_disturbance(self, components: Sequence[Component]) -> None:
        """Put other components in the place of the present ones, from the next sample on.

        The time of the new components, their `start` included, counts from the next sample.
        """
        self._generation += 1
        self._plant[0].injected = self._index
        self._runs["stuck"] = False
        rows = [component_row(each) for each in components]
        known = [row for row in rows if row is not None]
        self._components = np.array(known).reshape(len(known), ROW)
        self._others = [each for each, row in zip(components, rows, strict=True) if row is None]
        drifts = [
            RandomStream(self._seeds, Source.DISTURBANCE, (self._generation, place))
            for place, row in enumerate(rows)
            if row is not None and row[0] == GAUSS_MARKOV
        ]
        runs = len(self._seeds)
        self._drifts = np.zeros((runs, len(drifts)))
        self._drift_noise = np.empty((len(drifts), runs, self._block))
        self._drift_streams = list(zip(drifts, self._drift_noise, strict=True))
        for stream, block in self._drift_streams:
            stream.fill(block[:, self._drawn :])

    def exchange_excitation(self, excitation: Excitation) -> None:
        """Move the arm otherwise from the next sample on; its time goes on counting."""
        row = excitation_row(excitation)
        self._excitation = excitation if row is None else None
        self._plant[0].excitation[:] = 0.0 if row is None else row

    def exchange_sensor(self, sensor: Sensor) -> None:
        """Measure with other noise, outliers or dropouts from the next sample on."""
        for item in fields(sensor):
            self._plant[0][item.name] = getattr(sensor, item.name)
        runs, degrees = len(self._seeds), sensor.noise_degrees
        if degrees != self._tail.shape[2]:
            self._tail = np.empty((runs, self._block, degrees))
            stream = RandomStream(self._seeds, Source.TAIL, (degrees,))
            stream.fill(self._tail[:, self._drawn :])
            self._tail_streams = [(stream, self._tail)] * (degrees > 0)
        places = 1 + round(sensor.latency * self.scenario.rate)
        if places != self._past.shape[1]:
            self._past = self._runs["physical"][:, :1].repeat(places, axis=1)

    def step(self, torque: ArrayLike | None = None) -> Sample:
        """Measure at the present sample, move on to the next one and return the former.

        Args:
            torque: Torque to apply instead of the excitation [N m]; a number, or (runs, 1).

        Raises:
            ModelError: The torque is not finite or does not fit the batch.
        """
        index, time = self._index, self.time
        if torque is not None:
            torque = self._checked_torque(torque, (len(self._seeds), 1) if self._is_batch else (1,))
        physical, torques, disturbances, measurements = self._advance(1, torque)
        physical = physical[:, 0]
        if not self._is_batch:
            physical, torques = physical[0], torques[0]
            disturbances, measurements = disturbances[0], measurements[0]
        state = self.scenario.arm.from_physical(physical)
        lost = bool(self._plant["lost"][0])
        return Sample(index, time, state, physical, disturbances, measurements, torques, lost)

    def run(self, samples: int, torque: ArrayLike | None = None) -> Trajectories:
        """Step many times and return all samples; other threads of Python can run meanwhile.

        Everything is kept: 88 bytes a run and sample.

        Args:
            samples: Number of steps.
            torque: Torque to apply instead of the excitation [N m]; a number, shape (samples, 1)
                or (runs, samples, 1).

        Raises:
            ModelError: The torque is not finite, or of another shape.
        """
        if torque is not None:
            shapes = [(samples, 1)] + [(len(self._seeds), samples, 1)] * self._is_batch
            given = self._checked_torque(torque, *shapes)
            torque = given[..., 0] if given.ndim else given
        times = np.arange(self._index, self._index + samples) / self.scenario.rate
        physical, *signals = self._advance(samples, torque)
        if not self._is_batch:
            physical, signals = physical[0], [signal[0] for signal in signals]
        torques, disturbances, measurements = (signal[..., np.newaxis] for signal in signals)
        states = self.scenario.arm.from_physical(physical)
        return Trajectories(times, states, disturbances, measurements, torques, physical)

    def _checked_torque(self, torque: ArrayLike, *shapes: tuple[int, ...]) -> Array:
        given = np.asarray(torque, dtype=np.float64)
        if given.shape not in ((), *shapes):
            expected = " or ".join(map(str, shapes))
            raise ModelError(f"torque: expected shape {expected}, got {given.shape}")
        wrong = ~np.isfinite(given)
        if wrong.any():
            place = int(wrong.any(axis=0).argmax()) if given.ndim == 3 else int(wrong.argmax())
            raise ModelError(f"torque of sample {self._index + place}: expected finite numbers")
        return given

    def _advance(
        self, samples: int, torque: ArrayLike | None = None
    ) -> tuple[Array, Array, Array, Array]:
        """Step and return physical states, torques, disturbances and measurements, runs first."""
        shape = (len(self._seeds), samples)
        physical, measurements = np.empty((*shape, 4)), np.empty(shape)
        torques, disturbances = np.empty(shape), np.zeros(shape)
        if torque is not None:
            torques[:] = torque
        elif self._excitation is not None:
            torques[:] = [self._excitation.torque(time) for time in self._times(samples)]
        for other in self._others:
            injected = int(self._plant[0].injected)
            disturbances += [other.value(time) for time in self._times(samples, injected)]
        times = self._times(samples) if self.scenario.torque_error else []
        errors = [[each.value(time) for time in times] for each in self.scenario.torque_error]
        done = 0
        while True:
            if self._drawn == self._block:
                for stream, block in self._streams + self._drift_streams + self._tail_streams:
                    stream.fill(block)
                self._drawn = 0
            part = min(samples - done, self._block - self._drawn)
            _simulate(
                self._plant,
                self._integrator.motion,
                self._components,
                self._runs,
                self._drifts,
                self._kicks,
                self._noise,
                self._tail,
                self._luck,
                self._past,
                self._drift_noise,
                self._index,
                self._drawn,
                part,
                physical,
                torques,
                torque is not None or self._excitation is not None,
                disturbances,
                measurements,
                done,
            )
            self._index += part
            self._drawn += part
            done += part
            if done == samples:
                break
        for error in errors:
            torques += error
        return physical, torques, disturbances, measurements

    def _times(self, samples: int, since: int = 0) -> list[float]:
        first, rate = self._index - since, self.scenario.rate
        return [place / rate for place in range(first, first + samples)]


@compiled_nogil
def _simulate(
    plant: Any,
    motion: Any,
    components: Array,
    runs: Any,
    drifts: Array,
    kicks: Array,
    noise: Array,
    tail: Array,
    luck: Array,
    past: Array,
    drift_noise: Array,
    index: int,
    drawn: int,
    samples: int,
    physical: Array,
    torques: Array,
    are_given: bool,
    disturbances: Array,
    measurements: Array,
    first: int,
) -> None:
    """Measure and move every run, sample by sample.

    Args:
        plant: One record of what all runs share; whether the last sample is lost is written.
        motion: One record of the arm that moves.
        components: Rows of the disturbance, shape (rows, ROW).
        runs: A record for each run, which is moved.
        drifts: Present values of the drifts, shape (runs, drifts), which are moved.
        kicks: Normal numbers of the process noise, shape (runs, block, 2 substeps or 0).
        noise: Normal numbers of the sensor, shape (runs, block).
        tail: Further normal numbers, of noise with Student's t, shape (runs, block, degrees).
        luck: Numbers of [0, 1) that decide on outliers, shape (runs, block).
        past: The last angles, in the places of a ring, shape (runs, 1 + samples of latency).
        drift_noise: Normal numbers of the drifts, shape (drifts, runs, block).
        index: Index of the first sample.
        drawn: Its place in the blocks of random numbers.
        samples: Number of samples.
        physical: Physical states to write, shape (runs, all, 4).
        torques: Torques to write, unless they are given, shape (runs, all).
        are_given: Whether they are.
        disturbances: Disturbances to add to, shape (runs, all).
        measurements: To write, shape (runs, all).
        first: Place of the first sample in these four.
    """
    numbers, rate, injected = plant[0], float(plant[0].rate), int(plant[0].injected)
    for step in range(samples):
        draw, place = drawn + step, first + step
        time, since = (index + step) / rate, index + step - injected
        elapsed = since / rate
        lost = is_within(time, numbers.dropout_interval, numbers.dropout_duration)
        loud = is_within(time, numbers.burst_interval, numbers.burst_duration)
        loudness = float(numbers.burst_factor) if loud else 1.0
        added, stuck = disturbance_at(components, elapsed), is_stuck(components, elapsed)
        numbers.lost = lost
        torque = 0.0 if are_given else torque_at(numbers.excitation, time)
        for run in range(runs.shape[0]):
            state = runs[run].physical
            angle = float(state[0])
            disturbance = float(disturbances[run, place]) + added
            drift = 0
            for row in range(components.shape[0]):
                if int(components[row, 0]) == GAUSS_MARKOV:
                    value = 0.0
                    if since > 0 and (since - 1) / rate >= float(components[row, 3]):
                        number = float(drift_noise[drift, run, draw])
                        before = float(drifts[run, drift])
                        value = drifted(components[row], before, number, 1.0 / rate)
                    drifts[run, drift] = value
                    disturbance += value
                    drift += 1
            number = float(noise[run, draw])
            if numbers.noise_degrees > 0:
                number = student(number, tail[run, draw])
            if numbers.noise_time_constant > 0.0 and index + step > 0:
                before = float(runs[run].noise)
                number = correlated(before, number, 1.0 / rate, float(numbers.noise_time_constant))
            runs[run].noise = number
            past[run, (index + step) % past.shape[1]] = angle
            seen = float(past[run, (index + step + 1) % past.shape[1]])
            measured = seen + disturbance + float(numbers.noise_std) * loudness * number
            if stuck:
                if not runs[run].stuck:
                    runs[run].frozen = measured
                measured = float(runs[run].frozen)
                disturbance = measured - angle
            runs[run].stuck = stuck
            if numbers.outlier_probability > 0.0:
                measured += outlier(
                    luck[run, draw],
                    numbers.outlier_probability,
                    float(numbers.outlier_size),
                    numbers.outlier_is_uniform,
                )
            resolution = float(numbers.resolution)
            if resolution > 0.0 and math.isfinite(measured):
                measured = resolution * math.floor(measured / resolution + 0.5)
            for item in range(4):
                physical[run, place, item] = state[item]
            disturbances[run, place] = disturbance
            measurements[run, place] = math.nan if lost else measured
            if are_given:
                torque = float(torques[run, place])
            else:
                torques[run, place] = torque
            advance_arm(
                motion[0],
                state,
                torque,
                kicks[run, draw],
                float(numbers.link_kick),
                float(numbers.motor_kick),
            )
