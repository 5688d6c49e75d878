# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixed-step integration of plants: the true motion the observers are judged by.

The classical fourth-order Runge–Kutta method at 1 ms keeps the undriven arm's energy to 1e-10
over a minute, so its error is far below any noise; no adaptive solver or exact-flow splitting is
needed.
"""

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, check_each, non_negative, positive
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise

LONGEST_SUBSTEP = 1e-3
"""Upper limit of an integration step [s]; a sampling period is cut into equal steps below it."""

_ARM = record_type(native.simulated_arm_layout())

STANDARD_GRAVITY = 9.80665
"""[m/s²]."""

CREEP = 0.01
"""Speed below which Coulomb friction is proportional to the speed [rad/s], as in simulate.c."""


@dataclass(frozen=True)
class Friction:
    """Friction of the true arm that the nominal one lacks.

    Coulomb friction is c·sign(q̇), and below `CREEP` it grows linearly from zero.

    Attributes:
        link_viscous: Of the link's bearing [N m s/rad].
        link_coulomb: [N m].
        motor_viscous: Of the motor with its gear [N m s/rad].
        motor_coulomb: [N m].

    Raises:
        ModelError: A number is negative or not finite.
    """

    link_viscous: float = 0.0
    link_coulomb: float = 0.0
    motor_viscous: float = 0.0
    motor_coulomb: float = 0.0

    def __post_init__(self) -> None:
        names = (item.name for item in fields(self))
        check_each(non_negative, self, *names, prefix="friction ")


@dataclass(frozen=True)
class Payload:
    """What the link carries besides, from a time on; its speed does not jump as it is put on.

    Attributes:
        link_inertia: Inertia that it adds to the link's [kg m²].
        gravity_torque: Torque that it adds to the one that holds the link horizontal [N m].
        start: From the first sample at this time or later [s].
        duration: How long it is carried [s]; infinite for ever.

    Raises:
        ModelError: A number is negative or not finite.
    """

    link_inertia: float = 0.0
    gravity_torque: float = 0.0
    start: float = 0.0
    duration: float = math.inf

    def __post_init__(self) -> None:
        names = ("link_inertia", "gravity_torque", "start")
        check_each(non_negative, self, *names, prefix="payload ")
        if not self.duration >= 0.0:
            raise ModelError(f"payload duration: expected at least 0 s, got {self.duration!r}")

    @classmethod
    def point(
        cls, mass: float, distance: float, start: float = 0.0, duration: float = math.inf
    ) -> "Payload":
        """Return a mass [kg] at a distance from a horizontal axis [m].

        >>> Payload.point(2.0, 0.5).link_inertia
        0.5
        """
        non_negative("payload mass", mass)
        non_negative("payload distance", distance)
        torque = mass * STANDARD_GRAVITY * distance
        return cls(mass * distance * distance, torque, start, duration)

    def on(self, arm: ElasticJointArm) -> ElasticJointArm:
        """Return an arm with the payload."""
        return replace(
            arm,
            link_inertia=arm.link_inertia + self.link_inertia,
            gravity_torque=arm.gravity_torque + self.gravity_torque,
        )


class ArmIntegrator:
    """Advances an elastic-joint arm by one sampling period, in physical coordinates.

    Physical, because the design coordinates of a true arm and of the nominal one it is compared
    with differ as soon as their stiffnesses do.

    Args:
        arm: The arm that moves.
        period: Time that one call of `advance` covers [s].
        friction: Friction besides the arm's damping.
        longest_substep: Upper limit of the integration step [s].
        payload: What the arm carries besides.
        process_noise: What `advance` is to make of kicks that are normal numbers.
        backlash: Play of the gear [rad]; the spring is free within half of it to either side.

    Attributes:
        numbers: The numbers of the record that the compiled core takes.

    Raises:
        ModelError: The period or the step limit is not a finite number above zero.
    """

    def __init__(
        self,
        arm: ElasticJointArm,
        period: float,
        friction: Friction | None = None,
        longest_substep: float = LONGEST_SUBSTEP,
        payload: Payload | None = None,
        process_noise: ProcessNoise | None = None,
        backlash: float = 0.0,
    ) -> None:
        friction, payload = friction or Friction(), payload or Payload()
        arm = payload.on(arm)
        positive("longest_substep", longest_substep)
        # A period of exactly five steps must not become six because .005/.001 rounds upwards.
        self.substeps = max(1, math.ceil(positive("period", period) / longest_substep - 1e-9))
        self.substep = period / self.substeps
        noise = process_noise
        record = np.zeros(1, _ARM)
        record[0] = (
            self.substeps,
            self.substep,
            arm.gravity_gain,
            arm.motor_inertia,
            arm.stiffness / arm.link_inertia,
            (arm.link_damping + friction.link_viscous) / arm.link_inertia,
            arm.stiffness / arm.motor_inertia,
            (arm.motor_damping + friction.motor_viscous) / arm.motor_inertia,
            friction.link_coulomb / arm.link_inertia,
            friction.motor_coulomb / arm.motor_inertia,
            arm.link_inertia,
            friction.link_viscous,
            friction.link_coulomb,
            friction.motor_viscous,
            friction.motor_coulomb,
            payload.link_inertia,
            payload.gravity_torque,
            1.0 if noise is None else math.sqrt(noise.link * self.substep),
            1.0 if noise is None else math.sqrt(noise.motor * self.substep),
            0.5 * non_negative("backlash", backlash),
        )
        self.numbers: Array = record.view(np.float64)

    def advance(self, state: ArrayLike, torque: ArrayLike, kicks: ArrayLike | None = None) -> Array:
        """Return the physical state one period later.

        Args:
            state: [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (4,) or (runs, 4).
            torque: Motor torque held over the period [N m], shape (1,) or (runs, 1).
            kicks: Velocity steps of link and motor [rad/s] at the end of each integration step,
                shape (substeps, 2) or (runs, substeps, 2): the process noise.

        Raises:
            ModelError: The state or the kicks have another shape.
        """
        start = np.array(state, np.float64, order="C")
        if start.ndim not in (1, 2) or start.shape[-1] != 4:
            raise ModelError(f"state: expected shape (4,) or (runs, 4), got {start.shape}")
        shape = (*start.shape[:-1], self.substeps, 2)
        noise = np.zeros(shape) if kicks is None else np.array(kicks, np.float64, order="C")
        if noise.shape != shape:
            raise ModelError(f"kicks: expected shape {shape}, got {noise.shape}")
        states = start.reshape(-1, 4)
        torques = np.empty((len(states), 1))
        torques[...] = torque
        native.simulate_arms(
            np.concatenate([self.numbers, self.numbers]),
            np.zeros(1, np.int64),
            torques,
            noise,
            states,
            np.empty_like(states),
            np.zeros((len(states), 2)),
        )
        return start
