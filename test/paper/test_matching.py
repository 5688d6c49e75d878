# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The gradient law's matching condition: not for an angle alone, possible with velocities."""

import numpy as np
import pytest

from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.paper.matching import matching

A = ElasticJointArm().slope_matrix(1.0)
STIFFNESS = np.array([[0.0], [1.0], [0.0], [-5.0]])
VELOCITIES = np.eye(4)[:, [1, 3]]


def rows(*places: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.eye(4)[list(places)]


@pytest.mark.parametrize(
    ("C", "G", "possible", "degree"),
    [
        (rows(0), STIFFNESS, False, 2),
        (rows(0, 2), STIFFNESS, False, 2),
        (rows(0, 1), STIFFNESS, True, 1),
        (rows(0, 1), VELOCITIES, False, None),
        (rows(1, 3), VELOCITIES, True, 1),
        (np.eye(4), VELOCITIES, True, 1),
    ],
)
def test_only_measured_velocities_match(C, G, possible, degree) -> None:  # type: ignore[no-untyped-def]
    verdict = matching(A, C, G)
    assert (verdict.possible, verdict.relative_degree) == (possible, degree)
    assert ("can hold" in str(verdict)) == possible


def test_where_it_is_possible_a_matrix_matches() -> None:
    # The lemma's other half: with CG of full rank, P = I + α CᵀC-like matrices can be built.
    C, G = rows(1, 3), VELOCITIES
    P = np.eye(4)
    F = np.linalg.lstsq(C.T, P @ G, rcond=None)[0]
    np.testing.assert_allclose(C.T @ F, P @ G, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_where_it_is_not_no_matrix_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((4, 4))
    P = root @ root.T + np.eye(4)
    C = rows(0)
    F = np.linalg.lstsq(C.T, P @ STIFFNESS, rcond=None)[0]
    # PG = CᵀF would give GᵀPG = (CG)ᵀF = 0, but P is positive.
    assert np.linalg.norm(C.T @ F - P @ STIFFNESS) > 0.1


def test_shapes_are_named() -> None:
    with pytest.raises(ModelError, match=r"got \(4, 4\), \(1, 3\)"):
        matching(A, np.ones((1, 3)), STIFFNESS)
