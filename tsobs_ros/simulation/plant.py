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
from dataclasses import dataclass, field, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, Flags, non_negative, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import QUANTITIES, SIDES, ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.simulation.integrator import Friction, Payload
from tsobs_ros.simulation.motion import ArmMotion, Motion
from tsobs_ros.simulation.sensor import Sensor, Sensors
from tsobs_ros.simulation.series import Series, Span
from tsobs_ros.simulation.signals import Signal, Sine, StuckSensor
from tsobs_ros.simulation.streams import RandomStream, Seeds, Source, checked_seeds

_BLOCK = 256
"""Samples drawn at a time, fewer of many runs."""

_LARGEST_BLOCK = 2**16
"""Samples of all runs drawn at a time, so that the memory stays bounded."""


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
    """

    measures: str = QUANTITIES[0]
    sensor: Sensor = field(default_factory=Sensor)
    disturbance: tuple[Signal, ...] = ()


@dataclass(frozen=True)
class TorqueDisturbance:
    """Torques on an arm besides the drive's [N m]; each is held from a sample to the next.

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


class PlantScenario(ABC):
    """A plant, what moves it and what its outputs measure.

    Attributes:
        rate: Samples a second [Hz].
        duration: How long a campaign simulates [s].
    """

    rate: float
    duration: float

    @property
    @abstractmethod
    def measured(self) -> tuple[SimulatedOutput, ...]:
        """The outputs, p of them."""

    @property
    @abstractmethod
    def excitations(self) -> tuple[Signal, ...]:
        """The signal of each input and scheduled signal in the absence of a command."""

    @property
    @abstractmethod
    def input_count(self) -> int:
        """Number of inputs that can be commanded; scheduled signals are not among them."""

    @property
    def torques(self) -> tuple[tuple[Signal, ...], ...]:
        """Components of the disturbance of each torque."""
        return ()

    @property
    def reporting_error(self) -> tuple[Signal, ...]:
        """What the first reported input has beyond the applied one."""
        return ()

    @abstractmethod
    def motion(self, seeds: Sequence[int], block: int) -> Motion:
        """Return the plants at the first sample, ready to move."""

    def to_design(self, physical: Array) -> Array:
        """Return states in the coordinates of designs, shape (..., n)."""
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
        outputs: What is measured, each with a sensor and a disturbance of its own; empty for the
            link angle alone, by `sensor` and with `disturbance`.
        torque_disturbance: Torques besides the drive's.
        payload: What the link carries for a time.
        backlash: Play of the true arm's gear [rad], half of it to either side.

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

    def __post_init__(self) -> None:
        positive("rate", self.rate)
        non_negative("duration", self.duration)
        non_negative("backlash", self.backlash)
        for name in ("initial_state", "initial_spread"):
            values = getattr(self, name)
            if len(values) != 4 or not all(math.isfinite(value) for value in values):
                raise ModelError(f"{name}: expected four finite numbers, got {values!r}")
        names = [output.measures for output in self.outputs]
        for place, name in enumerate(names):
            if name not in QUANTITIES:
                raise ModelError(
                    f"outputs[{place}].measures: expected one of {', '.join(QUANTITIES)}, "
                    f"got {name!r}"
                )
            if name in names[:place]:
                raise ModelError(f"outputs[{place}].measures: {name} is listed twice")
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
    def measured(self) -> tuple[SimulatedOutput, ...]:
        """The outputs, p of them."""
        return self.outputs or (SimulatedOutput(sensor=self.sensor, disturbance=self.disturbance),)

    @property
    def excitations(self) -> tuple[Signal, ...]:
        """The torque in the absence of a command."""
        return (self.excitation,)

    @property
    def input_count(self) -> int:
        """Number of inputs that can be commanded."""
        return 1

    @property
    def torques(self) -> tuple[tuple[Signal, ...], ...]:
        """Components of the torque on the motor, and of that on the link."""
        return tuple(getattr(self.torque_disturbance, side) for side in SIDES)

    @property
    def reporting_error(self) -> tuple[Signal, ...]:
        """What the reported torque has beyond the applied one."""
        return self.torque_error

    def motion(self, seeds: Sequence[int], block: int) -> Motion:
        """Return the arms at the first sample, ready to move."""
        spread = np.empty((len(seeds), 4))
        RandomStream(seeds, Source.INITIAL_STATE).fill(spread)
        start = np.array(self.initial_state) + spread * np.array(self.initial_spread)
        return ArmMotion(
            self.true_arm,
            self.friction,
            self.payload,
            self.process_noise,
            self.backlash,
            [QUANTITIES.index(output.measures) for output in self.measured],
            self.rate,
            seeds,
            self.arm.to_physical(start),
            block,
        )

    def to_design(self, physical: Array) -> Array:
        """Return states in the nominal arm's design coordinates, shape (..., 4)."""
        return self.arm.from_physical(physical)


