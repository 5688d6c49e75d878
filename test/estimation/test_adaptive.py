# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Adaptation: one way for one output and a general one, and the measure of excitation."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.adaptive import AdaptiveObserver, exceeds
from tsobs_ros.resources import SHIPPED_ADAPTIVE_DESIGN, config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

DESIGN = load_design(config_path(SHIPPED_ADAPTIVE_DESIGN))


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


def test_one_output_takes_a_quick_way_to_the_same_numbers() -> None:
    run = simulate(SCENARIOS["stiff"], [4], 15.0)
    quick = AdaptiveObserver(DESIGN.observer(), DESIGN.request.uncertainty_model)
    general = AdaptiveObserver(DESIGN.observer(), DESIGN.request.uncertainty_model)
    general._single_output = False
    states = [quick.initial(), general.initial()]
    for y, u in zip(run.measurements[0], run.torques[0], strict=True):
        for place, observer in enumerate((quick, general)):
            corrected, _ = observer.correct(states[place], y)
            states[place] = observer.predict(corrected, u, quick.period)
    one, other = states
    assert one.observer.certified
    assert np.abs(one.theta).max() > 0.1
    for a, b in (
        (one.observer.x, other.observer.x),
        (one.theta, other.theta),
        (one.gamma, other.gamma),
        (one.upsilon, other.upsilon),
        (one.gram, other.gram),
    ):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9)


def test_a_reset_keeps_the_parameters_unless_they_are_to_be_nominal() -> None:
    observer = AdaptiveObserver(DESIGN.observer(), DESIGN.request.uncertainty_model)
    fresh = observer.initial()
    learnt = fresh._replace(theta=fresh.theta + 0.1, gamma=2.0 * fresh.gamma, gram=fresh.gram + 1.0)
    reset = observer.reset_adaptation(learnt, nominal=False)
    assert (reset.gamma == fresh.gamma).all()
    assert (reset.theta == learnt.theta).all()
    assert (reset.gram == learnt.gram).all()
    nominal = observer.reset_adaptation(learnt, nominal=True)
    assert not nominal.theta.any()
    assert not nominal.gram.any()
