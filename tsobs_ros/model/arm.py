# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The arm with an elastic joint: its physics and its coordinates.

    J₁ q̈₁ + b₁ q̇₁ + k (q₁ − q₂) + mgl sin q₁ = 0
    J₂ q̈₂ + b₂ q̇₂ − k (q₁ − q₂)             = u

The estimators work in the coordinates of the method's Example 3,
x = [q₁, q̇₁, (k/J₁) q₂, (k/J₁) q̇₂], in which the spring enters the link's row with unit gain.
Here they are called *design coordinates*; [q₁, q̇₁, q₂, q̇₂] are the *physical* ones.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, finite, non_negative, positive, shown
from tsobs_ros.errors import ModelError

LINK_ANGLE, LINK_VELOCITY, MOTOR_ANGLE, MOTOR_VELOCITY = range(4)
"""Places of the four states, the same in both coordinates."""

QUANTITIES = ("link_angle", "link_velocity", "motor_angle", "motor_velocity")
"""Names of the quantities that a sensor can measure (rad, rad/s), in the order of the states."""

ANGLES = (QUANTITIES[LINK_ANGLE], QUANTITIES[MOTOR_ANGLE])
"""The quantities whose derivative is the next state."""

SIDES = ("motor", "link")
"""Where a torque may disturb an arm, in the order of the torques' states."""

MAX_DELAY = 20
"""Longest delay of a torque or an output, in periods."""

_REFERENCE_ACCELERATION = 10.0
"""Acceleration of both inertias under the reference torque of an arm without gravity [rad/s²]."""


