# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The proportional high-gain observer (PO) of the arm, to compare with.

    x̂' = f(x̂, u) + K (y − x̂₁) ,     poles of A(c = 1) − K C at −θ (1, 1.1, 1.2, 1.3)

θ trades the speed of convergence against noise; a disturbance of y goes into the estimate as if
it were motion. One instance can hold a whole grid of θ as a batch axis.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import LINK_ANGLE, ElasticJointArm

POLE_RATIOS = (1.0, 1.1, 1.2, 1.3)
"""Poles as multiples of −θ; distinct, so that a small change of a gain moves them little."""

STEP_LIMIT = 0.1
"""Largest step times |pole|: Runge–Kutta's own error is then about 1e-6 of the estimate a step."""

Derivative = Callable[[Array], Array]
"""ẋ as a function of x alone, shapes (..., n)."""


class HighGainState(NamedTuple):
    """The estimate in design coordinates, shape (..., 4), and the sample in use, (..., 1)."""

    x: Array
    y: Array


class HighGainObserver:
    """The PO of one arm, or of a batch.

    Attributes:
        arm: The physical model.
        theta: θ [1/s], a number or an array of shape (...), which then is part of the batch.
        K: Gains, shape (..., 4).

    Raises:
        ModelError: A θ is not a finite number above zero.
    """

    def __init__(self, arm: ElasticJointArm, theta: ArrayLike) -> None:
        self.arm = arm
        self.theta = checked_theta(theta)
        self.K = np.stack(
            [
                place_single_output(
                    arm.slope_matrix(1.0), arm.output_matrix, -each * np.array(POLE_RATIOS)
                )
                for each in self.theta.ravel()
            ]
        ).reshape(*self.theta.shape, 4)
        self._longest_step = STEP_LIMIT / (float(self.theta.max()) * POLE_RATIOS[-1])

    def initial(self, batch: tuple[int, ...] = ()) -> HighGainState:
        """Return the state before any measurement: zero; `batch` must fit θ's shape."""
        return HighGainState(np.zeros((*batch, 4)), np.zeros((*batch, 1)))

    def correct(self, state: HighGainState, y: Array) -> tuple[HighGainState, Array]:
        """Take a sample [rad], shape (..., 1); return the state and the innovation y − x̂₁."""
        return HighGainState(state.x, y), y - state.x[..., :1]

    def predict(self, state: HighGainState, u: Array, duration: float) -> HighGainState:
        """Integrate for `duration` [s] with the last sample and u (..., 1) held."""

        def derivative(x: Array) -> Array:
            error = state.y - x[..., LINK_ANGLE, np.newaxis]
            return np.asarray(self.arm.derivative(x, u) + self.K * error)

        x = integrate(derivative, state.x, duration, self._longest_step)
        return HighGainState(x, state.y)


def checked_theta(theta: ArrayLike) -> Array:
    """Return θ as an array, or raise `ModelError` if one is not a finite number above zero."""
    array = np.asarray(theta, dtype=np.float64)
    for each in array.ravel():
        positive("theta", float(each))
    return array


def place_single_output(A: Array, C: Array, poles: ArrayLike) -> Array:
    """Return K, shape (n,), such that A − K C has the given poles (Ackermann's formula).

    Args:
        A: State matrix, shape (n, n).
        C: Output matrix of one output, shape (1, n).
        poles: n poles [1/s], closed under conjugation.

    Raises:
        ModelError: The output does not see every mode of A.
    """
    n = A.shape[0]
    rows = [C[0]]
    for _ in range(n - 1):
        rows.append(rows[-1] @ A)
    observability = np.array(rows)
    if np.linalg.matrix_rank(observability) < n:
        raise ModelError(f"C: expected an output that sees all {n} modes of A, got {C.tolist()}")
    polynomial = np.zeros((n, n))
    for coefficient in np.real(np.poly(np.asarray(poles))):
        polynomial = polynomial @ A + coefficient * np.eye(n)
    last = np.zeros(n)
    last[-1] = 1.0
    return np.asarray(polynomial @ np.linalg.solve(observability, last))


def integrate(derivative: Derivative, x: Array, duration: float, longest_step: float) -> Array:
    """Return the state after `duration` [s] by equal classical Runge–Kutta steps."""
    steps = max(1, math.ceil(duration / longest_step - 1e-9))
    h = duration / steps
    for _ in range(steps):
        k1 = derivative(x)
        k2 = derivative(x + 0.5 * h * k1)
        k3 = derivative(x + 0.5 * h * k2)
        k4 = derivative(x + h * k3)
        x = x + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
    return x
