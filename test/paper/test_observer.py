# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The method's observer: its equations, and what its structure makes of them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tsobs_ros.design.file import load_request
from tsobs_ros.design.request import TSRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.paper.augmentation import Augmentation, blend
from tsobs_ros.paper.examples import (
    EXAMPLE_3_H,
    EXAMPLE_3_P,
    PaperExample,
    example_1,
    example_2,
    example_3,
    torque,
)
from tsobs_ros.paper.observer import (
    AugmentedEstimates,
    AugmentedObserver,
    paper_observer,
    paper_system_observer,
    project,
)
from tsobs_ros.resources import config_path

Array = NDArray[np.float64]

EXAMPLE = example_1()
RANDOM = np.random.default_rng(11)
AUG = Augmentation(EXAMPLE.system, np.vstack([RANDOM.normal(size=(3, 3)), 2.0 * np.eye(3)]))
P = np.diag([1.0, 2.0, 1.5, 1.0, 0.7, 1.2])
M = np.linalg.solve(P, AUG.C_bar.T)
H1 = np.stack([3.0 * AUG.E_L_inverse[:, 3:], 4.0 * AUG.E_L_inverse[:, 3:]])
GAMMA = np.stack([np.diag([5.0, 1.0, 2.0]), np.array([[2.0, 0.5, 0], [0.5, 1, 0], [0, 0, 1]])])
START = np.array([0.1, -0.2, 0.3, 0.05, 0.0, -0.1])
# Fits the first sample, [0, 0.3, 0], so that the innovation is zero.
FITTING = np.concatenate([START[:3], np.array([0.0, 0.3, 0.0]) - AUG.C @ START[:3]])


def y_of(t: float) -> Array:
    return np.array([0.5 * np.sin(2 * t), 0.3 * np.cos(3 * t), 0.2 * np.sin(t) ** 2])


def y_rate(t: float) -> Array:
    return np.array([np.cos(2 * t), -0.9 * np.sin(3 * t), 0.2 * np.sin(2 * t)])


def u_of(t: float) -> Array:
    return np.array([np.sin(t)])


def run(
    observer: AugmentedObserver,
    end: float,
    step: float,
    start: Array = START,
    samples: Array | None = None,
    premises: Array | None = None,
) -> AugmentedEstimates:
    """Return the estimates at the end."""
    times = np.arange(round(end / step) + 1) * step
    y = np.stack([y_of(t) for t in times])
    z = y[:, :1] if premises is None else premises
    u = np.sin(times)[:, np.newaxis]
    states = observer.follow(y if samples is None else samples, u, step, z, start)
    return AugmentedEstimates(*(each[-1] for each in states))


def test_realisation_equals_the_observer_with_the_derivative_of_y() -> None:
    observer = AugmentedObserver(AUG, H1, M, GAMMA)

    def with_derivative(t: float, joined: Array) -> Array:
        x_bar, Xi = joined[:6], joined[6:].reshape(2, 3, 6)
        h2 = min(y_of(t)[0] ** 2, 1.0)
        innovation = y_of(t) - AUG.C_bar @ x_bar
        rate, Xi_rate = AUG.N1 @ y_of(t) + AUG.L1 @ y_rate(t), np.empty((2, 3, 6))
        for rule, weight in enumerate((1.0 - h2, h2)):
            rate = rate + weight * (
                AUG.A1[rule] @ x_bar
                + AUG.B1[rule] @ u_of(t)
                + H1[rule] @ innovation
                + M @ Xi[rule] @ x_bar
            )
            Xi_rate[rule] = weight * GAMMA[rule] @ np.outer(innovation, x_bar)
        return np.concatenate([rate, Xi_rate.ravel()])

    exact = solve_ivp(
        with_derivative, (0.0, 2.0), np.r_[START, np.zeros(36)], "DOP853", rtol=1e-11, atol=1e-12
    ).y[:, -1]
    errors = []
    for step in (0.04, 0.02, 0.01):
        state = run(observer, 2.0, step)
        errors.append(np.abs(state.x_bar - exact[:6]).max())
    # Signals are taken as linear between samples, so the whole is of second order.
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 2.0, atol=0.15)
    assert errors[-1] < 2e-4
    np.testing.assert_allclose(state.Xi, exact[6:].reshape(2, 3, 6), atol=2e-4)
    assert np.abs(state.Xi).max() > 0.05


def test_estimate_is_the_same_from_noise() -> None:
    observer = AugmentedObserver(AUG, H1, M)
    noise = np.random.default_rng(3).normal(size=(101, 3))
    noise[0] = y_of(0.0)
    honest = run(observer, 2.0, 0.02)
    fooled = run(observer, 2.0, 0.02, samples=noise)
    np.testing.assert_allclose(fooled.x, honest.x, atol=1e-13)
    np.testing.assert_allclose(fooled.innovation, honest.innovation, atol=1e-13)
    # It does depend on the premise.
    other = run(observer, 2.0, 0.02, premises=np.full((101, 1), 0.9))
    assert np.abs(other.x - honest.x).max() > 0.05


def test_adaptation_never_starts_from_a_fitting_estimate() -> None:
    observer = AugmentedObserver(AUG, H1, M, GAMMA)
    silent = run(observer, 3.0, 0.02, start=FITTING)
    assert np.abs(silent.Xi).max() < 1e-13
    system = EXAMPLE.system
    output = blend(system.rule_outputs, system.rule_base.weights(y_of(3.0)[:1]), silent.x)
    np.testing.assert_allclose(silent.disturbance, y_of(3.0) - output, atol=1e-12)
    assert np.abs(run(observer, 3.0, 0.02).Xi).max() > 0.05


