# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A scenario: everything that decides how a simulated plant behaves, except the seed."""

import math
from dataclasses import dataclass, field, fields

from tsobs_ros.checks import non_negative, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.simulation.excitation import Excitation, Sine
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import Component


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
