# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Prediction with uncertain parameters θ: the estimate, how it depends on θ, its covariance.

Υ = ∂x̂/∂θ moves with the step's own Jacobian and gathers what θ does to the state's derivative.
"""

import math
from typing import Any, Protocol

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import LINK_ANGLE, LINK_VELOCITY, MOTOR_VELOCITY
from tsobs_ros.model.flow import ArmFlow, Transition
from tsobs_ros.model.matrix_uncertainty import MatrixUncertainty
from tsobs_ros.model.ts_flow import TSFlow
from tsobs_ros.model.uncertainty import ArmUncertainty

_VELOCITIES = slice(LINK_VELOCITY, MOTOR_VELOCITY + 1, MOTOR_VELOCITY - LINK_VELOCITY)
"""The rows that θ acts on, as a slice: indexing by a list costs several times as much."""


class Uncertainty(Protocol):
    """Uncertain parameters θ of a model."""

    @property
    def names(self) -> tuple[str, ...]:
        """Their names, in the order of θ."""
        ...

    @property
    def count(self) -> int:
        """Their number k."""
        ...

    @property
    def limits(self) -> Array:
        """Bound of each |θ|, shape (k,)."""
        ...


class Sensitivity(Protocol):
    """Predicts estimate, sensitivity and covariance together."""

    def carry(
        self,
        x: Array,
        upsilon: Array,
        covariance: Array | None,
        theta: Array,
        u: Array,
        duration: float,
    ) -> tuple[Array, Array, Array | None]:
        """Return x̄, Υ and the error covariance a time `duration` later.

        Args:
            x: Augmented state, shape (n,).
            upsilon: Υ, shape (n, k).
            covariance: Shape (n, n); None if nobody asks for it.
            theta: θ̂, shape (k,).
            u: Inputs held over the step, shape (m,).
            duration: [s], at least 0.
        """
        ...


def sensitivity(flow: Any, uncertainty: Uncertainty) -> Sensitivity:
    """Return the prediction that belongs to a flow and its kind of uncertainty.

    Raises:
        ModelError: They do not belong together.
    """
    if isinstance(flow, ArmFlow) and isinstance(uncertainty, ArmUncertainty):
        return ArmSensitivity(flow, uncertainty)
    if isinstance(flow, TSFlow) and isinstance(uncertainty, MatrixUncertainty):
        return TSSensitivity(flow, uncertainty)
    raise ModelError(
        f"uncertainty: expected ArmUncertainty with ArmFlow or MatrixUncertainty with TSFlow, "
        f"got {type(uncertainty).__name__} with {type(flow).__name__}"
    )


class ArmSensitivity:
    """The arm's step with θ in its two kicks."""

    def __init__(self, flow: ArmFlow, uncertainty: ArmUncertainty) -> None:
        self._flow = flow
        self._uncertainty = uncertainty
        self._identity = np.eye(flow.state_count)

    def carry(
        self,
        x: Array,
        upsilon: Array,
        covariance: Array | None,
        theta: Array,
        u: Array,
        duration: float,
    ) -> tuple[Array, Array, Array | None]:
        """Return x̄, Υ and the covariance later; see `Sensitivity.carry`."""
        torque = float(u[0])
        for step in self._flow.steps(duration):
            x, upsilon, rows = self._kick(x, upsilon, theta, torque, step)
            if covariance is not None:
                onward = step.phi @ self._jacobian(rows)
                covariance = onward @ covariance @ onward.T + step.noise
            x = step.phi @ x + step.gamma[:, 0] * torque
            x, upsilon, rows = self._kick(x, step.phi @ upsilon, theta, torque, step)
            if covariance is not None:
                after = self._jacobian(rows)
                covariance = after @ covariance @ after.T
        return x, upsilon, covariance

    def _kick(
        self, x: Array, upsilon: Array, theta: Array, torque: float, step: Transition
    ) -> tuple[Array, Array, Array]:
        """Return x and Υ after half a kick by gravity and θ, and what the kick adds to dx.

        That is the kick's Jacobian less the identity in the rows of the velocities, shape (2, 4).
        """
        half, angle = 0.5 * step.duration, float(x[LINK_ANGLE])
        regressor = half * self._uncertainty.regressor(x, torque)
        rows = half * self._uncertainty.jacobian(x, theta)
        rows[0, LINK_ANGLE] -= step.half_kick * math.cos(angle)
        gained = regressor @ theta
        gained[0] -= step.half_kick * math.sin(angle)
        kicked = x.copy()
        kicked[_VELOCITIES] += gained
        turned = upsilon.copy()
        turned[_VELOCITIES] += rows @ upsilon[:4] + regressor
        return kicked, turned, rows

    def _jacobian(self, rows: Array) -> Array:
        jacobian = self._identity.copy()
        jacobian[_VELOCITIES, :4] += rows
        return jacobian


class TSSensitivity:
    """The exponential midpoint step of a T–S system with θ in what enters at its middle."""

    def __init__(self, flow: TSFlow, uncertainty: MatrixUncertainty) -> None:
        self._flow = flow
        self._uncertainty = uncertainty
        self._plant = uncertainty.model.state_count
        self._zeros = np.zeros((flow.state_count, flow.state_count))

    def carry(
        self,
        x: Array,
        upsilon: Array,
        covariance: Array | None,
        theta: Array,
        u: Array,
        duration: float,
    ) -> tuple[Array, Array, Array | None]:
        """Return x̄, Υ and the covariance later; see `Sensitivity.carry`."""
        flow = self._flow
        inputs = u[: flow.model.input_count]
        for step in flow.steps(duration):
            T, phi = step.duration, step.phi
            forced = step.gamma @ inputs
            rate, turning, first = self._enter(x, upsilon, theta, u)
            coasted, carried = phi @ x + forced, phi @ upsilon
            middle = coasted + 0.5 * T * (phi @ rate)
            half_way = carried + 0.5 * T * (phi @ turning)
            rate, turning, second = self._enter(middle, half_way, theta, u)
            if covariance is not None:
                transition, noise = flow.error_map(first, second, step)
                covariance = transition @ covariance @ transition.T + noise
            x = phi @ (coasted + T * rate) + forced
            upsilon = phi @ (carried + T * turning)
        return x, upsilon, covariance

    def _enter(
        self, x: Array, upsilon: Array, theta: Array, u: Array
    ) -> tuple[Array, Array, Array]:
        """Return what enters x and Υ besides the linear flow, and its Jacobian in x."""
        n, model = self._plant, self._flow.model
        plant = x[:n]
        local = model.weights_and_turning(plant, u)
        weights = local[0]
        total = self._flow.deviations + np.tensordot(theta, self._uncertainty.wide, 1)
        rate, regressor, jacobian = np.zeros(x.shape), np.zeros(upsilon.shape), self._zeros.copy()
        rate[:n] = model.blended(total, plant, u, weights)
        regressor[:n] = self._uncertainty.regressor(plant, u, weights)
        jacobian[:n, :n] = model.blended_jacobian(total, plant, u, local)
        return rate, jacobian @ upsilon + regressor, jacobian
