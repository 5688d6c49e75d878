# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Late torques and sensors: observers take what arrives at the motor, and when it does."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output
from tsobs_ros.estimation.records import USED, Measurement, RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import METHODS
from tsobs_ros.model.arm import TorquePath

DESIGN = ts.load_design()
BOTH = ts.load_design(Path(__file__).parent / "data" / "both_encoders.design.yaml")
PERIOD = DESIGN.request.period
NANOSECONDS = round(1e9 * PERIOD)
BEGIN = 10**9
RUN = ts.simulate(DESIGN, duration=3.0, seed=4)
# It changes at every sample, so that each of them counts.
TORQUE = RUN.torque + np.random.default_rng(5).normal(0.0, 0.5, len(RUN.torque))


def design_with(torque: TorquePath, design: Design = DESIGN) -> Design:
    return replace(design, request=replace(design.arm_request, torque=torque))


def estimates(torque: TorquePath, u: Array, method: str) -> ts.Estimates:
    """Return estimates of the run with other torques."""
    settings = ts.ObserverSettings(method=method)
    return ts.estimate(design_with(torque), RUN.time, RUN.angle, u, settings=settings)


def shifted(u: Array, periods: int) -> Array:
    """Return torques as late by a number of periods, the first of them for ever before."""
    return np.concatenate([np.full(periods, u[0]), u])[: len(u)]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("share", [0.0, 0.25])
def test_gain_offset_and_delay_are_those_of_the_torques_themselves(
    method: str, share: float
) -> None:
    """Of a part of a period, the step of the torque is within it: its mean counts."""
    late, early = shifted(TORQUE, 2), shifted(TORQUE, 1)
    one = estimates(TorquePath(0.8, 0.3, (2.0 - share) * PERIOD), TORQUE, method)
    other = estimates(TorquePath(), 0.8 * ((1.0 - share) * late + share * early) + 0.3, method)
    for name in ("state", "state_bound"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-9, atol=1e-9)


def test_while_estimates_are_read_torques_go_on_arriving() -> None:
    """Between samples, and long after the last one; a reading changes nothing."""
    delay, u = 3.0 * PERIOD, np.array([2.0])
    design = design_with(TorquePath(delay=delay))
    tracker, plain = ts.make_tracker(design), ts.make_tracker(DESIGN)
    for index in range(10):
        for each in (tracker, plain):
            torque = u if index == 9 else np.zeros(1)
            each.offer(Measurement(BEGIN + index * NANOSECONDS, np.zeros(1), torque), 10**18)
    last = BEGIN + 9 * NANOSECONDS

    def speed(of: Tracker, after: float) -> float:
        estimate = of.estimate(last + round(1e9 * after))
        assert estimate is not None
        return float(estimate.state[3])

    for after in (0.4, 1.0, 2.0, 2.9):
        assert abs(speed(tracker, after * PERIOD)) < 1e-9
    for after in (0.5, 1.0, 8.3):
        assert speed(tracker, delay + after * PERIOD) == pytest.approx(
            speed(plain, after * PERIOD), rel=2e-3
        )
    assert speed(tracker, 0.4 * PERIOD) < 1e-9


def test_the_first_torque_was_always_there_and_after_a_restart_too() -> None:
    tracker = ts.make_tracker(design_with(TorquePath(delay=5.0 * PERIOD)))
    for stamp, u in ((BEGIN, 3.0), (BEGIN + 10**11, -2.0)):  # a gap that is too long
        tracker.offer(Measurement(stamp, np.zeros(1), np.array([u])), 10**18)
        assert tracker.state["held"][0].tolist() == [u]
    assert tracker.restarts == 1


def test_limits_are_those_of_the_torque_in_messages() -> None:
    """An offset or a delay of what reaches the motor makes no torque implausible, nor plausible."""
    torque = TorquePath(0.1, 40.0, 4.0 * PERIOD)
    request = replace(DESIGN.arm_request, torque=torque, torque_limit=5.0, torque_rate_limit=100.0)
    tracker = ts.make_tracker(replace(DESIGN, request=request))
    reasons = []
    for index, u in enumerate([0.0, 0.4, 0.8, 4.9, 1.2, 1.6, -5.1]):
        stamp = BEGIN + index * NANOSECONDS
        outcome = tracker.offer(Measurement(stamp, np.zeros(1), np.array([u])), 10**18)
        reasons.append(int(outcome.codes[0]))
    wrong = RejectReason.IMPLAUSIBLE_TORQUE
    assert reasons == [USED, USED, USED, wrong, USED, USED, wrong]


@cache
def sensors_with(delay: float) -> Design:
    """Return a design with an encoder on each side, both late."""
    pytest.importorskip("cvxpy")
    bias = (DisturbanceTerm("bias", {"density": 1e-6}),)
    outputs = (Output("motor_angle", 0.001, delay=delay), Output("link_angle", 0.005, bias, delay))
    return ts.synthesise(ArmRequest(outputs=outputs, uncertainty={}))


@pytest.mark.parametrize("late", ["torque", "torque of two encoders", "sensors"])
def test_an_observer_with_the_path_is_as_accurate_as_one_without_need_of_it(late: str) -> None:
    """And one that lacks it is several times worse; so it is with sensors that are late."""
    if late == "sensors":
        design, true = sensors_with(0.0), sensors_with(PERIOD)
    else:
        design = DESIGN if late == "torque" else BOTH
        offset = 0.05 * design.arm_request.arm.reference_torque
        true = design_with(TorquePath(0.9, offset, 1.5 * PERIOD), design)

    def error(plant: Design, observer: Design) -> Array:
        found = []
        for seed in range(3):
            run = ts.simulate(plant, duration=16.0, seed=seed)
            said = ts.estimate(observer, run.time, run.angle, run.torque)
            found.append((said.state - run.state)[run.time > 8.0])
        return np.sqrt((np.array(found) ** 2).mean(axis=(0, 1)))

    plain = error(design, design)
    assert np.exp(np.log(error(true, true) / plain).mean()) < 1.05
    assert (error(true, design) / plain).max() > 5.0


def test_of_a_late_sensor_the_velocity_is_part_of_the_output_which_is_worth_little_less() -> None:
    design, plain = sensors_with(PERIOD), sensors_with(0.0)
    C, C0 = (each.request.flow.output_matrix for each in (design, plain))
    np.testing.assert_allclose(C[:, [0, 2, 4]], C0[:, [0, 2, 4]])
    np.testing.assert_allclose(C[:, [1, 3]], -PERIOD * C0[:, [0, 2]])
    assert design.certificate.holds
    assert (design.bound_std >= plain.bound_std * (1.0 - 1e-6)).all()
    assert (design.bound_std <= 1.1 * plain.bound_std).all()
