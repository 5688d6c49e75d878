# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The motion of arms against physics, against SciPy and against the textbook's formula."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.simulation.integrator import CREEP, Friction
from tsobs_ros.simulation.plant import Plant, Scenario

Vector = NDArray[np.float64]
ARM = ElasticJointArm()
DAMPED = ElasticJointArm(1.3, 1.7, 12.0, 9.0, 0.2, 0.1)
START = np.array([0.3, -0.2, 0.4, 0.5])


def moved(arm: ElasticJointArm, start: Any, torque: float, seconds: float, **more: Any) -> Vector:
    """Return the physical state of an arm some time later."""
    scenario = Scenario(
        arm=arm,
        initial_state=tuple(arm.from_physical(start).tolist()),
        initial_spread=(0.0,) * 4,
        process_noise=ProcessNoise(0.0, 0.0),
        **more,
    )
    run = Plant(scenario).run(round(seconds * scenario.rate) + 1, torque)
    return np.asarray(run.physical[-1])


def exact(rate: Callable[[float, Vector], Vector], end: float, method: str = "DOP853") -> Vector:
    found = solve_ivp(rate, (0.0, end), START, method=method, rtol=1e-12, atol=1e-12)
    return np.asarray(found.y[:, -1])


def nominal(arm: ElasticJointArm, x: Vector) -> Vector:
    return arm.to_physical(arm.derivative(arm.from_physical(x), [0.7]))


def energy(x: Vector) -> float:
    """Return kinetic + spring + gravity energy of the default arm [J]."""
    q1, v1, q2, v2 = x.tolist()
    kinetic = 0.5 * (ARM.link_inertia * v1**2 + ARM.motor_inertia * v2**2)
    spring = 0.5 * ARM.stiffness * (q1 - q2) ** 2
    return float(kinetic + spring + ARM.gravity_torque * 2.0 * np.sin(0.5 * q1) ** 2)


@pytest.mark.parametrize("angle", [0.3, 3.0])
def test_energy_of_the_undriven_arm_stays_over_a_minute(angle: float) -> None:
    start = np.array([angle, 0.0, 0.0, 0.0])
    assert abs(energy(moved(ARM, start, 0.0, 60.0)) / energy(start) - 1.0) < 1e-6


@pytest.mark.parametrize("rate", [200.0, 300.0])
def test_agrees_with_a_solver_of_order_eight(rate: float) -> None:
    expected = exact(lambda _, x: nominal(DAMPED, x), 5.0)
    ours = moved(DAMPED, START, 0.7, 5.0, rate=rate)
    np.testing.assert_allclose(ours, expected, rtol=0.0, atol=1e-9)


def test_friction_agrees_with_its_formula() -> None:
    def rate(_: float, x: Vector) -> Vector:
        rest = nominal(ARM, x)
        link, motor = np.clip(x[[1, 3]] / CREEP, -1.0, 1.0)
        rest[1] -= (0.2 * x[1] + 0.1 * link) / ARM.link_inertia
        rest[3] -= (0.3 * x[3] + 0.15 * motor) / ARM.motor_inertia
        return rest

    ours = moved(ARM, START, 0.7, 5.0, friction=Friction(0.2, 0.1, 0.3, 0.15))
    np.testing.assert_allclose(ours, exact(rate, 5.0, "LSODA"), rtol=0.0, atol=1e-6)
