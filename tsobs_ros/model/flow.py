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

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, non_negative, positive
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import (
    LINK_ANGLE,
    LINK_VELOCITY,
    MOTOR_VELOCITY,
    QUANTITIES,
    SIDES,
    ElasticJointArm,
)
from tsobs_ros.model.disturbance import DisturbanceModel
from tsobs_ros.model.linear_flow import LinearFlow
from tsobs_ros.model.matrices import block_diagonal
from tsobs_ros.model.prediction import Flow, Transition
from tsobs_ros.model.torque_path import DIRECT, TorquePath
from tsobs_ros.model.uncertainty import EXTERNAL, SINE, TORQUE, Uncertainty
from tsobs_ros.model.vertices import (
    KickCorner,
    VertexSystem,
    describe,
    kick_corners,
    linear_directions,
)


@dataclass(frozen=True)
class ProcessNoise:
    """White angular-acceleration noise of the arm, in physical units.

    Attributes:
        link: Density on the link's acceleration [rad²/s³].
        motor: Density on the motor's acceleration [rad²/s³].
    """

    link: float = 1e-4
    motor: float = 1e-5

    def __post_init__(self) -> None:
        for name in ("link", "motor"):
            density = non_negative(f"process noise density of the {name}", getattr(self, name))
            object.__setattr__(self, name, density)


