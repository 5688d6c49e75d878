# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the shipped observer learns of simulated arms, and what it leaves alone."""

from dataclasses import replace

import numpy as np
import pytest

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.estimator import Readout
from tsobs_ros.estimation.records import Basis, Learning
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.plant import Mismatch, Plant, Scenario, Trajectories
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep, NoTorque

OBSERVER = load_design(config_path(SHIPPED_DESIGN)).supervised()
RATE, STD, RUNS = 200, 0.028, 6
STIFF = Scenario(mismatch=Mismatch(stiffness=0.2))
TRUTH = np.array([0.2, 0.0])


def learnt(runs: Trajectories) -> Readout:
    return OBSERVER.observe(runs.measurements, runs.torques)


def run(scenario: Scenario, seconds: int) -> Trajectories:
    return Plant(scenario, range(RUNS)).run(seconds * RATE)


@pytest.mark.parametrize(
    "scenario",
    [
        Scenario(),
        Scenario(sensor=Sensor(noise_std=2.0 * STD)),
        Scenario(sensor=Sensor(outlier_probability=0.1, outlier_is_uniform=True)),
        replace(STIFF, excitation=NoTorque(), initial_state=(0.0,) * 4, initial_spread=(0.0,) * 4),
    ],
    ids=["nominal", "louder", "outliers", "at rest"],
)
def test_nothing_is_learnt_without_evidence(scenario: Scenario) -> None:
    """Of an arm that is nominal, or that does not move: not even a little."""
    found = learnt(run(scenario, 30))
    assert not found.parameters.any()
    assert not (found.basis == Basis.CERTIFIED).any()  # the certificate does not cover θ


@pytest.mark.parametrize(
    "sensor",
    [
        Sensor(),
        Sensor(noise_std=2.0 * STD),
        Sensor(noise_degrees=3),
        Sensor(outlier_probability=0.05, outlier_size=3.0, outlier_is_uniform=True),
    ],
    ids=["designed", "louder", "heavy tails", "outliers"],
)
def test_a_stiffer_arm_is_learnt_whatever_the_noise(sensor: Sensor) -> None:
    runs = run(replace(STIFF, sensor=sensor), 30)
    found = learnt(runs)
    errors = np.abs(found.parameters - TRUTH)
    assert (errors[:, -1] < [0.02, 0.02]).all()
    inside = (errors <= 3.0 * found.parameter_bound).all(axis=2)
    assert inside[found.parameters_valid].mean() > 0.97
    assert found.parameters_valid[:, -1].all()
    # An outlier beyond reason is a missing sample.
    bases = [Basis.LEARNT, Basis.GAP] if sensor.outlier_probability else [Basis.LEARNT]
    assert np.isin(found.basis[:, 20 * RATE :], bases).mean() > 0.9
    outside = (np.abs(runs.physical - found.state) > 3.0 * found.state_bound).any(axis=2)
    assert outside[:, 25 * RATE :].mean() < 0.01


def test_what_was_learnt_stays_while_the_arm_is_held() -> None:
    torques = np.full((50 * RATE, 1), 2.0)
    torques[: 25 * RATE, 0] = np.sin(np.arange(25 * RATE) / RATE)
    found = learnt(Plant(STIFF, range(RUNS)).run(50 * RATE, torques))
    held = found.parameters[:, 28 * RATE :]
    assert np.abs(held - TRUTH).max() < 0.02
    assert np.abs(held - held[:, :1]).max() < 0.01


def test_a_jump_of_the_sensor_is_not_learnt() -> None:
    """Its first samples are, and taken back when it is found."""
    jump = 25 * RATE
    found = learnt(run(replace(STIFF, disturbance=(BiasStep(0.3, 25.0),)), 30))
    rests = found.learning[:, jump : jump + 20] == Learning.AFTER_JUMP
    assert rests.any(axis=1).all()
    for learning, theta in zip(rests, found.parameters, strict=True):
        first = jump + int(np.argmax(learning))
        np.testing.assert_allclose(theta[first], theta[jump - 4], atol=0.002)
    after = found.parameters[:, jump + 20 :] - found.parameters[:, jump - 1 : jump]
    assert np.abs(after).max() < 0.01
