# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tests of an arm with an encoder on either side and an unknown torque at the link."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tsobs_ros.checks import Array
from tsobs_ros.design.file import load_design
from tsobs_ros.design.request import ArmRequest, Output
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation.estimator import Rows
from tsobs_ros.estimation.records import USED, Basis, RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import make_tracker
from tsobs_ros.simulation.plant import Scenario, SimulatedOutput, TorqueDisturbance, Trajectories
from tsobs_ros.simulation.scenarios import simulate
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep, Pulses

DESIGN = load_design(Path(__file__).parent / "data" / "both_encoders.design.yaml")
LINK, MOTOR = 0, 1
NON_FINITE = RejectReason.NON_FINITE
PERIOD, CONTACT, FAULT, END = 5_000_000, 8.0, 14.0, 20.0


@cache
def run(bias: float = 0.1) -> Trajectories:
    """Return a run with a contact from 8 s on and a bias of the link's encoder from 14 s on."""
    outputs = (
        SimulatedOutput("link_angle", Sensor(noise_std=0.005), (BiasStep(bias, FAULT),)),
        SimulatedOutput("motor_angle", Sensor(noise_std=0.002)),
    )
    torques = TorqueDisturbance(link=(BiasStep(2.0, CONTACT),))
    scenario = Scenario(
        outputs=outputs, torque_disturbance=torques, initial_state=(0.2, 0.0, 2.0, 0.0)
    )
    return simulate(scenario, [0], END)


def stamps_of(count: int) -> "np.ndarray[tuple[int], np.dtype[np.int64]]":
    return 1_000_000_000 + PERIOD * np.arange(count)


def follow(y: Array) -> tuple[Tracker, Rows]:
    tracker = make_tracker(DESIGN)
    return tracker, tracker.follow(stamps_of(len(y)), y, run().torques[0])


def seconds(begin: float, end: float = END) -> slice:
    return slice(round(begin * 200), round(end * 200))


def test_a_contact_and_a_bias_are_told_apart_and_within_their_bounds() -> None:
    tracker, rows = follow(run().measurements[0])
    assert (tracker.events["sensor jumps"], tracker.events["losses of track"]) == (1, 0)
    for name, truth in (
        ("state", run().physical[0]),
        ("torque_disturbance", run().torque_disturbances[0][:, 1:]),
        ("disturbance", run().disturbances[0][:, :1]),
    ):
        found, bound = (each[:, : truth.shape[1]] for each in (rows[name], rows[f"{name}_bound"]))
        assert (np.abs(found - truth) <= 3.0 * bound)[seconds(6.0)].mean(axis=0).min() >= 0.97
    torque, bias = (rows[name][:, 0] for name in ("torque_disturbance", "disturbance"))
    before, pressed, both = seconds(6.0, CONTACT), seconds(10.0, FAULT), seconds(16.0)
    assert np.abs(torque[before]).mean() < 0.4
    assert torque[pressed].mean() == pytest.approx(2.0, abs=0.4)
    assert torque[both].mean() == pytest.approx(2.0, abs=0.4)
    assert np.abs(bias[pressed]).mean() < 0.015
    assert bias[both].mean() == pytest.approx(0.1, abs=0.015)
    assert rows.claimed[pressed].mean() > 0.8


@pytest.mark.parametrize("lost", [LINK, MOTOR])
def test_the_other_encoder_goes_on_with_a_wider_bound(lost: int) -> None:
    y = run(bias=0.0).measurements[0].copy()
    y[seconds(10.0, 16.0), lost] = np.nan
    tracker, rows = follow(y)
    away, back = seconds(11.0, 16.0), seconds(17.0)
    assert tracker.rejected == {}
    sensors = tracker.state["sensors"][0]
    assert (sensors["gated"][lost], sensors["missing"][lost]) == (0, 1200)
    assert sensors["missing"][1 - lost] == 0
    assert not np.isin(rows.basis[away], [Basis.CERTIFIED, Basis.LEARNT]).any()
    assert rows.claimed[away].mean() > 0.9
    assert rows.claimed[back].mean() > 0.9
    bounds = rows["state_bound"]
    side = 2 * lost
    assert (bounds[away, side] > 1.2 * np.median(bounds[seconds(7.0, 10.0), side])).all()
    error = np.abs(rows["state"] - run(bias=0.0).physical[0])
    assert ((error <= 3.0 * bounds)[away].mean(axis=0) >= 0.97).all()
    assert np.isfinite(rows.state[1:]).all()


