# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A plain extended Kalman filter of the arm, to compare with: no certificate, gates or health."""

from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.model.flow import ArmFlow


class KalmanState(NamedTuple):
    """The estimate, shape (..., n), and its error covariance, shape (..., n, n)."""

    x: Array
    covariance: Array


class ExtendedKalmanFilter:
    """The EKF with an arm's prediction model and its disturbance states.

    Attributes:
        flow: Prediction model with its process noise.

    Raises:
        ModelError: A covariance has the wrong shape.
    """

    def __init__(
        self, flow: ArmFlow, measurement_covariance: Array, initial_covariance: Array
    ) -> None:
        n, p = flow.state_count, flow.output_matrix.shape[0]
        self.flow = flow
        self._R = as_matrix("R", measurement_covariance, (p, p))
        self._initial = as_matrix("initial covariance", initial_covariance, (n, n))
        self._C = flow.output_matrix

    def initial(self, batch: tuple[int, ...] = ()) -> KalmanState:
        """Return the state before any measurement: zero estimate, wide covariance."""
        n = self.flow.state_count
        covariance = np.broadcast_to(self._initial, (*batch, n, n)).copy()
        return KalmanState(np.zeros((*batch, n)), covariance)

    def correct(self, state: KalmanState, y: Array) -> tuple[KalmanState, Array]:
        """Use a sample [rad], shape (..., p); return the state and the innovation y − C̄x̂."""
        innovation = y - state.x @ self._C.T
        cross = state.covariance @ self._C.T
        spread = self._C @ cross + self._R
        gain = np.swapaxes(np.linalg.solve(spread, np.swapaxes(cross, -1, -2)), -1, -2)
        covariance = state.covariance - gain @ spread @ np.swapaxes(gain, -1, -2)
        covariance = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
        x = state.x + (gain @ innovation[..., np.newaxis])[..., 0]
        return KalmanState(x, covariance), innovation

    def predict(self, state: KalmanState, u: Array, duration: float) -> KalmanState:
        """Predict over `duration` [s] with the torque u (..., 1) held [N m]."""
        return KalmanState(
            *self.flow.predict_with_covariance(state.x, state.covariance, u, duration)
        )
