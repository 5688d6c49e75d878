# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Modes a sensor cannot see: found with eigenvalue and shape, and only where they exist."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from tsobs_ros.model.detectability import hidden_modes, undetectable_modes

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=20)
EYE = np.eye(4)


@PROPERTY
@given(
    hnp.arrays(np.float64, (4, 4), elements=st.floats(-1.0, 1.0)),
    hnp.arrays(np.bool_, 4, elements=st.booleans()),
)
def test_exactly_the_unseen_modes_of_a_known_system_are_found(mixing: Array, seen: Array) -> None:
    """A is built from four known modes, and C sees some of them."""
    basis = EYE + 0.2 * mixing
    modes = np.array([-2.0, -0.5, 0.0, 1.5])
    inverse = np.linalg.inv(basis)
    A, C = basis @ np.diag(modes) @ inverse, seen.astype(float)[np.newaxis] @ inverse
    found = {round(mode.eigenvalue.real, 6): mode for mode in hidden_modes(A, C)}
    assert sorted(found) == sorted(modes[~seen])
    for eigenvalue, mode in found.items():
        assert np.linalg.norm(A @ mode.shape - mode.eigenvalue * mode.shape) < 1e-12
        assert np.linalg.norm(C @ mode.shape) < 1e-12
        assert np.linalg.norm(mode.shape) == pytest.approx(1.0)
        true = basis[:, list(modes).index(eigenvalue)]
        assert abs(mode.shape @ true) == pytest.approx(np.linalg.norm(true), rel=1e-9)


def test_a_hidden_mode_that_decays_is_detectable() -> None:
    A, C = np.diag([-1.0, 2.0]), np.array([[0.0, 1.0]])
    assert [mode.eigenvalue for mode in hidden_modes(A, C)] == [-1.0]
    assert undetectable_modes(A, C) == []
    assert [mode.eigenvalue for mode in undetectable_modes(A, np.array([[1.0, 0.0]]))] == [2.0]
