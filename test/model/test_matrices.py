# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The small matrices of the compiled core against NumPy."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tsobs_ros.core import native
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
    result = np.empty((rows, columns))
    native.multiply(A, B, result, rows, inner, columns)
    size = np.abs(A).max() * np.abs(B).max()
    np.testing.assert_allclose(result, A @ B, rtol=1e-11, atol=1e-13 * size)
    assert matrices.product(A, B).tobytes() == result.tobytes()

    expected = A @ S @ A.T + W
    assert matrices.congruent(A, S, W).tolist() == matrices.congruent(A, S, W).T.tolist()
    np.testing.assert_allclose(matrices.congruent(A, S, W), expected, **close)
    np.testing.assert_allclose(matrices.congruent(A, S), A @ S @ A.T, **close)
    if rows == inner:
        native.congruence(A, S, W, np.empty((rows, inner)), S, rows, inner)
        np.testing.assert_allclose(S, expected, **close)


@given(SEEDS, SIZES, SIZES)
def test_solutions_are_those_of_numpy(seed: int, n: int, columns: int) -> None:
    make = drawn(seed)
    S, B = square(make(n, n), least=1e-3), make(n, columns)
    X = np.empty((n, columns))
    native.solve(S, B, np.empty((n, n)), X, n, columns)
    expected = np.linalg.solve(S, B)
    np.testing.assert_allclose(X, expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())
    native.solve(S, B, np.empty((n, n)), B, n, columns)
    assert (B == X).all()
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


@given(SEEDS, st.integers(1, 6), st.floats(0.0, 10.0))
def test_pivots_find_what_the_smallest_eigenvalue_does(seed: int, n: int, level: float) -> None:
    S, B, scratch = square(drawn(seed)(n, n)), level * np.eye(n), np.empty((n, n))
    smallest = float(np.linalg.eigvalsh(S)[0])
    if abs(smallest - level) > 1e-9 * (1.0 + np.abs(S).max()):
        assert native.is_below(B, S, scratch, n) == (smallest > level)
        assert not native.is_below(S, B, scratch, n) or n == 1 or smallest <= level


@pytest.mark.parametrize(
    ("matrix", "verdict"),
    [
        (np.zeros((2, 2)), True),
        (np.diag([1.0, 0.0]), True),
        (np.array([[0.0, 1.0], [1.0, 5.0]]), False),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), False),
        (np.diag([1.0, -1e-300]), False),
        (np.full((2, 2), np.nan), False),
        (np.diag([1.0, np.nan]), False),
    ],
)
def test_zero_is_no_negative_eigenvalue_and_nan_none_at_all(matrix: Array, verdict: bool) -> None:
    assert native.is_below(np.zeros((2, 2)), matrix, np.empty((2, 2)), 2) is verdict


@pytest.mark.parametrize("matrix", [np.zeros((2, 2)), np.ones((2, 2)), np.full((2, 2), np.nan)])
def test_a_singular_matrix_has_no_finite_inverse(matrix: Array) -> None:
    assert not np.isfinite(matrices.inverse(matrix)).all()


def test_too_short_arrays_and_impossible_sizes_are_refused() -> None:
    four, three = np.zeros(4), np.zeros(3)
    with pytest.raises(ValueError, match="multiply: result: expected at least 4 numbers, got 3"):
        native.multiply(four, four, three, 2, 2, 2)
    with pytest.raises(ValueError, match="solve: n: expected a size of 0 to 4096, got -1"):
        native.solve(four, four, four, four, -1, 1)
    with pytest.raises(ValueError, match="joseph_form: scratch"):
        native.joseph_form(four, four, four, four, four, four, 2, 2)
