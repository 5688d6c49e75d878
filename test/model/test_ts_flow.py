# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The prediction of a T–S system: second order, and its vertices exact."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tsobs_ros.errors import ModelError
from tsobs_ros.model.disturbance import bias, clean, per_channel, sinusoid
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.ts_flow import TSFlow
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.model.uncertainty import Direction, system_uncertainty

Array = NDArray[np.float64]

WIDTH = 1.2
SECTOR = RuleBase(
    tuple((membership(name, {"half_width": WIDTH}),) for name in ("sine_upper", "sine_lower"))
)
RAMPS = RuleBase(
    (
        (membership("linear", {"zero": 1.0, "one": 0.0}),),
        (membership("linear", {"zero": 0.0, "one": 1.0}),),
    )
)
BUMPS = RuleBase(
    tuple((membership("gaussian", {"centre": c, "width": 0.8}),) for c in (-1.0, 0.1, 1.3))
)


def pendulum(period: float = 0.01) -> TSFlow:
    """A pendulum whose angle, the premise, is estimated; a bias on the second output."""
    stiffness = np.array([9.81, 9.81 * np.sin(WIDTH) / WIDTH])
    model = TSModel(
        A=np.array([[[0.0, 1.0], [-k, -0.2]] for k in stiffness]),
        B=np.array([[0.0], [1.0]]),
        C=np.eye(2),
        rule_base=SECTOR,
        premise=np.array([[1.0, 0.0]]),
    )
    return TSFlow(model, per_channel([clean(), bias(1e-6)]), [0.0, 1e-3], period)


def scheduled(period: float = 0.05) -> TSFlow:
    """Two rules that do not commute, with inputs of their own, blended by a known signal."""
    rng = np.random.default_rng(5)
    model = TSModel(
        A=rng.standard_normal((2, 3, 3)) - np.eye(3),
        B=rng.standard_normal((2, 3, 2)),
        C=rng.standard_normal((2, 3)),
        rule_base=RAMPS,
        premise=np.zeros((1, 3)),
        schedule=np.array([[1.0]]),
    )
    return TSFlow(model, per_channel([bias(), sinusoid(2.0)]), [0.1, 0.2, 0.3], period)


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
    return TSFlow(model, clean(), np.zeros(3), period)


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


def test_with_a_known_premise_the_error_map_blends_the_vertices(predicted: Any) -> None:
    weight = 0.3
    flow = scheduled()
    u = np.array([0.4, -0.7, weight])
    x, other = np.random.default_rng(2).standard_normal((2, 6))
    h = [1.0 - weight, weight]
    pairs = list(product(h, h))
    vertices = flow.vertices(flow.model.A, ["rule 1", "rule 2"])
    blend = sum(a * b * v.transition for (a, b), v in zip(pairs, vertices, strict=True))
    error = predicted(flow, x, u, flow.period) - predicted(flow, other, u, flow.period)
    np.testing.assert_allclose(error, blend @ (x - other), rtol=1e-12, atol=1e-14)


def middle_of(flow: TSFlow, x: Array) -> float:
    """Return the angle in the middle of a pendulum's step without torque."""
    phi, stiffness = flow.nominal.phi, 9.81 * np.array([1.0, np.sin(WIDTH) / WIDTH])
    entering = np.zeros(3)
    entering[1] = stiffness.mean() * x[0] - 9.81 * np.sin(x[0])
    return float((phi @ (x + 0.5 * flow.period * entering))[0])


def test_with_an_estimated_premise_the_error_map_is_between_the_vertices(
    predicted: Any,
) -> None:
    """Solve for the two slopes of the mean value theorem: they lie in the range of the cosine."""
    flow = pendulum(0.05)
    rng = np.random.default_rng(4)
    lowest = np.cos(WIDTH)
    matrices = np.array([[[0.0, 1.0], [-9.81 * c, -0.2]] for c in (lowest, 1.0)])
    corners = [v.transition for v in flow.vertices(matrices, ["low", "high"])]
    for _ in range(20):
        # Small rates and no torque keep the middle of the step in the domain, too.
        x, other = rng.uniform([-1.1, -1.0, -1.0], [1.1, 1.0, 1.0], (2, 3))
        u = np.zeros(1)
        middles = [middle_of(flow, each) for each in (x, other)]
        c1, c2 = ((np.sin(a) - np.sin(b)) / (a - b) for a, b in ((x[0], other[0]), (*middles,)))
        assert lowest - 1e-12 <= min(c1, c2) <= max(c1, c2) <= 1.0
        first, second = (
            [(1.0 - c) / (1.0 - lowest), (c - lowest) / (1.0 - lowest)] for c in (c1, c2)
        )
        blend = sum(
            a * b * corner for (a, b), corner in zip(product(first, second), corners, strict=True)
        )
        error = predicted(flow, x, u, flow.period) - predicted(flow, other, u, flow.period)
        np.testing.assert_allclose(error, blend @ (x - other), atol=1e-13)


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
    model = pendulum().model
    change = np.array([[0.0, 0.0], [-1.0, 0.0]])
    known = system_uncertainty(model, {"k": Direction(change, 0.2)})
    np.testing.assert_array_equal(known.linear, [[change, change]])
    assert (known.names, known.limits.tolist(), known.linear_places) == (("k",), [0.2], [0])
    for E, bound, message in (
        (change, 0.0, "uncertainty.k.bound: expected a finite number above 0"),
        (0.0 * change, 0.2, "uncertainty.k.E: expected a matrix other than zero"),
        (np.eye(3), 0.2, r"uncertainty.k.E: expected shape \(2, 2\)"),
    ):
        with pytest.raises(ModelError, match=message):
            system_uncertainty(model, {"k": Direction(E, bound)})
    with pytest.raises(ModelError, match="process_noise: expected densities of at least 0"):
        TSFlow(model, per_channel([clean(), clean()]), [0.0, -1.0], 0.1)
