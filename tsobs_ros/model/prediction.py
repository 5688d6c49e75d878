# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Prediction models as observers and designs use them, also with uncertain parameters θ.

Υ = ∂x̂/∂θ moves with the step's own Jacobian and gathers the effect of θ on the state's derivative.
"""

import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import LINK_VELOCITY, MOTOR_VELOCITY
from tsobs_ros.model.disturbance import DisturbanceModel
from tsobs_ros.model.flow import UNKNOWN_TORQUE, ArmFlow, GapFlow
from tsobs_ros.model.ts_flow import TSFlow
from tsobs_ros.model.uncertainty import SINE, TORQUE, Uncertainty

_VELOCITIES = slice(LINK_VELOCITY, MOTOR_VELOCITY + 1, MOTOR_VELOCITY - LINK_VELOCITY)
"""The rows that θ acts on, as a slice: indexing by a list costs several times as much."""


class PredictionModel(Protocol):
    """One step of the augmented state x̄ = [x; w] and of its error covariance.

    Attributes:
        disturbance: The exosystem, whose states w are the last ones of x̄.
        period: Nominal step [s].
    """

    disturbance: DisturbanceModel
    period: float

    @property
    def state_count(self) -> int:
        """Length n of the augmented state."""
        ...

    @property
    def output_matrix(self) -> Array:
        """Augmented state to measurement C̄ = [C H], shape (p, n)."""
        ...

    def predict(self, x: Array, u: Array, duration: float) -> Array:
        """Return x̄, shape (..., n), a time `duration` [s] later, u of shape (..., m) held."""
        ...

    def predict_with_covariance(
        self, x: Array, covariance: Array, u: Array, duration: float
    ) -> tuple[Array, Array]:
        """Return x̄ and its error covariance, shape (..., n, n), a time `duration` [s] later."""
        ...

    def to_physical(self, x: ArrayLike) -> Array:
        """Return the plant's states in physical units for augmented states, shape (..., n)."""
        ...


def sensitivity(flow: Any, uncertainty: Uncertainty) -> "ArmSensitivity | TSSensitivity":
    """Return the prediction of a flow with uncertain parameters.

    Raises:
        ModelError: The uncertainty is of another model.
    """
    kind: type[ArmSensitivity | TSSensitivity] = TSSensitivity
    if isinstance(flow, ArmFlow):
        kind, signals = ArmSensitivity, (1, 4, TORQUE + 1)
    else:
        signals = flow.deviations.shape
    if uncertainty.directions.shape[1:] != signals:
        raise ModelError(
            f"uncertainty: expected directions of shape {signals} for {type(flow).__name__}, "
            f"got {uncertainty.directions.shape[1:]}"
        )
    return kind(flow, uncertainty)