@dataclass(frozen=True)
class ElasticJointArm:
    """Physical parameters of an arm with an elastic joint.

    Those that are left out are Example 3's, so state all of your own arm's, as a request file must.

    Attributes:
        link_inertia: J₁ [kg m²].
        motor_inertia: J₂ [kg m²].
        stiffness: Spring constant k of the joint [N m/rad].
        gravity_torque: mgl, the torque that holds the link horizontal [N m]; 0 for a vertical axis.
        link_damping: b₁ [N m s/rad].
        motor_damping: b₂ [N m s/rad].

    Raises:
        ModelError: An inertia or the stiffness is not a finite number above zero, or the gravity
            torque or a damping is negative.
    """

    link_inertia: float = 1.0
    motor_inertia: float = 2.0
    stiffness: float = 10.0
    gravity_torque: float = 10.0
    link_damping: float = 0.0
    motor_damping: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            may_be_zero = field.name.endswith(("damping", "gravity_torque"))
            check = non_negative if may_be_zero else positive
            object.__setattr__(self, field.name, check(field.name, getattr(self, field.name)))

    @property
    def gravity_gain(self) -> float:
        """mgl/J₁ [1/s²]: the link's angular acceleration by gravity when it is horizontal."""
        return self.gravity_torque / self.link_inertia

    @property
    def resonances(self) -> tuple[float, float]:
        """Frequencies of the link against a motor that is held, and against a free one [rad/s]."""
        held = self.stiffness / self.link_inertia
        return math.sqrt(held), math.sqrt(held + self.stiffness / self.motor_inertia)

    @property
    def modes(self) -> tuple[float, float]:
        """Frequencies at which the hanging arm swings by itself [rad/s].

        ω² are the zeros of ω⁴ − (k/J₁ + g + k/J₂) ω² + g k/J₂, with g = mgl/J₁.
        """
        motor, gravity = self.stiffness / self.motor_inertia, self.gravity_gain
        half = 0.5 * (self.stiffness / self.link_inertia + gravity + motor)
        root = math.sqrt(half * half - gravity * motor)
        return math.sqrt(half - root), math.sqrt(half + root)

    @property
    def reference_torque(self) -> float:
        """The typical size of the arm's torques [N m]: gravity's, or 10 rad/s² of both inertias."""
        inertia = self.link_inertia + self.motor_inertia
        return self.gravity_torque or _REFERENCE_ACCELERATION * inertia

    @cached_property
    def spring_matrix(self) -> Array:
        """State matrix without gravity, shape (4, 4): what the exact linear flow integrates."""
        j1, j2, k = self.link_inertia, self.motor_inertia, self.stiffness
        return as_matrix(
            "spring_matrix",
            [
                [0.0, 1.0, 0.0, 0.0],
                [-k / j1, -self.link_damping / j1, 1.0, 0.0],
                [0.0, 0.0, 0.0, 1.0],
                # Not k²/(J₁J₂), whose denominator underflows before the quotients overflow.
                [(k / j1) * (k / j2), 0.0, -k / j2, -self.motor_damping / j2],
            ],
            (4, 4),
        )

    @cached_property
    def input_matrix(self) -> Array:
        """Torque to state derivative, shape (4, 1)."""
        gain = self.stiffness / self.link_inertia / self.motor_inertia
        return as_matrix("input_matrix", [[0.0], [0.0], [0.0], [gain]], (4, 1))

    @cached_property
    def output_matrix(self) -> Array:
        """State to measured link angle, shape (1, 4)."""
        return self.measured(("link_angle",))

    def measured(self, outputs: Sequence[str], delays: Sequence[float] = ()) -> Array:
        """Return the matrix that maps the state to some of `QUANTITIES`, shape (p, 4).

        An angle q that is late by a delay [s] is approximated by q − delay q̇.

        Raises:
            ModelError: A name is unknown or listed twice, or a velocity is late.
        """
        rows, late = np.zeros((len(outputs), 4)), delays or (0.0,) * len(outputs)
        for place, (name, delay) in enumerate(zip(outputs, late, strict=True)):
            problem = ""
            if name not in QUANTITIES:
                problem = f": expected one of {', '.join(QUANTITIES)}, got {shown(name)}"
            elif name in outputs[:place]:
                problem = f": {name} is listed already, as outputs[{outputs.index(name)}]"
            elif delay and name not in ANGLES:
                problem = f".delay: expected 0 for {name}, as only angles can be late, got {delay}"
            if problem:
                raise ModelError(f"outputs[{place}]{problem}")
            state = QUANTITIES.index(name)
            rows[place, state] = self._physical_scale[state]
            if delay:
                rows[place, state + 1] = -delay * rows[place, state]
        return as_matrix("output_matrix", rows, rows.shape)

    @cached_property
    def _physical_scale(self) -> Array:
        shrink = self.link_inertia / self.stiffness
        return as_matrix("physical_scale", [1.0, 1.0, shrink, shrink], (4,))

    def to_physical(self, x: ArrayLike) -> Array:
        """Return [q₁, q̇₁, q₂, q̇₂] (rad, rad/s) for design coordinates of shape (..., 4)."""
        return np.asarray(x, dtype=np.float64) * self._physical_scale

    def from_physical(self, q: ArrayLike) -> Array:
        """Return design coordinates for [q₁, q̇₁, q₂, q̇₂] (rad, rad/s) of shape (..., 4)."""
        return np.asarray(q, dtype=np.float64) / self._physical_scale

    def slope_matrix(self, slope: float) -> Array:
        """Return the state matrix A(c), shape (4, 4), with gravity replaced by mgl·c·q₁.

        The slope c is a value of sin q₁/q₁ (a T–S rule) or of its derivative (an error system).
        """
        matrix = self.spring_matrix.copy()
        matrix[LINK_VELOCITY, LINK_ANGLE] -= self.gravity_gain * slope
        return matrix

    def derivative(self, x: ArrayLike, u: ArrayLike) -> Array:
        """Return ẋ for states of shape (..., 4) and motor torques of shape (..., 1) [N m]."""
        state = np.asarray(x, dtype=np.float64)
        rate = state @ self.spring_matrix.T + np.asarray(u, dtype=np.float64) @ self.input_matrix.T
        rate[..., LINK_VELOCITY] -= self.gravity_gain * np.sin(state[..., LINK_ANGLE])
        return np.asarray(rate)


@dataclass(frozen=True)
class TorquePath:
    """How the torque in messages and logs reaches the motor: gain · u(t − delay) + offset.

    Each torque u is held from its sample to the next one, and so is the torque at the motor. That
    torque is known as well as u is, so it moves truth and estimate alike. Errors, their bounds and
    the certificate do not depend on it.

    Attributes:
        gain: Torque at the motor per torque in messages, above 0 [-].
        offset: Torque at the motor at u = 0 [N m].
        delay: Time from the sample of a torque until it acts [s].

    Raises:
        ModelError: A number is not finite, or of the wrong sign.
    """

    OMIT_EMPTY: ClassVar[bool] = True
    """Zeros are left out of files."""

    gain: float = 1.0
    offset: float = 0.0
    delay: float = 0.0

    def __post_init__(self) -> None:
        for name, check in (("gain", positive), ("offset", finite), ("delay", non_negative)):
            object.__setattr__(self, name, check(name, getattr(self, name)))


DIRECT = TorquePath()
"""A path on which the torque in messages acts at the motor, unchanged and at once."""


def require_delay(name: str, delay: float, period: float) -> None:
    """Raise `ModelError` for a delay of more than `MAX_DELAY` periods."""
    longest = MAX_DELAY * period
    if delay > longest * (1.0 + 1e-9):
        raise ModelError(
            f"{name}: expected at most {MAX_DELAY} periods, {longest:.4g} s, got {delay!r} s"
        )
