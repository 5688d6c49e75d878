# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The elastic-joint arm: its physics, its coordinates, and the T–S form that equals it."""

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
from tsobs_ros.paper.systems import arm_system

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=80)

INERTIAS = st.floats(0.1, 10.0)
DAMPINGS = st.one_of(st.just(0.0), st.floats(0.01, 5.0))
ARMS = st.builds(
    ElasticJointArm, INERTIAS, INERTIAS, st.floats(0.5, 50.0), st.floats(0.1, 50.0), DAMPINGS,
    DAMPINGS,
)  # fmt: skip
TORQUES = hnp.arrays(np.float64, 1, elements=st.floats(-10.0, 10.0))


def states(bound: float = 5.0) -> st.SearchStrategy[Array]:
    return hnp.arrays(np.float64, 4, elements=st.floats(-bound, bound, allow_subnormal=False))


def test_the_matrices_of_example_3_are_the_papers() -> None:
    """Equation (47) with the signs restored: both rules, input and output, to the last bit."""
    system = arm_system(ElasticJointArm())
    for A, corner in zip(system.A, (-20.0, -20.0 / math.pi - 10.0), strict=True):
        expected = [[0, 1, 0, 0], [corner, 0, 1, 0], [0, 0, 0, 1], [50, 0, -5, 0]]
        np.testing.assert_allclose(A, expected, rtol=1e-15, atol=0.0)
    assert (system.B == [[0.0], [0.0], [0.0], [5.0]]).all()
    assert (system.C == [[1.0, 0.0, 0.0, 0.0]]).all()


@pytest.mark.parametrize(
    ("slope", "frequencies"), [(1.0, (1.4806, 4.7757)), (2.0 / math.pi, (1.2694, 4.4446))]
)
def test_the_undamped_arm_oscillates_at_the_known_frequencies(
    slope: float, frequencies: tuple[float, float]
) -> None:
    eigenvalues = np.linalg.eigvals(ElasticJointArm().slope_matrix(slope))
    assert np.abs(eigenvalues.real).max() < 1e-13
    upper = np.sort(eigenvalues.imag)[2:]
    assert upper == pytest.approx(frequencies, abs=5e-5)


def test_the_membership_is_equation_49() -> None:
    rule_base = arm_system(ElasticJointArm()).rule_base
    angle = np.concatenate([-np.linspace(1e-3, np.pi / 2, 50), np.linspace(1e-3, np.pi / 2, 50)])
    near = (np.sin(angle) - 2.0 / np.pi * angle) / ((1.0 - 2.0 / np.pi) * angle)
    weights = rule_base.weights(angle[:, np.newaxis])
    np.testing.assert_allclose(weights, np.stack([near, 1.0 - near], axis=-1), atol=1e-9)
    assert (rule_base.weights([0.0]) == [1.0, 0.0]).all()
    np.testing.assert_allclose(rule_base.weights([np.pi / 2]), [0.0, 1.0], atol=1e-15)


@PROPERTY
@given(ARMS, st.floats(0.01, math.pi - 0.01), st.floats(-1.0, 1.0), states(), TORQUES)
def test_the_ts_form_is_the_nonlinear_arm_on_its_whole_domain(
    arm: ElasticJointArm, x_max: float, place: float, x: Array, u: Array
) -> None:
    x[0] = place * x_max
    system = arm_system(arm, x_max)
    terms = np.abs(arm.spring_matrix) + np.abs(arm.slope_matrix(1.0) - arm.spring_matrix)
    scale = 1.0 + terms @ np.abs(x) + np.abs(arm.input_matrix @ u)
    error = system.derivative(x, u) - arm.derivative(x, u)
    # The membership divides rounding by 1 − sin(x_max)/x_max, and the blend multiplies it back.
    assert (np.abs(error) <= 1e-14 * scale).all()
    assert (system.output(x) == x[:1]).all()


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


@PROPERTY
@given(ARMS, states())
def test_coordinates_go_there_and_back(arm: ElasticJointArm, x: Array) -> None:
    np.testing.assert_allclose(arm.from_physical(arm.to_physical(x)), x, rtol=1e-15, atol=0.0)
    np.testing.assert_allclose(arm.to_physical(arm.from_physical(x)), x, rtol=1e-15, atol=0.0)


def test_design_coordinates_scale_the_motor_by_stiffness_over_link_inertia() -> None:
    arm = ElasticJointArm(link_inertia=2.0, stiffness=12.0)
    np.testing.assert_allclose(arm.from_physical([0.1, 0.2, 0.3, 0.4]), [0.1, 0.2, 1.8, 2.4])


@PROPERTY
@given(ARMS, states(), TORQUES)
def test_energy_changes_by_the_power_of_torque_and_damping_alone(
    arm: ElasticJointArm, x: Array, u: Array
) -> None:
    rate = arm.derivative(x, u)
    _, v1, _, v2 = arm.to_physical(x)
    power = u[0] * v2 - arm.link_damping * v1**2 - arm.motor_damping * v2**2
    # The derivative of E along ẋ, by a difference of fourth order; its rounding is eps·E/step.
    step = 1e-3 / (1.0 + float(np.abs(arm.to_physical(rate)).max()))
    ahead, behind, far, back = (arm.energy(x + k * step * rate) for k in (1, -1, 2, -2))
    numeric = (8.0 * (ahead - behind) - (far - back)) / (12.0 * step)
    assert numeric == pytest.approx(power, abs=1e-11 * (1.0 + float(ahead)) / step)


def test_energy_is_zero_at_rest_and_twice_the_gravity_torque_upright() -> None:
    arm = ElasticJointArm(gravity_torque=7.0)
    assert arm.energy(np.zeros(4)) == 0.0
    assert arm.energy(arm.from_physical([math.pi, 0.0, math.pi, 0.0])) == pytest.approx(14.0)


@PROPERTY
@given(ARMS, hnp.arrays(np.float64, (2, 3, 4), elements=st.floats(-5.0, 5.0)))
def test_a_batch_of_states_is_its_members_side_by_side(arm: ElasticJointArm, x: Array) -> None:
    # To rounding: the matrix product of a batch adds in another order than that of a vector.
    u = x[..., :1] - 1.0
    members = [[arm.derivative(x[i, j], u[i, j]) for j in range(3)] for i in range(2)]
    np.testing.assert_allclose(arm.derivative(x, u), members, rtol=1e-12, atol=1e-9)
    assert arm.energy(x).shape == (2, 3)


@pytest.mark.parametrize("name", ["link_inertia", "motor_inertia", "stiffness", "gravity_torque"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_parameters_that_must_be_positive_are_named(name: str, value: float) -> None:
    with pytest.raises(ModelError, match=f"{name}: expected a finite number above 0"):
        ElasticJointArm(**{name: value})


@pytest.mark.parametrize("name", ["link_damping", "motor_damping"])
@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_dampings_may_be_zero_but_not_negative(name: str, value: float) -> None:
    assert getattr(ElasticJointArm(**{name: 0.0}), name) == 0.0
    with pytest.raises(ModelError, match=f"{name}: expected a finite number of at least 0"):
        ElasticJointArm(**{name: value})


@pytest.mark.parametrize("x_max", [0.0, -1.0, math.pi, 4.0, math.nan])
def test_the_domain_of_the_ts_form_is_an_open_half_turn(x_max: Any) -> None:
    with pytest.raises(ModelError, match="x_max: expected 0 < x_max < π"):
        arm_system(ElasticJointArm(), x_max)
