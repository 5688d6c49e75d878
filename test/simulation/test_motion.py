# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The motion of arms and T–S systems against physics and SciPy, and its delays."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tsobs_ros.design.file import load_request
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm, TorquePath
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.plants import scenario_of
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.plant import Friction, Plant, Scenario, SystemScenario
from tsobs_ros.simulation.sensor import Sensor, SimulatedOutput
from tsobs_ros.simulation.signals import BiasStep, Constant, Sine

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


@pytest.mark.parametrize("rate", [200.0, 300.0])
def test_agrees_with_a_solver_of_order_eight(rate: float) -> None:
    expected = exact(lambda _, x: nominal(DAMPED, x), 5.0)
    ours = moved(DAMPED, START, 0.7, 5.0, rate=rate)
    np.testing.assert_allclose(ours, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    "arm",
    [ElasticJointArm(0.01, 0.001, 10.0, 0.0, 0.0, 3.0), ElasticJointArm(0.02, 2e-4, 200.0, 1.0)],
    ids=["damped", "stiff"],
)
def test_fast_modes_neither_diverge_nor_lose_their_energy(arm: ElasticJointArm) -> None:
    expected = exact(lambda _, x: nominal(arm, x), 0.2, "LSODA")
    np.testing.assert_allclose(moved(arm, START, 0.7, 0.2), expected, rtol=0.03, atol=0.01)


def test_friction_agrees_with_its_formula() -> None:
    def rate(_: float, x: Vector) -> Vector:
        rest = nominal(ARM, x)
        link, motor = np.clip(x[[1, 3]] / 0.01, -1.0, 1.0)
        rest[1] -= (0.2 * x[1] + 0.1 * link) / ARM.link_inertia
        rest[3] -= (0.3 * x[3] + 0.15 * motor) / ARM.motor_inertia
        return rest

    ours = moved(ARM, START, 0.7, 5.0, friction=Friction(0.2, 0.1, 0.3, 0.15))
    np.testing.assert_allclose(ours, exact(rate, 5.0, "LSODA"), rtol=0.0, atol=1e-6)


PERIOD = 0.005
QUIET = Scenario(
    initial_state=(0.3, 0.4, 2.0, -1.0),
    initial_spread=(0.0,) * 4,
    process_noise=ProcessNoise(0.0, 0.0),
    outputs=(SimulatedOutput(sensor=Sensor(noise_std=0.0)),),
)
COMMANDS = np.random.default_rng(0).normal(0.0, 3.0, (2, 120, 1))


def later(commands: Vector, periods: int) -> Vector:
    first = np.repeat(commands[:, :1], periods, axis=1)
    return np.concatenate([first, commands], axis=1)[:, : commands.shape[1]]


@pytest.mark.parametrize("periods", [0.3, 1.0, 20.0])
def test_a_command_reaches_the_motor_by_the_mean_over_a_period(periods: float) -> None:
    torque = TorquePath(0.7, 0.4, periods * PERIOD)
    moved = Plant(replace(QUIET, torque=torque), [1, 2]).run(120, COMMANDS)
    share = periods % 1.0
    before, after = (later(COMMANDS, int(periods) + more) for more in (0, 1))
    applied = 0.7 * ((1.0 - share) * before + share * after) + 0.4
    plain = Plant(QUIET, [1, 2]).run(120, applied)
    np.testing.assert_allclose(moved.physical, plain.physical, rtol=0.0, atol=1e-12)
    # The command is what is logged, and nothing else moves the arm.
    np.testing.assert_array_equal(moved.torques, COMMANDS)
    assert not moved.torque_disturbances.any()


def test_an_error_of_the_report_is_worth_what_would_reach_the_motor() -> None:
    torque = TorquePath(0.5, 0.4, 2.0 * PERIOD)
    scenario = replace(QUIET, torque=torque, torque_error=(BiasStep(0.2, 0.1),))
    run = Plant(scenario).run(40)
    np.testing.assert_allclose(run.torque_disturbances[:22, 0], 0.0, atol=1e-15)
    np.testing.assert_allclose(run.torque_disturbances[22:, 0], -0.1, atol=1e-15)