def test_the_record_with_the_printed_gains_is_the_observer_with_the_sample_held() -> None:
    aug, record = Augmentation(example_3().system), paper_observer(ElasticJointArm(), 0.005, 0.028)
    M = np.linalg.solve(EXAMPLE_3_P, aug.C_bar.T)
    observer = AugmentedObserver(aug, aug.E_L_inverse @ EXAMPLE_3_H, M)
    y, u = np.full((201, 1), 0.4), np.full((201, 1), 0.3)
    # The record starts at ξ = 0, which is x̂̄ = E_L⁻¹L y.
    states = observer.follow(y, u, 0.005, estimate=aug.L1 @ y[0])
    estimates = Tracker(record).follow(10**9 + 5_000_000 * np.arange(201), y, u)
    expected = ElasticJointArm().to_physical(states.x)
    np.testing.assert_allclose(estimates.state, expected, atol=1e-6)
    np.testing.assert_allclose(estimates.disturbance, states.disturbance, atol=1e-6)
    assert np.ptp(expected[:, 0]) > 0.01


@pytest.mark.parametrize("example", [example_1(), example_2()], ids=["1", "2"])
def test_run_on_a_design_file_it_is_the_adaptive_observer_of_the_example(
    example: PaperExample,
) -> None:
    """But for inputs and premises that are held, and ω̂ by (29), which lags by a period."""
    request = load_request(config_path(f"paper_{example.name}.request.yaml"))
    assert isinstance(request, TSRequest)
    T, system = 1e-3, example.system
    times = np.arange(0.0, 6.0, T)
    u, y = torque(times), np.sin(times)[:, np.newaxis] * np.array([0.9, 0.5, -0.7])
    aug = Augmentation(system)
    adaptive = AugmentedObserver(
        aug, np.repeat(aug.L1[np.newaxis], 2, axis=0), aug.C_bar.T, example.Gamma
    )
    states = adaptive.follow(y, u, T, estimate=aug.L1 @ y[0])
    x, omega = states.x, states.disturbance

    estimator = paper_system_observer(replace(request, rate=1.0 / T))
    held = np.hstack([u, y[:, :1]])
    stamps = 10**9 + np.round(1e9 * times).astype(np.int64)
    estimates = Tracker(estimator).follow(stamps, y, held)
    np.testing.assert_allclose(estimates.state, x, atol=1e-3)
    np.testing.assert_allclose(estimates.disturbance, omega, atol=2e-3)
    assert np.abs(states.Xi).max() < 1e-12
    mismatch = np.abs(omega - (y - x @ system.C.T))
    assert mismatch.max() > 0.1, "(29) has nothing to do"


@pytest.mark.parametrize(
    ("premises", "message"),
    [
        ({"premise": [[0.0, 1.0, 0.0]], "schedule": []}, "premise 1 to be the output y1"),
        ({"schedule": [[2.0]]}, "premise 1 to be the output y1, or a scheduled signal of its name"),
        ({"schedule": [[0.0, 1.0]]}, "premise 1 to be the output y1"),
    ],
)
def test_premises_that_the_method_does_not_measure_are_refused(
    premises: dict[str, Any], message: str
) -> None:
    request = load_request(config_path("paper_example_1.request.yaml"))
    assert isinstance(request, TSRequest)
    model = replace(request.model, **{name: np.array(matrix) for name, matrix in premises.items()})
    scheduled = ("y1", "y2")[: model.schedule.shape[1]]
    names = replace(request.names, scheduled=scheduled)
    with pytest.raises(ModelError, match=message):
        paper_system_observer(replace(request, model=model, names=names))
    of_the_state = replace(request.model, premise=request.model.C[:1], schedule=np.zeros((1, 1)))
    assert paper_system_observer(replace(request, model=of_the_state)).shape.m == 2


@pytest.mark.parametrize("seed", range(4))
def test_projection_never_raises_the_lyapunov_function(seed: int) -> None:
    random = np.random.default_rng(seed)
    root = random.normal(size=(3, 3))
    gamma, limit = root @ root.T + 0.1 * np.eye(3), np.array(0.7)
    value = random.normal(size=(3, 6))
    value *= limit / np.linalg.norm(value, 2)
    rate = gamma @ random.normal(size=(3, 6))
    after = project(value, rate, gamma, limit)
    for _ in range(50):
        other = random.normal(size=(3, 6))
        other *= limit * random.uniform() / np.linalg.norm(other, 2)
        assert np.sum((value - other) * np.linalg.solve(gamma, after - rate)) <= 1e-12
    assert np.linalg.norm(value + 1e-6 * after, 2) <= limit + 1e-9
    left, _, right = np.linalg.svd(value)
    outward = left[:, 0] @ rate @ right[0]
    assert left[:, 0] @ after @ right[0] == pytest.approx(min(outward, 0.0), abs=1e-12)
    # Inside nothing is taken away, on a ball that is a point everything.
    assert (project(0.5 * value, rate, gamma, limit) == rate).all()
    assert (project(0.0 * value, rate, gamma, 0.0 * limit) == 0.0).all()
