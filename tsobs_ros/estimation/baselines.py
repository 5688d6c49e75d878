# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers of the arm to compare with: proportional, proportional-integral, and a plain EKF.

The proportional high-gain observer (PO),

    x̂' = f(x̂, u) + K (y − x̂₁) ,     poles of A(c = 1) − K C at −θ (1, 1.1, 1.2, 1.3)

trades by θ the speed of convergence against noise. The proportional-integral one (PIO), after
K. Busawon, P. Kaboré, "Disturbance attenuation using proportional integral observers",
International Journal of Control 74 (2001), measures the integral x₀' = y in place of y,

    x̂₀' = C x̂ + K₀ (x₀ − x̂₀) ,     x̂' = f(x̂, u) + K (x₀ − x̂₀)

with the poles of the error at −θ (1, 1.1, 1.2, 1.3, 1.4). Both take a disturbance of y for motion.
None of the observers here has a certificate, gates or health logic. One instance can hold a whole
grid of θ, or of runs, as a batch axis.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import Correction, Readout
from tsobs_ros.model.arm import LINK_ANGLE, ElasticJointArm
from tsobs_ros.model.flow import ArmFlow

_POLE_RATIOS = (1.0, 1.1, 1.2, 1.3, 1.4)
"""Poles as multiples of −θ; distinct, so that a small change of a gain moves them little."""

_STEP_LIMIT = 0.1
"""Largest step times |pole|: Runge–Kutta's own error is then about 1e-6 of the estimate a step."""

_NONE = np.zeros(0)


class HighGainState(NamedTuple):
    """The running estimate.

    Attributes:
        x: Estimate in design coordinates, shape (..., 4).
        y: The sample in use [rad], shape (..., 1).
        integral_error: Of a PIO e₀ = ∫y − x̂₀ [rad s], shape (..., 1). Only it matters: x₀ itself
            grows without bound if y has a mean.
    """

    x: Array
    y: Array
    integral_error: Array = _NONE


class HighGainObserver:
    """The PO of one arm, or of a batch.

    Attributes:
        arm: The physical model.
        theta: θ [1/s], a number or an array of shape (...), which then is part of the batch.
        K: Gains, shape (..., 4); of a PIO those of [x₀, x], shape (..., 5).

    Raises:
        ModelError: A θ is not a finite number above zero.
    """

    def __init__(self, arm: ElasticJointArm, theta: ArrayLike) -> None:
        self.arm = arm
        self.theta = np.asarray(theta, dtype=np.float64)
        for each in self.theta.ravel():
            positive("theta", float(each))
        A, C = self._error_system()
        ratios = np.array(_POLE_RATIOS[: len(A)])
        gains = [place_single_output(A, C, -each * ratios) for each in self.theta.ravel()]
        self.K = np.stack(gains).reshape(*self.theta.shape, len(A))
        self._longest_step = _STEP_LIMIT / float(self.theta.max() * ratios[-1])

    def _error_system(self) -> tuple[Array, Array]:
        return self.arm.slope_matrix(1.0), self.arm.output_matrix

    def initial(self, batch: tuple[int, ...] = ()) -> HighGainState:
        """Return the state before any measurement: zero; `batch` must fit θ's shape."""
        zero = np.zeros((*batch, 1))
        return HighGainState(np.zeros((*batch, 4)), zero, zero)

    def correct(self, state: HighGainState, y: Array) -> tuple[HighGainState, Array]:
        """Take a sample [rad], shape (..., 1); return the state and the innovation y − x̂₁."""
        return state._replace(y=y), y - state.x[..., :1]

    def predict(self, state: HighGainState, u: Array, duration: float) -> HighGainState:
        """Integrate for `duration` [s] with the last sample and u (..., 1) held."""

        def derivative(x: Array) -> Array:
            error = state.y - x[..., LINK_ANGLE, np.newaxis]
            return np.asarray(self.arm.derivative(x, u) + self.K * error)

        x = integrate(derivative, state.x, duration, self._longest_step)
        return state._replace(x=x)


class ProportionalIntegralObserver(HighGainObserver):
    """The PIO of one arm, or of a batch."""

    def _error_system(self) -> tuple[Array, Array]:
        A = np.zeros((5, 5))
        A[:1, 1:] = self.arm.output_matrix
        A[1:, 1:] = self.arm.slope_matrix(1.0)
        return A, np.eye(1, 5)

    def predict(self, state: HighGainState, u: Array, duration: float) -> HighGainState:
        """Integrate for `duration` [s] with the last sample and u (..., 1) held."""

        def derivative(joined: Array) -> Array:
            error, x = joined[..., :1], joined[..., 1:]
            error_rate = state.y - x[..., LINK_ANGLE, np.newaxis] - self.K[..., :1] * error
            return np.concatenate(
                [error_rate, self.arm.derivative(x, u) + self.K[..., 1:] * error], axis=-1
            )

        start = np.concatenate([state.integral_error, state.x], axis=-1)
        end = integrate(derivative, start, duration, self._longest_step)
        return HighGainState(end[..., 1:], state.y, end[..., :1])


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


