# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Wrong torques: what is implausible is not used, and the published bounds hold all the same."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from tsobs_ros.checks import Array
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.options import TorqueLimits
from tsobs_ros.estimation.records import NANOSECONDS, Basis, Innovation, Measurement, RejectReason
from tsobs_ros.estimation.state import CONDITIONS
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import ObserverSettings, make_tracker
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.plant import Mismatch
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate
from tsobs_ros.simulation.signals import Square

FIXED = load_design(config_path("elastic_joint_fixed.design.yaml"))
DESIGNS = [FIXED, load_design(config_path(SHIPPED_DESIGN))]
SCENARIO = SCENARIOS["noise"]
RATE, SETTLED = 200, 25 * 200
RUN = simulate(SCENARIO, [0, 1, 2], 40.0)
TRUTH = SCENARIO.arm.to_physical(RUN.states)
STAMPS = NANOSECONDS + np.round(RUN.times * NANOSECONDS).astype(np.int64)
VOID = (Basis.CONTRADICTED, Basis.OUTSIDE)


class Course(NamedTuple):
    """What is published from a sample on: errors in bounds, the worst of a sample, and bases."""

    sigmas: Array
    bases: Array
    tracker: Tracker

    def holds(self) -> bool:
        return bool((self.sigmas[~np.isin(self.bases, VOID)] < 3.0).all())


def course(design: Design, run: int, torques: Array, begin: int = SETTLED) -> Course:
    tracker = make_tracker(design, ObserverSettings(history=0.0))
    rows = tracker.follow(STAMPS, RUN.measurements[run], torques[:, np.newaxis])
    parts = tracker.estimator.row_parts
    errors = np.abs(rows[:, parts["state"]] - TRUTH[run]) / rows[:, parts["state_bound"]]
    bases = rows[:, -len(CONDITIONS) - 2]
    return Course(errors.max(axis=1)[begin:], bases[begin:], tracker)


def with_torque(run: int, begin: float, seconds: float, wrong: Callable[[Array], Array]) -> Array:
    """Return the torques of a run, some of them wrong; one at least."""
    torques = RUN.torques[run, :, 0].copy()
    first = round(begin * RATE)
    part = slice(first, first + max(1, round(seconds * RATE)))
    torques[part] = wrong(torques[part])
    return torques


IMPLAUSIBLE: dict[str, tuple[float, float, Callable[[Array], Array]]] = {
    "one of 1000 N m": (30.0, 0.0, lambda u: 0.0 * u + 1000.0),
    "one of -1e6 N m": (30.0, 0.0, lambda u: 0.0 * u - 1e6),
    "one that is NaN": (30.0, 0.0, lambda u: math.nan * u),
    "one that is infinite": (30.0, 0.0, lambda u: 0.0 * u - math.inf),
    "five of 1000 N m": (30.0, 0.025, lambda u: 0.0 * u + 1000.0),
    "half a second of -600 N m": (30.0, 0.5, lambda u: 0.0 * u - 600.0),
    "half a second in mN m": (30.5, 0.5, lambda u: 1e3 * u),
    "ten seconds without": (28.0, 10.0, lambda u: math.nan * u),
    "none from the start": (0.0, 20.0, lambda u: math.nan * u),
    "none at all": (0.0, 40.0, lambda u: math.nan * u),
}


@pytest.mark.parametrize("design", DESIGNS, ids=["fixed", "learning"])
@pytest.mark.parametrize("name", IMPLAUSIBLE)
def test_an_implausible_torque_is_a_gap_and_its_angle_is_used(name: str, design: Design) -> None:
    begin, seconds, wrong = IMPLAUSIBLE[name]
    for run in range(3):
        torques = with_torque(run, begin, seconds, wrong)
        implausible = int((~(np.abs(torques) <= 400.0)).sum())
        got = course(design, run, torques)
        assert got.holds()
        assert got.tracker.rejected == {RejectReason.IMPLAUSIBLE_TORQUE: implausible}
        assert got.tracker.used == len(torques) - implausible
        # Angles go on being used: what is lost is little.
        assert np.sqrt(np.mean(got.sigmas**2)) < 1.5
        events = got.tracker.events
        assert events["sensor jumps"] == events["losses of track"] == 0


@pytest.mark.parametrize("design", DESIGNS, ids=["fixed", "learning"])
@pytest.mark.parametrize("size", [0.5, -1.5, 3.0, -10.0, 30.0, -100.0, 390.0])
def test_a_wrong_torque_of_any_plausible_size_stays_inside_three_bounds(
    size: float, design: Design
) -> None:
    """For one sample or for a tenth of a second, at any part of the torque's turn."""
    moments = np.random.default_rng(abs(round(size)))
    for samples in (1, 2, 5, 20):
        for run in range(3):
            torques = with_torque(run, moments.uniform(26, 32), samples / RATE, lambda u: u + size)
            got = course(design, run, torques)
            # The angle has to reveal twenty times .5 N m, which is no step that can be told.
            assert got.holds() or samples * abs(size) > 400.0
            assert (got.sigmas < 3.5).all()
            assert not got.tracker.rejected
            events = got.tracker.events
            assert events["sensor jumps"] == events["losses of track"] == 0
            assert np.isin(got.bases, (Basis.CERTIFIED, Basis.LEARNT, Basis.TORQUE)).all()


