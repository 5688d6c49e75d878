# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Directions in which the arm's parameters may differ from the nominal ones, by physical name.

Each direction adds θ·a(x, u) to the accelerations of link and motor, with a linear in the state,
in sin x₁ and in the torque: ΔAᵢ = Σ θ_k E_{i,k} in T–S form.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tsobs_ros.checks import Array, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import LINK_ANGLE, LINK_VELOCITY, MOTOR_VELOCITY, ElasticJointArm

VELOCITY_ROWS = (LINK_VELOCITY, MOTOR_VELOCITY)
"""Every direction acts on these rows of the state derivative only."""


def _stiffness(arm: ElasticJointArm) -> tuple[Array, Array, Array]:
    linear = np.zeros((2, 4))
    linear[0, 0], linear[0, 2] = -arm.stiffness / arm.link_inertia, 1.0
    linear[1] = -arm.stiffness / arm.motor_inertia * linear[0]
    return linear, np.zeros(2), np.zeros(2)


def _gravity(arm: ElasticJointArm) -> tuple[Array, Array, Array]:
    return np.zeros((2, 4)), np.array([-arm.gravity_gain, 0.0]), np.zeros(2)


def _link_damping(arm: ElasticJointArm) -> tuple[Array, Array, Array]:
    linear = np.zeros((2, 4))
    linear[0, 1] = -1.0 / arm.link_inertia
    return linear, np.zeros(2), np.zeros(2)


def _motor_damping(arm: ElasticJointArm) -> tuple[Array, Array, Array]:
    linear = np.zeros((2, 4))
    linear[1, 3] = -1.0 / arm.motor_inertia
    return linear, np.zeros(2), np.zeros(2)


def _link_inverse_inertia(arm: ElasticJointArm) -> tuple[Array, Array, Array]:
    linear = np.zeros((2, 4))
    linear[0] = arm.spring_matrix[LINK_VELOCITY]
    return linear, np.array([-arm.gravity_gain, 0.0]), np.zeros(2)


def _motor_inverse_inertia(arm: ElasticJointArm) -> tuple[Array, Array, Array]:
    linear = np.zeros((2, 4))
    linear[1] = arm.spring_matrix[MOTOR_VELOCITY]
    return linear, np.zeros(2), np.array([0.0, arm.input_matrix[MOTOR_VELOCITY, 0]])


DIRECTIONS = {
    "stiffness": _stiffness,
    "gravity": _gravity,
    "link_damping": _link_damping,
    "motor_damping": _motor_damping,
    "link_inverse_inertia": _link_inverse_inertia,
    "motor_inverse_inertia": _motor_inverse_inertia,
}
"""Relative change of k, of mgl, of 1/J₁, of 1/J₂; added damping in N m s/rad."""


@dataclass(frozen=True)
class ArmUncertainty:
    """What is uncertain about an arm, and by how much at most.

    Attributes:
        arm: The nominal arm.
        bounds: |θ| at most so much, by name of the direction; relative, or N m s/rad.

    Raises:
        ModelError: A name is unknown or a bound is not above zero.
    """

    arm: ElasticJointArm
    bounds: Mapping[str, float]

    def __post_init__(self) -> None:
        for name, bound in self.bounds.items():
            if name not in DIRECTIONS:
                raise ModelError(
                    f"uncertain parameter: expected one of {', '.join(DIRECTIONS)}, got {name!r}"
                )
            positive(f"bound of uncertain parameter {name}", bound)

    @property
    def names(self) -> tuple[str, ...]:
        """The directions, in the order of θ."""
        return tuple(self.bounds)

    @property
    def count(self) -> int:
        """Number k of uncertain parameters."""
        return len(self.bounds)

    @cached_property
    def limits(self) -> Array:
        """Bound of each |θ|, shape (k,)."""
        return np.array([float(bound) for bound in self.bounds.values()])

    @cached_property
    def linear(self) -> Array:
        """State to accelerations of link and motor for θ = 1, shape (k, 2, 4)."""
        return self._stack(0, (2, 4))

    @cached_property
    def sine(self) -> Array:
        """sin x₁ to accelerations, shape (k, 2)."""
        return self._stack(1, (2,))

    @cached_property
    def torque(self) -> Array:
        """Torque to accelerations, shape (k, 2)."""
        return self._stack(2, (2,))

    def regressor(self, x: Array, u: float) -> Array:
        """Return the accelerations a(x, u) for θ = 1, one row a velocity: shape (2, k).

        Args:
            x: State in design coordinates; entries after the fourth are not used.
            u: Torque [N m].
        """
        linear, sine, torque = self._by_row
        flat = linear @ x[:4] + sine * math.sin(x[LINK_ANGLE]) + torque * u
        return np.asarray(flat.reshape(2, -1))

    def jacobian(self, x: Array, theta: Array) -> Array:
        """Return d(accelerations)/dx for given θ, shape (2, 4)."""
        rows = (theta @ self.linear.reshape(-1, 8)).reshape(2, 4)
        rows[:, LINK_ANGLE] += theta @ self.sine * math.cos(x[LINK_ANGLE])
        return np.asarray(rows)

    @cached_property
    def _by_row(self) -> tuple[Array, Array, Array]:
        """Linear, sine and torque parts, the link's row of each θ first, then the motor's."""
        linear = np.ascontiguousarray(np.swapaxes(self.linear, 0, 1)).reshape(-1, 4)
        return linear, self.sine.T.ravel(), self.torque.T.ravel()

    def arm_with(self, theta: Sequence[float]) -> ElasticJointArm:
        """Return the physical arm that θ describes, for people to read.

        Raises:
            ModelError: θ describes an impossible arm, such as one of negative stiffness.
        """
        change = dict(zip(self.names, theta, strict=True))
        arm = self.arm
        link = 1.0 / (1.0 + change.get("link_inverse_inertia", 0.0))
        motor = 1.0 / (1.0 + change.get("motor_inverse_inertia", 0.0))
        return ElasticJointArm(
            link_inertia=arm.link_inertia * link,
            motor_inertia=arm.motor_inertia * motor,
            stiffness=arm.stiffness * (1.0 + change.get("stiffness", 0.0)),
            gravity_torque=arm.gravity_torque * (1.0 + change.get("gravity", 0.0)),
            link_damping=arm.link_damping + change.get("link_damping", 0.0),
            motor_damping=arm.motor_damping + change.get("motor_damping", 0.0),
        )

    def _stack(self, part: int, shape: tuple[int, ...]) -> Array:
        parts = [DIRECTIONS[name](self.arm)[part] for name in self.bounds]
        return np.array(parts, dtype=np.float64).reshape(len(parts), *shape)
