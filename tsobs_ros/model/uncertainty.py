# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bounded uncertainty of a model's parameters, for the arm and for any T–S system.

With parameters θ the state's derivative is ẋ(θ) = ẋ(0) + Σ_k θ_k Σᵢ hᵢ E_{k,i} s. The signals s are
those that the derivative is linear in: [x; u] of a T–S system, and [x; sin x₁; u; d] of the arm, d
being a torque at the link. The arm is a single rule of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tsobs_ros.checks import Array, Fixed, as_matrix, check_names, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import LINK_VELOCITY, MOTOR_VELOCITY, ElasticJointArm
from tsobs_ros.model.ts_model import TSModel

SINE, TORQUE, EXTERNAL = 4, 5, 6
"""Columns of the arm's directions that sin x₁, the motor's torque and one at the link [N m] meet;
before them is the state."""

ARM_DIRECTIONS = (
    "stiffness",
    "gravity",
    "link_damping",
    "motor_damping",
    "link_inverse_inertia",
    "motor_inverse_inertia",
)
"""The arm's uncertain parameters: relative changes of k, of mgl, of 1/J₁ and of 1/J₂, and added
damping [N m s/rad]."""

_MAX_DIRECTIONS = 3
"""Uncertain directions of a proof beside gravity: k of them make 4·4^k vertices."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertain parameters θ of a model with n states and r rules.

    Attributes:
        bounds: |θ| at most so much, by name; their order is that of θ.
        directions: E_{k,i}, shape (k, r, n, c) for c signals, of which the state is the first n.

    Raises:
        ModelError: A bound is not above zero, or a direction is missing or not finite.
    """

    bounds: Mapping[str, float]
    directions: Array

    def __post_init__(self) -> None:
        for name, bound in self.bounds.items():
            positive(f"uncertainty.{name}", bound)
        object.__setattr__(self, "bounds", Fixed(self.bounds))
        shape = (len(self.bounds), *np.shape(self.directions)[1:])
        object.__setattr__(self, "directions", as_matrix("directions", self.directions, shape))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of θ."""
        return tuple(self.bounds)

    @property
    def count(self) -> int:
        """Number k of uncertain parameters."""
        return len(self.bounds)

    @cached_property
    def limits(self) -> Array:
        """Bound of each |θ|, shape (k,)."""
        return np.array([float(bound) for bound in self.bounds.values()])

    @property
    def linear(self) -> Array:
        """The part of the directions that meets the state, shape (k, r, n, n)."""
        return self.directions[..., : self.directions.shape[2]]

    @property
    def linear_places(self) -> list[int]:
        """Places of the directions that act on the state linearly, all but gravity's.

        Raises `ModelError` if they are too many for a proof by vertices.
        """
        places = [k for k in range(self.count) if self.linear[k].any()]
        if len(places) > _MAX_DIRECTIONS:
            raise ModelError(
                f"certify_uncertainty: expected at most {_MAX_DIRECTIONS} uncertain parameters "
                f"beside gravity, got {', '.join(self.names[k] for k in places)}"
            )
        return places


@np.errstate(over="ignore")  # what is not finite is refused by name
def arm_uncertainty(arm: ElasticJointArm, bounds: Mapping[str, float]) -> Uncertainty:
    """Return the uncertainty of an arm's physical parameters, bounds by `ARM_DIRECTIONS`.

    Raises:
        ModelError: A name is unknown or a bound is not above zero.

    >>> arm_uncertainty(ElasticJointArm(), {"stiffness": 0.2}).names
    ('stiffness',)
    """
    check_names("uncertainty", bounds, ARM_DIRECTIONS)
    link, motor = LINK_VELOCITY, MOTOR_VELOCITY
    found = {name: np.zeros((1, 4, EXTERNAL + 1)) for name in ARM_DIRECTIONS}
    (stiffness,), (gravity,) = found["stiffness"], found["gravity"]
    stiffness[link, [0, 2]] = -arm.stiffness / arm.link_inertia, 1.0
    stiffness[motor, :4] = -arm.stiffness / arm.motor_inertia * stiffness[link, :4]
    gravity[link, SINE] = -arm.gravity_gain
    found["link_damping"][0, link, link] = -1.0 / arm.link_inertia
    found["motor_damping"][0, motor, motor] = -1.0 / arm.motor_inertia
    of_link = found["link_inverse_inertia"][0, link]
    of_link[:4], of_link[SINE] = arm.spring_matrix[link], -arm.gravity_gain
    of_link[EXTERNAL] = 1.0 / arm.link_inertia
    of_motor = found["motor_inverse_inertia"][0, motor]
    of_motor[:4], of_motor[TORQUE] = arm.spring_matrix[motor], arm.input_matrix[motor, 0]
    stack = np.reshape([found[name] for name in bounds], (len(bounds), 1, 4, EXTERNAL + 1))
    return Uncertainty(bounds, stack)


@dataclass(frozen=True, eq=False)
class Direction:
    """An uncertain direction of a T–S system's state matrices, Aᵢ + θ Eᵢ with |θ| ≤ bound.

    Attributes:
        E: Eᵢ, shape (r, n, n); one (n, n) serves every rule.
        bound: Of |θ|.
    """

    E: Array
    bound: float


def system_uncertainty(model: TSModel, directions: Mapping[str, Direction]) -> Uncertainty:
    """Return the uncertainty of a T–S system's state matrices, uncertain directions by name.

    Raises:
        ModelError: A direction is zero or of the wrong shape, or a bound is not above zero.
    """
    rules, n = model.rule_count, model.state_count
    stack = np.zeros((len(directions), rules, n, n + model.input_count))
    for (name, each), placed in zip(directions.items(), stack, strict=True):
        shape = (n, n) if np.ndim(each.E) == 2 else (rules, n, n)
        positive(f"uncertainty.{name}.bound", each.bound)
        matrix = as_matrix(f"uncertainty.{name}.E", each.E, shape)
        if not matrix.any():
            raise ModelError(f"uncertainty.{name}.E: expected a matrix other than zero")
        placed[..., :n] = matrix
    return Uncertainty({name: each.bound for name, each in directions.items()}, stack)
