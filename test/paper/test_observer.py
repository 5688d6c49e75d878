# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The method's observer: its equations, and what its structure makes of them."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from tsobs_ros.errors import ModelError
from tsobs_ros.model.fuzzy import RuleBase
from tsobs_ros.paper.augmentation import Augmentation
from tsobs_ros.paper.examples import example_1
from tsobs_ros.paper.observer import AugmentedObserver, AugmentedState, clipped, projected_rate
from tsobs_ros.paper.systems import TSSystem

Array = NDArray[np.float64]

EXAMPLE = example_1()
RANDOM = np.random.default_rng(11)
AUG = Augmentation(EXAMPLE.system, 0, np.vstack([RANDOM.normal(size=(3, 3)), 2.0 * np.eye(3)]))
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
    samples: Callable[[float], Array] = y_of,
    start: Array = START,
) -> AugmentedState:
    state = observer.initial(samples(0.0), start, z=y_of(0.0)[:1])
    for t in np.arange(round(end / step)) * step:
        after = t + step
        state = observer.advance(state, u_of(t), u_of(after), samples(after), step, y_of(after)[:1])
    return state


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
        errors.append(np.abs(observer.augmented_estimate(state) - exact[:6]).max())
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
    fooled = run(observer, 2.0, 0.02, lambda t: noise[round(t / 0.02)])
    np.testing.assert_allclose(fooled.x, honest.x, atol=1e-13)
    np.testing.assert_allclose(observer.innovation(fooled), observer.innovation(honest), atol=1e-13)
    # It does depend on the premise.
    z = np.array([0.9])
    state = observer.initial(y_of(0.0), START, z=z)
    for t in np.arange(100) * 0.02:
        state = observer.advance(state, u_of(t), u_of(t + 0.02), y_of(t + 0.02), 0.02, z)
    assert np.abs(state.x - honest.x).max() > 0.05


def test_innovation_decays_by_its_own_equation() -> None:
    rules = RuleBase(((lambda z: np.ones_like(z),),))
    system = TSSystem(
        EXAMPLE.system.A[:1],
        EXAMPLE.system.B[:1],
        EXAMPLE.system.C[:1],
        rules,
        lambda x: x[..., :1],
    )
    aug = Augmentation(system, 0, AUG.L)
    observer = AugmentedObserver(aug, H1[:1], M)
    state = run(observer, 0.5, 0.005)
    start = y_of(0.0) - aug.C_bar @ START
    expected = expm(-0.5 * (np.linalg.inv(aug.L[3:]) + aug.C_bar @ H1[0])) @ start
    np.testing.assert_allclose(observer.innovation(state), expected, atol=1e-8)
    assert np.abs(expected).max() > 1e-3


def test_adaptation_never_starts_from_a_fitting_estimate() -> None:
    observer = AugmentedObserver(AUG, H1, M, GAMMA)
    silent = run(observer, 3.0, 0.02, start=FITTING)
    assert np.abs(silent.Xi).max() < 1e-13
    estimate = observer.estimate(silent)
    output = EXAMPLE.system.output(estimate.x, silent.z)
    np.testing.assert_allclose(estimate.omega, y_of(3.0) - output, atol=1e-12)
    assert np.abs(run(observer, 3.0, 0.02).Xi).max() > 0.05


def test_held_and_linear_agree_where_nothing_changes() -> None:
    observer = AugmentedObserver(AUG, H1, M, GAMMA)
    y, u = np.array([0.4, 0.1, -0.2]), np.array([0.3])
    state = observer.initial(y, START)
    held = observer.predict(state, u, 0.3)
    steps = observer.initial(y, START)
    for _ in range(30):
        steps, innovation = observer.correct(observer.predict(steps, u, 0.01), y)
    np.testing.assert_allclose(steps.xi, held.xi, atol=1e-12)
    np.testing.assert_allclose(innovation, y - AUG.C_bar @ observer.augmented_estimate(steps))


