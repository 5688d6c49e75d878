# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The prediction of a T–S system is of second order; what is no system is named."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tsobs_ros.errors import ModelError
from tsobs_ros.model.disturbance import CLEAN
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.ts_model import Direction, TSFlow, TSModel, system_uncertainty

Array = NDArray[np.float64]

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