class ArmSensitivity:
    """The arm's step with θ in its two kicks.

    The kicks touch two rows of few columns, where Python's numbers cost less than NumPy's calls.
    """

    def __init__(self, flow: ArmFlow, uncertainty: Uncertainty) -> None:
        self._flow = flow
        self._identity = np.eye(flow.state_count)
        self._unknown_torque = (
            flow.state_count - UNKNOWN_TORQUE if isinstance(flow, GapFlow) else None
        )
        # What θ = 1 adds to both accelerations, by x, by sin x₁ and by u: one row a parameter.
        rows = uncertainty.directions[:, 0, _VELOCITIES]
        parts = (rows[..., :4].reshape(-1, 8), rows[..., SINE], rows[..., TORQUE])
        self._effects = np.hstack(parts)
        self._nominal = 0.5 * flow.period * self._effects
        self._nominal_rows: list[list[float]] = self._nominal.tolist()

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
            covariance: Shape (n, n); None if it is not needed.
            theta: θ̂, shape (k,).
            u: Inputs held over the step, shape (m,).
            duration: [s], at least 0.
        """
        torque = float(u[0])
        columns = [x.tolist(), *upsilon.T.tolist()]
        for step in self._flow.steps(duration):
            kicks, rows = self._nominal, self._nominal_rows
            if step is not self._flow.nominal:
                kicks = 0.5 * step.duration * self._effects
                rows = kicks.tolist()
            total = theta.dot(kicks).tolist()
            half_kick = float(step.half_kick)
            slopes = _kick(columns, total, rows, torque, half_kick)
            if covariance is not None:
                onward = step.phi @ self._jacobian(slopes, total)
                covariance = onward @ covariance @ onward.T + step.noise
            moved = np.array(columns).dot(step.phi.T)
            moved[0] += step.gamma[:, 0] * torque
            columns = moved.tolist()
            slopes = _kick(columns, total, rows, torque, half_kick)
            if covariance is not None:
                after = self._jacobian(slopes, total)
                covariance = after @ covariance @ after.T
        joined = np.array(columns)
        return joined[0], joined[1:].T, covariance

    def _jacobian(
        self, slopes: tuple[tuple[float, ...], tuple[float, ...]], total: list[float]
    ) -> Array:
        jacobian = self._identity.copy()
        jacobian[_VELOCITIES, :4] += slopes
        if self._unknown_torque is not None:
            # What θ̂ does to the torque, it does to its unknown part.
            jacobian[_VELOCITIES, self._unknown_torque] = total[-2:]
        return jacobian


def _kick(
    columns: list[list[float]],
    total: list[float],
    rows: list[list[float]],
    torque: float,
    half_kick: float,
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Kick x̄, the first column, and those of Υ in place; return what the kick adds to dx.

    Args:
        columns: Of length n each.
        total: Effects of θ̂ in half a step.
        rows: Effects of each θ = 1 in half a step.
        torque: [N m].
        half_kick: That of gravity [1/s].
    """
    x = columns[0]
    x0, x1, x2, x3 = x[:4]
    try:
        sine, cosine = math.sin(x0), math.cos(x0)
    except ValueError as error:
        raise FloatingPointError(f"angle: expected a finite number, got {x0}") from error
    a0, a1, a2, a3, b0, b1, b2, b3, a_sine, b_sine, a_u, b_u = total
    a_sine -= half_kick
    x[LINK_VELOCITY] += a0 * x0 + a1 * x1 + a2 * x2 + a3 * x3 + a_sine * sine + a_u * torque
    x[MOTOR_VELOCITY] += b0 * x0 + b1 * x1 + b2 * x2 + b3 * x3 + b_sine * sine + b_u * torque
    a0 += a_sine * cosine
    b0 += b_sine * cosine
    for column, row in zip(columns[1:], rows, strict=True):
        p0, p1, p2, p3, q0, q1, q2, q3, p_sine, q_sine, p_u, q_u = row
        v0, v1, v2, v3 = column[:4]
        added = p0 * x0 + p1 * x1 + p2 * x2 + p3 * x3 + p_sine * sine + p_u * torque
        column[LINK_VELOCITY] += a0 * v0 + a1 * v1 + a2 * v2 + a3 * v3 + added
        added = q0 * x0 + q1 * x1 + q2 * x2 + q3 * x3 + q_sine * sine + q_u * torque
        column[MOTOR_VELOCITY] += b0 * v0 + b1 * v1 + b2 * v2 + b3 * v3 + added
    return (a0, a1, a2, a3), (b0, b1, b2, b3)


class TSSensitivity:
    """The exponential midpoint step of a T–S system with θ in what enters at its middle."""

    def __init__(self, flow: TSFlow, uncertainty: Uncertainty) -> None:
        self._flow = flow
        self._directions = uncertainty.directions
        self._plant = flow.model.state_count
        # All directions of a rule above each other, shape (r, k n, n + m).
        turned = np.moveaxis(self._directions, 0, 1)
        self._stacked = turned.reshape(turned.shape[0], -1, turned.shape[-1])
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
        """Return x̄, Υ and the covariance later; see `ArmSensitivity.carry`."""
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
        total = self._flow.deviations + np.tensordot(theta, self._directions, 1)
        rate, regressor, jacobian = np.zeros(x.shape), np.zeros(upsilon.shape), self._zeros.copy()
        rate[:n] = model.blended(total, plant, u, weights)
        each = model.blended(self._stacked, plant, u, weights)
        regressor[:n] = each.reshape(len(self._directions), -1).T
        jacobian[:n, :n] = model.blended_jacobian(total, plant, u, local)
        return rate, jacobian @ upsilon + regressor, jacobian
