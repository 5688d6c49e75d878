# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Several arms predicted side by side, each with its own parameters, by one set of operations."""

from collections.abc import Sequence

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.model.linear_flow import LinearFlow, cut_into_steps
from tsobs_ros.model.transition import Transition, predicted, predicted_with_covariance


class FlowBank:
    """Predicts the augmented states of k arms, as `ArmFlow` does that of each.

    Args:
        flows: Of equal periods and state counts.
    """

    def __init__(self, flows: Sequence[ArmFlow]) -> None:
        self._flows = (flows[0],) if len(set(flows)) == 1 else tuple(flows)
        self._period = flows[0].period
        self._linear = LinearFlow.stack([flow.linear for flow in self._flows])
        self._gravity = np.array([flow.arm.gravity_gain for flow in self._flows])
        self._nominal = self._over(self._period)
        self._scales = np.array([flow.to_physical(np.ones(flow.state_count)) for flow in flows])

    def predict(self, x: Array, u: Array, duration: float) -> Array:
        """Return the states, shape (k, n), a time `duration` [s] later, torques (k, 1) held."""
        return predicted(x, u, self._steps(duration))

    def predict_with_covariance(
        self, x: Array, covariance: Array, u: Array, duration: float
    ) -> tuple[Array, Array]:
        """Return the states and covariances, shape (k, n, n), a time `duration` [s] later."""
        return predicted_with_covariance(x, covariance, u, self._steps(duration))

    def to_physical(self, x: Array) -> Array:
        """Return [q₁, q̇₁, q₂, q̇₂] (rad, rad/s) of each arm, shape (k, 4)."""
        return np.asarray(x[..., :4] * self._scales)

    def _steps(self, duration: float) -> list[Transition]:
        return cut_into_steps(duration, self._period, self._nominal, self._over)

    def _over(self, duration: float) -> Transition:
        """Return the linear flows over `duration` [s], with a leading axis of k, or 1 if shared."""
        if self._linear is None:
            each = [flow.linear.over(duration) for flow in self._flows]
            phi, gamma, noise = (np.array(parts) for parts in zip(*each, strict=True))
        else:
            phi, gamma, noise = self._linear.over(duration)
        return Transition(duration, phi, gamma, noise, 0.5 * duration * self._gravity)
