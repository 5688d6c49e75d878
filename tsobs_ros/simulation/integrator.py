# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixed-step integration of plants: the true motion the observers are judged by.

The classical fourth-order Runge–Kutta method at 1 ms keeps the undriven arm's energy to 1e-10
over a minute, so its error is far below any noise; no adaptive solver or exact-flow splitting is
needed.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, check_each, non_negative, positive
from tsobs_ros.compiled import compiled, inlined
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.stepping import record_type
from tsobs_ros.model.trigonometry import sine, unbranched_sine

LONGEST_SUBSTEP = 1e-3
"""Upper limit of an integration step [s]; a sampling period is cut into equal steps below it."""

_MOTION = record_type(
    [
        ("substeps", np.int64),
        ("substep", np.float64),
        ("gravity", np.float64),
        ("motor_inertia", np.float64),
        ("link_spring", np.float64),
        ("link_drag", np.float64),
        ("motor_spring", np.float64),
        ("motor_drag", np.float64),
        ("link_rub", np.float64),
        ("motor_rub", np.float64),
        ("link_inertia", np.float64),
        ("link_viscous", np.float64),
        ("link_coulomb", np.float64),
        ("motor_viscous", np.float64),
        ("motor_coulomb", np.float64),
        ("added_inertia", np.float64),
        ("added_gravity", np.float64),
    ]
)

STANDARD_GRAVITY = 9.80665
"""[m/s²]."""

_FEW = 4
"""Arms from which on they are integrated side by side."""

CREEP = 0.01
"""Speed below which Coulomb friction is proportional to the speed [rad/s]."""


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

    Attributes:
        motion: One record with the numbers that `advance_arms` takes.

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
    ) -> None:
        friction, payload = friction or Friction(), payload or Payload()
        arm = payload.on(arm)
        positive("longest_substep", longest_substep)
        # A period of exactly five steps must not become six because .005/.001 rounds upwards.
        self.substeps = max(1, math.ceil(positive("period", period) / longest_substep - 1e-9))
        self.substep = period / self.substeps
        self.motion = np.empty(1, _MOTION)
        self.motion[0] = (
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
        )

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
        start = np.array(state, dtype=np.float64)
        if start.ndim not in (1, 2) or start.shape[-1] != 4:
            raise ModelError(f"state: expected shape (4,) or (runs, 4), got {start.shape}")
        shape = (*start.shape[:-1], self.substeps, 2)
        noise = np.zeros(shape) if kicks is None else np.array(kicks, dtype=np.float64)
        if noise.shape != shape:
            raise ModelError(f"kicks: expected shape {shape}, got {noise.shape}")
        states = start.reshape(-1, 4)
        runs = len(states)
        torques = np.empty((runs, 1))
        torques[...] = torque
        _advance_arms(
            self.motion,
            states,
            torques[:, 0].copy(),
            np.zeros((2, runs)),
            noise.reshape(runs, 1, -1),
        )
        return start


@compiled
def advance_arms(
    motion: Any,
    states: Array,
    torques: Array,
    pushes: Array,
    kicks: Array,
    draw: int,
    link_kick: float,
    motor_kick: float,
) -> None:
    """Move the physical states of arms over a period, in place.

    Args:
        motion: Record of an `ArmIntegrator`.
        states: [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (runs, 4).
        torques: Motor torques held over the period [N m], shape (runs,).
        pushes: Torques on motor and link besides, held likewise [N m], shape (2, runs).
        kicks: Velocity steps of link and motor after each integration step in turn, shape
            (runs, block, 2 substeps), or (runs, block, 0) for none.
        draw: Which of the block.
        link_kick: What the link's are to be multiplied by [rad/s].
        motor_kick: What the motor's are to be multiplied by [rad/s].
    """
    lanes = np.empty((6, states.shape[0]))
    # Of few arms a sine with branches is faster; of an angle beyond 10⁶ rad the other one is NaN.
    is_done = states.shape[0] >= _FEW
    if is_done:
        _load(motion, states, torques, pushes, lanes)
        _integrate(motion, lanes, kicks, draw, link_kick, motor_kick, unbranched_sine)
        for run in range(states.shape[0]):
            is_done = is_done and not math.isnan(lanes[1, run])
    if not is_done:
        _load(motion, states, torques, pushes, lanes)
        _integrate(motion, lanes, kicks, draw, link_kick, motor_kick, sine)
    for run in range(states.shape[0]):
        for item in range(4):
            states[run, item] = lanes[item, run]


@compiled
def _load(motion: Any, states: Array, torques: Array, pushes: Array, lanes: Array) -> None:
    """Write states, and the accelerations by torques, as lanes: one quantity of all runs a row."""
    motor, link = float(motion.motor_inertia), float(motion.link_inertia)
    for run in range(states.shape[0]):
        for item in range(4):
            lanes[item, run] = states[run, item]
        # Subtracted, so that a push of zero changes no bit, the sign of a zero included.
        lanes[4, run] = float(torques[run]) / motor - (0.0 - float(pushes[0, run])) / motor
        lanes[5, run] = (0.0 - float(pushes[1, run])) / link


