# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The proportional-integral observer (PIO) of the arm, to compare with.

After K. Busawon, P. Kaboré, "Disturbance attenuation using proportional integral observers",
International Journal of Control 74 (2001): the integral x₀' = y is measured in place of y,

    x̂₀' = C x̂ + K₀ (x₀ − x̂₀) ,     x̂' = f(x̂, u) + K (x₀ − x̂₀)

with the poles of the error at −θ (1, 1.1, 1.2, 1.3, 1.4). Only e₀ = x₀ − x̂₀ matters, so it is the
state here; x₀ itself grows without bound where y has a mean.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array
from tsobs_ros.estimation.high_gain import (
    POLE_RATIOS,
    STEP_LIMIT,
    checked_theta,
    integrate,
    place_single_output,
)
from tsobs_ros.model.arm import LINK_ANGLE, ElasticJointArm

_POLE_RATIOS = (*POLE_RATIOS, 1.4)


class ProportionalIntegralState(NamedTuple):
    """The running estimate.

    Attributes:
        x: Estimate in design coordinates, shape (..., 4).
        integral_error: e₀ = ∫y − x̂₀ [rad s], shape (..., 1).
        y: The sample in use [rad], shape (..., 1).
    """

    x: Array
    integral_error: Array
    y: Array


class ProportionalIntegralObserver:
    """The PIO of one arm, or of a batch.

    Attributes:
        arm: The physical model.
        theta: θ [1/s], a number or an array of shape (...), which then is part of the batch.
        K: Gains of [x₀, x], shape (..., 5).

    Raises:
        ModelError: A θ is not a finite number above zero.
    """

    def __init__(self, arm: ElasticJointArm, theta: ArrayLike) -> None:
        self.arm = arm
        self.theta = checked_theta(theta)
        A = np.zeros((5, 5))
        A[:1, 1:] = arm.output_matrix
        A[1:, 1:] = arm.slope_matrix(1.0)
        C = np.eye(1, 5)
        gains = [
            place_single_output(A, C, -each * np.array(_POLE_RATIOS)) for each in self.theta.ravel()
        ]
        self.K = np.stack(gains).reshape(*self.theta.shape, 5)
        self._longest_step = STEP_LIMIT / (float(self.theta.max()) * _POLE_RATIOS[-1])

    def initial(self, batch: tuple[int, ...] = ()) -> ProportionalIntegralState:
        """Return the state before any measurement: zero; `batch` must fit θ's shape."""
        zero = np.zeros((*batch, 1))
        return ProportionalIntegralState(np.zeros((*batch, 4)), zero, zero)

    def correct(
        self, state: ProportionalIntegralState, y: Array
    ) -> tuple[ProportionalIntegralState, Array]:
        """Take a sample [rad], shape (..., 1); return the state and the innovation y − x̂₁."""
        return state._replace(y=y), y - state.x[..., :1]

    def predict(
        self, state: ProportionalIntegralState, u: Array, duration: float
    ) -> ProportionalIntegralState:
        """Integrate for `duration` [s] with the last sample and u (..., 1) held."""

        def derivative(joined: Array) -> Array:
            error, x = joined[..., :1], joined[..., 1:]
            error_rate = state.y - x[..., LINK_ANGLE, np.newaxis] - self.K[..., :1] * error
            return np.concatenate(
                [error_rate, self.arm.derivative(x, u) + self.K[..., 1:] * error], axis=-1
            )

        start = np.concatenate([state.integral_error, state.x], axis=-1)
        end = integrate(derivative, start, duration, self._longest_step)
        return ProportionalIntegralState(end[..., 1:], end[..., :1], state.y)