def test_a_sample_without_any_output_is_not_finite() -> None:
    tracker = make_tracker(DESIGN)
    y = np.array([[np.nan, np.nan], [0.1, np.nan], [0.1, np.inf], [0.1, 0.1]])
    outcomes = tracker.offer_many(stamps_of(4), y, np.zeros((4, 1)), 10**10)
    assert outcomes.codes.tolist() == [NON_FINITE, USED, USED, USED]
    assert outcomes.output_codes.tolist() == [
        [NON_FINITE, NON_FINITE],
        [USED, NON_FINITE],
        [USED, NON_FINITE],
        [USED, USED],
    ]
    assert np.isnan(outcomes.innovations[1:3, MOTOR]).all()
    assert np.isfinite(outcomes.innovations[1:, LINK]).all()
    assert tracker.rejected == {RejectReason.NON_FINITE: 1}


@pytest.mark.parametrize(
    ("output", "spoil"), [(MOTOR, "outliers"), (LINK, "stuck"), (LINK, "far off")]
)
def test_what_is_wrong_with_one_output_is_no_reason_to_refuse_the_other(
    output: int, spoil: str
) -> None:
    y = run(bias=0.0).measurements[0].copy()
    own = y[seconds(10.0), output]
    if spoil == "outliers":
        own[::20] += np.where(np.arange(len(own[::20])) % 2, 3.0, -3.0)
    elif spoil == "stuck":
        own[:] = own[0]
    else:
        own += 1.0
    tracker, rows = follow(y)
    assert tracker.rejected == {}
    assert tracker.events["losses of track"] == 0
    gated = tracker.state["sensors"]["gated"][0]
    assert (gated[1 - output] == 0, gated[output] > 0) == (True, True)
    kept = seconds(13.0)
    error = np.abs(rows["state"] - run(bias=0.0).physical[0])
    assert ((error <= 3.0 * rows["state_bound"])[kept].mean(axis=0) >= 0.97).all()


def test_a_hit_shows_in_an_output_that_is_a_speed() -> None:
    names, push = ("link_velocity", "motor_angle"), Pulses(400.0, 5.0, 0.005, 0.0)  # 2 rad/s
    design = synthesise(ArmRequest(outputs=tuple(Output(name, 0.01) for name in names)))
    outputs = tuple(SimulatedOutput(name, Sensor(noise_std=0.01)) for name in names)
    scenario = Scenario(outputs=outputs, torque_disturbance=TorqueDisturbance(link=(push,)))
    hit, tracker = simulate(scenario, [1], 6.0), make_tracker(design)
    rows = tracker.follow(stamps_of(len(hit.times)), hit.measurements[0], hit.torques[0])
    apart = np.abs(rows.state - hit.physical[0]) / rows.state_bound
    assert tracker.events["hits"] == 1
    assert (apart[seconds(5.05)] < 3.0).mean() > 0.97


def test_a_sample_without_the_loud_output_leaves_the_bound_as_wide() -> None:
    one = make_tracker(DESIGN).estimator
    state, X = one.initial(), one.model["X"][0]
    designed = state["hypotheses"][0, 0]  # as it would be some seconds later
    designed["covariance"], designed["settling"], designed["certified"] = X, 0.0, 1
    state["age"], state["sensors"]["noise_scale"] = 50.0, [[3.0, 1.0]]
    after, _ = one.correct(state, [np.nan, 0.0])
    assert not after["hypotheses"]["certified"][0, 0]
    # The motor's angle hardly shows the link's velocity, whose bound was 3² X before.
    assert after["hypotheses"]["covariance"][0, 0, 1, 1] > 0.9 * 3.0**2 * X[1, 1]
    assert one.readout(after).noise_scale == 3.0
