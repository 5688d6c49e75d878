# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated T–S systems: their motion, outputs, inputs and noise."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tsobs_ros.design.file import load_request
from tsobs_ros.errors import ModelError
from tsobs_ros.plants import scenario_of
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.plant import Plant, SystemScenario
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep, Constant, GaussMarkov, Sine


def pendulum(**theta: float) -> SystemScenario:
    scenario = scenario_of(load_request(config_path("ts_example.request.yaml")), theta)
    assert isinstance(scenario, SystemScenario)
    return scenario


def quiet(scenario: SystemScenario, **changes: Any) -> SystemScenario:
    outputs = tuple(replace(each, sensor=Sensor(0.0)) for each in scenario.outputs)
    return replace(scenario, outputs=outputs, process_noise=np.zeros(2), **changes)


def test_a_system_moves_as_its_equations_with_the_true_parameters_say() -> None:
    scenario = quiet(
        pendulum(gravity=0.15),
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
    np.testing.assert_allclose(run.measurements, run.physical, rtol=1e-12)
    assert run.states is run.physical
    assert run.torque_disturbances.shape == (150, 0)


def test_commands_move_the_inputs_and_outputs_have_sensors_of_their_own() -> None:
    scenario = pendulum()
    first = replace(scenario.outputs[0], disturbance=(BiasStep(0.5, 0.1), GaussMarkov(0.1, 1.0)))
    plant = Plant(replace(scenario, outputs=(first, scenario.outputs[1])), [3, 4])
    run = plant.run(1000, np.full((1000, 1), 0.25))
    assert (run.torques == 0.25).all()
    np.testing.assert_allclose(run.disturbances[:, :10, 0], 0.0, atol=0.1)
    assert run.disturbances[:, 10:, 0].mean() == pytest.approx(0.5, abs=0.3)
    assert not run.disturbances[..., 1].any()
    noise = run.measurements - run.physical - run.disturbances
    np.testing.assert_allclose(noise.std(axis=(0, 1)), [0.01, 0.02], rtol=0.05)
    # White noise on the rate's derivative of 1e-3 rad²/s³.
    still = replace(scenario, rate=1000.0, inputs=(Constant(0.0),))
    speeds = Plant(still, range(4000)).run(2).physical[:, 1, 1]
    assert speeds.std() == pytest.approx(np.sqrt(1e-3 * 1e-3), rel=0.05)


def test_what_fits_no_system_is_refused() -> None:
    with pytest.raises(ModelError, match=r"initial_state: expected shape \(2,\), got \(1,\)"):
        replace(pendulum(), initial_state=(1.0,))
    with pytest.raises(ModelError, match="mismatch: expected some of gravity, got 'mass'"):
        pendulum(mass=0.1)
