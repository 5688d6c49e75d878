# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulated plant: a pure, deterministic machine that is stepped by sample index.

Sample k belongs to the time k/rate. A step measures at that time, then moves the plant on to the
next sample with its inputs held. No clock is read: the same scenario, seed and inputs give the
same numbers, to the bit, for one plant and for a batch, sample by sample and many at a time.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, non_negative, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import QUANTITIES, SIDES, ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.model.torque_path import DIRECT, TorquePath
from tsobs_ros.simulation.integrator import ArmMotion, Friction, Motion, Payload, TorqueDelay
from tsobs_ros.simulation.sensor import Disturbance, Output, Sensor
from tsobs_ros.simulation.signals import Signal, Sine, StuckSensor
from tsobs_ros.simulation.streams import Seeds, Source, checked_seeds

_BLOCK = 2**16
"""Samples of all runs that are moved at a time, so that the memory stays bounded."""


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
class SimulatedOutput:
    """A measured output of a plant.

    Attributes:
        measures: What: link_angle, link_velocity, motor_angle or motor_velocity (rad, rad/s); the
            name of a T–S system's output.
        sensor: Its noise, outliers and dropouts.
        disturbance: Components of its disturbance, added up.
        delay: How late an arm's angle is measured as a design says [s]; `Sensor.latency` is what a
            design lacks. It is not rounded to samples: the true motion is interpolated.
    """

    measures: str = QUANTITIES[0]
    sensor: Sensor = field(default_factory=Sensor)
    disturbance: tuple[Signal, ...] = ()
    delay: float = 0.0

    def __post_init__(self) -> None:
        non_negative("delay", self.delay)


@dataclass(frozen=True)
class TorqueDisturbance:
    """Torques on an arm beside the drive's [N m]; each is held from a sample to the next.

    Attributes:
        motor: Components of the torque on the motor, added up.
        link: Components of the torque on the link, such as that of a contact, added up.

    Raises:
        ModelError: A component is a stuck sensor.
    """

    motor: tuple[Signal, ...] = ()
    link: tuple[Signal, ...] = ()

    def __post_init__(self) -> None:
        for side in SIDES:
            if any(isinstance(each, StuckSensor) for each in getattr(self, side)):
                raise ModelError(f"torque_disturbance {side}: expected torques, got a stuck sensor")


class PlantSignals(NamedTuple):
    """What moves a plant, and what is measured of it.

    Attributes:
        outputs: The outputs, p of them.
        inputs: The signal of each input and scheduled signal in the absence of a command.
        input_count: Number of inputs, which can be commanded; they are the first of `inputs`.
        torques: Signals of the disturbance of each torque.
        reporting_error: What the first reported input has beyond the applied one.
        torque: How the first input reaches the plant.
    """

    outputs: tuple[SimulatedOutput, ...]
    inputs: tuple[Signal, ...]
    input_count: int
    torques: tuple[tuple[Signal, ...], ...] = ()
    reporting_error: tuple[Signal, ...] = ()
    torque: TorquePath = DIRECT


class PlantScenario(ABC):
    """A plant, what moves it and what its outputs measure.

    Attributes:
        rate: Samples per second [Hz].
        duration: How long a campaign simulates [s].
    """

    rate: float
    duration: float

    @property
    @abstractmethod
    def signals(self) -> PlantSignals:
        """What moves it, and what is measured."""

    @abstractmethod
    def motion(self, seeds: Sequence[int]) -> Motion:
        """Return the plants at the first sample, ready to move."""

    def to_design(self, physical: Array) -> Array:
        """Return states in the coordinates of designs, of an arm the nominal one's, (..., n)."""
        return physical

    @property
    def sample_count(self) -> int:
        """Samples in `duration`: those at 0, 1/rate, … up to and including the end."""
        return math.floor(self.duration * self.rate + 1e-9) + 1