@dataclass(frozen=True, slots=True)
class Sample:
    """What is true and what is measured at one sampling time; (...) is () or (runs,).

    Shapes are those of an arm; a T–S system has n states, m inputs and then s scheduled signals,
    no torques, and `physical` is `state`.

    Attributes:
        index: k, from 0.
        time: k/rate, since the start [s].
        state: True state in the nominal arm's design coordinates, shape (..., 4).
        physical: True [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (..., 4).
        disturbance: What each measurement has beyond the truth, its latency, noise and outliers,
            shape (..., p). Of a stuck sensor it is the frozen value minus the true one.
        measurement: y, shape (..., p); NaN if the sample was lost.
        torque: Torque reported from this time to the next sample [N m], shape (..., 1): the one
            applied, and its error.
        torque_disturbance: See `Trajectories`, shape (..., 2).
        lost: Whether the sample of every output was lost in a dropout.
    """

    index: int
    time: float
    state: Array
    physical: Array
    disturbance: Array
    measurement: Array
    torque: Array
    torque_disturbance: Array
    lost: bool


class Trajectories(NamedTuple):
    """A batch of runs; without the first axis a single one.

    Shapes are those of an arm, as for `Sample`.

    Attributes:
        times: [s], shape (samples,).
        states: True states in the nominal arm's design coordinates, shape (runs, samples, 4).
        disturbances: True disturbances of the outputs, shape (runs, samples, p).
        measurements: y, NaN if lost, shape (runs, samples, p).
        torques: Torque reported from each sample to the next [N m]: the one applied, and its
            error, shape (runs, samples, 1).
        physical: True [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (runs, samples, 4).
        torque_disturbances: Torques on motor and link that the true arm (with its mismatch) would
            need besides the reported one, without friction, payload and backlash, to accelerate as
            it does, shape (runs, samples, 2) [N m]. They count the torque disturbance, friction,
            the payload's inertia and weight, what the spring lacks by play, and the error of the
            reported torque; not the mismatch, which is a matter of parameters, nor the random
            accelerations.
    """

    times: Array
    states: Array
    disturbances: Array
    measurements: Array
    torques: Array
    physical: Array
    torque_disturbances: Array


