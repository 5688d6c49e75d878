# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""PO, PIO and EKF against their definitions, exact solutions and an independent filter."""

from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

from tsobs_ros.design.request import ArmRequest, DisturbanceTerm
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation import baselines
from tsobs_ros.estimation.baselines import (
    ExtendedKalmanFilter,
    HighGainObserver,
    ProportionalIntegralObserver,
    place_single_output,
)
from tsobs_ros.estimation.observer import CertifiedGain, GainMode, TSObserver
from tsobs_ros.estimation.records import Innovation, Measurement
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.paper.observer import paper_observer
from tsobs_ros.simulation.integrator import ArmIntegrator
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

Array = NDArray[np.float64]

ARM = ElasticJointArm()
# So little gravity that the arm is linear to rounding.
LINEAR = ElasticJointArm(gravity_torque=1e-12)
PERIOD = 0.005
START = np.array([0.3, 0.0, 2.0, 0.0])
RUN = simulate(SCENARIOS["noise"], [3], 20.0)


@pytest.mark.parametrize("theta", [2.0, 5.0])
def test_observers_have_their_poles(theta: float) -> None:
    arm = ARM.slope_matrix(1.0)
    high = arm - np.outer(HighGainObserver(ARM, theta).K, ARM.output_matrix)
    joined = block_diag(0.0, arm)
    joined[0, 1] = 1.0  # the integral of the error
    joined[:, 0] -= ProportionalIntegralObserver(ARM, theta).K
    for closed, spread in ((high, [1.3, 1.2, 1.1, 1.0]), (joined, [1.4, 1.3, 1.2, 1.1, 1.0])):
        poles = np.sort(np.linalg.eigvals(closed).real)
        np.testing.assert_allclose(poles, -theta * np.array(spread), rtol=1e-5)


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
    for index in range(1200):
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


def follow(estimator: Any) -> tuple[Tracker[Any], Array]:
    tracker: Tracker[Any] = Tracker(estimator, TrackerOptions(x_max=0.75))
    errors = []
    for k, y in enumerate(RUN.measurements[0]):
        stamp = 10**9 + 5_000_000 * k
        outcome = tracker.offer(Measurement(stamp, y, RUN.torques[0, k]), stamp)
        assert isinstance(outcome, Innovation)
        estimate = tracker.estimate(stamp)
        assert estimate is not None
        assert estimate.state_bound.size == estimate.disturbance_bound.size == 0
        assert not estimate.certified
        errors.append(estimate.state - ARM.to_physical(RUN.states[0, k]))
    return tracker, np.array(errors)


@pytest.mark.parametrize("make", [baselines.high_gain, baselines.proportional_integral])
def test_high_gain_observers_follow_the_arm(make: Any) -> None:
    tracker, errors = follow(make(ARM, 2.5, PERIOD, 0.028))
    assert tracker.used == len(RUN.times)
    assert np.sqrt((errors[2000:, 0] ** 2).mean()) < 0.02
    estimate = tracker.estimate(10**9 + 5_000_000 * (len(RUN.times) - 1))
    assert estimate is not None
    assert estimate.disturbance.size == 0


def test_the_tracker_takes_the_observers_own_steps() -> None:
    own = HighGainObserver(ARM, 2.5)
    tracker = Tracker[Any](baselines.high_gain(ARM, 2.5, PERIOD, 0.028), TrackerOptions(0.75))
    state = own.initial()
    for k in range(50):
        stamp, y, u = 10**9 + 5_000_000 * k, RUN.measurements[0, k], RUN.torques[0, k]
        tracker.offer(Measurement(stamp, y, u), stamp)
        state, _ = own.correct(state, y)
        estimate = tracker.estimate(stamp)
        assert estimate is not None
        assert (estimate.state == ARM.to_physical(own.predict(state, u, 0.0).x)).all()
        state = own.predict(state, u, PERIOD)


def test_the_papers_observer_does_not_find_the_arm() -> None:
    _, errors = follow(paper_observer(ARM, PERIOD, 0.028))
    # It is an open-loop simulation from another start: the error neither decays nor grows.
    early, late = (
        np.sqrt((errors[part, 0] ** 2).mean()) for part in (slice(0, 2000), slice(2000, None))
    )
    assert late > 0.3 * early > 0.02


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: HighGainObserver(ARM, [1.0, -1.0]), "theta: expected .* above 0, got -1"),
        (lambda: ProportionalIntegralObserver(ARM, float("nan")), "theta: expected .* got nan"),
        (
            lambda: ExtendedKalmanFilter(ArmRequest().flow, np.eye(1), np.eye(4)),
            r"initial covariance: expected shape \(5, 5\), got \(4, 4",
        ),
        (
            lambda: place_single_output(np.diag([-1.0, -2.0]), np.array([[1.0, 0.0]]), [-3, -4]),
            "C: expected an output that sees all 2 modes of A",
        ),
        (lambda: paper_observer(ElasticJointArm(stiffness=11.0), PERIOD, 0.028), "Example 3"),
    ],
)
def test_wrong_numbers_are_named(make: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        make()
