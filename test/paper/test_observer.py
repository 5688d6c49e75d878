# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The method's observer: its equations, and what its structure makes of them."""

from collections.abc import Callable
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
from tsobs_ros.paper.augmentation import Augmentation
from tsobs_ros.paper.examples import (
    EXAMPLE_3_H,
    EXAMPLE_3_P,
    PaperExample,
    arm_system,
    example_1,
    example_2,
)
from tsobs_ros.paper.observer import (
    AdaptiveObserver,
    clip,
    paper_observer,
    paper_system_observer,
    project,
)
from tsobs_ros.resources import config_path

Array = NDArray[np.float64]
Signal = Callable[[float], Array]

EXAMPLE = example_1()
RANDOM = np.random.default_rng(11)
AUG = Augmentation(EXAMPLE.system, np.vstack([RANDOM.normal(size=(3, 3)), 2.0 * np.eye(3)]))
P = np.diag([1.0, 2.0, 1.5, 1.0, 0.7, 1.2])
M = np.linalg.solve(P, AUG.C_bar.T)
H1 = np.stack([3.0 * AUG.E_L_inverse[:, 3:], 4.0 * AUG.E_L_inverse[:, 3:]])
GAMMA = np.stack([np.diag([5.0, 1.0, 2.0]), np.array([[2.0, 0.5, 0], [0.5, 1, 0], [0, 0, 1]])])
FREE = np.full(2, np.inf)
START = np.array([0.1, -0.2, 0.3, 0.05, 0.0, -0.1])


def y_of(t: float) -> Array:
    return np.array([0.5 * np.sin(2 * t), 0.3 * np.cos(3 * t), 0.2 * np.sin(t) ** 2])


def y_rate(t: float) -> Array:
    return np.array([np.cos(2 * t), -0.9 * np.sin(3 * t), 0.2 * np.sin(2 * t)])


def u_of(t: float) -> Array:
    return np.array([np.sin(t)])


def solved(rate: Callable[[float, Array], Array], start: Array, times: Array) -> Array:
    """Return a state at times, shape (times, n)."""
    options = {"rtol": 1e-11, "atol": 1e-12, "t_eval": times}
    return solve_ivp(rate, (times[0], times[-1]), start, "DOP853", **options).y.T


def run(
    observer: AdaptiveObserver, times: Array, x_bar: Array, y: Signal = y_of, u: Signal = u_of
) -> tuple[Array, Array, Array]:
    """Return x̂̄, ω̂ and Ξ̂ at times."""
    aug = observer.augmentation
    r, size, p = observer.H1.shape

    def read(t: float) -> tuple[Array, Array]:
        return y(t), aug.system.rule_base.weights(y(t)[:1])

    def rate(t: float, state: Array) -> Array:
        (sample, h), Xi = read(t), state[size:].reshape(r, p, size)
        own, learnt = observer.rates(state[:size], Xi, sample, u(t), h)
        return np.concatenate([own, learnt.ravel()])

    start = np.concatenate([x_bar - aug.L1 @ y(times[0]), np.zeros(r * p * size)])
    states = solved(rate, start, times)
    pairs = zip(times, states, strict=True)
    each = [observer.estimates(state[:size], *read(t)) for t, state in pairs]
    x_bar, omega, _ = (np.array(column) for column in zip(*each, strict=True))
    return x_bar, omega, states[:, size:].reshape(-1, r, p, size)


def test_realisation_equals_the_observer_with_the_derivative_of_y() -> None:
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

    times = np.array([0.0, 1.0, 2.0])
    exact = solved(with_derivative, np.r_[START, np.zeros(36)], times)
    x_bar, _, Xi = run(AdaptiveObserver(AUG, H1, M, GAMMA, FREE), times, START)
    np.testing.assert_allclose(x_bar, exact[:, :6], atol=1e-8)
    np.testing.assert_allclose(Xi, exact[:, 6:].reshape(-1, 2, 3, 6), atol=1e-8)
    assert np.abs(Xi).max() > 0.05


def test_the_record_with_the_printed_gains_is_the_observer_with_the_sample_held() -> None:
    arm = ElasticJointArm()
    aug, record = Augmentation(arm_system(arm)), paper_observer(arm, 0.005, 0.028)
    M = np.linalg.solve(EXAMPLE_3_P, aug.C_bar.T)
    gains, still = (aug.E_L_inverse @ EXAMPLE_3_H, M, np.zeros((2, 1, 1))), np.full(1, 0.4)
    y, u = np.full((201, 1), 0.4), np.full((201, 1), 0.3)
    # The record starts at ξ = 0, which is x̂̄ = E_L⁻¹L y.
    x_bar, omega, _ = run(
        AdaptiveObserver(aug, *gains, FREE), 0.005 * np.arange(201), aug.L1 @ still,
        lambda t: still, lambda t: np.full(1, 0.3),
    )  # fmt: skip
    estimates = Tracker(record).follow(10**9 + 5_000_000 * np.arange(201), y, u)
    expected = arm.to_physical(x_bar[:, :4])
    np.testing.assert_allclose(estimates.state, expected, atol=1e-6)
    np.testing.assert_allclose(estimates.disturbance, omega, atol=1e-6)
    assert np.ptp(expected[:, 0]) > 0.01


@pytest.mark.parametrize(("number", "example"), [(1, example_1()), (2, example_2())])
def test_run_on_a_design_file_it_is_the_adaptive_observer_of_the_example(
    number: int, example: PaperExample
) -> None:
    """But for inputs and premises that are held, and ω̂ by (29), which lags by a period."""
    request = load_request(config_path(f"paper_example_{number}.request.yaml"))
    assert isinstance(request, TSRequest)

    def y_of(t: float) -> Array:
        return np.sin(t) * np.array([0.9, 0.5, -0.7])

    T, system = 1e-3, example.system
    times = np.arange(0.0, 6.0, T)
    y = np.array([y_of(t) for t in times])
    aug = Augmentation(system)
    gains = np.repeat(aug.L1[np.newaxis], 2, axis=0), aug.C_bar.T, example.Gamma
    observer = AdaptiveObserver(aug, *gains, FREE)
    x_bar, omega, Xi = run(observer, times, aug.L1 @ y[0], y_of)
    estimator = paper_system_observer(replace(request, rate=1.0 / T))
    held = np.stack([np.sin(times), y[:, 0]], axis=1)
    stamps = 10**9 + np.round(1e9 * times).astype(np.int64)
    estimates = Tracker(estimator).follow(stamps, y, held)
    np.testing.assert_allclose(estimates.state, x_bar[:, :3], atol=1e-3)
    np.testing.assert_allclose(estimates.disturbance, omega, atol=2e-3)
    assert np.abs(Xi).max() < 1e-12
    mismatch = np.abs(omega - (y - x_bar[:, :3] @ system.C.T))
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
    # Inside nothing is taken away.
    assert (project(0.5 * value, rate, gamma, limit) == rate).all()
    assert np.linalg.norm(clip(1.1 * value, limit), 2) == pytest.approx(limit)