def fine(delay: float, samples: int, scenario: Scenario) -> Vector:
    """Return angles that were `delay` earlier, of samples of 5 ms, from steps of 1 ms."""
    run = Plant(replace(scenario, rate=1000.0)).run(5 * samples, 1.0)
    places = np.round(1000.0 * (PERIOD * np.arange(samples) - delay)).astype(int)
    return np.asarray(run.physical[np.maximum(places, 0)][:, [0, 2]])


@pytest.mark.parametrize("delay", [0.002, 0.013])
def test_an_angle_is_measured_as_it_was(delay: float) -> None:
    outputs = (
        SimulatedOutput("link_angle", Sensor(noise_std=0.0), (BiasStep(0.1, 0.0),), delay),
        SimulatedOutput("motor_angle", Sensor(noise_std=0.0), delay=delay),
        SimulatedOutput("link_velocity", Sensor(noise_std=0.0)),
    )
    scenario = replace(QUIET, outputs=outputs)
    run = Plant(scenario).run(200, 1.0)
    first = round(delay / PERIOD) + 1
    seen = run.measurements - run.disturbances
    np.testing.assert_allclose(
        seen[first:, :2], fine(delay, 200, scenario)[first:], rtol=0.0, atol=1e-8
    )
    np.testing.assert_array_equal(seen[:, 2], run.physical[:, 1])
    # Before the first sample it moved as at the first.
    start = run.physical[0]
    np.testing.assert_allclose(seen[0, :2], start[[0, 2]] - delay * start[[1, 3]], atol=1e-12)


def pendulum(**theta: float) -> SystemScenario:
    scenario = scenario_of(load_request(config_path("ts_example.request.yaml")), theta)
    assert isinstance(scenario, SystemScenario)
    return scenario


def test_a_system_moves_as_its_equations_with_the_true_parameters_say() -> None:
    scenario = replace(
        pendulum(gravity=0.15),
        process_noise=np.zeros(2),
        initial_state=(0.9, 0.0),
        inputs=(Sine(0.4, 2.0),),
    )
    run = Plant(scenario).run(150)

    def moves(_: float, x: Any, u: float) -> list[float]:
        # The rules blend to sin x₁ on their domain; so do the directions of the change.
        return [x[1], -9.81 * 1.15 * np.sin(x[0]) - 0.2 * x[1] + u]

    x = np.array([0.9, 0.0])
    for k in range(150):
        assert run.physical[k] == pytest.approx(x, abs=1e-6)
        u = run.torques[k, 0]
        assert u == pytest.approx(0.4 * np.sin(2.0 * k / 100.0), abs=1e-12)
        x = solve_ivp(moves, (0.0, 0.01), x, args=(u,), rtol=1e-10, atol=1e-12).y[:, -1]
    assert run.torque_disturbances.shape == (150, 0)


def test_a_system_is_commanded_and_has_the_stated_noise() -> None:
    run = Plant(pendulum(), [3, 4]).run(1000, np.full((1000, 1), 0.25))
    assert (run.torques == 0.25).all()
    noise = run.measurements - run.physical
    np.testing.assert_allclose(noise.std(axis=(0, 1)), [0.01, 0.02], rtol=0.05)
    # White noise on the rate's derivative of 1e-3 rad²/s³.
    still = replace(pendulum(), rate=1000.0, inputs=(Constant(0.0),))
    speeds = Plant(still, range(4000)).run(2).physical[:, 1, 1]
    assert speeds.std() == pytest.approx(np.sqrt(1e-3 * 1e-3), rel=0.05)


def test_what_fits_no_system_is_refused() -> None:
    with pytest.raises(ModelError, match=r"simulation: expected .* modes up to 1e\+06 1/s, got 3e"):
        moved(ElasticJointArm(motor_inertia=1e-6, motor_damping=3e2), START, 0.0, 0.1)
    with pytest.raises(ModelError, match=r"initial_state: expected shape \(2,\), got \(1,\)"):
        replace(pendulum(), initial_state=(1.0,))
    with pytest.raises(ModelError, match="mismatch: expected some of gravity, got 'mass'"):
        pendulum(mass=0.1)
