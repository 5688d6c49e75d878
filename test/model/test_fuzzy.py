# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Membership functions by name, and weights that are a convex combination."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
from tsobs_ros.model.fuzzy import SHAPES, Membership, RuleBase, membership

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


BELLS = st.builds(
    lambda centre, width: membership("gaussian", {"centre": centre, "width": width}),
    st.floats(-5.0, 5.0), st.floats(0.5, 5.0),
)  # fmt: skip


@settings(max_examples=20)
@given(st.lists(st.tuples(BELLS, BELLS), min_size=1, max_size=4), st.integers(0, 99))
def test_weights_are_a_convex_combination(rules: Any, seed: int) -> None:
    z = np.random.default_rng(seed).uniform(-5.0, 5.0, (2, 3, 2))
    weights = RuleBase(tuple(rules)).weights(z)
    assert weights.shape == (2, 3, len(rules))
    assert (weights >= 0.0).all()
    np.testing.assert_allclose(weights.sum(axis=-1), 1.0, rtol=1e-14)
    products = np.array([[each[0](z[..., 0]) * each[1](z[..., 1]) for each in rules]])[0]
    np.testing.assert_allclose(weights, np.moveaxis(products / products.sum(axis=0), 0, -1))


@pytest.mark.parametrize(
    ("rules", "z", "message"),
    [
        ((), 0.0, "at least one rule"),
        ((EXAMPLES[:1], EXAMPLES[:2]), 0.0, r"one membership function.*\[1, 2\]"),
        ((EXAMPLES[3:4],), [[[0.5], [0.1]], [[0.2], [5.0]]], r"no rule fires at z = \[5.0\]"),
        ((EXAMPLES[3:4],), [0.5, 0.5], "z: expected a last axis of 1 premise variables, got"),
    ],
)
def test_rules_without_weights_are_refused(rules: Any, z: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        RuleBase(rules).weights(z)


@pytest.mark.parametrize(
    ("shape", "parameters", "z", "grades"),
    [
        ("always", {}, [-5.0, 0.0], [1.0, 1.0]),
        ("linear", {"zero": 1.0, "one": 3.0}, [0.0, 1.0, 1.5, 3.0, 9.0], [0, 0, 0.25, 1, 1]),
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
    # It is level outside, although beyond 2π the sine's share rises above the lower sector again.
    outside = np.array([-np.inf, -7.8, 3.1, 7.8, 1e300])
    assert not membership("sine_upper", {"half_width": width})(outside).any()


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda each: each.shape)
def test_the_cores_slopes_are_the_derivative_of_the_grade(example: Membership) -> None:
    """Compare with central differences at points away from the corners."""
    z = np.array([-2.5, -1.31, -0.77, -0.21, -1e-3, 0.0, 4e-4, 0.12, 0.45, 0.83, 1.13, 1.61, 3.1])
    step, (grades, slopes) = 1e-6, np.empty((2, len(z)))
    code = SHAPES[example.shape].code
    native.grades_and_slopes(code, np.array(example.coded), z, grades, slopes)
    assert (grades == example(z)).all()
    expected = (example(z + step) - example(z - step)) / (2.0 * step)
    np.testing.assert_allclose(slopes, expected, atol=1e-9)


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
        ("sine_upper", {"half_width": 3.2}, "sine_upper: expected 1e-4 ≤ half_width < π, got .3.2"),
        ("square_rest", {"half_width": 0.0}, "square_rest: expected half_width above 0"),
    ],
)
def test_wrong_parameters_are_named(shape: str, parameters: dict[str, float], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        membership(shape, parameters)