@dataclass(frozen=True)
class Scenario(PlantScenario):
    """How an arm is built, moved, disturbed and measured.

    Attributes:
        arm: The nominal arm, the one an estimator knows.
        mismatch: How the true arm differs from it.
        friction: What the true arm has in addition.
        rate: Samples per second [Hz].
        duration: How long a campaign simulates [s].
        initial_state: Mean of x(0) in the nominal arm's design coordinates.
        initial_spread: 1σ of x(0) in the same coordinates.
        process_noise: Densities of the random accelerations.
        excitation: Torque in the absence of a command.
        disturbance: Components of the sensor's disturbance, added up.
        sensor: Noise, outliers and dropouts.
        torque_error: What the reported torque has beyond the applied one, as signals of
            `signals` in N m, added up; of a drift its mean.
        outputs: What is measured, each with a sensor and a disturbance of its own; empty for the
            link angle alone, by `sensor` and with `disturbance`.
        torque_disturbance: Torques beside the drive's.
        payload: What the link carries for a time.
        backlash: Play of the true arm's gear [rad], half of it to either side.
        torque: How the commanded torque, which is the one that is reported, reaches the motor.

    Raises:
        ModelError: A number is not finite, of the wrong sign, a state has not four entries, or an
            output is unknown or listed twice.
    """

    arm: ElasticJointArm = field(default_factory=ElasticJointArm)
    mismatch: Mismatch = field(default_factory=Mismatch)
    friction: Friction = field(default_factory=Friction)
    rate: float = 200.0
    duration: float = 60.0
    initial_state: tuple[float, ...] = (0.3, 0.0, 2.0, 0.0)
    initial_spread: tuple[float, ...] = (0.05, 0.1, 0.5, 0.5)
    process_noise: ProcessNoise = field(default_factory=ProcessNoise)
    excitation: Signal = field(default_factory=Sine)
    disturbance: tuple[Signal, ...] = ()
    sensor: Sensor = field(default_factory=Sensor)
    torque_error: tuple[Signal, ...] = ()
    outputs: tuple[SimulatedOutput, ...] = ()
    torque_disturbance: TorqueDisturbance = field(default_factory=TorqueDisturbance)
    payload: Payload = field(default_factory=Payload)
    backlash: float = 0.0
    torque: TorquePath = DIRECT

    def __post_init__(self) -> None:
        positive("rate", self.rate)
        non_negative("duration", self.duration)
        non_negative("backlash", self.backlash)
        for name in ("initial_state", "initial_spread"):
            as_matrix(name, getattr(self, name), (4,))
        self.arm.measured(
            [output.measures for output in self.outputs], [output.delay for output in self.outputs]
        )
        if self.outputs and (self.disturbance or self.sensor != Sensor()):
            raise ModelError(
                "outputs: expected none beside `sensor` and `disturbance`, which are those of the "
                "link angle alone"
            )

    @property
    def true_arm(self) -> ElasticJointArm:
        """The arm that really moves."""
        return self.mismatch.apply(self.arm)

    @property
    def signals(self) -> PlantSignals:
        alone = SimulatedOutput(sensor=self.sensor, disturbance=self.disturbance)
        torques = (self.torque_disturbance.motor, self.torque_disturbance.link)
        outputs = self.outputs or (alone,)
        inputs = (self.excitation,)
        return PlantSignals(outputs, inputs, 1, torques, self.torque_error, self.torque)

    def motion(self, seeds: Sequence[int]) -> Motion:
        return ArmMotion(self, seeds)

    def to_design(self, physical: Array) -> Array:
        return self.arm.from_physical(physical)


