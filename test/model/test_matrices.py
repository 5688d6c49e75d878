# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Small matrices in sums of a fixed order against NumPy's."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
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


@given(SEEDS, SIZES, SIZES, SIZES)
def test_products_are_those_of_numpy(seed: int, rows: int, inner: int, columns: int) -> None:
    make = drawn(seed)
    A, B, S, W = (
        make(rows, inner), make(inner, columns), square(make(inner, inner)), make(rows, rows)
    )  # fmt: skip
    W = square(W)
    close = {"rtol": 1e-11, "atol": 1e-11 * (np.abs(A).max() ** 2 * np.abs(S).max() + 1e-3)}
    size = np.abs(A).max() * np.abs(B).max()
    np.testing.assert_allclose(matrices.product(A, B), A @ B, rtol=1e-11, atol=1e-13 * size)

    expected = A @ S @ A.T + W
    assert matrices.congruent(A, S, W).tolist() == matrices.congruent(A, S, W).T.tolist()
    np.testing.assert_allclose(matrices.congruent(A, S, W), expected, **close)
    np.testing.assert_allclose(matrices.congruent(A, S), A @ S @ A.T, **close)


@given(SEEDS, SIZES)
def test_inverses_are_those_of_numpy(seed: int, n: int) -> None:
    S = square(drawn(seed)(n, n), least=1e-3)
    unit = np.abs(np.linalg.inv(S)).max()
    np.testing.assert_allclose(matrices.inverse(S), np.linalg.inv(S), rtol=1e-8, atol=1e-10 * unit)


@given(SEEDS, SIZES, SIZES)
def test_josephs_form_is_positive_for_any_gain(seed: int, n: int, p: int) -> None:
    """Also with more outputs than states."""
    make = drawn(seed)
    C, R, S, K = make(p, n), square(make(p, p)), square(make(n, n)), make(n, p)
    closed = np.eye(n) - K @ C
    expected = closed @ S @ closed.T + K @ R @ K.T
    after = matrices.joseph(C, R, S, K)
    size = np.abs(closed).max() ** 2 * np.abs(S).max() + np.abs(K).max() ** 2 * np.abs(R).max()
    np.testing.assert_allclose(after, expected, rtol=1e-9, atol=1e-11 * size)
    assert (after == after.T).all()
    assert np.linalg.eigvalsh(after)[0] >= -1e-11 * size


@pytest.mark.parametrize("matrix", [np.zeros((2, 2)), np.ones((2, 2)), np.full((2, 2), np.nan)])
def test_a_singular_matrix_has_no_finite_inverse(matrix: Array) -> None:
    assert not np.isfinite(matrices.inverse(matrix)).all()
