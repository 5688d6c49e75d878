# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Common and smallest Lyapunov matrices, each with its proof."""

import numpy as np
import pytest

from tsobs_ros.design.lyapunov import common_lyapunov, refutation_margin, smallest_lyapunov
from tsobs_ros.errors import DesignError
from tsobs_ros.paper.examples import example_2


def test_matrices_that_share_a_lyapunov_matrix_are_proved_to() -> None:
    A = example_2().system.A + np.array([0.2, 0.5])[:, None, None] * np.eye(3)
    margin, P, _ = common_lyapunov(A)

    assert np.linalg.eigvalsh(P)[0] > 0.0
    largest = max(np.linalg.eigvalsh(each.T @ P + P @ each)[-1] for each in A)
    assert largest == pytest.approx(margin)
    assert margin < 0.0


def test_matrices_that_are_stable_alone_but_not_together_are_refuted_by_a_dual() -> None:
    A = np.array([[[-0.1, 1.0], [-10.0, -0.1]], [[-0.1, 10.0], [-1.0, -0.1]]])
    margin, P, Z = common_lyapunov(A)

    assert P is None
    # Farkas' certificate: with it, no P ≻ 0 has AᵢᵀP + PAᵢ ≺ 0 for all i.
    assert np.linalg.eigvalsh(Z).min() > -1e-12
    assert np.trace(Z, axis1=1, axis2=2).sum() == pytest.approx(1.0)
    assert refutation_margin(A, Z) == margin > -1e-6


def test_smallest_matrix_is_the_known_one_of_a_scalar() -> None:
    # 2 P − 2 Q + 1 ≤ 0 and P ≥ 1: the least P + w Q² is at P = 1, Q = 3/2.
    solution = smallest_lyapunov(np.ones((1, 1, 1)), np.ones((1, 1)), np.ones((1, 1)))

    assert solution.P[0, 0] == pytest.approx(1.0, abs=1e-5)
    assert solution.Q[0, 0, 0] == pytest.approx(1.5, abs=1e-5)
    assert solution.status == "optimal"
    with pytest.raises(DesignError, match="smallest Lyapunov matrix: the solver answered 'infeas"):
        smallest_lyapunov(np.ones((1, 1, 1)), np.zeros((1, 1)), np.ones((1, 1)))