class Plant:
    """A plant with its excitation, its sensors and everything random about them.

    Args:
        scenario: How it is built, moved, disturbed and measured.
        seeds: One seed for a single plant, or a sequence of seeds for a batch of runs. A run of a
            batch is the same as the single plant with its seed.

    Raises:
        ModelError: A seed is not an integer of at least zero.
    """

    def __init__(self, scenario: PlantScenario, seeds: Seeds = 0) -> None:
        self._seeds = checked_seeds(seeds)
        self._is_batch = not isinstance(seeds, int | np.integer)
        self.scenario = scenario
        self.reset()

    def reset(self) -> None:
        """Start again, exactly as a new plant of the same scenario and seeds."""
        scenario, runs = self.scenario, len(self._seeds)
        self._index = 0
        self._block = min(_BLOCK, max(1, _LARGEST_BLOCK // runs))
        self._drawn = self._block
        self._motion = scenario.motion(self._seeds, self._block)
        outputs = scenario.measured
        self._sensors = Sensors(self._seeds, len(outputs), self._block, scenario.rate)
        for place, excitation in enumerate(scenario.excitations):
            self.exchange_excitation(excitation, place)
        for place, output in enumerate(outputs):
            self.exchange_sensor(output.sensor, place)
            self.exchange_disturbance(output.disturbance, place)
        for side, components in enumerate(scenario.torques):
            self.exchange_torque_disturbance(components, side)
        self._measured_last: Flags = np.ones(len(outputs), np.bool_)
        for _, fed in self._motion.fed_back:
            self._measured_last[fed] = False
        self._held = np.zeros((runs, len(outputs)))
        # So that the first block is drawn before the first step.
        self._advance(0)

    @property
    def index(self) -> int:
        """Index of the sample that the next step returns."""
        return self._index

    @property
    def time(self) -> float:
        """Time of the sample that the next step returns, since the start [s]."""
        return self._index / self.scenario.rate

    def exchange_disturbance(self, components: Sequence[Signal], output: int = 0) -> None:
        """Put other components in the place of an output's present ones, from the next sample on.

        The time of the new components, their `start` included, counts from the next sample.
        """
        self._sensors.disturb(output, components, self._index, self._drawn)

    def exchange_torque_disturbance(self, components: Sequence[Signal], side: int) -> None:
        """Do so for the torque disturbance of the motor (0) or of the link (1)."""
        self._motion.torques.exchange(side, components, self._index, self._drawn)

    def exchange_excitation(self, excitation: Signal, place: int = 0) -> None:
        """Move an input otherwise from the next sample on; its time goes on counting."""
        self._motion.excite(place, excitation)

    def exchange_sensor(self, sensor: Sensor, output: int = 0) -> None:
        """Measure with other noise, outliers or dropouts from the next sample on."""
        self._sensors.exchange(output, sensor, self._drawn)

    def step(self, torque: ArrayLike | None = None) -> Sample:
        """Measure at the present sample, move on to the next one and return the former.

        Args:
            torque: Torque, or inputs of a T–S system, to apply instead of the excitations [N m]; a
                number, or shape (m,), of a batch (runs, m).

        Raises:
            ModelError: The torque is not finite or does not fit the plant.
        """
        index, time, m = self._index, self.time, self.scenario.input_count
        if torque is not None:
            torque = self._checked_torque(torque, (len(self._seeds), m) if self._is_batch else (m,))
            torque = torque[..., np.newaxis, :] if torque.ndim else torque
        where = np.s_[:, 0] if self._is_batch else (0, 0)
        series = self._advance(1, torque)
        physical = series.states[where]
        return Sample(
            index,
            time,
            self.scenario.to_design(physical),
            physical,
            series.disturbances[where],
            series.measurements[where],
            series.inputs[where],
            series.torques[where],
            self._sensors.lost,
        )

    def run(self, samples: int, torque: ArrayLike | None = None) -> Trajectories:
        """Step many times and return all samples; other threads of Python can run meanwhile.

        Everything is kept: 104 bytes a run and sample of an arm with one output.

        Args:
            samples: Number of steps.
            torque: Torque, or inputs of a T–S system, to apply instead of the excitations [N m]; a
                number, shape (samples, m) or (runs, samples, m).

        Raises:
            ModelError: The torque is not finite, or of another shape.
        """
        if torque is not None:
            m = self.scenario.input_count
            shapes = [(samples, m)] + [(len(self._seeds), samples, m)] * self._is_batch
            torque = self._checked_torque(torque, *shapes)
        times = np.arange(self._index, self._index + samples) / self.scenario.rate
        series = self._advance(samples, torque)
        where = np.s_[:] if self._is_batch else 0
        physical = series.states[where]
        return Trajectories(
            times,
            self.scenario.to_design(physical),
            series.disturbances[where],
            series.measurements[where],
            series.inputs[where],
            physical,
            series.torques[where],
        )

    def _checked_torque(self, torque: ArrayLike, *shapes: tuple[int, ...]) -> Array:
        given = np.asarray(torque, dtype=np.float64)
        if given.shape not in ((), *shapes):
            expected = " or ".join(map(str, shapes))
            raise ModelError(f"torque: expected shape {expected}, got {given.shape}")
        wrong = ~np.isfinite(given)
        if wrong.any():
            place = int(wrong.any(axis=(0, 2)).argmax()) if given.ndim == 3 else int(wrong.argmax())
            raise ModelError(f"torque of sample {self._index + place}: expected finite numbers")
        return given

    def _advance(self, samples: int, torque: ArrayLike | None = None) -> Series:
        """Step and return all that was true and measured on the way."""
        scenario, motion, shape = self.scenario, self._motion, (len(self._seeds), samples)
        outputs, signals = len(self._measured_last), len(motion.excitations)
        series = Series(
            np.empty((*shape, motion.states.shape[1])),
            np.empty((*shape, outputs)),
            np.zeros((*shape, outputs)),
            np.empty((*shape, outputs)),
            np.empty((*shape, signals)),
            np.zeros((*shape, len(scenario.torques))),
        )
        rate, first, given = scenario.rate, self._index, 0
        if torque is not None:
            given = scenario.input_count
            series.inputs[..., :given] = torque
        motion.add_inputs(series.inputs, given, first)
        motion.torques.add_means(series.torques, first)
        self._sensors.channels.add_means(series.disturbances, first)
        done = 0
        while True:
            if self._drawn == self._block:
                motion.draw()
                self._sensors.draw()
                self._drawn = 0
            part = min(samples - done, self._block - self._drawn, 1 if motion.fed_back else samples)
            span = Span(self._index, self._drawn, done, part)
            if part:
                if motion.fed_back:
                    self._feed_back(span, series)
                motion.move(span, series)
                self._sensors.measure(span, series, self._measured_last)
            self._index += part
            self._drawn += part
            done += part
            if done == samples:
                break
        for each in scenario.reporting_error:
            error = each.values(np.arange(first, self._index) / rate)
            series.inputs[..., 0] += error
            series.torques[..., 0] -= error
        return series

    def _feed_back(self, span: Span, series: Series) -> None:
        """Measure what is fed back at a sample, and enter it into the inputs."""
        series.truths[:, span.place] = self._motion.known_outputs()
        self._sensors.measure(span, series, ~self._measured_last)
        for row, output in self._motion.fed_back:
            now = series.measurements[:, span.place, output]
            self._held[:, output] = np.where(np.isfinite(now), now, self._held[:, output])
            series.inputs[:, span.place, row] = self._held[:, output]
