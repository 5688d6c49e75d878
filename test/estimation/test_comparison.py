# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""PO, PIO and EKF against their definitions, exact solutions and an independent filter."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from bayesian_filters.kalman import KalmanFilter
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

from tsobs_ros.design.file import load_design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation import baselines
from tsobs_ros.estimation.baselines import (
    high_gain,
    high_gain_matrix,
    place_single_output,
    proportional_integral,
    proportional_integral_matrix,
)
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.history import EXTRA, GATED
from tsobs_ros.estimation.records import Innovation, Measurement
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.methods import make_ekf
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.paper.observer import paper_observer
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.integrator import ArmIntegrator
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

Array = NDArray[np.float64]

ARM = ElasticJointArm()
# So little gravity that the arm is linear to rounding.
LINEAR = ElasticJointArm(gravity_torque=1e-12)
PERIOD = 0.005
START = np.array([0.3, 0.0, 2.0, 0.0])
RUN = simulate(SCENARIOS["noise"], [3], 20.0)


KNOWN = (PERIOD, 0.028)


@pytest.mark.parametrize("theta", [2.0, 5.0])
def test_observers_have_their_poles(theta: float) -> None:
    arm = ARM.slope_matrix(1.0)
    high = arm - high_gain_matrix(ARM, theta) @ ARM.output_matrix
    joined = block_diag(0.0, arm)
    joined[0, 1] = 1.0  # the integral of the error
    joined[:, :1] -= proportional_integral_matrix(ARM, theta)
    for closed, spread in ((high, [1.3, 1.2, 1.1, 1.0]), (joined, [1.4, 1.3, 1.2, 1.1, 1.0])):
        poles = np.sort(np.linalg.eigvals(closed).real)
        np.testing.assert_allclose(poles, -theta * np.array(spread), rtol=1e-5)


def test_held_sample_is_integrated_exactly() -> None:
    A, C = LINEAR.slope_matrix(1.0), LINEAR.output_matrix
    y, u = np.array([0.4]), np.array([0.7])
    drive = LINEAR.input_matrix @ u

    high, K = high_gain(LINEAR, 4.0, *KNOWN), high_gain_matrix(LINEAR, 4.0)
    state, correction = high.correct(high.initial().changed(x=START), y)
    np.testing.assert_allclose(correction.innovation, 0.1)
    np.testing.assert_allclose(correction.innovation_covariance, 0.028**2)
    expected = exact(A - K @ C, K @ y + drive, START, 0.05)
    np.testing.assert_allclose(high.predict(state, u, 0.05).x, expected, rtol=1e-5, atol=1e-5)

    integral = proportional_integral(LINEAR, 4.0, *KNOWN)
    K = proportional_integral_matrix(LINEAR, 4.0)
    begun, _ = integral.correct(integral.initial().changed(x=np.r_[START, 0.0]), y)
    joined = block_diag(A, -K[0])
    joined[:4, 4:], joined[4:, :4] = K[1:], -C
    expected = exact(joined, np.r_[drive, y], np.r_[START, 0.0], 0.05)
    after = integral.predict(begun, u, 0.05)
    np.testing.assert_allclose(after.x, expected, rtol=1e-5, atol=1e-5)


def exact(A: Array, b: Array, x: Array, t: float) -> Array:
    n = len(x)
    joined = np.zeros((n + 1, n + 1))
    joined[:n, :n], joined[:n, n] = A, b
    return (expm(t * joined) @ np.r_[x, 1.0])[:n]


@pytest.mark.parametrize("make", [high_gain, proportional_integral])
@pytest.mark.parametrize("theta", [3.0, 6.0])
def test_converges_on_a_clean_output_for_every_run_of_a_batch(
    make: Callable[..., Estimator], theta: float
) -> None:
    truth, plant, samples = ARM.to_physical(START), ArmIntegrator(ARM, PERIOD), []
    torques = np.sin(np.arange(1200) * PERIOD)[:, np.newaxis]
    for u in torques:
        samples.append(truth[:1])
        truth = plant.advance(truth, u)
    observer = make(ARM, theta, *KNOWN)
    states = observer.initial((3,))
    for y, u in zip(samples, torques, strict=True):
        states, correction = observer.correct(states, y)
        assert correction.innovation.shape == (3, 1)
        states = observer.predict(states, u, PERIOD)
    error = np.abs(states.x[:, :4] - ARM.from_physical(truth))
    # What is left is the sample's age, half a period of the velocity.
    assert error[:, 0].max() < 0.01
    assert error.max() < 0.5
    assert (states.x[0] == states.x[2]).all()


@pytest.mark.parametrize("learns", [False, True])
def test_an_ekf_puts_late_samples_in_their_place(learns: bool) -> None:
    """The bits are those of samples in order, whatever the order and the ticks."""
    design = load_design(config_path(SHIPPED_DESIGN))
    count, random = 400, np.random.default_rng(5)
    stamps = 10**9 + 5_000_000 * np.arange(count)
    y, u = RUN.measurements[0, :count].copy(), RUN.torques[0, :count, 0]
    y[100] += 1.0  # is left out
    ends = [make_ekf(design, learns=learns).follow(stamps, y, u[:, None])[-1]]
    late = np.argsort(np.arange(count) + random.uniform(0.0, 8.0, count), kind="stable")
    ekf = make_ekf(design, learns=learns)
    known = np.array([150, 151, 300, count])
    rows = np.empty((4, len(ends[0])))
    outcomes, newest = np.zeros(count, np.int64), np.zeros(4, np.int64)
    codes = np.full((count, 1), -1)
    ticks = (stamps[[200, 200, 320, count - 1]], np.full(4, stamps[-1]), known, np.full(4, -1))
    samples = (stamps[late], y[late], u[late])
    ekf.advance(ticks, samples, (outcomes, codes, *np.empty((2, count, 1))), newest, rows)

    assert ekf.rewinds > 50
    assert rows[-1].tolist() == ends[0].tolist()
    assert outcomes[late == 100] == GATED
    assert (codes[:, 0] == outcomes).all()


