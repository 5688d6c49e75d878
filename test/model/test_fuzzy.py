# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""T–S systems: weights are a convex combination, and the blend is what the rules say."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from tsobs_ros.errors import ModelError
from tsobs_ros.model.fuzzy import MembershipFunction, RuleBase
from tsobs_ros.paper.systems import TSSystem

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=60)
NUMBERS = st.floats(-5.0, 5.0)


def bell(centre: float, width: float) -> MembershipFunction:
    return lambda z: np.exp(-0.5 * ((z - centre) / width) ** 2)


def arrays(*shape: int) -> st.SearchStrategy[Array]:
    return hnp.arrays(np.float64, shape, elements=NUMBERS)


@st.composite
def rule_bases(draw: st.DrawFn) -> RuleBase:
    premises = draw(st.integers(1, 3))
    function = st.builds(bell, NUMBERS, st.floats(0.5, 5.0))
    rule = st.tuples(*[function] * premises)
    return RuleBase(tuple(draw(st.lists(rule, min_size=1, max_size=4))))


@st.composite
def systems(draw: st.DrawFn) -> TSSystem:
    """Systems of random size whose premise variables are the first states."""
    rule_base = draw(rule_bases())
    r, q = rule_base.rule_count, rule_base.premise_count
    n = draw(st.integers(q, 4))
    m, p = draw(st.integers(1, 2)), draw(st.integers(1, 2))
    matrices = [draw(arrays(r, *shape)) for shape in ((n, n), (n, m), (p, n))]
    return TSSystem(*matrices, rule_base, lambda x: x[..., :q])


# Two rules of one premise variable in [0, 1] that meet at its ends.
RAMPS = RuleBase(((lambda z: 1.0 - z,), (lambda z: z,)))
ONE_RULE = RuleBase(((np.ones_like,),))


def plain(rule_base: RuleBase = RAMPS, **changed: Any) -> TSSystem:
    matrices: dict[str, Any] = {
        "A": [[[0.0, 1.0], [-1.0, 0.0]], [[0.0, 1.0], [-2.0, -1.0]]],
        "B": [[[0.0], [1.0]]],
        "C": [[[1.0, 0.0]], [[1.0, 0.5]]],
    }
    return TSSystem.from_rules(
        **(matrices | changed), rule_base=rule_base, premise=lambda x: x[..., :1]
    )


@PROPERTY
@given(st.data(), rule_bases())
def test_weights_are_a_convex_combination(data: st.DataObject, rule_base: RuleBase) -> None:
    batch = data.draw(st.sampled_from([(), (3,), (2, 3)]))
    z = data.draw(arrays(*batch, rule_base.premise_count))
    weights = rule_base.weights(z)
    assert weights.shape == (*batch, rule_base.rule_count)
    assert (weights >= 0.0).all()
    np.testing.assert_allclose(weights.sum(axis=-1), 1.0, rtol=1e-14)


def test_grades_of_several_premise_variables_are_multiplied() -> None:
    rule_base = RuleBase(((lambda z: 1.0 - z, lambda z: 1.0 - z), (lambda z: z, lambda z: 1.0 - z)))
    grades = np.array([0.75 * 0.6, 0.25 * 0.6])
    np.testing.assert_allclose(rule_base.weights([0.25, 0.4]), grades / grades.sum(), rtol=1e-15)


@PROPERTY
@given(arrays(2), arrays(1))
def test_a_vertex_membership_reproduces_the_vertex_model(x: Array, u: Array) -> None:
    system = plain()
    for vertex in (0, 1):
        z = [float(vertex)]
        assert (system.derivative(x, u, z) == system.A[vertex] @ x + system.B[vertex] @ u).all()
        assert (system.output(x, z) == system.C[vertex] @ x).all()


