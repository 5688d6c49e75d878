# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observers on T–S systems given by their matrices: known answers, Monte Carlo, adaptation."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from tsobs_ros.design.file import load_request
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import DisturbanceTerm, TSRequest
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import Estimator, State, certified_estimator
from tsobs_ros.estimation.options import AdaptationOptions, CertifiedGain, GainMode
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.model.uncertainty import arm_uncertainty
from tsobs_ros.resources import config_path

Array = NDArray[np.float64]

RUNS = 1000


def settled(observer: Estimator, design: Design, x: Array) -> State:
    """Return a state, or a batch, in which the certified gain is in use."""
    batch = x.shape[:-1]
    bound = np.broadcast_to(design.covariance_bound, (*batch, *design.covariance_bound.shape))
    return observer.initial(batch).changed(
        x=x, covariance=bound, settling=np.zeros(batch), certified=np.ones(batch)
    )


@pytest.fixture(scope="module")
def pendulum() -> Design:
    """The shipped example: an encoder, a gyroscope with a bias, gravity uncertain by 20 %."""
    return synthesise(load_request(config_path("ts_example.request.yaml")))


@pytest.fixture(scope="module")
def linear() -> Design:
    """One rule, two states, two outputs of which the second has a bias."""
    rules = RuleBase(((membership("always", {}),),))
    A = np.array([[[0.0, 1.0], [-2.0, -0.3]]])
    model = TSModel(A, np.array([[0.0], [1.0]]), np.eye(2), rules, np.ones((1, 2)))
    return synthesise(
        TSRequest(
            model=model,
            disturbance=[[DisturbanceTerm("clean")], [DisturbanceTerm("bias")]],
            process_noise=[1e-3, 1e-2],
            measurement_std=[0.1, 0.05],
            rate=50.0,
            initial_std=[1.0, 1.0],
        )
    )


def true_pendulum(gravity: float = 9.81) -> Callable[[Array, Array], Array]:
    """The equation itself, not its rules."""

    def derivative(x: Array, u: Array) -> Array:
        swing = -gravity * np.sin(x[..., 0]) - 0.2 * x[..., 1] + u[..., 0]
        return np.stack([x[..., 1], swing], axis=-1)

    return derivative


class Campaign(NamedTuple):
    """Errors at checkpoints, shape (checkpoints, runs, 3), and the largest angle."""

    errors: Array
    widest: float


@pytest.fixture(scope="module")
def campaign(pendulum: Design, runge_kutta: Callable[..., Array]) -> Campaign:
    """Pendulums that follow the equation, kicked every quarter step, from errors as large as X."""
    rng = np.random.default_rng(20260301)
    T, substeps = pendulum.request.period, 4
    h = T / substeps
    derivative = true_pendulum()
    x = np.array([0.8, 0.0]) + rng.standard_normal((RUNS, 2)) * [0.05, 0.2]
    bias = 0.1 * rng.standard_normal((RUNS, 1))
    start = rng.standard_normal((RUNS, 3)) @ np.linalg.cholesky(pendulum.covariance_bound).T
    observer = pendulum.observer()
    state = settled(observer, pendulum, np.hstack([x, bias]) + start)
    errors, widest = [], 0.0
    for k in range(800):
        widest = max(widest, float(np.abs(x[:, 0]).max()))
        if k % 100 == 99:
            errors.append(state.x - np.hstack([x, bias]))
        u = np.full((RUNS, 1), 1.5 * math.sin(1.3 * k * T))
        y = x + np.hstack([np.zeros((RUNS, 1)), bias])
        y = y + rng.standard_normal((RUNS, 2)) * [0.01, 0.02]
        state, _ = observer.correct(state, y)
        state = observer.predict(state, u, T)
        assert state.certified.all()
        for _ in range(substeps):
            x = runge_kutta(lambda z, u=u: derivative(z, u), x, h)
            x = x + rng.standard_normal((RUNS, 2)) * [0.0, math.sqrt(1e-3 * h)]
        bias = bias + math.sqrt(1e-6 * T) * rng.standard_normal((RUNS, 1))
    return Campaign(np.array(errors), widest)


def test_the_covariance_of_the_errors_stays_below_the_bound(
    campaign: Campaign, pendulum: Design
) -> None:
    """For samples whose covariance is X the largest eigenvalue of X⁻¹cov(e) tends to
    (1 + √(3/1000))² = 1.11, with a deviation of about 0.03.
    """
    assert 0.9 < campaign.widest < 1.2
    root = np.linalg.cholesky(pendulum.P)
    for errors in campaign.errors:
        spread = root.T @ (errors.T @ errors / RUNS) @ root
        assert np.linalg.eigvalsh(spread)[-1] < 1.2