class Trajectories(NamedTuple):
    """A batch of runs; without the first axis a single one.

    Shapes are those of an arm; a T–S system has n states, m inputs and then s scheduled signals,
    no torques, and `physical` is `states`.

    Attributes:
        times: k/rate, since the start [s], shape (samples,).
        states: True states in the nominal arm's design coordinates, shape (runs, samples, 4).
        disturbances: What each measurement has beyond the truth, its delay, latency, noise and
            outliers, shape (runs, samples, p). Of a stuck sensor it is the frozen value minus the
            true one, of an output with a delay that of so long ago.
        measurements: y, NaN if lost, shape (runs, samples, p).
        torques: Torque reported from each sample to the next [N m]: the one commanded, and its
            error, shape (runs, samples, 1).
        physical: True [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (runs, samples, 4).
        torque_disturbances: Torques on motor and link that the true arm (with its mismatch) would
            need beside the reported one, which reaches it as the design says, without friction,
            payload and backlash, to accelerate as it does, shape (runs, samples, 2) [N m]. They
            count the torque disturbance, friction, the payload's inertia and weight, what the
            spring lacks by play, and the error of the reported torque; not the mismatch, which is a
            matter of parameters, nor the random accelerations.
    """

    times: Array
    states: Array
    disturbances: Array
    measurements: Array
    torques: Array
    physical: Array
    torque_disturbances: Array


@dataclass(frozen=True, slots=True)
class Sample:
    """One sample, `index` k, of `Trajectories`, which say what the others are."""

    index: int
    time: float
    state: Array
    disturbance: Array
    measurement: Array
    torque: Array
    physical: Array
    torque_disturbance: Array


