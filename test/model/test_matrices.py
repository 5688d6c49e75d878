# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Small matrices in compiled loops against NumPy, in arrays that have room for more."""

import math
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
    """Return what makes arrays with room for more, full of NaN there, and their part in use."""
    rng = np.random.default_rng(seed)

    def make(*shape: int) -> tuple[Array, Array]:
        room = np.full([size + int(rng.integers(0, 3)) for size in shape], math.nan)
        part = room[tuple(map(slice, shape))]
        part[...] = rng.standard_normal(shape) * 10.0 ** rng.integers(-3, 4)
        return room, part

    return make


def square(part: Array, least: float = 0.0) -> None:
    """Make a symmetric matrix without negative eigenvalues out of any."""
    part[...] = part @ part.T
    part[...] += least * np.trace(part) * np.eye(len(part))


@pytest.mark.parametrize("width", [8, 12, 16])
def test_padded_products_have_the_bits_of_those_without_room(width: int) -> None:
    rng, n = np.random.default_rng(width), width - 3
    a, b, plain, padded = (np.zeros((width, width)) for _ in range(4))
    a[:n, :n], b[:] = rng.standard_normal((n, n)), rng.standard_normal((width, width))
    matrices.multiply(a, b, plain, n, n, n)
    matrices.multiply_padded(a, b, padded, n, width)
    assert padded[:n, :n].tobytes() == plain[:n, :n].tobytes()


@given(SEEDS, SIZES, SIZES, SIZES)
def test_products_are_those_of_numpy(seed: int, rows: int, inner: int, columns: int) -> None:
    make = drawn(seed)
    (a, A), (b, B), (s, S), (x, X) = (
        make(rows, inner), make(inner, columns), make(inner, inner), make(inner)
    )  # fmt: skip
    (w, W), (scratch, _), (vector, V) = make(rows, rows), make(rows, inner), make(rows)
    result, R = make(rows, columns)
    square(S)
    square(W)
    close = {"rtol": 1e-11, "atol": 1e-11 * (np.abs(A).max() ** 2 * np.abs(S).max() + 1e-3)}

    matrices.multiply(a, b, result, rows, inner, columns)
    np.testing.assert_allclose(R, A @ B, rtol=1e-11, atol=1e-13 * np.abs(A).max() * np.abs(B).max())
    matrices.apply(a, x, vector, rows, inner)
    np.testing.assert_allclose(V, A @ X, rtol=1e-11, atol=1e-13 * np.abs(A).max() * np.abs(X).max())
    assert matrices.dot(x, x, inner) == pytest.approx(X @ X, rel=1e-12)
    assert matrices.quadratic(s, x, inner) == pytest.approx(X @ S @ X, rel=1e-9)

    expected = A @ S @ A.T + W
    matrices.congruence(a, s, w, scratch, w, rows, inner)
    np.testing.assert_allclose(W, expected, **close)
    assert (W == W.T).all()
    np.testing.assert_allclose(matrices.product(A, B), A @ B, **close | {"atol": 1e-3})
    np.testing.assert_allclose(matrices.congruent(A, S), A @ S @ A.T, **close)


@given(SEEDS, SIZES, SIZES)
def test_solutions_are_those_of_numpy(seed: int, n: int, columns: int) -> None:
    make = drawn(seed)
    (s, S), (b, B), (factor, _), (result, X) = (
        make(n, n),
        make(n, columns),
        make(n, n),
        make(n, columns),
    )
    square(S, least=1e-3)
    matrices.solve(s, b, factor, result, n, columns)
    expected = np.linalg.solve(S, B)
    np.testing.assert_allclose(X, expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())
    matrices.solve(s, b, factor, b, n, columns)
    assert (B == X).all()
    unit = np.abs(np.linalg.inv(S)).max()
    np.testing.assert_allclose(matrices.inverse(S), np.linalg.inv(S), rtol=1e-8, atol=1e-10 * unit)


@given(SEEDS, SIZES, SIZES)
def test_josephs_form_is_positive_for_any_gain(seed: int, n: int, p: int) -> None:
    """Also with more outputs than states."""
    make = drawn(seed)
    (_, C), (_, R), (_, S), (_, K) = make(p, n), make(p, p), make(n, n), make(n, p)
    square(R)
    square(S)
    closed = np.eye(n) - K @ C
    expected = closed @ S @ closed.T + K @ R @ K.T
    after = matrices.joseph(C, R, S, K)
    size = np.abs(closed).max() ** 2 * np.abs(S).max() + np.abs(K).max() ** 2 * np.abs(R).max()
    np.testing.assert_allclose(after, expected, rtol=1e-9, atol=1e-11 * size)
    assert (after == after.T).all()
    assert np.linalg.eigvalsh(after)[0] >= -1e-11 * size


@given(SEEDS, st.integers(1, 6), st.floats(0.0, 10.0))
def test_pivots_find_what_the_smallest_eigenvalue_does(seed: int, n: int, level: float) -> None:
    make = drawn(seed)
    (s, S), (bound, B), (scratch, _) = make(n, n), make(n, n), make(n, n)
    square(S)
    B[...] = level * np.eye(n)
    smallest = float(np.linalg.eigvalsh(S)[0])
    if abs(smallest - level) > 1e-9 * (1.0 + np.abs(S).max()):
        assert matrices.is_below(bound, s, scratch, n) == (smallest > level)
        assert not matrices.is_below(s, bound, scratch, n) or n == 1 or smallest <= level


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
    assert matrices.is_nonnegative(matrix.copy(), 2) is verdict


@pytest.mark.parametrize("matrix", [np.zeros((2, 2)), np.ones((2, 2)), np.full((2, 2), np.nan)])
def test_a_singular_matrix_has_no_finite_inverse(matrix: Array) -> None:
    assert not np.isfinite(matrices.inverse(matrix)).all()
