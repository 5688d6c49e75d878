# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sine, cosine, exponential, logarithm: as near to the true as the system's, everywhere alike."""

import math

import numpy as np
import pytest

from tsobs_ros.core.functions import evaluate

SYSTEM = {"sine": math.sin, "cosine": math.cos, "exponential": math.exp, "logarithm": math.log}


@pytest.mark.parametrize("function", SYSTEM)
def test_values_are_within_two_units_in_the_last_place(function: str) -> None:
    values = np.concatenate([np.geomspace(1e-320, 1e308, 5_000), np.linspace(0.7, 1.3, 5_001)])
    if function == "exponential":
        values = np.append(-np.geomspace(1e-17, 745.0, 5_000), 0.0)
    elif function != "logarithm":
        drawn = np.random.default_rng(3).uniform(-1.0, 1.0, (5, 3_000))
        angles = drawn * np.array([[1e-3], [0.7], [4.0], [1e3], [1e6]])
        values = np.append(angles, 0.5 * math.pi * np.arange(-60, 61))
    system = np.array([SYSTEM[function](x) for x in values.tolist()])
    error = np.abs(evaluate(function, values) - system)
    assert (error <= 2.0 * np.spacing(np.abs(system))).all()


def test_outside_of_their_range_they_are_zero_or_nan() -> None:
    assert evaluate("exponential", [-800.0, -math.inf]).tolist() == [0.0, 0.0]
    assert np.isnan(evaluate("exponential", math.nan))
    assert np.isnan(evaluate("logarithm", [0.0, -1.0, math.inf, math.nan])).all()
