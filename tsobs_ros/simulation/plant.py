# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulated plant: a pure, deterministic machine that is stepped by sample index.

Sample k belongs to the time k/rate. A step measures at that time, then moves the arm on to the
next sample with the torque held. No clock is read: the same scenario, seed and sequence of calls
give the same numbers, for one arm and for a batch of runs alike.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, non_negative, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.simulation.integrator import ArmIntegrator
from tsobs_ros.simulation.sensor import (
    RandomStream,
    Seeds,
    Sensor,
    SensorNoise,
    Source,
    batch_shape,
    checked_seeds,
)
from tsobs_ros.simulation.signals import Component, DisturbanceSource, Excitation, Sine


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
        rate: Samples a second [Hz].
        duration: How long a campaign simulates [s].
        initial_state: Mean of x(0) in the nominal arm's design coordinates.
        initial_spread: 1σ of x(0) in the same coordinates.
        process_noise: Densities of the random accelerations.
        excitation: Torque in the absence of a command.
        disturbance: Components of the sensor's disturbance, added up.
        sensor: Noise, outliers and dropouts.

    Raises:
        ModelError: A number is not finite, of the wrong sign, or a state has not four entries.
    """

    arm: ElasticJointArm = field(default_factory=ElasticJointArm)
    mismatch: Mismatch = field(default_factory=Mismatch)
    rate: float = 200.0
    duration: float = 60.0
    initial_state: tuple[float, ...] = (0.3, 0.0, 2.0, 0.0)
    initial_spread: tuple[float, ...] = (0.05, 0.1, 0.5, 0.5)
    process_noise: ProcessNoise = field(default_factory=ProcessNoise)
    excitation: Excitation = field(default_factory=Sine)
    disturbance: tuple[Component, ...] = ()
    sensor: Sensor = field(default_factory=Sensor)

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
        disturbance: What the measurement has beyond q₁, white noise and outliers [rad],
            shape (..., 1). Of a stuck sensor it is the frozen value minus q₁.
        measurement: y [rad], shape (..., 1); NaN if the sample was lost.
        torque: Torque applied from this time to the next sample [N m], shape (..., 1).
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
        checked_seeds(seeds)
        self.scenario = scenario
        self._seeds = seeds
        # A number times this is the cheapest array of equal numbers, for one sample at a time.
        self._ones = np.ones((*batch_shape(seeds), 1))
        self._period = 1.0 / scenario.rate
        self._integrator = ArmIntegrator(scenario.true_arm, self._period)
        self.reset()

    def reset(self) -> None:
        """Start again, exactly as a new plant of the same scenario and seeds."""
        scenario = self.scenario
        spread = RandomStream(
            self._seeds, Source.INITIAL_STATE, (4,), scale=scenario.initial_spread
        ).draw()
        start = np.array(scenario.initial_state) + spread
        self._physical = scenario.arm.to_physical(start)
        self._index = 0
        self._excitation = scenario.excitation
        self._sensor = scenario.sensor
        self._sensor_noise = SensorNoise(self._seeds)
        noise = scenario.process_noise
        densities = [noise.link, noise.motor]
        substeps, substep = self._integrator.substeps, self._integrator.substep
        kick_std = np.sqrt(np.array(densities) * substep)
        kicks = self._stream(Source.PROCESS, (substeps, 2), kick_std)
        self._kicks = kicks if any(densities) else None
        self._generation = -1
        self.exchange_disturbance(scenario.disturbance)

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
        self._injected_at = self._index
        self._frozen: Array | None = None
        self._disturbance = DisturbanceSource(
            components, self._period, self._seeds, self._generation
        )

    def exchange_excitation(self, excitation: Excitation) -> None:
        """Move the arm otherwise from the next sample on; its time goes on counting."""
        self._excitation = excitation

    def exchange_sensor(self, sensor: Sensor) -> None:
        """Measure with other noise, outliers or dropouts from the next sample on."""
        self._sensor = sensor

    def step(self, torque: ArrayLike | None = None) -> Sample:
        """Measure at the present sample, move on to the next one and return the former.

        Args:
            torque: Torque to apply instead of the excitation [N m]; a number, or (runs, 1).

        Raises:
            ModelError: The torque is not finite or does not fit the batch.
        """
        index, time, physical = self._index, self.time, self._physical
        applied = self._torque(time, torque)
        disturbance, measurement = self._measure(physical[..., :1])
        lost = self._sensor.drops(time)
        if lost:
            measurement = np.full_like(measurement, np.nan)
        kicks = None if self._kicks is None else self._kicks.draw()
        self._physical = self._integrator.advance(physical, applied, kicks)
        self._index = index + 1
        state = self.scenario.arm.from_physical(physical)
        return Sample(index, time, state, physical, disturbance, measurement, applied, lost)

    def _stream(self, source: Source, shape: tuple[int, ...], scale: ArrayLike) -> RandomStream:
        return RandomStream(self._seeds, source, shape, scale=scale)

    def _torque(self, time: float, torque: ArrayLike | None) -> Array:
        if torque is None:
            return self._excitation.torque(time) * self._ones
        given = np.asarray(torque, dtype=np.float64)
        if not np.isfinite(given).all():
            raise ModelError(f"torque of sample {self._index}: expected finite numbers")
        if given.shape not in ((), self._ones.shape):
            raise ModelError(f"torque: expected shape {self._ones.shape}, got {given.shape}")
        return np.asarray(given * self._ones)

    def _measure(self, angle: Array) -> tuple[Array, Array]:
        """Return disturbance and measurement of the link angle, shape (..., 1) each."""
        elapsed = (self._index - self._injected_at) / self.scenario.rate
        disturbance = self._disturbance.sample(elapsed)
        noise, outliers = self._sensor_noise.sample(self._sensor)
        measured = angle + disturbance + noise
        if not self._disturbance.stuck(elapsed):
            self._frozen = None
        else:
            if self._frozen is None:
                self._frozen = measured
            measured = self._frozen
            disturbance = measured - angle
        return disturbance, measured if outliers is None else measured + outliers