def test_a_batch_moves_as_its_single_runs() -> None:
    observer = AugmentedObserver(AUG, H1, M, GAMMA, xi=[0.05, 0.05])
    random = np.random.default_rng(8)
    y, after, starts = (random.normal(size=(2, 4, k)) for k in (3, 3, 6))
    u = random.normal(size=(2, 4, 1))
    batch = observer.advance(observer.initial(y, starts), u, -u, after, 0.05)
    for index in np.ndindex(2, 4):
        single = observer.initial(y[index], starts[index])
        single = observer.advance(single, u[index], -u[index], after[index], 0.05)
        np.testing.assert_allclose(batch.xi[index], single.xi, atol=1e-13)
        np.testing.assert_allclose(batch.Xi[index], single.Xi, atol=1e-13)
    assert observer.estimate(batch).omega.shape == (2, 4, 3)


def test_projection_holds_its_bounds_and_only_when_asked() -> None:
    free = run(AugmentedObserver(AUG, H1, M, GAMMA), 3.0, 0.02)
    norms = np.linalg.norm(free.Xi, 2, axis=(1, 2))
    limits = 0.3 * norms
    kept = run(AugmentedObserver(AUG, H1, M, GAMMA, xi=limits), 3.0, 0.02)
    assert (np.linalg.norm(kept.Xi, 2, axis=(1, 2)) <= limits * (1 + 1e-12)).all()
    loose = run(AugmentedObserver(AUG, H1, M, GAMMA, xi=[9.0, 9.0]), 3.0, 0.02)
    np.testing.assert_allclose(loose.Xi, free.Xi, atol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_projection_never_raises_the_lyapunov_function(seed: int) -> None:
    random = np.random.default_rng(seed)
    root = random.normal(size=(3, 3))
    gamma = root @ root.T + 0.1 * np.eye(3)
    limit = np.array(0.7)
    value = random.normal(size=(3, 6))
    value *= limit / np.linalg.norm(value, 2)
    gradient = random.normal(size=(3, 6))
    correction = projected_rate(value, gradient, gamma, limit) - gamma @ gradient
    for _ in range(50):
        other = random.normal(size=(3, 6))
        other *= limit * random.uniform() / np.linalg.norm(other, 2)
        assert np.sum((value - other) * np.linalg.solve(gamma, correction)) <= 1e-12
    moved = value + 1e-6 * (gamma @ gradient + correction)
    assert np.linalg.norm(moved, 2) <= 0.7 + 1e-9
    np.testing.assert_allclose(clipped(value, limit), value, atol=1e-14)
    assert np.linalg.norm(clipped(3.0 * value, limit), 2) == pytest.approx(0.7)
    inside = projected_rate(0.5 * value, gradient, gamma, limit)
    np.testing.assert_array_equal(inside, gamma @ gradient)


UNSYMMETRIC = GAMMA + np.eye(3, k=2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"H1": H1[0]}, r"H₁: expected shape \(2, 6, 3\), got \(6, 3\)"),
        ({"M": M.T}, r"M: expected shape \(6, 3\), got \(3, 6\)"),
        ({"Gamma": UNSYMMETRIC}, "Γ of rule 1: expected a symmetric matrix"),
        ({"xi": [-1.0, 1.0]}, r"xi: expected bounds of at least 0, got \[-1"),
    ],
)
def test_wrong_matrices_are_named(changes, message) -> None:
    with pytest.raises(ModelError, match=message):
        AugmentedObserver(**({"augmentation": AUG, "H1": H1, "M": M, "Gamma": GAMMA} | changes))


def test_wrong_samples_are_named() -> None:
    observer = AugmentedObserver(AUG, H1, M)
    with pytest.raises(ModelError, match=r"y: expected shape \(..., 3\), got \(2,\)"):
        observer.initial(np.zeros(2))
    with pytest.raises(ModelError, match=r"z: expected shape \(..., 1\), got \(2,\)"):
        observer.correct(observer.initial(np.zeros(3)), np.zeros(3), z=np.zeros(2))
