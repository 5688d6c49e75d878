# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The integrator against physics, against SciPy and against the textbook's formula."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.simulation.integrator import CREEP, ArmIntegrator, Friction

ARM = ElasticJointArm()
DAMPED = ElasticJointArm(1.3, 1.7, 12.0, 9.0, 0.2, 0.1)
START = np.array([0.3, -0.2, 0.4, 0.5])


def advance_for(
    integrator: ArmIntegrator, state: NDArray[np.float64], torque: float, periods: int
) -> NDArray[np.float64]:
    held = np.full((*state.shape[:-1], 1), torque)
    for _ in range(periods):
        state = integrator.advance(state, held)
    return state


def exact(
    arm: ElasticJointArm, physical: NDArray[np.float64], torque: float, end: float
) -> NDArray[np.float64]:
    solution = solve_ivp(
        lambda _, x: arm.derivative(x, [torque]),
        (0.0, end),
        arm.from_physical(physical),
        method="DOP853",
        rtol=1e-13,
        atol=1e-13,
    )
    return arm.to_physical(solution.y[:, -1])


@pytest.mark.parametrize("angle", [0.3, 1.5, 3.0])
def test_energy_of_the_undriven_arm_stays_over_a_minute(angle: float) -> None:
    integrator = ArmIntegrator(ARM, 0.005)
    start = np.array([angle, 0.0, 0.0, 0.0])
    before = ARM.energy(ARM.from_physical(start))
    after = ARM.energy(ARM.from_physical(advance_for(integrator, start, 0.0, 12_000)))
    assert abs(after / before - 1.0) < 1e-6


@pytest.mark.parametrize("arm", [ARM, DAMPED])
def test_agrees_with_a_solver_of_order_eight(arm: ElasticJointArm) -> None:
    ours = advance_for(ArmIntegrator(arm, 0.005), START, 0.7, 1000)
    np.testing.assert_allclose(ours, exact(arm, START, 0.7, 5.0), rtol=0.0, atol=1e-9)


def test_friction_agrees_with_its_formula() -> None:
    friction = Friction(0.2, 0.1, 0.3, 0.15)

    def slope(_: float, x: NDArray[np.float64]) -> NDArray[np.float64]:
        rest = ARM.to_physical(ARM.derivative(ARM.from_physical(x), [0.7]))
        link, motor = np.clip(x[[1, 3]] / CREEP, -1.0, 1.0)
        rest[1] -= (0.2 * x[1] + 0.1 * link) / ARM.link_inertia
        rest[3] -= (0.3 * x[3] + 0.15 * motor) / ARM.motor_inertia
        return rest

    solution = solve_ivp(slope, (0.0, 5.0), START, method="LSODA", rtol=1e-10, atol=1e-10)
    ours = advance_for(ArmIntegrator(ARM, 0.005, friction), START, 0.7, 1000)
    np.testing.assert_allclose(ours, solution.y[:, -1], rtol=0.0, atol=1e-6)


def test_error_falls_with_the_fourth_power_of_the_step() -> None:
    truth = exact(DAMPED, START, 0.7, 2.0)
    errors = [
        np.abs(
            advance_for(ArmIntegrator(DAMPED, 0.1, longest_substep=step), START, 0.7, 20) - truth
        ).max()
        for step in (0.1, 0.05, 0.025, 0.0125)
    ]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, 4.0, atol=0.35)


@pytest.mark.parametrize("arm", [ARM, DAMPED])
def test_equals_the_textbooks_step_on_the_model_in_design_coordinates(arm: ElasticJointArm) -> None:
    integrator = ArmIntegrator(arm, 0.005)
    x, h = arm.from_physical(START), 1e-3
    for _ in range(5):
        a = arm.derivative(x, [0.7])
        b = arm.derivative(x + 0.5 * h * a, [0.7])
        c = arm.derivative(x + 0.5 * h * b, [0.7])
        x = x + h / 6.0 * (a + 2.0 * (b + c) + arm.derivative(x + h * c, [0.7]))
    ours = integrator.advance(START, [0.7])
    np.testing.assert_allclose(ours, arm.to_physical(x), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("turns", [0, 300_000])  # which is beyond 10⁶ rad
def test_a_batch_moves_as_its_single_arms_and_as_those_many_turns_back(turns: int) -> None:
    random = np.random.default_rng(5)
    states, torques = random.normal(size=(7, 4)), random.normal(size=(7, 1))
    integrator = ArmIntegrator(DAMPED, 0.005)
    turned = states.copy()
    turned[::2, ::2] += turns * math.tau
    kicks = random.normal(size=(7, 5, 2))
    batch = integrator.advance(turned, torques, kicks)
    single = [integrator.advance(*run) for run in zip(turned, torques, kicks, strict=True)]
    assert batch.tolist() == np.array(single).tolist()
    back = batch - (turned - states)
    np.testing.assert_allclose(back, integrator.advance(states, torques, kicks), atol=1e-8)


def test_kicks_act_on_the_velocities_after_their_step() -> None:
    integrator = ArmIntegrator(ARM, 0.002)
    one_step = ArmIntegrator(ARM, 0.001)
    first = one_step.advance(START, [0.0]) + np.array([0.0, 0.1, 0.0, 0.2])
    second = one_step.advance(first, [0.0]) + np.array([0.0, 0.3, 0.0, 0.4])
    kicked = integrator.advance(START, [0.0], [[0.1, 0.2], [0.3, 0.4]])
    np.testing.assert_allclose(kicked, second, rtol=1e-15)


@pytest.mark.parametrize(
    ("period", "substeps"), [(0.005, 5), (0.001, 1), (0.0005, 1), (1 / 300, 4), (0.01, 10)]
)
def test_steps_are_equal_and_at_most_one_millisecond(period: float, substeps: int) -> None:
    integrator = ArmIntegrator(ARM, period)
    assert integrator.substeps == substeps
    assert integrator.substep == period / substeps


def test_wrong_shapes_are_named() -> None:
    integrator = ArmIntegrator(ARM, 0.005)
    with pytest.raises(ModelError, match=r"state: expected shape \(4,\)"):
        integrator.advance(np.zeros(3), [0.0])
    with pytest.raises(ModelError, match=r"kicks: expected shape \(5, 2\), got \(2, 2\)"):
        integrator.advance(np.zeros(4), [0.0], np.zeros((2, 2)))
    with pytest.raises(ModelError, match="period"):
        ArmIntegrator(ARM, 0.0)
