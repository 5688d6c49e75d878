# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The augmented form against the system it stands for, and its refusals."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.errors import ModelError
from tsobs_ros.paper.augmentation import Augmentation
from tsobs_ros.paper.examples import example_1

SYSTEM = example_1().system
N, P = 3, 3


def some_L(seed: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(size=(N + P, P))


@pytest.mark.parametrize("seed", [None, 1, 2, 3])
@pytest.mark.parametrize("rule", [0, 1])
def test_stands_for_the_system_whatever_the_disturbance_does(seed: int | None, rule: int) -> None:
    aug = Augmentation(SYSTEM, None if seed is None else some_L(seed))
    random = np.random.default_rng(7)
    x, omega, omega_rate, u = (random.normal(size=k) for k in (3, 3, 3, 1))
    x_rate = SYSTEM.A[rule] @ x + SYSTEM.B[rule] @ u
    y, y_rate = aug.C @ x + omega, aug.C @ x_rate + omega_rate
    left = np.concatenate([x_rate, omega_rate])
    x_bar = np.concatenate([x, omega])
    right = aug.A1[rule] @ x_bar + aug.B1[rule] @ u + aug.N1 @ y
    right += aug.E_L_inverse @ aug.L @ y_rate
    np.testing.assert_allclose(left, right, atol=1e-12)


def test_bound_of_the_uncertainty_covers_every_uncertainty_of_that_norm() -> None:
    aug = Augmentation(SYSTEM, some_L(1))
    random = np.random.default_rng(3)
    limits = aug.alpha_1([0.3, 0.7])
    for _ in range(50):
        change = random.normal(size=(2, 3, 3))
        change *= (np.array([0.3, 0.7]) / np.linalg.norm(change, 2, axis=(1, 2)))[:, None, None]
        norms = np.linalg.norm(aug.augmented_uncertainty(change), 2, axis=(1, 2))
        assert (norms <= limits).all()


def test_disturbance_is_recovered_where_the_outputs_differ() -> None:
    aug = Augmentation(SYSTEM)
    random = np.random.default_rng(5)
    x, omega, h2 = random.normal(size=(4, 3)), random.normal(size=(4, 3)), random.uniform(size=4)
    weights = np.stack([1.0 - h2, h2], axis=-1)
    y = np.einsum("bi,ipn,bn->bp", weights, SYSTEM.rule_outputs, x) + omega
    lumped = y - x @ aug.C.T
    np.testing.assert_allclose(aug.recover_disturbance(x, lumped, weights), omega, atol=1e-14)


SINGULAR = np.vstack([np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0])])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Augmentation(SYSTEM, SINGULAR), r"L: expected E_L .* invertible.*singular val"),
        (lambda: Augmentation(SYSTEM, np.eye(3)), r"L: expected shape \(6, 3\), got \(3, 3\)"),
        (
            lambda: Augmentation(SYSTEM).augmented_uncertainty(np.eye(3)),
            r"ΔA: expected shape \(2, ",
        ),
        (lambda: Augmentation(SYSTEM).alpha_1([0.1, -0.2]), r"alpha: expected bounds of at least"),
    ],
)
def test_wrong_matrices_are_named(make, message) -> None:
    with pytest.raises(ModelError, match=message):
        make()
