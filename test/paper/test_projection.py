# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The projection on balls of the spectral norm, against NumPy's singular values and its theory."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.paper.projection import clip, project

Array = NDArray[np.float64]


@pytest.mark.parametrize("seed", range(20))
def test_projection_never_raises_the_lyapunov_function(seed: int) -> None:
    random = np.random.default_rng(seed)
    root = random.normal(size=(3, 3))
    gamma, limit = root @ root.T + 0.1 * np.eye(3), np.array(0.7)
    value = random.normal(size=(3, 6))
    value *= limit / np.linalg.norm(value, 2)
    rate = gamma @ random.normal(size=(3, 6))
    after = project(value, rate, gamma, limit)
    for _ in range(50):
        other = random.normal(size=(3, 6))
        other *= limit * random.uniform() / np.linalg.norm(other, 2)
        assert np.sum((value - other) * np.linalg.solve(gamma, after - rate)) <= 1e-12
    assert np.linalg.norm(value + 1e-6 * after, 2) <= limit + 1e-9
    left, _, right = np.linalg.svd(value)
    outward = left[:, 0] @ rate @ right[0]
    assert left[:, 0] @ after @ right[0] == pytest.approx(min(outward, 0.0), abs=1e-12)
    # Inside nothing is taken away, on a ball that is a point everything.
    assert (project(0.5 * value, rate, gamma, limit) == rate).all()
    assert (project(0.0 * value, rate, gamma, 0.0 * limit) == 0.0).all()


def test_many_matrices_are_projected_as_each_alone() -> None:
    random = np.random.default_rng(4)
    limits = np.array([0.0, 0.4, 1.0, np.inf])
    value, rate = random.normal(size=(2, 5, 4, 3, 6))
    sizes = 1.1 * random.uniform(size=(5, 4)) / np.linalg.norm(value, 2, (2, 3))
    value *= sizes[..., np.newaxis, np.newaxis]
    gamma = np.eye(3) + np.arange(4.0).reshape(4, 1, 1)
    value[0, :2], value[1, 2] = 0.0, np.nan
    clipped, projected = clip(value, limits), project(clip(value, limits), rate, gamma, limits)
    for run, rule in np.ndindex(5, 4):
        one = clip(value[run, rule], limits[rule])
        assert clipped[run, rule].tobytes() == one.tobytes()
        alone = project(one, rate[run, rule], gamma[rule], limits[rule])
        assert projected[run, rule].tobytes() == alone.tobytes()
    changed = (projected != rate).any(axis=(2, 3))
    assert changed[:, 0].all()
    assert 0 < changed[:, 1:3].sum() < 10
    assert not changed[:, 3].any()
