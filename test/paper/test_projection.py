# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The projection on balls of the spectral norm, against NumPy's singular values and its theory."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.paper.projection import clip, diagonalise, project

Array = NDArray[np.float64]


def clipped(value: Array, limit: float) -> Array:
    result, (p, _) = value.copy(), value.shape
    clip(result, limit, np.empty((p, p)), np.empty((p, p)))
    return result


def projected(value: Array, rate: Array, gamma: Array, limit: float) -> Array:
    result, (p, _) = rate.copy(), value.shape
    project(value, result, gamma, limit, np.empty((p, p)), np.empty((p, p)))
    return result


@pytest.mark.parametrize("shape", [(1, 5), (2, 6), (3, 6), (4, 4)])
@pytest.mark.parametrize("rank", [1, 4])
def test_clipped_singular_values_are_those_of_numpy(shape: tuple[int, int], rank: int) -> None:
    random = np.random.default_rng(shape[0])
    for _ in range(50):
        value = random.normal(size=(shape[0], rank)) @ random.normal(size=(rank, shape[1]))
        left, singular, right = np.linalg.svd(value, full_matrices=False)
        for limit in (0.0, 0.5, float(singular[0]), 9.0, np.inf):
            expected = left * np.minimum(singular, limit) @ right
            np.testing.assert_allclose(clipped(value, limit), expected, atol=1e-13)


@pytest.mark.parametrize("p", [1, 2, 3, 6])
def test_rotations_find_eigenvalues_and_vectors(p: int) -> None:
    random = np.random.default_rng(p)
    for spread in (0.0, 1.0, 12.0):
        basis = np.linalg.qr(random.normal(size=(p, p)))[0]
        matrix = basis * np.logspace(0.0, -spread, p) @ basis.T
        matrix = 0.5 * (matrix + matrix.T)
        values, vectors = matrix.copy(), np.empty((p, p))
        diagonalise(values, vectors)
        np.testing.assert_allclose(vectors @ vectors.T, np.eye(p), atol=1e-14)
        np.testing.assert_allclose(vectors * np.diag(values) @ vectors.T, matrix, atol=1e-14)
        np.testing.assert_allclose(np.sort(np.diag(values)), np.linalg.eigvalsh(matrix), atol=1e-14)


@pytest.mark.parametrize("seed", range(20))
def test_projection_never_raises_the_lyapunov_function(seed: int) -> None:
    random = np.random.default_rng(seed)
    root = random.normal(size=(3, 3))
    gamma, limit = root @ root.T + 0.1 * np.eye(3), 0.7
    value = random.normal(size=(3, 6))
    value *= limit / np.linalg.norm(value, 2)
    rate = gamma @ random.normal(size=(3, 6))
    after = projected(value, rate, gamma, limit)
    for _ in range(50):
        other = random.normal(size=(3, 6))
        other *= limit * random.uniform() / np.linalg.norm(other, 2)
        assert np.sum((value - other) * np.linalg.solve(gamma, after - rate)) <= 1e-12
    assert np.linalg.norm(value + 1e-6 * after, 2) <= limit + 1e-9
    left, _, right = np.linalg.svd(value)
    outward = left[:, 0] @ rate @ right[0]
    assert left[:, 0] @ after @ right[0] == pytest.approx(min(outward, 0.0), abs=1e-12)
    # Inside nothing is taken away, on a ball that is a point everything.
    assert (projected(0.5 * value, rate, gamma, limit) == rate).all()
    assert (projected(0.0 * value, rate, gamma, 0.0) == 0.0).all()


def test_numbers_that_are_none_stay_in_sight() -> None:
    assert np.isnan(clipped(np.full((2, 3), np.nan), 1.0)).all()
