# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The extended Kalman filters that the acceptance benchmark compares with, all of them plain.

Plain: the Kalman gain along the estimate for ever; no gates, no search for jumps, no projection.
"""

from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.estimator import Estimator, certified_estimator
from tsobs_ros.estimation.options import CertifiedGain, GainMode
from tsobs_ros.model.arm import LINK_ANGLE, LINK_VELOCITY, MOTOR_VELOCITY, ElasticJointArm
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.model.uncertainty import SINE, TORQUE, Uncertainty

THETA_STD = 0.2
"""1σ of each θ before any measurement."""

THETA_WANDER = 1e-6
"""Growth of each θ's variance [1/s]."""

_ROWS = [LINK_VELOCITY, MOTOR_VELOCITY]


class KalmanState(NamedTuple):
    """Estimates, shape (..., n), and their error covariances, shape (..., n, n)."""

    x: Array
    covariance: Array


def knowing_filter(design: Design, arm: ElasticJointArm) -> Estimator:
    """Return the EKF that predicts with the true arm, in that arm's design coordinates."""
    request = design.request
    flow = ArmFlow(arm, request.disturbance_model, request.process_noise, request.period)
    std = np.concatenate(
        [arm.from_physical(request.initial_std), request.disturbance_model.initial_std]
    )
    n = flow.state_count
    return certified_estimator(
        flow,
        request.measurement_covariance,
        np.diag(std**2),
        # Never used: with Riccati gains no constant one takes over.
        CertifiedGain(np.zeros((n, 1)), np.eye(n)),
        gain_mode=GainMode.RICCATI,
    )


class AugmentedFilter:
    """The EKF with the states [x; w; θ], for a batch of arms.

    Attributes:
        flow: Prediction model of the nominal arm.
        uncertainty: Directions of θ.
    """

    def __init__(self, design: Design, uncertainty: Uncertainty) -> None:
        self.flow = design.request.flow
        self.uncertainty = uncertainty
        n, k = self.flow.state_count, uncertainty.count
        self._R = design.request.measurement_covariance
        self._C = np.hstack([self.flow.output_matrix, np.zeros((1, k))])
        self._identity = np.eye(n + k)
        self._initial = THETA_STD**2 * np.eye(n + k)
        self._initial[:n, :n] = design.request.initial_covariance
        step = self.flow.nominal
        self.phi = np.eye(n + k)
        self.phi[:n, :n] = step.phi
        self.gamma = np.concatenate([step.gamma[:, 0], np.zeros(k)])
        self.noise = THETA_WANDER * step.duration * np.eye(n + k)
        self.noise[:n, :n] = step.noise

    def initial(self, batch: tuple[int, ...]) -> KalmanState:
        """Return the state before any measurement."""
        size = len(self._identity)
        covariance = np.broadcast_to(self._initial, (*batch, size, size)).copy()
        return KalmanState(np.zeros((*batch, size)), covariance)

    def correct(self, state: KalmanState, y: Array) -> KalmanState:
        """Use a sample [rad], shape (..., 1)."""
        cross = state.covariance @ self._C.T
        spread = self._C @ cross + self._R
        gain = cross / spread
        closed = self._identity - gain @ self._C
        covariance = closed @ state.covariance @ np.swapaxes(closed, -1, -2)
        covariance = covariance + gain @ self._R @ np.swapaxes(gain, -1, -2)
        innovation = y - state.x @ self._C.T
        return KalmanState(state.x + gain[..., 0] * innovation, covariance)

    def predict(self, state: KalmanState, u: Array) -> KalmanState:
        """Predict over a nominal step with the torque u (..., 1) held [N m]."""
        x, first = self._kicked(state.x, u)
        onward = self.phi @ first
        covariance = onward @ state.covariance @ np.swapaxes(onward, -1, -2) + self.noise
        x, second = self._kicked(x @ self.phi.T + u * self.gamma, u)
        return KalmanState(x, second @ covariance @ np.swapaxes(second, -1, -2))

    def _kicked(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return the state after half a kick, and the kick's Jacobian."""
        step, n = self.flow.nominal, self.flow.state_count
        effects = self.uncertainty.directions[:, 0, _ROWS]
        linear, sine, torque = effects[..., :4], effects[..., SINE], effects[..., TORQUE]
        half, angle, theta = 0.5 * step.duration, x[..., LINK_ANGLE, np.newaxis], x[..., n:]
        # Accelerations a(x, u) of each θ, shape (..., 2, k).
        push = np.einsum("kij,...j->...ik", linear, x[..., :4])
        push += sine.T * np.sin(angle)[..., np.newaxis]
        push += torque.T * u[..., np.newaxis]
        jacobian = np.broadcast_to(self._identity, (*x.shape, x.shape[-1])).copy()
        slope = np.einsum("...k,kij->...ij", theta, linear)
        slope[..., LINK_ANGLE] += (theta @ sine) * np.cos(angle)
        jacobian[..., _ROWS, :4] += half * slope
        jacobian[..., _ROWS, n:] = half * push
        jacobian[..., LINK_VELOCITY, LINK_ANGLE] -= step.half_kick * np.cos(angle[..., 0])
        kicked = x.copy()
        kicked[..., _ROWS] += half * np.einsum("...ik,...k->...i", push, theta)
        kicked[..., LINK_VELOCITY] -= step.half_kick * np.sin(angle[..., 0])
        return kicked, jacobian
