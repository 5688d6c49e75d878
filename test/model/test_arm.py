# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The elastic-joint arm: its physics and its coordinates."""

import math
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm

Array = NDArray[np.float64]

INERTIAS = st.floats(0.1, 10.0)
DAMPINGS = st.one_of(st.just(0.0), st.floats(0.01, 5.0))
ARMS = st.builds(
    ElasticJointArm, INERTIAS, INERTIAS, st.floats(0.5, 50.0), st.floats(0.1, 50.0), DAMPINGS,
    DAMPINGS,
)  # fmt: skip
TORQUES = hnp.arrays(np.float64, 1, elements=st.floats(-10.0, 10.0))
STATES = hnp.arrays(np.float64, 4, elements=st.floats(-5.0, 5.0, allow_subnormal=False))


@settings(max_examples=20)
@given(ARMS, STATES, TORQUES)
def test_the_derivative_is_newtons_law_in_physical_coordinates(
    arm: ElasticJointArm, q: Array, u: Array
) -> None:
    rate = arm.to_physical(arm.derivative(arm.from_physical(q), u))
    q1, v1, q2, v2 = q
    twist = arm.stiffness * (q1 - q2)
    link = -(arm.link_damping * v1 + twist + arm.gravity_torque * math.sin(q1)) / arm.link_inertia
    motor = (u[0] + twist - arm.motor_damping * v2) / arm.motor_inertia
    np.testing.assert_allclose(rate, [v1, link, v2, motor], rtol=1e-11, atol=1e-10)


def test_parameters_out_of_range_are_named() -> None:
    for name in (each.name for each in fields(ElasticJointArm)):
        may_be_zero = name.endswith(("damping", "torque"))
        expected = "of at least 0" if may_be_zero else "above 0"
        for value in (-0.1, math.nan, math.inf, *([] if may_be_zero else [0.0])):
            with pytest.raises(ModelError, match=f"{name}: expected a finite number {expected}"):
                ElasticJointArm(**{name: value})


def test_what_is_measured_is_a_row_of_the_physical_state() -> None:
    arm = ElasticJointArm(link_inertia=2.0, stiffness=12.0)
    x = arm.from_physical([0.1, 0.2, 0.3, 0.4])
    outputs = ("motor_velocity", "link_angle", "motor_angle")
    np.testing.assert_allclose(arm.measured(outputs, (0.0, 0.0, 0.5)) @ x, [0.4, 0.1, 0.1])
    for names, delays, message in (
        (("elbow",), (), r"outputs\[0\]: expected one of link_angle"),
        (("link_angle",) * 2, (), r"outputs\[1\]: link_angle is listed already, as outputs\[0\]"),
        (("link_velocity",), (0.1,), r"outputs\[0\].delay: expected 0 for link_velocity"),
    ):
        with pytest.raises(ModelError, match=message):
            arm.measured(names, delays)
