# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""T–S systems by their rules, and the arm as one of them."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.paper.systems import TSSystem, arm_system, blend

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=40)
NUMBERS = st.floats(-5.0, 5.0, allow_subnormal=False)
ARMS = st.builds(
    ElasticJointArm, st.floats(0.1, 10.0), st.floats(0.1, 10.0), st.floats(0.5, 50.0),
    st.floats(0.1, 50.0), st.floats(0.0, 5.0), st.floats(0.0, 5.0),
)  # fmt: skip
# Two rules of one premise variable in [0, 1] that meet at its ends.
RAMPS = RuleBase(tuple((membership("linear", {"zero": 1.0 - at, "one": at}),) for at in (0.0, 1.0)))


def arrays(*shape: int) -> st.SearchStrategy[Array]:
    return hnp.arrays(np.float64, shape, elements=NUMBERS)


def plain(**changed: Any) -> TSSystem:
    matrices: dict[str, Any] = {
        "A": [[[0.0, 1.0], [-1.0, 0.0]], [[0.0, 1.0], [-2.0, -1.0]]],
        "B": [[[0.0], [1.0]]],
        "C": [[[1.0, 0.0]], [[1.0, 0.5]]],
    }
    return TSSystem.from_rules(**(matrices | changed), rule_base=RAMPS)


@st.composite
def systems(draw: st.DrawFn) -> TSSystem:
    """Systems of random size."""
    q, r = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    n, m, p = draw(st.integers(q, 4)), draw(st.integers(1, 2)), draw(st.integers(1, 2))
    centres = draw(arrays(r, q))
    rules = [[membership("gaussian", {"centre": c, "width": 2.0}) for c in row] for row in centres]
    matrices = [draw(arrays(r, *shape)) for shape in ((n, n), (n, m), (p, n))]
    return TSSystem(*matrices, RuleBase(tuple(map(tuple, rules))))


@PROPERTY
@given(st.data(), systems())
def test_the_blend_is_the_weighted_sum_of_the_rules(data: st.DataObject, system: TSSystem) -> None:
    x, z = data.draw(arrays(system.state_count)), data.draw(arrays(system.rule_base.premise_count))
    weights = system.rule_base.weights(z)
    output = sum(h * (C @ x) for h, C in zip(weights, system.C, strict=True))
    np.testing.assert_allclose(system.output(x, z), output, rtol=1e-12, atol=1e-12)


@PROPERTY
@given(arrays(2))
def test_a_vertex_membership_reproduces_the_vertex_model(x: Array) -> None:
    system = plain()
    for vertex in (0, 1):
        assert (system.output(x, [float(vertex)]) == system.C[vertex] @ x).all()


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


def test_a_system_needs_an_output_matrix_for_each_rule() -> None:
    with pytest.raises(ModelError, match=r"C: expected one matrix a rule.*got \(1, 2\)"):
        TSSystem(np.zeros((1, 2, 2)), np.zeros((1, 2, 1)), np.zeros((1, 2)), RAMPS)


def test_the_matrices_of_example_3_are_the_papers() -> None:
    """Equation (47) with the signs restored: both rules, input and output, to the last bit."""
    system = arm_system(ElasticJointArm())
    for A, corner in zip(system.A, (-20.0, -20.0 / math.pi - 10.0), strict=True):
        expected = [[0, 1, 0, 0], [corner, 0, 1, 0], [0, 0, 0, 1], [50, 0, -5, 0]]
        np.testing.assert_allclose(A, expected, rtol=1e-15, atol=0.0)
    assert (system.B == [[0.0], [0.0], [0.0], [5.0]]).all()
    assert (system.C == [[1.0, 0.0, 0.0, 0.0]]).all()


def test_the_membership_is_equation_49() -> None:
    rule_base = arm_system(ElasticJointArm()).rule_base
    angle = np.concatenate([-np.linspace(1e-3, np.pi / 2, 50), np.linspace(1e-3, np.pi / 2, 50)])
    near = (np.sin(angle) - 2.0 / np.pi * angle) / ((1.0 - 2.0 / np.pi) * angle)
    weights = rule_base.weights(angle[:, np.newaxis])
    np.testing.assert_allclose(weights, np.stack([near, 1.0 - near], axis=-1), atol=1e-9)
    assert (rule_base.weights([0.0]) == [1.0, 0.0]).all()
    np.testing.assert_allclose(rule_base.weights([np.pi / 2]), [0.0, 1.0], atol=1e-15)


@PROPERTY
@given(ARMS, st.floats(0.01, math.pi - 0.01), st.floats(-1.0, 1.0), arrays(4), arrays(1))
def test_the_ts_form_is_the_nonlinear_arm_on_its_whole_domain(
    arm: ElasticJointArm, x_max: float, place: float, x: Array, u: Array
) -> None:
    x[0] = place * x_max
    system = arm_system(arm, x_max)
    terms = np.abs(arm.spring_matrix) + np.abs(arm.slope_matrix(1.0) - arm.spring_matrix)
    scale = 1.0 + terms @ np.abs(x) + np.abs(arm.input_matrix @ u)
    weights = system.rule_base.weights(x[:1])
    rate = blend(system.A, weights, x) + blend(system.B, weights, u)
    error = rate - arm.derivative(x, u)
    # The membership divides rounding by 1 − sin(x_max)/x_max, and the blend multiplies it back.
    assert (np.abs(error) <= 1e-14 * scale).all()
    assert (system.output(x, x[:1]) == x[:1]).all()


@pytest.mark.parametrize("x_max", [0.0, -1.0, math.pi, 4.0, math.nan])
def test_the_domain_of_the_ts_form_is_an_open_half_turn(x_max: Any) -> None:
    with pytest.raises(ModelError, match="x_max: expected 0 < x_max < π"):
        arm_system(ElasticJointArm(), x_max)