class ArmFlow(Flow):
    """Predicts the augmented state of one arm (or of a batch of equal arms).

    Attributes:
        arm: The physical model.
        disturbance: The exosystem of the outputs' disturbances, one channel per output.
        process_noise: Densities of the arm's acceleration noise.
        period: Nominal step [s]; longer steps are taken in nominal ones and a last one.
        outputs: What is measured, names of `QUANTITIES`.
        torque_disturbance: The exosystem of torques at motor and link [N m], two channels; None if
            the arm has the known torque only.
        torque_path: How the known torque reaches the motor.
        delays: Delay of each output, an angle q(t − delay) ≈ q − delay q̇ [s]; () if there is none.
        linear: The flow without gravity.
        motor_torque: Augmented state to the unknown torque at the motor [N m], shape (n,).
        link_torque: Augmented state to the unknown torque at the link [N m], shape (n,).

    Raises:
        ModelError: An output is unknown or listed twice, or a disturbance has another number of
            channels.
    """

    kind, plant_count, input_count = native.KIND_ARM, 4, 1
    directions = (1, 4, EXTERNAL + 1)

    def __init__(
        self,
        arm: ElasticJointArm,
        disturbance: DisturbanceModel,
        process_noise: ProcessNoise,
        period: float,
        outputs: Sequence[str] = (QUANTITIES[LINK_ANGLE],),
        torque_disturbance: DisturbanceModel | None = None,
        torque_path: TorquePath = DIRECT,
        delays: Sequence[float] = (),
    ) -> None:
        self.arm, self.disturbance, self.process_noise = arm, disturbance, process_noise
        self.period, self.outputs = positive("period", period), tuple(outputs)
        self.torque_disturbance = torque_disturbance
        self.torque_path = torque_path
        measured = self._placed(arm.measured(self.outputs, delays), 0)
        _require_channels("disturbance", disturbance, self.outputs)
        torques = np.zeros((2, 0))
        if torque_disturbance is not None:
            _require_channels("torque_disturbance", torque_disturbance, SIDES)
            torques = torque_disturbance.H
        self.output_matrix = as_matrix("C̄", measured + self.disturbance_map, measured.shape)
        own = 4 + disturbance.state_count
        self.motor_torque, self.link_torque = self._placed(torques, own)
        models = [disturbance] if torque_disturbance is None else [disturbance, torque_disturbance]
        drift = block_diagonal(arm.spring_matrix, *(model.S for model in models))
        drift[MOTOR_VELOCITY, own:] = arm.input_matrix[MOTOR_VELOCITY] * torques[0]
        drift[LINK_VELOCITY, own:] = torques[1] / arm.link_inertia
        known = np.zeros((self.state_count, 1))
        known[:4] = arm.input_matrix
        scale = arm.stiffness / arm.link_inertia
        white = np.diag([0.0, process_noise.link, 0.0, process_noise.motor * (scale * scale)])
        density = block_diagonal(white, *(model.noise_density for model in models))
        self._drift = drift
        self.linear = LinearFlow(drift, known, np.asarray(density), self.period)

    def slope_matrix(self, slope: float) -> Array:
        """Return the continuous augmented matrix with gravity slope c, shape (n, n)."""
        matrix = self._drift.copy()
        matrix[:4, :4] = self.arm.slope_matrix(slope)
        return matrix

    def to_physical(self, x: ArrayLike) -> Array:
        """Return [q₁, q̇₁, q₂, q̇₂] (rad, rad/s) of augmented states of shape (..., n)."""
        return self.arm.to_physical(super().to_physical(x))

    def transition(self, duration: float) -> Transition:
        """Return the linear flow over `duration` [s]."""
        half_kick = 0.5 * duration * self.arm.gravity_gain
        return Transition(duration, *self.linear.over(duration), half_kick)

    def numbers(self, uncertainty: Uncertainty | None) -> Mapping[str, Any]:
        """Return what only arms have in their record; see `Flow.numbers`."""
        numbers: dict[str, Any] = {
            "gravity_gain": self.arm.gravity_gain,
            "motor_torque": self.motor_torque,
            "link_torque": self.link_torque,
            "has_unknown": int(self.motor_torque.any() or self.link_torque.any()),
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
            slope_min: Smallest cosine of the domain.
            slope_max: Largest cosine of the domain.
            uncertainty: Parameters whose errors are to be covered in both half kicks.
            share: How much of their bounds.
        """
        step = self.nominal
        bounds = [] if uncertainty is None else [share * b for b in uncertainty.limits.tolist()]
        has_gravity = self.arm.gravity_torque > 0.0
        slopes = (slope_min, slope_max) if has_gravity else (0.0,)
        corners = list(kick_corners(slopes, uncertainty, bounds))
        kicks = [self._kick_matrix(corner, uncertainty) for corner in corners]
        systems = []
        for first, before in zip(corners, kicks, strict=True):
            for second, after in zip(corners, kicks, strict=True):
                noise = after @ step.noise @ after.T
                where = describe(first, second, uncertainty, has_gravity)
                transition, slopes = after @ step.phi @ before, (first.slope, second.slope)
                systems.append(VertexSystem(transition, (noise + noise.T) / 2, where, slopes))
        return systems

    def _kick_matrix(self, corner: KickCorner[float], uncertainty: Uncertainty | None) -> Array:
        """Return the Jacobian of half a kick at one corner, shape (n, n)."""
        matrix = np.eye(self.state_count)
        if uncertainty is not None:
            change = uncertainty.directions[linear_directions(uncertainty), 0]
            sum_of_changes = 0.5 * self.period * np.tensordot(corner.theta, change, 1)
            matrix[:4, :4] += sum_of_changes[:, :4]
            # Unknown torques meet what known ones do.
            for column, torque in ((TORQUE, self.motor_torque), (EXTERNAL, self.link_torque)):
                matrix[:4] += np.outer(sum_of_changes[:, column], torque)
        matrix[LINK_VELOCITY, LINK_ANGLE] -= self.nominal.half_kick * corner.slope
        return matrix


def _require_channels(name: str, model: DisturbanceModel, channels: Sequence[str]) -> None:
    if model.channel_count != len(channels):
        raise ModelError(
            f"{name}: expected {len(channels)} channels, those of {', '.join(channels)}, "
            f"got {model.channel_count}"
        )


def slope_range(x_max: float) -> tuple[float, float]:
    """Return the smallest and largest cosine on |q₁| ≤ x_max [rad], x_max at most π."""
    return math.cos(min(x_max, math.pi)), 1.0
