# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One-step prediction of the arm with its disturbance model, and of its error covariance.

The augmented state is x̄ = [x; w; w_d]: the arm in design coordinates, then the states of the
outputs' disturbances, then those of torques that disturb motor and link, which the linear flow
takes in: the motor's row by 1/J₂, the link's by 1/J₁.
A step is a half gravity kick, the exact linear flow with the torque held, and a half kick:

    x₂ −= (T/2)(mgl/J₁) sin x₁;   x̄ ← Φ(T) x̄ + Γ(T) u;   x₂ −= (T/2)(mgl/J₁) sin x₁

It is symmetric, of second order in the gravity term alone, and its error map is *bi-affine* in
two slopes: sin x₁ − sin x̂₁ = c (x₁ − x̂₁) with c between the smallest and the largest cosine of
the domain (mean value theorem), so four vertices describe every error system exactly, whatever
the estimate that serves as premise.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, non_negative
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
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
from tsobs_ros.model.prediction import NO_TORQUES, Flow, VertexSystem
from tsobs_ros.model.uncertainty import EXTERNAL, SINE, TORQUE, Uncertainty


@dataclass(frozen=True)
class ProcessNoise:
    """Densities of white noise on the accelerations of link and motor [rad²/s³]."""

    link: float = 1e-4
    motor: float = 1e-5

    def __post_init__(self) -> None:
        for name in ("link", "motor"):
            density = non_negative(f"process noise density of the {name}", getattr(self, name))
            object.__setattr__(self, name, density)


def kick_corners(
    slopes: Sequence[Any], uncertainty: Uncertainty | None, bounds: Sequence[Any] = ()
) -> Iterator[tuple[Any, tuple[Any, ...]]]:
    """Yield the corners of half a kick; of those on one line only its two ends.

    Half a kick multiplies the error by I + (T/2)(Σ θ_k ∂a_k/∂x − c mgl/J₁ e₂e₁ᵀ), which is affine
    in the slope c and in each parameter θ_k on its own (gravity's θ multiplies the slope). So over
    a box of parameters it is a convex combination of its values at the corners. Floats and
    fractions go through the same formula: an exact proof needs exact corners.

    Args:
        slopes: Smallest and largest cosine of the domain; any single number without gravity.
        uncertainty: The uncertain parameters, if any are to be covered, up to their bounds.

    Yields:
        The slope c, that of uncertain gravity and inertia included, and θ of every direction that
        acts on the state linearly.
    """
    linear, pulls = [], []
    if uncertainty is not None:
        linear = uncertainty.linear_places
        # A direction that scales gravity adds θ c to the slope; none kicks the motor by it.
        pulls = [bool(each.any()) for each in uncertainty.directions[..., SINE]]
    free = [bounds[k] for k, pulled in enumerate(pulls) if pulled and k not in linear]
    for signs in product((-1, 1), repeat=len(linear)):
        theta = tuple(sign * bounds[k] for sign, k in zip(signs, linear, strict=True))
        pull = 1 + sum(value for value, k in zip(theta, linear, strict=True) if pulls[k])
        ends = [
            slope * (pull + sum(sign * bound for sign, bound in zip(turn, free, strict=True)))
            for slope in slopes
            for turn in product((-1, 1), repeat=len(free))
        ]
        yield min(ends), theta
        if len(ends) > 1:
            yield max(ends), theta