def test_an_ekf_refuses_what_its_sizes_do_not_fit() -> None:
    ekf = make_ekf(load_design(config_path(SHIPPED_DESIGN)))
    stamps, y = np.arange(1, 4), np.zeros((3, 1))
    results = (np.zeros(3, np.int64), np.zeros((3, 1), np.int64), y.copy(), y.copy())
    newest, rows = np.zeros(1, np.int64), np.zeros((1, ekf.row_width + EXTRA))

    def advance(ends: int, rows: Array, u: Array) -> None:
        ticks = (stamps[-1:], stamps[-1:], np.array([ends]), np.array([-1]))
        ekf.advance(ticks, (stamps, y, u), results, newest, rows)

    advance(3, rows, np.zeros(3))
    assert newest[0] == 3
    with pytest.raises(ValueError, match="kalman_advance: ends: expected at most 3"):
        advance(4, rows, np.zeros(3))
    with pytest.raises(ValueError, match="kalman_advance: rows: expected at least"):
        advance(3, rows[:, :-1].copy(), np.zeros(3))
    with pytest.raises(ValueError, match="kalman_advance: u: expected at least 3 numbers, got 2"):
        advance(3, rows, np.zeros(2))
    ekf.memory["length"] = -1
    with pytest.raises(ValueError, match="kalman_advance: memory: its ring is damaged"):
        advance(3, rows, np.zeros(3))


def test_an_ekf_is_the_textbook_filter_on_a_linear_arm() -> None:
    request = ArmRequest(arm=LINEAR, disturbance=(DisturbanceTerm("bias"),))
    std = np.sqrt(np.diag(request.initial_covariance))
    flow, options = request.flow, TrackerOptions(x_max=0.75)
    variances = np.diag(request.measurement_covariance).copy()
    ekf = baselines.KalmanFilter(flow, variances, std, gate=np.inf, options=options)
    textbook = KalmanFilter(dim_x=5, dim_z=1, dim_u=1)
    step = flow.transition(PERIOD)
    textbook.F, textbook.B, textbook.Q = step.phi, step.gamma, step.noise
    textbook.H, textbook.R = flow.output_matrix, request.measurement_covariance
    textbook.P = request.initial_covariance.copy()
    random = np.random.default_rng(2)
    y, u = random.normal(0.0, 0.3, (300, 1)), random.normal(size=(300, 1))
    rows = ekf.follow(10**9 + 5_000_000 * np.arange(300), y, u)
    for k in range(300):
        textbook.update(y[k])
        states = LINEAR.to_physical(textbook.x[:4, 0])
        np.testing.assert_allclose(rows[k, ekf.row_parts["state"]], states, atol=1e-7)
        bound = np.sqrt(textbook.P[4, 4])
        np.testing.assert_allclose(rows[k, ekf.row_parts["disturbance_bound"]], bound, rtol=1e-6)
        textbook.predict(u[k, :, None])


def follow(estimator: Estimator) -> tuple[Tracker, Array]:
    tracker = Tracker(estimator, TrackerOptions(x_max=0.75))
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


@pytest.mark.parametrize("make", [high_gain, proportional_integral])
def test_high_gain_observers_follow_the_arm(make: Callable[..., Estimator]) -> None:
    tracker, errors = follow(make(ARM, 2.5, *KNOWN))
    assert tracker.used == len(RUN.times)
    assert np.sqrt((errors[2000:, 0] ** 2).mean()) < 0.02
    estimate = tracker.estimate(10**9 + 5_000_000 * (len(RUN.times) - 1))
    assert estimate is not None
    assert estimate.disturbance.size == 0


def test_the_papers_observer_does_not_find_the_arm() -> None:
    _, errors = follow(paper_observer(ARM, *KNOWN))
    # It is an open-loop simulation from another start: the error neither decays nor grows.
    early, late = (
        np.sqrt((errors[part, 0] ** 2).mean()) for part in (slice(0, 2000), slice(2000, None))
    )
    assert late > 0.3 * early > 0.02


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: high_gain(ARM, -1.0, *KNOWN), "theta: expected .* above 0, got -1"),
        (lambda: proportional_integral(ARM, float("nan"), *KNOWN), "theta: expected .* got nan"),
        (lambda: high_gain(ARM, 2.0, 0.0, 0.028), "period: expected .* above 0, got 0"),
        (lambda: high_gain(ARM, 2.0, PERIOD, 0.0), "measurement_std: expected .* above 0, got 0"),
        (
            lambda: place_single_output(np.diag([-1.0, -2.0]), np.array([[1.0, 0.0]]), [-3, -4]),
            "C: expected an output that sees all 2 modes of A",
        ),
        (lambda: paper_observer(ElasticJointArm(stiffness=11.0), *KNOWN), "Example 3"),
    ],
)
def test_wrong_numbers_are_named(make: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        make()
