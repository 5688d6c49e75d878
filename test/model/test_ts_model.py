# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""T–S systems: memberships, weights that are convex combinations, order of the prediction."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from tsobs_ros.checks import Array
from tsobs_ros.errors import ModelError
from tsobs_ros.model.disturbance import CLEAN
from tsobs_ros.model.fuzzy import Membership, RuleBase, membership
from tsobs_ros.model.ts_model import Direction, TSFlow, TSModel, system_uncertainty

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


def grades(of: Membership, z: Array) -> Array:
    """Return the grade at each of some z, by its weight beside a rule that always fires."""
    weights = RuleBase(((of,), (membership("always"),))).weights(z[:, np.newaxis])
    return np.asarray(weights[:, 0] / weights[:, 1])


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
    first, second = z.reshape(-1, 2).T
    products = np.array([grades(a, first) * grades(b, second) for a, b in rules])
    np.testing.assert_allclose(weights.reshape(-1, len(rules)).T, products / products.sum(axis=0))


def test_rules_without_weights_are_refused() -> None:
    one: Any = (EXAMPLES[3:4],)
    for rules, z, message in (
        ((), 0.0, "at least one rule"),
        ((EXAMPLES[:1], EXAMPLES[:2]), 0.0, r"one membership function.*\[1, 2\]"),
        (one, [[[0.5], [0.1]], [[0.2], [5.0]]], r"no rule fires at z = \[5.0\]"),
        (one, [0.5, 0.5], "z: expected a last axis of 1 premise variables, got"),
    ):
        with pytest.raises(ModelError, match=message):
            RuleBase(rules).weights(z)


@pytest.mark.parametrize("one", EXAMPLES)
def test_no_rule_fires_in_the_gaps_and_only_there(one: Membership) -> None:
    """Beside a triangle on its left, whose gap to it some shapes leave open."""
    left = membership("triangle", {"left": -4.0, "peak": -3.0, "right": -1.5})
    z = np.linspace(-5.0, 5.0, 1000)
    gaps = RuleBase(((left,), (one,))).gaps
    outside = sum(((low < z) & (z < high) for low, high in gaps), start=np.zeros(1000, bool))
    np.testing.assert_array_equal(outside, (grades(left, z) == 0.0) & (grades(one, z) == 0.0))


def test_grades() -> None:
    shapes: dict[str, tuple[dict[str, float], list[float], list[float]]] = {
        "always": ({}, [-5.0, 0.0], [1.0, 1.0]),
        "linear": ({"zero": 1.0, "one": 3.0}, [0.0, 1.0, 1.5, 3.0, 9.0], [0, 0, 0.25, 1, 1]),
        "triangle": ({"left": 0, "peak": 1, "right": 3}, [-1, 0.5, 1, 2, 4], [0, 0.5, 1, 0.5, 0]),
        "trapezoid": (
            {"left": 0, "top_left": 1, "top_right": 2, "right": 4},
            [-1, 0.25, 1, 1.7, 3, 5],
            [0, 0.25, 1, 1, 0.5, 0],
        ),
        "gaussian": ({"centre": 1.0, "width": 2.0}, [1.0, 3.0], [1.0, math.exp(-0.5)]),
    }
    for shape, (parameters, z, expected) in shapes.items():
        found = grades(membership(shape, parameters), np.array(z))
        np.testing.assert_allclose(found, expected, atol=1e-15)


@pytest.mark.parametrize("width", [0.4, math.pi / 2, 3.0])
def test_the_sine_sector_is_the_sine_and_level_outside(width: float) -> None:
    z = np.linspace(-width, width, 41)
    upper, lower = (
        membership(f"sine_{name}", {"half_width": width}) for name in ("upper", "lower")
    )
    share, rest = grades(upper, z), grades(lower, z)
    np.testing.assert_allclose((share + rest * math.sin(width) / width) * z, np.sin(z), atol=1e-15)
    np.testing.assert_allclose(share + rest, 1.0, rtol=1e-15)
    # Although beyond 2π the sine's share rises above the lower sector again.
    assert not grades(upper, np.array([-np.inf, -7.8, 3.1, 7.8, 1e300])).any()


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda each: each.mapping["shape"])
def test_the_covariance_follows_the_derivative_of_the_weights(
    example: Membership, predicted: Any
) -> None:
    """Compare with central differences at points away from the corners."""
    rules = RuleBase(((example,), (membership("always"),)))
    plant = TSModel(np.array([[[-1.0]], [[2.0]]]), np.zeros((2, 1, 1)), np.eye(1), rules, np.eye(1))
    flow, step = TSFlow(plant, CLEAN[0].model, np.zeros(1), 0.01), 1e-6
    z = np.array([-2.5, -1.31, -0.77, -0.21, -1e-3, 4e-4, 0.12, 0.45, 0.83, 1.13, 1.61])
    for x in z[:, np.newaxis]:
        ahead, behind = (predicted(flow, x + sign * step, [0.0], 0.01) for sign in (1.0, -1.0))
        _, spread = predicted(flow, x, [0.0], 0.01, np.eye(1))
        assert spread[0, 0] == pytest.approx(float((ahead - behind)[0] / (2.0 * step)) ** 2)