@PROPERTY
@given(arrays(2), arrays(1))
def test_one_rule_is_the_linear_system(x: Array, u: Array) -> None:
    A, B, C = np.array([[0.0, 1.0], [-3.0, -0.2]]), np.array([[0.0], [2.0]]), np.eye(2)
    system = plain(ONE_RULE, A=[A], B=[B], C=[C])
    np.testing.assert_allclose(system.derivative(x, u), A @ x + B @ u, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(system.output(x), C @ x, rtol=1e-14, atol=1e-14)


@PROPERTY
@given(st.data(), systems())
def test_the_blend_is_the_weighted_sum_of_the_rules(data: st.DataObject, system: TSSystem) -> None:
    x, u = data.draw(arrays(system.state_count)), data.draw(arrays(system.B.shape[-1]))
    weights = system.rule_base.weights(system.premise(x))
    rate = sum(h * (A @ x + B @ u) for h, A, B in zip(weights, system.A, system.B, strict=True))
    output = sum(h * (C @ x) for h, C in zip(weights, system.C, strict=True))
    np.testing.assert_allclose(system.derivative(x, u), rate, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(system.output(x), output, rtol=1e-12, atol=1e-12)


def test_a_single_matrix_serves_every_rule() -> None:
    system = plain()
    assert system.B.shape == (2, 2, 1)
    assert (system.B[0] == system.B[1]).all()


def test_matrices_of_a_system_cannot_be_changed_behind_its_back() -> None:
    system = plain()
    with pytest.raises(ValueError, match="read-only"):
        system.A[0, 0, 0] = 1.0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"A": [np.zeros((2, 3))] * 2}, r"A: expected shape \(2, 3, 3\), got \(2, 2, 3\)"),
        ({"A": [np.eye(2)] * 3}, "A: expected 1 or 2 matrices, got 3"),
        ({"A": [np.eye(2), np.eye(3)]}, r"A: every rule needs the same shape.*\(2, 2\).*\(3, 3\)"),
        ({"A": [np.zeros(2)] * 2}, r"A: expected one matrix a rule.*got \(2, 2\)"),
        ({"A": [np.full((2, 2), np.nan)]}, "A: every entry must be finite"),
        ({"B": [np.zeros((3, 1))]}, r"B: expected shape \(2, 2, 1\), got \(2, 3, 1\)"),
        ({"B": [np.full((2, 1), np.inf)]}, "B: every entry must be finite"),
        ({"C": [np.zeros((1, 3))]}, r"C: expected shape \(2, 1, 2\), got \(2, 1, 3\)"),
        ({"C": [np.zeros((1, 2)), np.zeros((2, 2))]}, "C: every rule needs the same shape"),
        (
            {"A": [[[1, 2], [3]], np.eye(2)]},
            r"A: expected rows of equal length, got \[\[1, 2\], \[3",
        ),
        ({"C": [[[1.0, np.nan]]]}, "C: every entry must be finite"),
    ],
)
def test_a_wrong_matrix_is_named_with_its_shapes(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        plain(**changed)


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ((), "at least one rule"),
        (((),), "at least one rule with one premise variable"),
        (((np.ones_like,), (np.ones_like, np.ones_like)), r"one membership function.*\[1, 2\]"),
    ],
)
def test_an_incomplete_rule_base_is_refused(rules: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        RuleBase(rules)


@pytest.mark.parametrize(
    ("z", "message"),
    [
        ([2.0], "membership of rule 1: expected finite grades of at least 0, got -1.0"),
        ([[np.nan], [0.1]], "membership of rule 1: expected finite grades of at least 0, got nan"),
        ([-2.0], "membership of rule 2: expected finite grades of at least 0, got -2.0"),
        ([np.nan], "membership of rule 1: expected finite grades of at least 0, got nan"),
        ([0.5, 0.5], r"z: expected a last axis of 1 premise variables, got shape \(2,\)"),
        (0.5, r"z: expected a last axis of 1 premise variables, got shape \(\)"),
    ],
)
def test_weights_name_what_is_wrong_with_a_premise(z: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        RAMPS.weights(z)


def test_a_system_needs_an_output_matrix_for_each_rule() -> None:
    with pytest.raises(ModelError, match=r"C: expected one matrix a rule.*got \(1, 2\)"):
        TSSystem(np.zeros((1, 2, 2)), np.zeros((1, 2, 1)), np.zeros((1, 2)), ONE_RULE, lambda x: x)


def test_a_membership_may_be_a_constant_but_not_of_another_shape() -> None:
    constant = RuleBase(((lambda z: np.float64(2.0),), (np.ones_like,)))
    np.testing.assert_allclose(constant.weights(np.zeros((3, 1))), [[2 / 3, 1 / 3]] * 3)
    wrong = RuleBase(((lambda z: np.ones(7),),))
    with pytest.raises(ModelError, match=r"rule 1: expected one grade an entry, shape \(3,\)"):
        wrong.weights(np.zeros((3, 1)))


@pytest.mark.parametrize("grade", [1e308, 1e-308])
def test_extreme_grades_still_sum_to_one(grade: float) -> None:
    rules = RuleBase(((lambda z: np.full_like(z, grade),), (lambda z: np.full_like(z, grade),)))
    assert rules.weights([0.0]) == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize(
    ("z", "place"),
    [
        ([3.0], r"\[3.0\]"),
        ([[0.5], [4.0]], r"\[4.0\]"),
        ([[[0.5], [0.1]], [[0.2], [5.0]]], r"\[5.0\]"),
    ],
)
def test_a_premise_at_which_no_rule_fires_is_named(z: Any, place: str) -> None:
    hat = RuleBase(((lambda z: np.clip(1.0 - np.abs(z), 0.0, None),),))
    with pytest.raises(ModelError, match=f"no rule fires at z = {place}"):
        hat.weights(z)
