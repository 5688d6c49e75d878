# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether an excitation suffices, by pivots: what the eigenvalues say."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tsobs_ros.estimation.regression import exceeds, spread_of


@given(st.data(), st.integers(1, 6), st.floats(0.0, 10.0))
def test_pivots_tell_what_the_smallest_eigenvalue_tells(
    data: st.DataObject, size: int, level: float
) -> None:
    root = data.draw(hnp.arrays(np.float64, (size, size), elements=st.floats(-3.0, 3.0)))
    gram = root @ root.T
    smallest = np.linalg.eigvalsh(gram)[0]
    assume(abs(smallest - level) > 1e-9 * (1.0 + np.abs(gram).max()))
    assert exceeds(gram.tolist(), level) == (smallest > level)


@pytest.mark.parametrize(
    ("matrix", "enough"),
    [
        (np.zeros((2, 2)), True),
        (np.diag([1.0, 0.0]), True),
        (np.array([[0.0, 1.0], [1.0, 5.0]]), False),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), False),
        (np.full((2, 2), np.nan), False),
    ],
)
def test_a_level_of_zero_asks_for_no_negative_eigenvalue(matrix: np.ndarray, enough: bool) -> None:
    assert exceeds(matrix.tolist(), 0.0) is enough


def test_the_spread_is_the_diagonal_of_the_product() -> None:
    rng = np.random.default_rng(1)
    rows, root = rng.standard_normal((2, 5)), rng.standard_normal((2, 2))
    gamma = root @ root.T
    np.testing.assert_allclose(spread_of(rows, gamma), np.diag(rows.T @ gamma @ rows))