def integrate(
    derivative: Callable[[Array], Array], x: Array, duration: float, longest_step: float
) -> Array:
    """Return the state after `duration` [s] by equal Runge–Kutta steps of order four.

    Args:
        derivative: ẋ = f(x), x and ẋ of shape (..., n).
        x: State, shape (..., n).
        duration: [s].
        longest_step: Upper limit of a step [s].
    """
    steps = max(1, math.ceil(duration / longest_step - 1e-9))
    h = duration / steps
    for _ in range(steps):
        k1 = derivative(x)
        k2 = derivative(x + 0.5 * h * k1)
        k3 = derivative(x + 0.5 * h * k2)
        k4 = derivative(x + h * k3)
        x = x + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
    return x


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
        S = self._C @ cross + self._R
        gain = np.swapaxes(np.linalg.solve(S, np.swapaxes(cross, -1, -2)), -1, -2)
        covariance = state.covariance - gain @ S @ np.swapaxes(gain, -1, -2)
        covariance = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
        x = state.x + (gain @ innovation[..., np.newaxis])[..., 0]
        return KalmanState(x, covariance), innovation

    def predict(self, state: KalmanState, u: Array, duration: float) -> KalmanState:
        """Predict over `duration` [s] with the torque u (..., 1) held [N m]."""
        return KalmanState(
            *self.flow.predict_with_covariance(state.x, state.covariance, u, duration)
        )


class ComparisonObserver:
    """An observer without bounds as an `Estimator` of one joint; bounds it lacks have length zero.

    Args:
        observer: Has `correct(state, y) -> (state, innovation)` and `predict`, and states whose
            `x` begins with the four of the arm in design coordinates.
        initial: Its state before any measurement.
        arm: The nominal arm, for physical units.
        period: Nominal sampling period [s].
        measurement_std: 1σ of a sample [rad], the only known part of an innovation's size.
        disturbance: Reads the disturbance [rad] off a state, if the observer has one.

    Attributes:
        period: Nominal sampling period [s].
    """

    def __init__(
        self,
        observer: Any,
        initial: Any,
        arm: ElasticJointArm,
        period: float,
        measurement_std: float,
        disturbance: Callable[[Any], Array] | None = None,
    ) -> None:
        self.period = positive("period", period)
        self._observer = observer
        self._initial = initial
        self._arm = arm
        self._covariance = np.array([[positive("measurement_std", measurement_std) ** 2]])
        self._disturbance = disturbance

    def initial(self) -> Any:
        """Return the state before any measurement."""
        return self._initial

    def correct(self, state: Any, y: Array) -> tuple[Any, Correction]:
        """Use one measurement y [rad], shape (1,)."""
        corrected, innovation = self._observer.correct(state, y)
        return corrected, Correction(innovation, self._covariance, _NONE)

    def predict(self, state: Any, u: Array, duration: float) -> Any:
        """Predict over `duration` [s] with the torque u [N m], shape (1,), held."""
        return self._observer.predict(state, u, duration)

    extrapolate = predict

    def readout(self, state: Any) -> Readout:
        """Return the estimate in physical units."""
        disturbance = _NONE if self._disturbance is None else self._disturbance(state)
        physical = self._arm.to_physical(state.x[..., :4])
        return Readout(physical, _NONE, disturbance, _NONE, _NONE, certified=False)

    def events(self, state: Any) -> dict[str, int]:
        """Return no counts: these observers are not supervised."""
        return {}


def high_gain(
    arm: ElasticJointArm, theta: float, period: float, measurement_std: float
) -> ComparisonObserver:
    """Return the proportional high-gain observer (PO) with poles at −θ·(1, 1.1, 1.2, 1.3)."""
    inner = HighGainObserver(arm, theta)
    return ComparisonObserver(inner, inner.initial(), arm, period, measurement_std)


def proportional_integral(
    arm: ElasticJointArm, theta: float, period: float, measurement_std: float
) -> ComparisonObserver:
    """Return the proportional-integral observer (PIO) with poles at −θ·(1, …, 1.4)."""
    inner = ProportionalIntegralObserver(arm, theta)
    return ComparisonObserver(inner, inner.initial(), arm, period, measurement_std)
