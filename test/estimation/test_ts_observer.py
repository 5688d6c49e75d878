# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observers on a T–S system given by its matrices: Monte Carlo, adaptation, supervision."""

import math
from dataclasses import replace

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.design.file import load_request
from tsobs_ros.design.record import Design
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation.records import Basis, Hypothesis, RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import ObserverSettings, make_tracker
from tsobs_ros.plants import scenario_of
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.plant import Plant, SimulatedOutput, Trajectories
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep, Ramp, Signal, Sine


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


def test_no_bound_is_claimed_in_a_gap_as_inputs_are_unknown(pendulum: Design) -> None:
    run = ts.simulate(pendulum, duration=20.0, torque=lambda t: 2.0 * math.sin(2.0 * t))
    torque, lost = run.torque.copy(), run.time % 10.0 > 7.0
    torque[lost] = math.nan
    got = ts.estimate(pendulum, run.time, run.angle, torque)
    wrong = (np.abs(got.state - run.state) > 3.0 * got.state_bound).any(axis=1)
    assert got.claimed[~lost].all()
    assert got.claimed[lost].mean() < 0.01
    assert not wrong[got.claimed].any()


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


def test_a_sample_teaches_the_less_the_more_innovations_are_alike(pendulum: Design) -> None:
    """In slow systems the averages are of few innovations, and their ratio may be any."""
    observer = pendulum.observer(1.0, adapt=True)
    run = simulated(pendulum, 1, 301, initial_state=(0.5, 0.0))
    tracker = Tracker(observer)
    stamps = 10**9 + np.round(1e9 * run.times[:300]).astype(np.int64)
    tracker.follow(stamps, run.measurements[0, :300], run.torques[0, :300])
    state = observer.predict(tracker.state, run.torques[0, 299], observer.period)
    learnt = []
    for colour in (0.0, 0.9, 1.3, 4.0):
        state["hypotheses"]["nis"], state["hypotheses"]["colour"] = 1.0, colour
        after, _ = observer.correct(state, run.measurements[0, 300])
        gammas = [each["hypotheses"]["gamma"][0, 0, 0, 0] for each in (state, after)]
        learnt.append(gammas[0] - gammas[1])
    assert learnt[0] > learnt[1] > learnt[2] == learnt[3] > 0.0


@pytest.mark.parametrize(
    ("fault", "outputs"),
    [("jump", [0]), ("jump", [1]), ("gap", [0]), ("gap", [1]), ("gap", [0, 1])],
)
def test_what_happens_to_sensors_is_seen_and_survived(
    pendulum: Design, fault: str, outputs: list[int]
) -> None:
    """Only the gyroscope's disturbance is part of the design; the input is known in gaps, too."""
    tracker = make_tracker(pendulum, ObserverSettings())
    runs = simulated(pendulum, 1, 2000, BiasStep(0.05, 0.0), initial_state=(0.5, 0.0))
    y, part = runs.measurements[0].copy(), slice(1200, 1500 if fault == "gap" else None)
    y[part, outputs] += math.nan if fault == "gap" else 0.5
    rows = tracker.follow(10**9 + 10_000_000 * np.arange(2000), y, runs.torques[0])
    inside = (np.abs(rows.state - runs.states[0]) <= 3.0 * rows.state_bound).all(axis=1)
    assert inside[1200:].mean() > 0.95
    jumps = fault == "jump"
    assert (tracker.events["sensor jumps"], tracker.events["hits"]) == (jumps, 0)
    assert rows.hypothesis[-1] != Hypothesis.FORCE
    assert (rows.hypothesis[-1] != Hypothesis.AS_DESIGNED) == (jumps and outputs == [0])
    expected = 0.55 if jumps and outputs == [1] else 0.05
    assert rows.disturbance[-1, 1] == pytest.approx(expected, abs=0.03)
    assert tracker.rejected[RejectReason.NON_FINITE] == (300 if len(outputs) == 2 else 0)


@pytest.mark.parametrize("time", [0.1, 0.2])
def test_coloured_noise_is_taken_for_what_it_is(pendulum: Design, time: float) -> None:
    count, left = 4000, math.exp(-0.01 / time)
    runs = simulated(pendulum, 1, count, initial_state=(0.5, 0.0))
    white = np.random.default_rng(3).standard_normal((count, 2)) * math.sqrt(1.0 - left * left)
    noise = np.zeros((count, 2))
    for k in range(1, count):
        noise[k] = left * noise[k - 1] + white[k]
    y, stamps = runs.states[0] + noise * [0.01, 0.02], 10**9 + 10_000_000 * np.arange(count)
    errors, late = [], slice(1000, None)
    for method in ("certified", "ekf"):
        tracker = make_tracker(pendulum, ObserverSettings(method=method))
        rows = tracker.follow(stamps, y, runs.torques[0])
        errors.append(np.sqrt(((rows.state - runs.states[0])[late] ** 2).mean(axis=0)))
        if method == "certified":
            taken = np.bincount(rows.hypothesis[late].astype(int), minlength=len(Hypothesis))
    assert taken.argmax() == Hypothesis.COLOURED_NOISE
    assert (errors[0] <= errors[1]).all()


@pytest.mark.parametrize(("offset", "gain"), [(1.0, 1.0), (0.0, 0.5), (-0.5, 1.2)])
def test_an_unknown_input_of_any_size_is_found(
    pendulum: Design, offset: float, gain: float
) -> None:
    """The true input is `gain` times the known one plus `offset`; the known one has amplitude 2."""
    runs = simulated(pendulum, 1, 4000, BiasStep(0.05, 0.0), initial_state=(0.5, 0.0))
    stamps, late, errors = 10**9 + 10_000_000 * np.arange(4000), slice(1000, None), []
    for method in ("ekf", "certified"):
        tracker = make_tracker(pendulum, ObserverSettings(method=method))
        known = (runs.torques[0] - offset) / gain
        rows = tracker.follow(stamps, runs.measurements[0], known)[late]
        errors.append(np.abs(rows.state - runs.states[0, late]))
    assert (rows.hypothesis == Hypothesis.FORCE).mean() > 0.9
    assert rows.claimed.all()
    assert (errors[1] <= 3.0 * rows.state_bound).all(axis=1).mean() > 0.97
    assert (errors[1].mean(axis=0) < 0.5 * errors[0].mean(axis=0)).all()


def test_bounds_cover_an_input_and_a_drift_that_act_alike(pendulum: Design) -> None:
    """The encoder drifts by a standard deviation per second; an input may explain that as well."""
    runs = simulated(pendulum, 3, 4000, BiasStep(0.05, 0.0))
    drift = Ramp(0.01, 10.0).values(runs.times)
    for y, u, states in zip(runs.measurements, runs.torques, runs.states, strict=True):
        y[:, 0] += drift
        tracker = make_tracker(pendulum, ObserverSettings())
        rows = tracker.follow(10**9 + 10_000_000 * np.arange(4000), y, u)
        assert (rows.hypothesis[2000:] == Hypothesis.FORCE).mean() > 0.5  # and not the drift
        inside = (np.abs(rows.state - states) <= 3.0 * rows.state_bound).all(axis=1)
        assert rows.claimed.mean() > 0.95
        assert inside[rows.claimed > 0.0].mean() > 0.95
