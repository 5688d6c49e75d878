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
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

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
from tsobs_ros.model.prediction import Flow, fill_common, fill_matrix, require_directions
from tsobs_ros.model.uncertainty import EXTERNAL, SINE, TORQUE, Uncertainty
from tsobs_ros.model.vertices import (
    KickCorner,
    VertexSystem,
    describe,
    kick_corners,
    linear_directions,
)


class Transition(NamedTuple):
    """The linear flow over one step.

    Attributes:
        duration: T [s].
        phi: State transition Φ(T), shape (n, n).
        gamma: Effect of a held torque Γ(T), shape (n, 1).
        noise: Covariance the process noise adds, shape (n, n).
        half_kick: (T/2) mgl/J₁ [1/s].
    """

    duration: float
    phi: Array
    gamma: Array
    noise: Array
    half_kick: float


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
        disturbance: The exosystem of the outputs' disturbances, one channel an output.
        process_noise: Densities of the arm's acceleration noise.
        period: Nominal step [s]; longer steps are taken in nominal ones and a last one.
        outputs: What is measured, names of `QUANTITIES`.
        torque_disturbance: The exosystem of torques at motor and link [N m], two channels; None if
            the arm has the known torque only.
        linear: The flow without gravity.

    Raises:
        ModelError: An output is unknown or listed twice, or a disturbance has another number of
            channels.
    """

    def __init__(
        self,
        arm: ElasticJointArm,
        disturbance: DisturbanceModel,
        process_noise: ProcessNoise,
        period: float,
        outputs: Sequence[str] = (QUANTITIES[LINK_ANGLE],),
        torque_disturbance: DisturbanceModel | None = None,
    ) -> None:
        self.arm = arm
        self.disturbance = disturbance
        self.process_noise = process_noise
        self.period = positive("period", period)
        self.outputs = tuple(outputs)
        self.torque_disturbance = torque_disturbance
        self._measured = arm.measured(self.outputs)
        _require_channels("disturbance", disturbance, self.outputs)
        if torque_disturbance is not None:
            _require_channels("torque_disturbance", torque_disturbance, SIDES)
        torque = np.zeros((self.state_count, 1))
        torque[:4] = arm.input_matrix
        self.linear = LinearFlow(self.drift, torque, self._noise_density(), self.period)
        self.nominal = self.transition(self.period)

    @property
    def plant_count(self) -> int:
        """Number of the arm's own states."""
        return 4

    @property
    def state_count(self) -> int:
        """Length n of the augmented state."""
        torque = self.torque_disturbance
        return 4 + self.disturbance.state_count + (torque.state_count if torque else 0)

    @cached_property
    def output_matrix(self) -> Array:
        """Augmented state to measurement C̄ = [C H 0], shape (p, n)."""
        measured = self._placed(self._measured, 0) + self.disturbance_map
        return as_matrix("C̄", measured, measured.shape)

    @cached_property
    def motor_torque(self) -> Array:
        """Augmented state to the unknown torque at the motor [N m], shape (n,)."""
        return self._torque_of(SIDES.index("motor"))

    @cached_property
    def link_torque(self) -> Array:
        """Augmented state to the unknown torque at the link [N m], shape (n,)."""
        return self._torque_of(SIDES.index("link"))

    def _torque_of(self, side: int) -> Array:
        if self.torque_disturbance is None:
            return np.zeros(self.state_count)
        row = self.torque_disturbance.H[side : side + 1]
        return np.ravel(self._placed(row, 4 + self.disturbance.state_count))

    @cached_property
    def drift(self) -> Array:
        """Continuous augmented matrix without gravity, what the linear flow integrates, (n, n)."""
        own = block_diag(self.arm.spring_matrix, self.disturbance.S)
        torque = self.torque_disturbance
        if torque is None:
            return np.asarray(own)
        drift = np.asarray(block_diag(own, torque.S))
        motor, link = torque.H
        drift[MOTOR_VELOCITY, len(own) :] = self.arm.input_matrix[MOTOR_VELOCITY] * motor
        drift[LINK_VELOCITY, len(own) :] = link / self.arm.link_inertia
        return drift

    def slope_matrix(self, slope: float) -> Array:
        """Return the continuous augmented matrix with gravity slope c, shape (n, n)."""
        matrix = self.drift.copy()
        matrix[:4, :4] = self.arm.slope_matrix(slope)
        return matrix

    @property
    def input_count(self) -> int:
        """The torque alone."""
        return 1

    def transition(self, duration: float) -> Transition:
        """Return the linear flow over `duration` [s]."""
        half_kick = 0.5 * duration * self.arm.gravity_gain
        return Transition(duration, *self.linear.over(duration), half_kick)

    def fill(self, record: Any, uncertainty: Uncertainty | None = None) -> None:
        """Enter the model's numbers into one record; see `Flow`."""
        fill_common(record, self, self.linear, self.period, uncertainty)
        record["kind"], record["plant"] = native.KIND_ARM, 4
        record["gravity_gain"] = self.arm.gravity_gain
        for name, torque in (
            ("motor_torque", self.motor_torque),
            ("link_torque", self.link_torque),
        ):
            fill_matrix(record[name], torque)
            record["has_unknown"] |= int(torque.any())
        if uncertainty is not None and uncertainty.count:
            require_directions(uncertainty, (1, 4, EXTERNAL + 1), type(self).__name__)
            rows = uncertainty.directions[:, 0, [LINK_VELOCITY, MOTOR_VELOCITY]]
            columns = (rows[..., place] for place in (SINE, TORQUE, EXTERNAL))
            parts = (rows[..., :4].reshape(-1, 8), *columns)
            fill_matrix(record["effects"], np.hstack(parts))

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
                systems.append(
                    VertexSystem(
                        (first.slope, second.slope),
                        after @ step.phi @ before,
                        (noise + noise.T) / 2,
                        describe(first, second, uncertainty, has_gravity),
                    )
                )
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

    def _noise_density(self) -> Array:
        """Return the white noise density of the augmented state in design coordinates, (n, n)."""
        arm = np.zeros((4, 4))
        arm[LINK_VELOCITY, LINK_VELOCITY] = self.process_noise.link
        scale = self.arm.stiffness / self.arm.link_inertia
        arm[MOTOR_VELOCITY, MOTOR_VELOCITY] = self.process_noise.motor * (scale * scale)
        densities = [self.disturbance.noise_density]
        if self.torque_disturbance is not None:
            densities.append(self.torque_disturbance.noise_density)
        return np.asarray(block_diag(arm, *densities))

    def to_physical(self, x: ArrayLike) -> Array:
        """Return [q₁, q̇₁, q₂, q̇₂] (rad, rad/s) of augmented states of shape (..., n)."""
        return self.arm.to_physical(np.asarray(x, dtype=np.float64)[..., :4])


def _require_channels(name: str, model: DisturbanceModel, channels: Sequence[str]) -> None:
    if model.channel_count != len(channels):
        raise ModelError(
            f"{name}: expected {len(channels)} channels, those of {', '.join(channels)}, "
            f"got {model.channel_count}"
        )


def slope_range(x_max: float) -> tuple[float, float]:
    """Return the smallest and largest cosine on |q₁| ≤ x_max [rad], x_max at most π."""
    return math.cos(min(x_max, math.pi)), 1.0
