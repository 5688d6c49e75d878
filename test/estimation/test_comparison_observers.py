# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""PO, PIO and EKF against their definitions, exact solutions and an independent filter."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray
from scipy.linalg import expm

from tsobs_ros.design.request import ArmRequest, DisturbanceTerm
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.baselines import (
    ExtendedKalmanFilter,
    HighGainObserver,
    ProportionalIntegralObserver,
    place_single_output,
)
from tsobs_ros.estimation.observer import CertifiedGain, GainMode, TSObserver
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.simulation.integrator import ArmIntegrator

Array = NDArray[np.float64]

ARM = ElasticJointArm()
# So little gravity that the arm is linear to rounding.
LINEAR = ElasticJointArm(gravity_torque=1e-12)
PERIOD = 0.005
START = np.array([0.3, 0.0, 2.0, 0.0])


def test_high_gain_observer_has_its_poles() -> None:
    observer = HighGainObserver(ARM, [2.0, 5.0])
    for theta, K in zip((2.0, 5.0), observer.K, strict=True):
        closed = ARM.slope_matrix(1.0) - np.outer(K, ARM.output_matrix)
        poles = np.sort(np.linalg.eigvals(closed).real)
        np.testing.assert_allclose(poles, -theta * np.array([1.3, 1.2, 1.1, 1.0]), rtol=1e-6)


def test_proportional_integral_observer_has_its_poles() -> None:
    observer = ProportionalIntegralObserver(ARM, 3.0)
    closed = np.zeros((5, 5))
    closed[0, 1] = 1.0
    closed[1:, 1:] = ARM.slope_matrix(1.0)
    closed[:, 0] -= observer.K
    poles = np.sort(np.linalg.eigvals(closed).real)
    np.testing.assert_allclose(poles, -3.0 * np.array([1.4, 1.3, 1.2, 1.1, 1.0]), rtol=1e-5)


def test_poles_cannot_be_placed_where_the_output_is_blind() -> None:
    with pytest.raises(ModelError, match="C: expected an output that sees all 2 modes of A"):
        place_single_output(np.diag([-1.0, -2.0]), np.array([[1.0, 0.0]]), [-3.0, -4.0])


def test_held_sample_is_integrated_exactly() -> None:
    A, C = LINEAR.slope_matrix(1.0), LINEAR.output_matrix
    y, u = np.array([0.4]), np.array([0.7])
    drive = LINEAR.input_matrix @ u

    high = HighGainObserver(LINEAR, 4.0)
    state, innovation = high.correct(high.initial()._replace(x=START), y)
    np.testing.assert_allclose(innovation, 0.1)
    closed = A - np.outer(high.K, C)
    expected = exact(closed, np.r_[high.K * y + drive], START, 0.05)
    np.testing.assert_allclose(high.predict(state, u, 0.05).x, expected, rtol=1e-5, atol=1e-5)

    integral = ProportionalIntegralObserver(LINEAR, 4.0)
    begun, _ = integral.correct(integral.initial()._replace(x=START), y)
    joined = np.zeros((5, 5))
    joined[0, 1:] = -C[0]
    joined[1:, 1:] = A
    joined[0, 0] -= integral.K[0]
    joined[1:, 0] += integral.K[1:]
    expected = exact(joined, np.r_[y, drive], np.r_[0.0, START], 0.05)
    after = integral.predict(begun, u, 0.05)
    np.testing.assert_allclose(np.r_[after.integral_error, after.x], expected, rtol=1e-5, atol=1e-5)


def exact(A: Array, b: Array, x: Array, t: float) -> Array:
    n = len(x)
    joined = np.zeros((n + 1, n + 1))
    joined[:n, :n], joined[:n, n] = A, b
    return (expm(t * joined) @ np.r_[x, 1.0])[:n]


@pytest.mark.parametrize("kind", [HighGainObserver, ProportionalIntegralObserver])
def test_converges_on_a_clean_output_for_every_theta_of_a_batch(
    kind: type[HighGainObserver] | type[ProportionalIntegralObserver],
) -> None:
    observer = kind(ARM, np.array([[3.0], [6.0]]))
    state = observer.initial((2, 3))
    truth = ARM.to_physical(START)
    plant = ArmIntegrator(ARM, PERIOD)
    for index in range(2000):
        u = np.array([np.sin(index * PERIOD)])
        state, innovation = observer.correct(state, truth[:1])  # type: ignore[arg-type]
        assert innovation.shape == (2, 3, 1)
        state = observer.predict(state, u, PERIOD)  # type: ignore[arg-type]
        truth = plant.advance(truth, u)
    error = np.abs(state.x - ARM.from_physical(truth))
    # What is left is the sample's age, half a period of the velocity.
    assert error[..., 0].max() < 0.01
    assert error.max() < 0.5
    np.testing.assert_allclose(state.x[:, 0], state.x[:, 2])


def test_kalman_filter_is_the_riccati_mode_of_the_certified_observer() -> None:
    request = ArmRequest()
    ekf = ExtendedKalmanFilter(
        request.flow, request.measurement_covariance, request.initial_covariance
    )
    certified = TSObserver(
        request.flow,
        request.measurement_covariance,
        request.initial_covariance,
        CertifiedGain(np.zeros((5, 1)), np.eye(5)),
        gain_mode=GainMode.RICCATI,
    )
    random = np.random.default_rng(1)
    one, other = ekf.initial((3,)), certified.initial((3,))
    for _ in range(200):
        y, u = random.normal(0.0, 0.3, size=(3, 1)), random.normal(size=(3, 1))
        one, innovation = ekf.correct(one, y)
        other, correction = certified.correct(other, y)
        np.testing.assert_allclose(innovation, correction.innovation, atol=1e-9)
        one, other = ekf.predict(one, u, PERIOD), certified.predict(other, u, PERIOD)
    np.testing.assert_allclose(one.x, other.x, atol=1e-9)
    np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-12)


def test_kalman_filter_is_the_textbook_one_on_a_linear_arm() -> None:
    request = ArmRequest(arm=LINEAR, disturbance=(DisturbanceTerm("bias"),))
    flow = request.flow
    ekf = ExtendedKalmanFilter(flow, request.measurement_covariance, request.initial_covariance)
    textbook = KalmanFilter(dim_x=5, dim_z=1, dim_u=1)
    step = flow.transition(PERIOD)
    textbook.F, textbook.B, textbook.Q = step.phi, step.gamma, step.noise
    textbook.H, textbook.R = flow.output_matrix, request.measurement_covariance
    textbook.P = request.initial_covariance.copy()
    state = ekf.initial()
    random = np.random.default_rng(2)
    for _ in range(300):
        y, u = random.normal(0.0, 0.3, size=1), random.normal(size=1)
        state, _ = ekf.correct(state, y)
        textbook.update(y)
        np.testing.assert_allclose(state.x, textbook.x[:, 0], atol=1e-8)
        state = ekf.predict(state, u, PERIOD)
        textbook.predict(u[:, None])
    np.testing.assert_allclose(state.covariance, textbook.P, atol=1e-9)


def test_wrong_numbers_are_named() -> None:
    with pytest.raises(ModelError, match="theta: expected a finite number above 0, got -1"):
        HighGainObserver(ARM, [1.0, -1.0])
    with pytest.raises(ModelError, match="theta: expected a finite number above 0, got nan"):
        ProportionalIntegralObserver(ARM, float("nan"))
    request = ArmRequest()
    with pytest.raises(
        ModelError, match=r"initial covariance: expected shape \(5, 5\), got \(4, 4"
    ):
        ExtendedKalmanFilter(request.flow, request.measurement_covariance, np.eye(4))
