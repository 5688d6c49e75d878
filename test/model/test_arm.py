# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The elastic-joint arm: its physics and its coordinates."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=40)

INERTIAS = st.floats(0.1, 10.0)
DAMPINGS = st.one_of(st.just(0.0), st.floats(0.01, 5.0))
ARMS = st.builds(
    ElasticJointArm, INERTIAS, INERTIAS, st.floats(0.5, 50.0), st.floats(0.1, 50.0), DAMPINGS,
    DAMPINGS,
)  # fmt: skip
TORQUES = hnp.arrays(np.float64, 1, elements=st.floats(-10.0, 10.0))


def states(bound: float = 5.0) -> st.SearchStrategy[Array]:
    return hnp.arrays(np.float64, 4, elements=st.floats(-bound, bound, allow_subnormal=False))


@PROPERTY
@given(ARMS, states(), TORQUES)
def test_the_derivative_is_newtons_law_in_physical_coordinates(
    arm: ElasticJointArm, q: Array, u: Array
) -> None:
    rate = arm.to_physical(arm.derivative(arm.from_physical(q), u))
    q1, v1, q2, v2 = q
    twist = arm.stiffness * (q1 - q2)
    link = -(arm.link_damping * v1 + twist + arm.gravity_torque * math.sin(q1)) / arm.link_inertia
    motor = (u[0] + twist - arm.motor_damping * v2) / arm.motor_inertia
    np.testing.assert_allclose(rate, [v1, link, v2, motor], rtol=1e-11, atol=1e-10)


def test_coordinates_of_a_known_arm() -> None:
    arm = ElasticJointArm(link_inertia=2.0, stiffness=12.0, gravity_torque=7.0)
    np.testing.assert_allclose(arm.from_physical([0.1, 0.2, 0.3, 0.4]), [0.1, 0.2, 1.8, 2.4])


POSITIVE = ["link_inertia", "motor_inertia", "stiffness"]
NOT_NEGATIVE = ["gravity_torque", "link_damping", "motor_damping"]


@pytest.mark.parametrize("value", [0.0, -0.1, math.nan, math.inf])
@pytest.mark.parametrize("name", [*POSITIVE, *NOT_NEGATIVE])
def test_parameters_out_of_range_are_named(name: str, value: float) -> None:
    if name in NOT_NEGATIVE and value == 0.0:
        assert getattr(ElasticJointArm(**{name: value}), name) == 0.0
        return
    expected = "above 0" if name in POSITIVE else "of at least 0"
    with pytest.raises(ModelError, match=f"{name}: expected a finite number {expected}"):
        ElasticJointArm(**{name: value})
