# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Membership functions by name, and weights that are a convex combination."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from tsobs_ros.errors import ModelError
from tsobs_ros.model.fuzzy import Membership, RuleBase, membership

Array = NDArray[np.float64]
NUMBERS = st.floats(-5.0, 5.0)
EXAMPLES = [
    membership("always"),
    membership("linear", {"zero": -1.0, "one": 2.0}),
    membership("linear", {"zero": 1.5, "one": 0.25}),
    membership("triangle", {"left": -1.0, "peak": 0.3, "right": 2.0}),
    membership("trapezoid", {"left": -1.0, "top_left": -0.4, "top_right": 0.6, "right": 1.7}),
    membership("gaussian", {"centre": 0.3, "width": 0.7}),
    membership("sine_upper", {"half_width": 1.8}),
    membership("sine_lower", {"half_width": 1.8}),
    membership("square", {"half_width": 1.3}),
    membership("square_rest", {"half_width": 1.3}),
]


@st.composite
def rule_bases(draw: st.DrawFn) -> RuleBase:
    premises = draw(st.integers(1, 3))
    parameters = st.fixed_dictionaries({"centre": NUMBERS, "width": st.floats(0.5, 5.0)})
    bell = parameters.map(lambda each: membership("gaussian", each))
    return RuleBase(tuple(draw(st.lists(st.tuples(*[bell] * premises), min_size=1, max_size=4))))