@inlined
def _integrate(
    motion: Any,
    lanes: Array,
    kicks: Array,
    draw: int,
    link_kick: float,
    motor_kick: float,
    sin: Callable[[float], float],
) -> None:
    # Floats, since scalars of NumPy are slow and warn of an overflow when this is interpreted.
    h, gravity = float(motion.substep), float(motion.gravity)
    link_spring, drag = float(motion.link_spring), float(motion.link_drag)
    motor_spring, motor_drag = float(motion.motor_spring), float(motion.motor_drag)
    link_rub, motor_rub = float(motion.link_rub), float(motion.motor_rub)
    half, sixth = 0.5 * h, h / 6.0
    for step in range(motion.substeps):
        # The velocity of each stage is the slope of the angle: w of the link, s of the motor.
        for run in range(lanes.shape[1]):
            q1, v1 = float(lanes[0, run]), float(lanes[1, run])
            q2, v2 = float(lanes[2, run]), float(lanes[3, run])
            drive, brake = float(lanes[4, run]), float(lanes[5, run])
            a1 = (
                link_spring * (q2 - q1) - gravity * sin(q1) - drag * v1 - _rub(link_rub, v1) - brake
            )
            b1 = drive - motor_spring * (q2 - q1) - motor_drag * v2 - _rub(motor_rub, v2)
            w2, s2 = v1 + half * a1, v2 + half * b1
            p1, p2 = q1 + half * v1, q2 + half * v2
            a2 = (
                link_spring * (p2 - p1) - gravity * sin(p1) - drag * w2 - _rub(link_rub, w2) - brake
            )
            b2 = drive - motor_spring * (p2 - p1) - motor_drag * s2 - _rub(motor_rub, s2)
            w3, s3 = v1 + half * a2, v2 + half * b2
            p1, p2 = q1 + half * w2, q2 + half * s2
            a3 = (
                link_spring * (p2 - p1) - gravity * sin(p1) - drag * w3 - _rub(link_rub, w3) - brake
            )
            b3 = drive - motor_spring * (p2 - p1) - motor_drag * s3 - _rub(motor_rub, s3)
            w4, s4 = v1 + h * a3, v2 + h * b3
            p1, p2 = q1 + h * w3, q2 + h * s3
            a4 = (
                link_spring * (p2 - p1) - gravity * sin(p1) - drag * w4 - _rub(link_rub, w4) - brake
            )
            b4 = drive - motor_spring * (p2 - p1) - motor_drag * s4 - _rub(motor_rub, s4)
            lanes[0, run] = q1 + sixth * (v1 + 2.0 * (w2 + w3) + w4)
            lanes[1, run] = v1 + sixth * (a1 + 2.0 * (a2 + a3) + a4)
            lanes[2, run] = q2 + sixth * (v2 + 2.0 * (s2 + s3) + s4)
            lanes[3, run] = v2 + sixth * (b1 + 2.0 * (b2 + b3) + b4)
        if kicks.shape[2]:
            for run in range(lanes.shape[1]):
                lanes[1, run] += link_kick * float(kicks[run, draw, 2 * step])
                lanes[3, run] += motor_kick * float(kicks[run, draw, 2 * step + 1])


@compiled
def missing_torques(
    motion: Any, state: Array, motor_push: float, link_push: float
) -> tuple[float, float]:
    """Return the torques that an arm without friction and payload would need to move like this one.

    Args:
        motion: Record of an `ArmIntegrator`.
        state: [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (4,).
        motor_push: Torque on the motor besides the drive's [N m].
        link_push: Torque on the link [N m].

    Returns:
        The motor's and the link's [N m]: the pushes less Coulomb and viscous friction, and on the
        link less what turns the payload and holds it, ΔJ q̈₁ + Δmgl sin q₁.
    """
    q1, v1, q2, v2 = float(state[0]), float(state[1]), float(state[2]), float(state[3])
    motor = motor_push - float(motion.motor_viscous) * v2 - _rub(float(motion.motor_coulomb), v2)
    link = link_push - float(motion.link_viscous) * v1 - _rub(float(motion.link_coulomb), v1)
    inertia, weight = float(motion.added_inertia), float(motion.added_gravity)
    if inertia > 0.0 or weight > 0.0:
        pull = float(motion.gravity) * sine(q1)
        speeding = float(motion.link_spring) * (q2 - q1) - pull - float(motion.link_drag) * v1
        speeding -= _rub(float(motion.link_rub), v1)
        speeding += link_push / float(motion.link_inertia)
        link -= inertia * speeding + weight * sine(q1)
    return motor, link


@inlined
def _rub(level: float, speed: float) -> float:
    """Return Coulomb friction of a level, a torque [N m] or a deceleration [rad/s²]."""
    return level * min(max(speed / CREEP, -1.0), 1.0) if level > 0.0 else 0.0


@compiled
def _advance_arms(motion: Any, states: Array, torques: Array, pushes: Array, kicks: Array) -> None:
    advance_arms(motion[0], states, torques, pushes, kicks, 0, 1.0, 1.0)
