# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One-step prediction of the arm with its disturbance model, and of its error covariance.

The augmented state is x̄ = [x; w; w_d]: the arm in design coordinates, then the states of the
outputs' disturbances, then those of torques that disturb motor and link. These torques are part of
the linear flow: they enter the motor's row by 1/J₂ and the link's row by 1/J₁.
A step is a half gravity kick, the exact linear flow with the torque held, and a half kick:

    x₂ −= (T/2)(mgl/J₁) sin x₁;   x̄ ← Φ(T) x̄ + Γ(T) u;   x₂ −= (T/2)(mgl/J₁) sin x₁

It is symmetric and of second order; only the gravity term is inexact. Its error map is *bi-affine*
in two slopes: sin x₁ − sin x̂₁ = c (x₁ − x̂₁) with c between the smallest and the largest cosine of
the domain (mean value theorem). So four vertices describe every error system exactly, for any
estimate as the premise.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, check_names, non_negative
from tsobs_ros.core import native
from tsobs_ros.model.arm import (
    DIRECT,
    LINK_ANGLE,
    LINK_VELOCITY,
    MOTOR_VELOCITY,
    QUANTITIES,
    SIDES,
    ElasticJointArm,
    TorquePath,
)
from tsobs_ros.model.disturbance import DisturbanceModel
from tsobs_ros.model.prediction import Corner, Flow, Uncertainty

SINE, TORQUE, EXTERNAL, COMMAND = 4, 5, 6, 7
"""Columns of the arm's directions for sin x₁, the motor's torque, a torque at the link, and the
commanded part of the motor's torque [N m]; the columns before them are those of the state."""

ARM_DIRECTIONS = (
    "stiffness",
    "gravity",
    "link_damping",
    "motor_damping",
    "link_inverse_inertia",
    "motor_inverse_inertia",
    "torque_gain",
)
"""The arm's uncertain parameters: relative changes of k, of mgl, of 1/J₁, of 1/J₂ and of the torque
that commands make at the motor, and added damping [N m s/rad].

Each changes the accelerations by itself, and all of these changes add up."""


@dataclass(frozen=True)
class ProcessNoise:
    """Densities of white noise on the accelerations of link and motor [rad²/s³]."""

    link: float = 1e-4
    motor: float = 1e-5

    def __post_init__(self) -> None:
        for name in ("link", "motor"):
            density = non_negative(f"process noise density of the {name}", getattr(self, name))
            object.__setattr__(self, name, density)


@np.errstate(over="ignore")  # `Uncertainty` refuses entries that are not finite
def arm_uncertainty(arm: ElasticJointArm, bounds: Mapping[str, float]) -> Uncertainty:
    """Return the uncertainty of an arm's physical parameters, with bounds by `ARM_DIRECTIONS`.

    Raises:
        ModelError: A name is unknown or a bound is not above zero.

    >>> arm_uncertainty(ElasticJointArm(), {"stiffness": 0.2}).names
    ('stiffness',)
    """
    check_names("uncertainty", bounds, ARM_DIRECTIONS)
    link, motor = LINK_VELOCITY, MOTOR_VELOCITY
    found = {name: np.zeros((1, 4, COMMAND + 1)) for name in ARM_DIRECTIONS}
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
    found["torque_gain"][0, motor, COMMAND] = arm.input_matrix[motor, 0]
    stack = np.reshape([found[name] for name in bounds], (len(bounds), 1, 4, COMMAND + 1))
    return Uncertainty(tuple(bounds), np.array([*bounds.values()], np.float64), stack)


