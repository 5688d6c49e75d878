# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Small matrices in sums of a fixed order against NumPy's."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tsobs_ros.model import matrices

Array = NDArray[np.float64]
SIZES = st.integers(1, 7)
SEEDS = st.integers(0, 2**32 - 1)


def drawn(seed: int) -> Any:
    """Return what makes random arrays of some size."""
    rng = np.random.default_rng(seed)

    def make(*shape: int) -> Array:
        return rng.standard_normal(shape) * 10.0 ** rng.integers(-3, 4)

    return make


def square(matrix: Array, least: float = 0.0) -> Array:
    """Return a symmetric matrix without negative eigenvalues made of any."""
    product = matrix @ matrix.T
    return np.asarray(product + least * np.trace(product) * np.eye(len(matrix)))


@settings(max_examples=30)
@given(SEEDS, SIZES, SIZES, SIZES)
def test_they_are_those_of_numpy(seed: int, n: int, p: int, columns: int) -> None:
    """Joseph's form is positive for any gain, also with more outputs than states."""
    make = drawn(seed)
    C, R, S, K = make(p, n), square(make(p, p)), square(make(n, n), least=1e-3), make(n, p)
    B, size = make(n, columns), np.abs(C).max()
    product = matrices.product(C, B)
    np.testing.assert_allclose(product, C @ B, rtol=1e-11, atol=1e-13 * size * np.abs(B).max())
    moved = matrices.congruent(C, S, R)
    size = size**2 * np.abs(S).max() + np.abs(R).max()
    np.testing.assert_allclose(moved, C @ S @ C.T + R, rtol=1e-11, atol=1e-11 * size)
    assert (moved == moved.T).all()
    expected = np.linalg.inv(S)
    unit = np.abs(expected).max()
    np.testing.assert_allclose(matrices.inverse(S), expected, rtol=1e-8, atol=1e-10 * unit)

    closed = np.eye(n) - K @ C
    after = matrices.joseph(C, R, S, K)
    size = np.abs(closed).max() ** 2 * np.abs(S).max() + np.abs(K).max() ** 2 * np.abs(R).max()
    expected = closed @ S @ closed.T + K @ R @ K.T
    np.testing.assert_allclose(after, expected, rtol=1e-9, atol=1e-11 * size)
    assert np.linalg.eigvalsh(after)[0] >= -1e-11 * size


@pytest.mark.parametrize("matrix", [np.zeros((2, 2)), np.ones((2, 2)), np.full((2, 2), np.nan)])
def test_a_singular_matrix_has_no_finite_inverse(matrix: Array) -> None:
    assert not np.isfinite(matrices.inverse(matrix)).all()