class ArmFlow(Flow):
    """Predicts the augmented state of one arm (or of a batch of equal arms).

    Args:
        arm: The physical model.
        disturbance: The exosystem of the outputs' disturbances, one channel per output.
        process_noise: Densities of the arm's acceleration noise.
        period: Nominal step [s].
        outputs: What is measured, names of `QUANTITIES`.
        torque_disturbance: The exosystem of unknown torques at motor and link [N m].
        torque_path: How the known torque reaches the motor.
        delays: Delay of each output, an angle q(t − delay) ≈ q − delay q̇ [s]; () if there is none.

    Attributes:
        motor_torque: Augmented state to the unknown torque at the motor [N m], shape (n,).
        link_torque: Augmented state to the unknown torque at the link [N m], shape (n,).

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
        torque_disturbance: DisturbanceModel = NO_TORQUES,
        torque_path: TorquePath = DIRECT,
        delays: Sequence[float] = (),
    ) -> None:
        torques = torque_disturbance.H
        if len(torques) != len(SIDES):
            raise ModelError(
                f"torque_disturbance: expected 2 channels, those of {' and '.join(SIDES)}, "
                f"got {len(torques)}"
            )
        self.arm, self.gravity_gain, self.torque_path = arm, arm.gravity_gain, torque_path
        effect = np.zeros((4, torque_disturbance.state_count))
        effect[MOTOR_VELOCITY] = arm.input_matrix[MOTOR_VELOCITY] * torques[0]
        effect[LINK_VELOCITY] = torques[1] / arm.link_inertia
        scale = arm.stiffness / arm.link_inertia
        super().__init__(
            (arm.spring_matrix, arm.input_matrix, arm.measured(outputs, delays)),
            np.array([0.0, process_noise.link, 0.0, process_noise.motor * (scale * scale)]),
            disturbance,
            period,
            torque_disturbance,
            effect,
        )
        self.motor_torque, self.link_torque = self._placed(torques, 4 + disturbance.state_count)

    def to_physical(self, x: ArrayLike) -> Array:
        return self.arm.to_physical(super().to_physical(x))

    def numbers(self, uncertainty: Uncertainty | None) -> Mapping[str, Any]:
        numbers: dict[str, Any] = {
            "gravity_gain": self.gravity_gain,
            "motor_torque": self.motor_torque,
            "link_torque": self.link_torque,
        }
        if uncertainty is not None and uncertainty.count:
            rows = uncertainty.directions[:, 0, [LINK_VELOCITY, MOTOR_VELOCITY]]
            columns = (rows[..., place] for place in (SINE, TORQUE, EXTERNAL))
            numbers["effects"] = np.hstack([rows[..., :4].reshape(-1, 8), *columns])
        return numbers

    def vertices(
        self,
        slope_min: float,
        slope_max: float,
        uncertainty: Uncertainty | None = None,
        share: float = 1.0,
    ) -> list[VertexSystem]:
        """Return the vertex error systems of a nominal step: of known parameters four with gravity
        and one without.

        Args:
            slope_min: Smallest cosine of the domain; `slope_max` is the largest.
            uncertainty: Parameters whose errors are to be covered in both half kicks, up to a
                share of their bounds.
        """
        step, bounds, names = self.nominal, [], []
        if uncertainty is not None:
            bounds = [share * bound for bound in uncertainty.limits.tolist()]
            names = [uncertainty.names[k] for k in uncertainty.linear_places]
        slopes = (slope_min, slope_max) if self.arm.gravity_torque else (0.0,)
        corners = [
            (corner, self._kick_matrix(*corner, uncertainty))
            for corner in kick_corners(slopes, uncertainty, bounds)
        ]
        systems = []
        for (first, before), (second, after) in product(corners, repeat=2):
            noise, kicks = after @ step.noise @ after.T, (first[0], second[0])
            words = ["slopes ({:.4g}, {:.4g})".format(*kicks)]
            words = words if self.arm.gravity_torque else ["no gravity"]
            pairs = zip(names, first[1], second[1], strict=True)
            words += [f"{name} ({one:.4g}, {other:.4g})" for name, one, other in pairs]
            transition, noise = after @ step.phi @ before, (noise + noise.T) / 2
            systems.append(VertexSystem(transition, noise, ", ".join(words), kicks))
        return systems

    def _kick_matrix(
        self, slope: float, theta: tuple[float, ...], uncertainty: Uncertainty | None
    ) -> Array:
        """Return the Jacobian of half a kick at one corner, shape (n, n)."""
        matrix = np.eye(self.state_count)
        if uncertainty is not None:
            change = uncertainty.directions[uncertainty.linear_places, 0]
            sum_of_changes = 0.5 * self.period * np.tensordot(theta, change, 1)
            matrix[:4, :4] += sum_of_changes[:, :4]
            # Unknown torques meet what known ones do.
            for column, torque in ((TORQUE, self.motor_torque), (EXTERNAL, self.link_torque)):
                matrix[:4] += np.outer(sum_of_changes[:, column], torque)
        matrix[LINK_VELOCITY, LINK_ANGLE] -= self.nominal.half_kick * slope
        return matrix