@settings(max_examples=40)
@given(st.data(), rule_bases())
def test_weights_are_a_convex_combination(data: st.DataObject, rule_base: RuleBase) -> None:
    batch = data.draw(st.sampled_from([(), (3,), (2, 3)]))
    z = data.draw(hnp.arrays(np.float64, (*batch, rule_base.premise_count), elements=NUMBERS))
    weights = rule_base.weights(z)
    assert weights.shape == (*batch, rule_base.rule_count)
    assert (weights >= 0.0).all()
    np.testing.assert_allclose(weights.sum(axis=-1), 1.0, rtol=1e-14)


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ((), "at least one rule"),
        (((),), "at least one rule with one premise variable"),
        ((EXAMPLES[:1], EXAMPLES[:2]), r"one membership function.*\[1, 2\]"),
    ],
)
def test_an_incomplete_rule_base_is_refused(rules: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        RuleBase(rules)


@pytest.mark.parametrize(
    ("z", "message"),
    [
        ([3.0], r"no rule fires at z = \[3.0\]"),
        ([[0.5], [np.nan]], r"no rule fires at z = \[nan\]"),
        ([[[0.5], [0.1]], [[0.2], [5.0]]], r"no rule fires at z = \[5.0\]"),
        ([0.5, 0.5], r"z: expected a last axis of 1 premise variables, got shape \(2,\)"),
        (0.5, r"z: expected a last axis of 1 premise variables, got shape \(\)"),
    ],
)
def test_weights_name_what_is_wrong_with_a_premise(z: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        RuleBase(((EXAMPLES[3],),)).weights(z)


@pytest.mark.parametrize(
    ("shape", "parameters", "z", "grades"),
    [
        ("always", {}, [-5.0, 0.0], [1.0, 1.0]),
        ("linear", {"zero": 1.0, "one": 3.0}, [0.0, 1.0, 1.5, 3.0, 9.0], [0, 0, 0.25, 1, 1]),
        ("linear", {"zero": 3.0, "one": 1.0}, [0.0, 1.5, 3.0], [1.0, 0.75, 0.0]),
        ("triangle", {"left": 0, "peak": 1, "right": 3}, [-1, 0.5, 1, 2, 4], [0, 0.5, 1, 0.5, 0]),
        (
            "trapezoid",
            {"left": 0, "top_left": 1, "top_right": 2, "right": 4},
            [-1, 0.25, 1, 1.7, 3, 5],
            [0, 0.25, 1, 1, 0.5, 0],
        ),
        ("gaussian", {"centre": 1.0, "width": 2.0}, [1.0, 3.0], [1.0, math.exp(-0.5)]),
    ],
)
def test_grades(
    shape: str, parameters: dict[str, float], z: list[float], grades: list[float]
) -> None:
    np.testing.assert_allclose(membership(shape, parameters)(np.array(z)), grades, atol=1e-15)


@pytest.mark.parametrize("width", [0.4, math.pi / 2, 3.0])
def test_the_sine_sector_is_the_sine(width: float) -> None:
    z = np.linspace(-width, width, 41)
    upper = membership("sine_upper", {"half_width": width})(z)
    lower = membership("sine_lower", {"half_width": width})(z)
    bottom = math.sin(width) / width
    np.testing.assert_allclose((upper + lower * bottom) * z, np.sin(z), atol=1e-15)
    np.testing.assert_allclose(upper + lower, 1.0, rtol=1e-15)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda each: each.shape)
def test_slopes_are_the_derivative_of_the_grade(example: Membership) -> None:
    """Compare with central differences at points away from the corners."""
    z = np.array([-2.5, -1.31, -0.77, -0.21, -1e-3, 0.0, 4e-4, 0.12, 0.45, 0.83, 1.13, 1.61, 3.1])
    step = 1e-6
    expected = (example(z + step) - example(z - step)) / (2.0 * step)
    np.testing.assert_allclose(example.slope(z), expected, atol=1e-9)


def test_slopes_of_the_weights_of_two_premises() -> None:
    rules = RuleBase(((EXAMPLES[5], EXAMPLES[1]), (EXAMPLES[5], EXAMPLES[2]), (EXAMPLES[0],) * 2))
    z = np.random.default_rng(3).uniform(-0.9, 1.4, (20, 2))
    weights, slopes = rules.weights_and_slopes(z)
    np.testing.assert_allclose(weights, rules.weights(z), rtol=1e-14)
    assert slopes.shape == (20, 3, 2)
    for place in range(2):
        step = 1e-6 * np.eye(2)[place]
        expected = (rules.weights(z + step) - rules.weights(z - step)) / 2e-6
        np.testing.assert_allclose(slopes[..., place], expected, atol=1e-8)


# Every shape, alone and with another premise; the last rule fires everywhere but at NaN.
def test_the_sine_sector_is_level_outside_of_its_domain() -> None:
    """Beyond 2π the sine's share rises above the lower sector again."""
    z = np.array([-np.inf, -7.8, -3.0, 3.0, 7.8, 1e300])
    for shape, grade in (("sine_upper", 0.0), ("sine_lower", 1.0)):
        sector = membership(shape, {"half_width": 3.0})
        assert (sector(z) == grade).all()
        assert (sector.slope(z) == 0.0).all()


@pytest.mark.parametrize(
    ("shape", "parameters", "message"),
    [
        ("circle", {}, "expected one of always, linear, .* got 'circle'"),
        ("always", {"left": 1.0}, "membership always: expected the parameters none, got left"),
        ("linear", {"zero": 1.0}, "membership linear: expected the parameters zero, one, got zero"),
        ("linear", {"zero": 1.0, "one": 1.0}, "membership linear: expected zero and one apart"),
        ("triangle", {"left": 0, "peak": 0, "right": 1}, "triangle: expected left < peak < right"),
        (
            "trapezoid",
            {"left": 0, "top_left": 2, "top_right": 1, "right": 3},
            "trapezoid: expected left < top_left < top_right < right, got",
        ),
        ("gaussian", {"centre": 0.0, "width": 0.0}, "gaussian: expected width above 0"),
        ("gaussian", {"centre": math.nan, "width": 1.0}, "membership gaussian: centre"),
        ("sine_upper", {"half_width": 3.2}, "sine_upper: expected 1e-4 ≤ half_width < π, got .3.2"),
        ("square_rest", {"half_width": 0.0}, "square_rest: expected half_width above 0"),
        ("sine_lower", {"half_width": 0.0}, "sine_lower: expected 1e-4 ≤ half_width < π"),
    ],
)
def test_wrong_parameters_are_named(shape: str, parameters: dict[str, float], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        membership(shape, parameters)