class Plant:
    """A plant with its excitation, its sensors and everything random about them.

    Args:
        scenario: How it is built, moved, disturbed and measured.
        seeds: One seed for a single plant, or a sequence of seeds for a batch of runs. A run of a
            batch is the same as the single plant with its seed.

    Attributes:
        scenario: As given.
        index: Index of the sample that the next step returns.

    Raises:
        ModelError: A seed is not an integer of at least zero.
    """

    def __init__(self, scenario: PlantScenario, seeds: Seeds = 0) -> None:
        self._is_batch = not isinstance(seeds, int | np.integer)
        self._seeds = runs = checked_seeds(seeds)
        self.scenario, self.index = scenario, 0
        self._motion, self._signals = scenario.motion(runs), scenario.signals
        self._inputs, rate = list(self._signals.inputs), scenario.rate
        self._outputs = [
            Output(runs, number, rate, each.sensor, each.disturbance)
            for number, each in enumerate(self._signals.outputs)
        ]
        self._torques = [
            Disturbance(runs, Source.TORQUE, side, rate, signals)
            for side, signals in enumerate(self._signals.torques)
        ]
        self._held = np.zeros((len(runs), len(self._outputs)))
        path, errors = self._signals.torque, self._signals.reporting_error
        self._is_direct = path == DIRECT
        self._path = TorqueDelay(path, rate)
        # The error of a report takes the same path in estimators.
        self._error_paths = [TorqueDelay(replace(path, offset=0.0), rate) for _ in errors]

    @property
    def time(self) -> float:
        """Time of the sample that the next step returns, since the start [s]."""
        return self.index / self.scenario.rate

    def exchange_disturbance(self, signals: Sequence[Signal], output: int = 0) -> None:
        """Put other signals in the place of an output's present ones, from the next sample on.

        The time of the new signals, their `start` included, counts from the next sample.
        """
        self._outputs[output].disturb(signals, self.index)

    def exchange_torque_disturbance(self, signals: Sequence[Signal], side: int) -> None:
        """Do so for the torque disturbance of the motor (0) or of the link (1)."""
        self._torques[side].exchange(signals, self.index)

    def exchange_excitation(self, excitation: Signal, place: int = 0) -> None:
        """Move an input otherwise from the next sample on; its time goes on counting."""
        self._inputs[place] = excitation

    def exchange_sensor(self, sensor: Sensor, output: int = 0) -> None:
        """Measure with other noise, outliers or dropouts from the next sample on."""
        self._outputs[output].exchange(sensor)

    def step(self, torque: ArrayLike | None = None) -> Sample:
        """Measure at the present sample, move on to the next one and return the former.

        Args:
            torque: Torque, or inputs of a T–S system, to apply instead of the excitations [N m]; a
                number, or shape (m,), of a batch (runs, m).

        Raises:
            ModelError: The torque is not finite or does not fit the plant.
        """
        index, given = self.index, None if torque is None else np.asarray(torque, np.float64)
        if given is not None and given.ndim:
            given = given[..., np.newaxis, :]
        times, *arrays = self.run(1, given)
        return Sample(index, float(times[0]), *(each[..., 0, :] for each in arrays))

    def run(self, samples: int, torque: ArrayLike | None = None) -> Trajectories:
        """Step many times and return all samples; other threads of Python can run meanwhile.

        Everything is kept: 104 bytes per run and sample of an arm with one output.

        Args:
            samples: Number of steps.
            torque: Torque, or inputs of a T–S system, to apply instead of the excitations [N m]; a
                number, shape (samples, m) or (runs, samples, m).

        Raises:
            ModelError: The torque is not finite, or of another shape.
        """
        given = None if torque is None else self._checked_torque(torque, samples)
        times = np.arange(self.index, self.index + samples) / self.scenario.rate
        n, p, t = self._motion.states.shape[1], len(self._outputs), len(self._torques)
        widths = (n, p, p, len(self._inputs), t)
        kept = [np.empty((len(self._seeds), samples, width)) for width in widths]
        block = 1 if self._motion.fed_back else max(1, _BLOCK // len(self._seeds))
        for done in range(0, samples, block):
            now = np.s_[:, done : done + block]
            parts = self._advance(times[now[1]], None if given is None else given[now])
            for whole, part in zip(kept, parts, strict=True):
                whole[now] = part
            self.index += parts[0].shape[1]
        one = [each if self._is_batch else each[0] for each in kept]
        design = self.scenario.to_design(one[0])
        return Trajectories(times, design, one[1], one[2], one[3], one[0], one[4])

    def _checked_torque(self, torque: ArrayLike, samples: int) -> Array:
        """Return commands of all runs, shape (runs, samples, m)."""
        given, runs, m = np.asarray(torque, np.float64), len(self._seeds), self._signals.input_count
        shapes = [(samples, m)] + [(runs, samples, m)] * self._is_batch
        if given.shape not in ((), *shapes):
            expected = " or ".join(map(str, shapes))
            raise ModelError(f"torque: expected shape {expected}, got {given.shape}")
        whole = np.broadcast_to(given, (runs, samples, m))
        wrong = ~np.isfinite(whole).all(axis=(0, 2))
        if wrong.any():
            place = self.index + int(wrong.argmax())
            raise ModelError(f"torque of sample {place}: expected finite numbers")
        return whole

    def _advance(self, times: Array, given: Array | None) -> tuple[Array, ...]:
        """Move on over samples; return states, disturbances, measurements, inputs and torques."""
        motion, start = self._motion, self.index
        shape = (len(self._seeds), len(times))
        inputs = np.empty((*shape, len(self._inputs)))
        for place, excitation in enumerate(self._inputs):
            if given is not None and place < given.shape[2]:
                inputs[..., place] = given[..., place]
            else:
                inputs[..., place] = excitation.values(times)
        torques = np.empty((*shape, len(self._torques)))
        for side, disturbance in enumerate(self._torques):
            torques[..., side] = disturbance.values(start, len(times))
        measured = {}
        for place, output in motion.fed_back:
            truth = motion.known_output(output)[:, np.newaxis]
            measured[output] = self._outputs[output].measure(start, truth)
            value = measured[output][1][:, 0]
            self._held[:, output] = np.where(np.isfinite(value), value, self._held[:, output])
            inputs[:, 0, place] = self._held[:, output]
        applied = inputs
        if not self._is_direct:
            applied = inputs.copy()
            applied[..., 0] = self._path.through(inputs[..., 0])
        states, truths = motion.move(start, applied, torques)
        for number, each in enumerate(self._outputs):
            if number not in measured:
                measured[number] = each.measure(start, np.ascontiguousarray(truths[..., number]))
        pairs = [measured[number] for number in range(len(self._outputs))]
        disturbances, measurements = (np.stack(each, axis=-1) for each in zip(*pairs, strict=True))
        for signal, path in zip(self._signals.reporting_error, self._error_paths, strict=True):
            error = signal.values(times)
            inputs[..., 0] += error
            torques[..., 0] -= error if self._is_direct else path.through(error[np.newaxis])
        return states, disturbances, measurements, inputs, torques
