# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Wrong torques: what is implausible is not used, and the published bounds hold all the same."""

import math
from collections.abc import Callable
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
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

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
