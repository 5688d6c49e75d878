# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observers on a T–S system given by its matrices: Monte Carlo, adaptation, supervision."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tsobs_ros.design.file import load_request
from tsobs_ros.design.record import Design
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation.records import Basis, Hypothesis
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.plants import scenario_of
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.plant import Plant, SimulatedOutput, Trajectories
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep, Signal, Sine


@pytest.fixture(scope="module")
def pendulum() -> Design:
    """The shipped example: an encoder, a gyroscope with a bias, gravity uncertain by 20 %."""
    return synthesise(load_request(config_path("ts_example.request.yaml")))


def simulated(
    design: Design, runs: int, samples: int, *bias: Signal, theta: float = 0.0, **changes: object
) -> Trajectories:
    """Return swings with a bias of the gyroscope, and with gravity that differs by θ."""
    outputs = (
        SimulatedOutput("encoder", Sensor(0.01)),
        SimulatedOutput("gyroscope", Sensor(0.02), bias),
    )
    scenario = scenario_of(design.request, {"gravity": theta})
    made = replace(scenario, outputs=outputs, inputs=(Sine(2.0, 2.1),), **changes)  # type: ignore
    return Plant(made, range(runs)).run(samples)


def test_adaptation_finds_the_true_parameter(pendulum: Design) -> None:
    theta, observer = -0.15, pendulum.observer(1.0, adapt=True)
    runs = simulated(pendulum, 1, 2500, BiasStep(0.05, 0.0), theta=theta, initial_state=(0.5, 0.0))
    stamps = 10**9 + np.round(1e9 * runs.times).astype(np.int64)
    last = Tracker(observer).follow(stamps, runs.measurements[0], runs.torques[0])[-1]
    assert last.parameters_valid
    # Adapted, but the certificate was not asked to cover θ.
    assert last.basis != Basis.CERTIFIED
    assert last.parameters[0] == pytest.approx(theta, abs=0.01)
    assert abs(last.parameters[0] - theta) < 4.0 * last.parameter_bound[0]
    np.testing.assert_allclose(last.disturbance, [0.0, 0.05], atol=0.01)


@pytest.mark.parametrize("output", [0, 1])
@pytest.mark.parametrize("fault", ["jump", "missing"])
def test_what_happens_to_one_sensor_is_seen_and_survived(
    pendulum: Design, output: int, fault: str
) -> None:
    """There is no unknown torque, and only the gyroscope's disturbance is part of the design."""
    observer = make_estimator(pendulum, ObserverSettings())
    runs = simulated(pendulum, 1, 2000, BiasStep(0.05, 0.0), initial_state=(0.5, 0.0))
    truth, y, u = runs.states[0], runs.measurements[0].copy(), runs.torques[0]
    part = slice(1200, 1500) if fault == "missing" else slice(1200, None)
    y[part, output] += math.nan if fault == "missing" else 0.5
    state, inside, jumps = observer.initial(), [], 0
    for k in range(2000):
        state, _ = observer.correct(state, y[k])
        said = observer.readout(state)
        inside.append((np.abs(said.state - truth[k]) <= 3.0 * said.state_bound).all())
        jumps = max(jumps, int(state["jumps"][0]))
        state = observer.predict(state, u[k], 0.01)
    assert np.mean(inside[1200:]) > 0.95
    assert jumps == (fault == "jump") or (fault, output) == ("jump", 0)
    assert state["hits"][0] == 0
    if (fault, output) == ("jump", 1):
        assert said.disturbance[1] == pytest.approx(0.55, abs=0.02)
    elif fault == "jump":
        assert said.hypothesis != Hypothesis.AS_DESIGNED
    assert not state["hypotheses"]["live"][0, Hypothesis.FORCE]