def test_wrong_parameters_are_named() -> None:
    cases: list[tuple[str, dict[str, float], str]] = [
        ("circle", {}, "expected one of always, linear, .* got 'circle'"),
        ("always", {"left": 1.0}, "always: expected the parameters none, got left"),
        ("linear", {"zero": 1.0}, "linear: expected the parameters zero, one, got zero"),
        ("linear", {"zero": 1.0, "one": 1.0}, "linear: expected zero and one apart"),
        ("triangle", {"left": 0, "peak": 0, "right": 1}, "expected left < peak < right"),
        ("gaussian", {"centre": 0.0, "width": 0.0}, "gaussian: expected width above 0"),
        ("sine_upper", {"half_width": 3.2}, "expected 1e-4 ≤ half_width < π, got .3.2"),
    ]
    for shape, parameters, message in cases:
        with pytest.raises(ModelError, match=message):
            membership(shape, parameters)


RAMPS = RuleBase(
    (
        (membership("linear", {"zero": 1.0, "one": 0.0}),),
        (membership("linear", {"zero": 0.0, "one": 1.0}),),
    )
)
BUMPS = RuleBase(
    tuple((membership("gaussian", {"centre": c, "width": 0.8}),) for c in (-1.0, 0.1, 1.3))
)


def tangled(period: float) -> TSFlow:
    """Three rules that do not commute, premise and input mixed."""
    rng = np.random.default_rng(8)
    model = TSModel(
        A=rng.standard_normal((3, 3, 3)),
        B=rng.standard_normal((3, 3, 1)),
        C=np.eye(3)[:1],
        rule_base=BUMPS,
        premise=np.array([[1.0, 0.5, -0.2]]),
    )
    return TSFlow(model, CLEAN[0].model, np.zeros(3), period)


def test_it_is_of_second_order(predicted: Any) -> None:
    """Halving the step divides the error after one second by four."""
    start, u = np.array([0.4, -0.3, 0.2]), np.array([0.7])
    model = tangled(1.0).model
    exact = solve_ivp(
        lambda _, x: model.derivative(x, u), (0.0, 1.0), start, rtol=1e-11, atol=1e-12
    ).y[:, -1]
    errors = []
    for steps in (40, 80):
        flow, x = tangled(1.0 / steps), start
        for _ in range(steps):
            x = predicted(flow, x, u, flow.period)
        errors.append(float(np.abs(x - exact).max()))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)
    assert errors[1] < 1e-3


def test_wrong_matrices_are_named() -> None:
    right: dict[str, Array] = {
        "A": np.zeros((2, 2, 2)), "B": np.zeros((2, 1)), "C": np.eye(2)[:1],
        "premise": np.ones((1, 2)),
    }  # fmt: skip
    for name, matrix, message in (
        ("A", np.eye(2), r"A: expected one matrix per rule, shape \(r, ·, ·\), got shape \(2, 2\)"),
        ("B", np.zeros((3, 1)), r"B: expected shape \(2, 2, 1\), got \(2, 3, 1\)"),
        ("C", np.zeros(2), r"C: expected a matrix, got shape \(2,\)"),
        ("B", np.full((2, 1), 1e101), "B: expected numbers up to 1e\\+100, got a larger one"),
        ("premise", np.eye(2), r"premise: expected shape \(1, 2\), got \(2, 2\)"),
    ):
        with pytest.raises(ModelError, match=message):
            TSModel(rule_base=RAMPS, **{**right, name: matrix})


def test_uncertain_directions_fit_the_system_or_are_named() -> None:
    model, change = tangled(0.1).model, np.eye(3)[[1, 2, 0]]
    known = system_uncertainty(model, {"k": Direction(change, 0.2)})
    np.testing.assert_array_equal(known.linear, [[change] * 3])
    assert (known.names, known.limits.tolist(), known.linear_places) == (("k",), [0.2], [0])
    for E, bound, message in (
        (change, 0.0, "uncertainty.k.bound: expected a finite number above 0"),
        (0.0 * change, 0.2, "uncertainty.k.E: expected a matrix other than zero"),
        (np.eye(2), 0.2, r"uncertainty.k.E: expected shape \(3, 3\)"),
    ):
        with pytest.raises(ModelError, match=message):
            system_uncertainty(model, {"k": Direction(E, bound)})
    with pytest.raises(ModelError, match="process_noise: expected densities of at least 0"):
        TSFlow(model, CLEAN[0].model, [0.0, 0.0, -1.0], 0.1)