class ArmFlow(Flow):
    """Predicts the augmented state of one arm (or of a batch of equal arms).

    Args:
        arm: The physical model.
        disturbance: The exosystem of the outputs' disturbances, one channel per output, and of
            unknown torques at motor and link [N m], if any.
        process_noise: Densities of the arm's acceleration noise.
        period: Nominal step [s].
        outputs: The measured quantities, names from `QUANTITIES`.
        torque_path: How the known torque reaches the motor.
        delays: Delay of each output, an angle q(t − delay) ≈ q − delay q̇ [s]; () if there is none.

    Raises:
        ModelError: An output is unknown or listed twice, or a disturbance has another number of
            channels.
    """

    kind = native.KIND_ARM

    def __init__(
        self,
        arm: ElasticJointArm,
        disturbance: DisturbanceModel,
        process_noise: ProcessNoise,
        period: float,
        outputs: Sequence[str] = (QUANTITIES[LINK_ANGLE],),
        torque_path: TorquePath = DIRECT,
        delays: Sequence[float] = (),
    ) -> None:
        self.arm, self.gravity_gain, self.torque_path = arm, arm.gravity_gain, torque_path
        if len(disturbance.H) == len(outputs):
            no_torques = np.zeros((len(SIDES), disturbance.state_count))
            disturbance = replace(disturbance, H=np.vstack([disturbance.H, no_torques]))
        at_link = np.zeros((4, 1))
        at_link[LINK_VELOCITY] = 1.0 / arm.link_inertia
        scale = arm.stiffness / arm.link_inertia
        super().__init__(
            (arm.spring_matrix, arm.input_matrix, arm.measured(outputs, delays)),
            np.array([0.0, process_noise.link, 0.0, process_noise.motor * (scale * scale)]),
            disturbance,
            period,
            np.hstack([arm.input_matrix, at_link]),
        )

    def to_physical(self, x: ArrayLike) -> Array:
        return self.arm.to_physical(super().to_physical(x))

    def numbers(self, uncertainty: Uncertainty | None) -> Mapping[str, Any]:
        torques = dict(zip(("motor_torque", "link_torque"), self.torques, strict=True))
        numbers: dict[str, Any] = {"gravity_gain": self.gravity_gain, **torques}
        if uncertainty is not None and uncertainty.count:
            rows = uncertainty.directions[:, 0, [LINK_VELOCITY, MOTOR_VELOCITY]]
            numbers["effects"] = rows.reshape(-1, COMMAND + 1)
        return numbers

    def error_map(self, first: Array, second: Array) -> tuple[Array, Array]:
        noise = second @ self.nominal.noise @ second.T
        return second @ self.nominal.phi @ first, (noise + noise.T) / 2

    def corners(
        self,
        slopes: tuple[Any, Any],
        uncertainty: Uncertainty,
        share: float,
        half_step: Any,
        number: Callable[[Any], Any] = np.asarray,
    ) -> Iterator[Corner]:
        """Yield the error map of a half kick at the corners; of corners on one line, the two ends.

        The map is I + (T/2)(Σ θ_k ∂a_k/∂x − c mgl/J₁ e₂e₁ᵀ). It is affine in the slope c and in
        each parameter θ_k by itself (gravity's θ multiplies the slope). So over a box of parameters
        it is a convex combination of its corner values. Unknown torques enter like known ones.
        Floats and fractions use the same formula, since an exact proof needs exact corners.

        Args:
            slopes: Smallest and largest cosine of the domain; not used without gravity.
            uncertainty: The uncertain parameters that are covered.
            share: The covered share of their bounds.
            half_step: T/2 [s].
            number: Converts an array of floats to an array of the numbers in use.
        """
        places = uncertainty.linear_places
        changes = number(uncertainty.directions[places, 0])
        bounds = [share * bound for bound in number(uncertainty.limits)]
        # A direction that scales gravity adds θ c to the slope; gravity does not act on the motor.
        pulls = [bool(each.any()) for each in uncertainty.directions[..., SINE]]
        free = [bounds[k] for k, pulled in enumerate(pulls) if pulled and k not in places]
        for signs in itertools.product((-1, 1), repeat=len(places)):
            theta = [sign * bounds[k] for sign, k in zip(signs, places, strict=True)]
            matrix = number(np.eye(self.state_count))
            if theta:
                change = half_step * np.tensordot(theta, changes, 1)
                matrix[:4, :4] += change[:, :4]
                for column, torque in zip((TORQUE, EXTERNAL), self.torques, strict=True):
                    matrix[:4] += np.outer(change[:, column], number(torque))
            names = [uncertainty.names[k] for k in places]
            at = {name: f"{float(each):.4g}" for name, each in zip(names, theta, strict=True)}
            if not self.gravity_gain:
                yield Corner({"no gravity": "", **at}, matrix)
                continue
            pull = 1 + sum(each for each, k in zip(theta, places, strict=True) if pulls[k])
            ends = [
                slope * (pull + sum(sign * bound for sign, bound in zip(turn, free, strict=True)))
                for slope in slopes
                for turn in itertools.product((-1, 1), repeat=len(free))
            ]
            for slope in (min(ends), max(ends)):
                kick = matrix.copy()
                kick[LINK_VELOCITY, LINK_ANGLE] -= half_step * number(self.gravity_gain) * slope
                yield Corner({"slopes": f"{float(slope):.4g}", **at}, kick)
