# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The augmented form, the propositions and the conditions, on examples and random systems."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.paper.augmentation import (
    Augmentation,
    innovation_drive,
    uncertainty_factor,
    unmatched_share,
)
from tsobs_ros.paper.examples import example_1


def some_system(seed: int, n: int = 4, p: int = 2, r: int = 3) -> TSModel:
    random = np.random.default_rng(seed)
    bells = [membership("gaussian", {"centre": c, "width": 0.7}) for c in range(r)]
    rules = RuleBase(tuple((bell,) for bell in bells))
    C = random.normal(size=(r, p, n))
    A, B = random.normal(size=(r, n, n)), random.normal(size=(r, n, 1))
    return TSModel(A, B, C[0], rules, np.zeros((1, n)), np.ones((1, 1)), C)


def some_augmentation(seed: int) -> Augmentation:
    return Augmentation(some_system(seed), np.random.default_rng(seed + 99).normal(size=(6, 2)))


def some_P(seed: int, size: int) -> NDArray[np.float64]:
    root = np.random.default_rng(seed).normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


@pytest.mark.parametrize("seed", [None, 1])
@pytest.mark.parametrize("rule", [0, 1])
def test_stands_for_the_system_whatever_the_disturbance_does(seed: int | None, rule: int) -> None:
    L = None if seed is None else np.random.default_rng(seed).normal(size=(6, 3))
    system, random = example_1().system, np.random.default_rng(7)
    aug = Augmentation(system, L)
    x, omega, omega_rate, u = (random.normal(size=k) for k in (3, 3, 3, 1))
    x_rate = system.A[rule] @ x + system.B[rule] @ u
    y, y_rate = aug.C @ x + omega, aug.C @ x_rate + omega_rate
    left = np.concatenate([x_rate, omega_rate])
    x_bar = np.concatenate([x, omega])
    right = aug.A1[rule] @ x_bar + aug.B1[rule] @ u + aug.N1 @ y
    right += aug.L1 @ y_rate
    np.testing.assert_allclose(left, right, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_innovation_is_autonomous_for_every_l(seed: int) -> None:
    aug = some_augmentation(seed)
    assert innovation_drive(aug) < 1e-10
    random = np.random.default_rng(seed)
    H1, h = random.normal(size=(3, 6, 2)), np.array([0.2, 0.5, 0.3])
    closed = np.tensordot(h, aug.A1 - H1 @ aug.C_bar, axes=1)
    F = np.linalg.inv(aug.L[4:]) + aug.C_bar @ np.tensordot(h, H1, axes=1)
    np.testing.assert_allclose(aug.C_bar @ closed, -F @ aug.C_bar, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_matching_leaves_all_of_the_uncertainty(seed: int) -> None:
    aug = some_augmentation(seed)
    delta_A = np.random.default_rng(seed).normal(size=(3, 4, 4))
    assert unmatched_share(aug, some_P(seed, 6), delta_A) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_uncertainty_factor_is_attained_and_never_exceeded(seed: int) -> None:
    P = some_P(seed, 4)
    factor = uncertainty_factor(P)
    values, vectors = np.linalg.eigh(P)
    e = vectors[:, -1] / np.sqrt(values[-1]) + vectors[:, 0] / np.sqrt(values[0])
    delta_A = np.outer(P @ e, e) / (np.linalg.norm(P @ e) * np.linalg.norm(e))
    assert e @ P @ delta_A @ e / (e @ P @ e) == pytest.approx(factor, rel=1e-9)
    assert 1.0 < factor < np.sqrt(np.linalg.cond(P))
    random = np.random.default_rng(seed)
    for _ in range(500):
        e, change = random.normal(size=4), random.normal(size=(4, 4))
        change /= np.linalg.norm(change, 2)
        assert abs(e @ P @ change @ e) <= factor * (e @ P @ e) * (1.0 + 1e-12)