def test_the_bound_is_not_idle(campaign: Campaign, pendulum: Design) -> None:
    share = np.sqrt((campaign.errors**2).mean(axis=(0, 1))) / pendulum.bound_std
    assert (share > 0.7).all()
    assert (share < 1.03).all()


def test_adaptation_finds_the_true_parameter(
    pendulum: Design, runge_kutta: Callable[..., Array]
) -> None:
    """Gravity differs by θ; the truth is the equation, both sensors are noisy, one has a bias."""
    theta, observer = -0.15, pendulum.adaptive(1.0, options=AdaptationOptions(start=1.0))
    rng = np.random.default_rng(7)
    T = pendulum.request.period
    derivative = true_pendulum(9.81 * (1.0 + theta))
    state, x = observer.initial(), np.array([0.5, 0.0])
    for k in range(2500):
        u = np.array([2.0 * math.sin(2.1 * k * T) + 1.0 * math.sin(0.7 * k * T)])
        y = x + np.array([0.0, 0.05]) + rng.standard_normal(2) * [0.01, 0.02]
        state, correction = observer.correct(state, y)
        assert correction.innovation_covariance.shape == (2, 2)
        state = observer.predict(state, u, T)
        x = runge_kutta(lambda z, u=u: derivative(z, u), x, T)
    readout = observer.readout(state)
    assert readout.parameters_valid
    # Adapted, but the certificate was not asked to cover θ.
    assert not readout.certified
    assert readout.parameters[0] == pytest.approx(theta, abs=0.005)
    assert abs(readout.parameters[0] - theta) < 4.0 * readout.parameter_bound[0]
    np.testing.assert_allclose(readout.state, x, atol=0.01)
    np.testing.assert_allclose(readout.disturbance, [0.0, 0.05], atol=0.006)


def test_known_parameters_are_those_of_the_changed_model(pendulum: Design) -> None:
    """Predicting with θ is predicting with Aᵢ + θEᵢ; and θ = 0 is the plain prediction."""
    request, flow, observer = pendulum.request, pendulum.request.flow, pendulum.adaptive()
    assert request.uncertainty is not None
    x, u, covariance = np.array([0.7, -0.4, 0.1]), np.array([1.5]), np.diag([0.1, 0.2, 0.3])
    state = observer.initial().changed(x=x, covariance=covariance)
    moved = observer.predict(state, u, 0.01)
    expected = flow.predict_with_covariance(x, covariance, u, 0.01)
    np.testing.assert_allclose(moved.x, expected[0], rtol=1e-13)
    np.testing.assert_allclose(moved.covariance, expected[1], rtol=1e-12, atol=1e-16)

    model = request.model
    changed = replace(model, A=model.A + 0.15 * request.uncertainty.linear[0])
    np.testing.assert_allclose(changed.A[:, 1, 0], 1.15 * request.model.A[:, 1, 0])
    state = state.changed(theta=0.15)
    for _ in range(100):
        state = observer.predict(state, u, 0.01)
    truth = solve_ivp(
        lambda _, z: changed.derivative(z, u), (0.0, 1.0), x[:2], rtol=1e-9, atol=1e-10
    )
    np.testing.assert_allclose(state.x[:2], truth.y[:, -1], atol=1e-3)


def test_the_readout_is_in_the_models_own_terms(pendulum: Design) -> None:
    observer = pendulum.observer()
    x = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    readout = observer.readout(settled(observer, pendulum, x))
    np.testing.assert_array_equal(readout.state, [[0.1, 0.2], [0.4, 0.5]])
    np.testing.assert_allclose(readout.state_bound, [pendulum.bound_std[:2]] * 2, rtol=1e-12)
    np.testing.assert_array_equal(readout.disturbance, [[0.0, 0.3], [0.0, 0.6]])
    own = [0.0, pendulum.bound_std[2]]
    np.testing.assert_allclose(readout.disturbance_bound, [own, own], rtol=1e-12)


def test_what_cannot_be_learnt_is_refused(pendulum: Design, linear: Design) -> None:
    arm = arm_uncertainty(ElasticJointArm(), {"stiffness": 0.2})
    with pytest.raises(ModelError, match=r"shape \(2, 2, 3\) for TSFlow, got \(1, 4, 7\)"):
        certified_estimator(
            pendulum.request.flow,
            np.eye(2),
            np.eye(3),
            CertifiedGain(pendulum.K, np.eye(3)),
            uncertainty=arm,
        )
    with pytest.raises(ModelError, match="expected at least one parameter to learn, got none"):
        linear.adaptive()
