# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observers on T–S systems given by their matrices: Monte Carlo, adaptation, supervision."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.design.file import load_request
from tsobs_ros.design.record import Design
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation.records import Basis, Hypothesis
from tsobs_ros.resources import config_path

Array = NDArray[np.float64]
RUNS, NOISE = 500, np.array([0.01, 0.02])


@pytest.fixture(scope="module")
def pendulum() -> Design:
    """The shipped example: an encoder, a gyroscope with a bias, gravity uncertain by 20 %."""
    return synthesise(load_request(config_path("ts_example.request.yaml")))


def swing(gravity: float, x: Array, u: Array) -> Array:
    """The equation itself, not its rules."""
    rate = -gravity * np.sin(x[..., 0]) - 0.2 * x[..., 1] + u[..., 0]
    return np.stack([x[..., 1], rate], axis=-1)


class Campaign(NamedTuple):
    """Errors at checkpoints, shape (checkpoints, runs, 3), and the largest angle."""

    errors: Array
    widest: float


@pytest.fixture(scope="module")
def campaign(pendulum: Design, runge_kutta: Callable[..., Array]) -> Campaign:
    """Pendulums that follow the equation, kicked every quarter step, from errors as large as X."""
    rng, T, substeps = np.random.default_rng(20260301), pendulum.request.period, 4
    h = T / substeps
    x = np.array([0.8, 0.0]) + rng.standard_normal((RUNS, 2)) * [0.05, 0.2]
    bias = 0.1 * rng.standard_normal((RUNS, 1))
    start = rng.standard_normal((RUNS, 3)) @ np.linalg.cholesky(pendulum.covariance_bound).T
    observer = pendulum.observer()
    state = observer.initial((RUNS,))
    design = state.records["hypotheses"][:, 0]
    design["x"][:, :3] = np.hstack([x, bias]) + start
    design["settling"], design["certified"] = 0.0, 1
    errors, widest = [], 0.0
    for k in range(400):
        widest = max(widest, float(np.abs(x[:, 0]).max()))
        if k % 100 == 99:
            errors.append(state.x - np.hstack([x, bias]))
        u = np.full((RUNS, 1), 1.5 * math.sin(1.3 * k * T))
        y = x + np.hstack([np.zeros((RUNS, 1)), bias]) + rng.standard_normal((RUNS, 2)) * NOISE
        state, _ = observer.correct(state, y)
        state = observer.predict(state, u, T)
        assert state.certified.all()
        for _ in range(substeps):
            x = runge_kutta(lambda z, u=u: swing(9.81, z, u), x, h)
            x = x + rng.standard_normal((RUNS, 2)) * [0.0, math.sqrt(1e-3 * h)]
        bias = bias + math.sqrt(1e-6 * T) * rng.standard_normal((RUNS, 1))
    return Campaign(np.array(errors), widest)


def test_the_covariance_of_the_errors_stays_below_the_bound_which_is_not_idle(
    campaign: Campaign, pendulum: Design
) -> None:
    """For samples whose covariance is X the largest eigenvalue of X⁻¹cov(e) tends to
    (1 + √(3/500))² = 1.16, with a deviation of about 0.04.
    """
    assert 0.9 < campaign.widest < 1.2
    root = np.linalg.cholesky(pendulum.P)
    for errors in campaign.errors:
        spread = root.T @ (errors.T @ errors / RUNS) @ root
        assert np.linalg.eigvalsh(spread)[-1] < 1.3
    share = np.sqrt((campaign.errors**2).mean(axis=(0, 1))) / pendulum.bound_std
    assert (share > 0.7).all()
    assert (share < 1.03).all()


def swung(theta: float, count: int, runge_kutta: Callable[..., Array]) -> tuple[Array, ...]:
    """Return true states, samples with a bias of the gyroscope, and inputs."""
    rng, T, x = np.random.default_rng(7), 0.01, np.array([0.5, 0.0])
    times = T * np.arange(count)
    inputs = (2.0 * np.sin(2.1 * times) + np.sin(0.7 * times))[:, np.newaxis]
    truth = []
    for u in inputs:
        truth.append(x)
        x = runge_kutta(lambda z, u=u: swing(9.81 * (1.0 + theta), z, u), x, T)
    states = np.array(truth)
    return states, states + [0.0, 0.05] + rng.standard_normal((count, 2)) * NOISE, inputs


def test_adaptation_finds_the_true_parameter(
    pendulum: Design, runge_kutta: Callable[..., Array]
) -> None:
    """Gravity differs by θ; the truth is the equation, both sensors are noisy, one has a bias."""
    theta, observer = -0.15, pendulum.observer(1.0, adapt=True)
    observer.learn(pendulum.request.uncertainty_model, start=1.0)
    assert pendulum.request.period == 0.01
    truth, y, u = swung(theta, 2500, runge_kutta)
    readout = observer.observe(y[np.newaxis], u[np.newaxis])
    assert readout.parameters_valid[0, -1]
    # Adapted, but the certificate was not asked to cover θ.
    assert readout.basis[0, -1] != Basis.CERTIFIED
    assert readout.parameters[0, -1, 0] == pytest.approx(theta, abs=0.005)
    assert abs(readout.parameters[0, -1, 0] - theta) < 4.0 * readout.parameter_bound[0, -1, 0]
    np.testing.assert_allclose(readout.state[0, -1], truth[-1], atol=0.01)
    np.testing.assert_allclose(readout.disturbance[0, -1], [0.0, 0.05], atol=0.006)


@pytest.mark.parametrize("output", [0, 1])
@pytest.mark.parametrize("fault", ["jump", "missing"])
def test_what_happens_to_one_sensor_is_seen_and_survived(
    pendulum: Design, runge_kutta: Callable[..., Array], output: int, fault: str
) -> None:
    """There is no unknown torque, and only the gyroscope's disturbance is part of the design."""
    observer, (truth, y, u) = pendulum.supervised(), swung(0.0, 2000, runge_kutta)
    part = {"outlier": slice(1200, 1201), "jump": slice(1200, None), "missing": slice(1200, 1500)}
    y[part[fault], output] += math.nan if fault == "missing" else 0.5
    state, inside, jumps = observer.initial(), [], 0
    for k in range(2000):
        state, _ = observer.correct(state, y[k])
        said = observer.readout(state)
        inside.append((np.abs(said.state - truth[k]) <= 3.0 * said.state_bound).all())
        jumps = max(jumps, observer.events(state)["sensor jumps"])
        state = observer.predict(state, u[k], 0.01)
    assert np.mean(inside[1200:]) > 0.95
    assert jumps == (fault == "jump") or (fault, output) == ("jump", 0)
    assert observer.events(state)["hits"] == 0
    if (fault, output) == ("jump", 1):
        assert said.disturbance[1] == pytest.approx(0.55, abs=0.02)
    elif fault == "jump":
        assert said.hypothesis != Hypothesis.AS_DESIGNED
    assert not state.records["hypotheses"]["live"][0, Hypothesis.FORCE]