@pytest.mark.parametrize("size", [20.0, -350.0])
def test_what_was_learnt_of_the_arm_tells_what_a_torque_would_have_done(size: float) -> None:
    """An arm 20 % stiffer than designed, whose response to the torque is another."""
    scenario = replace(SCENARIO, mismatch=Mismatch(stiffness=0.2))
    run = simulate(scenario, [0, 1, 2], 40.0)
    truth = run.physical
    for place in range(3):
        torques = run.torques[place].copy()
        torques[30 * RATE] += size
        tracker = make_tracker(DESIGNS[1], ObserverSettings(history=0.0))
        rows = tracker.follow(STAMPS, run.measurements[place], torques)
        parts = tracker.estimator.row_parts
        errors = np.abs(rows[:, parts["state"]] - truth[place]) / rows[:, parts["state_bound"]]
        assert (errors[SETTLED:] < 3.0).all()


def test_garbage_in_the_torque_is_taken_back() -> None:
    garbage = np.random.default_rng(7)
    for run in range(3):
        torques = with_torque(run, 30.0, 0.5, lambda u: garbage.uniform(-300.0, 300.0, u.shape))
        assert (course(FIXED, run, torques).sigmas < 3.5).all()


@pytest.mark.parametrize(("level", "seconds"), [(3.0, 0.5), (-10.0, 0.5), (5.0, 3.0)])
def test_a_wrong_level_is_the_torques_fault_and_not_the_sensors(
    level: float, seconds: float
) -> None:
    """The level is used until the angle contradicts it, and nothing is certified until then."""
    for run in range(3):
        got = course(FIXED, run, with_torque(run, 28.0, seconds, lambda u: u + level))
        wrong = got.sigmas > 3.0
        assert not np.isin(got.bases[wrong], (Basis.CERTIFIED, Basis.LEARNT)).any()
        # It takes the angle so long to show a torque: the fourth power of time.
        assert np.flatnonzero(wrong).max(initial=0) < (3.0 + 1.0) * RATE
        events = got.tracker.events
        assert events["sensor jumps"] == events["losses of track"] == 0


@pytest.mark.parametrize("amplitude", [0.3, 1.0, 1.2])
def test_legal_steps_cost_no_accuracy(amplitude: float) -> None:
    """The estimates are, bit for bit, those of an observer that suspects no torque."""
    scenario = replace(SCENARIO, excitation=Square(amplitude))
    run = simulate(scenario, [5], 30.0)
    rows = []
    for suspicious in (True, False):
        tracker = make_tracker(FIXED, ObserverSettings(history=0.0))
        if not suspicious:
            tracker.estimator.model["torque_doubt"] = 0.0
        rows.append(tracker.follow(STAMPS[: len(run.times)], run.measurements[0], run.torques[0]))
        assert not tracker.rejected
    parts = tracker.estimator.row_parts
    state, bound = parts["state"], parts["state_bound"]
    assert rows[0][:, state].tobytes() == rows[1][:, state].tobytes()
    assert (rows[0][:, bound] >= rows[1][:, bound]).all()
    certified = rows[0][SETTLED:, -len(CONDITIONS) - 2] == Basis.CERTIFIED
    assert 0.7 < certified.mean() < 1.0 or amplitude == 0.3


@pytest.mark.parametrize("after", [0.05, 0.3, 0.6, 2.0])
def test_a_jump_of_the_sensor_after_a_step_of_the_torque_is_the_sensors(after: float) -> None:
    run = simulate(replace(SCENARIO, excitation=Square(1.0)), [6], 32.0)
    # Steps are at multiples of π s.
    first = round((9 * math.pi + after) * RATE)
    angles = run.measurements[0] + 0.3 * (np.arange(len(run.times)) >= first)[:, np.newaxis]
    tracker = make_tracker(FIXED, ObserverSettings(history=0.0))
    tracker.follow(STAMPS[: len(run.times)], angles, run.torques[0])
    assert tracker.events["sensor jumps"] == 1
    assert not tracker.rejected


def test_a_lasting_new_level_is_used_again_once_its_rate_is_plausible() -> None:
    tracker = make_tracker(FIXED, ObserverSettings(torque_rate_limit=100.0))
    wanted, outcomes = RejectReason.IMPLAUSIBLE_TORQUE, []
    for index in range(1, 12):
        torque = np.array([3.0 * (index > 4)])
        given = Measurement(index * 5_000_000, np.array([1e-3 * index]), torque)
        outcome = tracker.offer(given, given.stamp)
        outcomes.append(outcome if isinstance(outcome, RejectReason) else None)
    # 3 N m in 30 ms: from the sixth period on, counted from the last torque in use.
    assert outcomes == [None] * 4 + [wanted] * 5 + [None] * 2


def test_limits_come_from_the_settings_the_request_or_the_arm() -> None:
    request = FIXED.arm_request
    assert request.torque_limits() == (400.0, 4e5, 400.0 / 3.0)
    assert request.torque_limits(50.0, 7.0) == (50.0, 7.0, 50.0 / 3.0)
    assert TorqueLimits.of(0.0, 0.0, 400.0) == (math.inf, math.inf, 400.0 / 3.0)
    assert TorqueLimits.of(0.0, None, 400.0).rate_limit == 4e5
    for method in ("certified", "high_gain"):
        settings = ObserverSettings(method).with_parameters({"torque_limit": "2.5"})
        tracker = make_tracker(FIXED, settings)
        for place, (torque, used) in enumerate([(2.5, True), (-2.6, False)], 1):
            given = Measurement(place * 5_000_000, np.zeros(1), np.array([torque]))
            assert isinstance(tracker.offer(given, given.stamp), Innovation) == used
    with pytest.raises(ModelError, match=r"torque_limit: expected a finite number .* got -1"):
        ObserverSettings(torque_limit=-1.0)
