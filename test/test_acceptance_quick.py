# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A few runs of the acceptance benchmark, short and seeded: what it demands may not be lost.

The benchmark itself (`benchmarks/acceptance.py`) has more runs, of a minute each, and tighter
limits; here limits leave room for two seeds.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation import baselines
from tsobs_ros.estimation.records import Hypothesis
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.plant import Scenario, Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate
from tsobs_ros.simulation.signals import BiasStep, Pulses

DESIGN = load_design(config_path("elastic_joint.design.yaml"))
SEEDS = [71, 72]
DURATION = 18.0
WINDOW = (10.0, DURATION)


@pytest.fixture(scope="module")
def bench(benchmark: Callable[[str], ModuleType]) -> ModuleType:
    """Return the benchmark's module of runs."""
    return benchmark("acceptance_runs")


@pytest.fixture(autouse=True)
def short(bench: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """Judge the last seconds."""
    monkeypatch.setattr(bench, "WINDOWS", {"settled": WINDOW, "full": WINDOW})


@lru_cache
def simulated(name: str) -> Trajectories:
    """Return runs of a scenario, made once."""
    return simulate(SCENARIOS[name], SEEDS, DURATION)


def judged(bench: ModuleType, name: str, contender: str, **options: Any) -> Any:
    runs = simulated(name)
    return bench.outcome(SCENARIOS[name], runs, getattr(bench, contender)(DESIGN, runs, **options))


def error(outcome: Any) -> float:
    return float(outcome.errors["settled"].mean())


def test_a_stiffer_joint_is_learnt(bench: ModuleType) -> None:
    learning, fixed = (judged(bench, "stiff", "ours", adapt=adapt) for adapt in (True, False))

    assert error(learning) < 0.03
    assert error(learning) < 0.1 * error(fixed)
    assert np.abs(learning.theta).max() < 0.03
    assert learning.theta_inside.min() > 0.95
    assert learning.inside.min() > 0.95
    assert fixed.theta is None


def test_under_plain_noise_it_is_as_good_as_an_ekf_and_better_than_high_gains(
    bench: ModuleType,
) -> None:
    high_gain = bench.high_gain(baselines.high_gain, DESIGN, simulated("noise"))
    mine = judged(bench, "noise", "ours")

    assert error(mine) < 1.3 * error(judged(bench, "noise", "kalman"))
    assert error(mine) < 0.9 * error(high_gain)
    assert mine.foreign.max() <= 1.0
    assert (mine.broken == 0.0).all()


@pytest.mark.parametrize("name", ["stiff_loud_2", "stiff_many_outliers", "stiff_pulses"])
def test_it_is_as_good_as_a_fair_rival_where_the_world_is_not_as_designed(
    bench: ModuleType, name: str
) -> None:
    rival = judged(bench, name, "kalman", learns=True, gated=True)
    mine = judged(bench, name, "ours")

    assert error(mine) < 1.4 * error(rival)
    assert mine.inside.mean(axis=0).min() > 0.95
    assert mine.broken.max() < 0.05


def test_outliers_hurt_an_ekf_more_unless_it_has_a_gate(bench: ModuleType) -> None:
    plain, gated = (
        error(judged(bench, "outliers", "kalman", gated=gated)) for gated in (False, True)
    )

    assert error(judged(bench, "outliers", "ours")) < 0.85 * plain
    assert gated < 0.85 * plain


def test_an_ekf_with_a_gate_starts_again_if_it_leaves_everything_out(bench: ModuleType) -> None:
    scenario = Scenario(disturbance=(Pulses(0.5, 2.0, 100.0, 0.0),))
    runs = simulate(scenario, SEEDS, DURATION)
    outcome = bench.outcome(scenario, runs, bench.kalman(DESIGN, runs, gated=True))

    assert error(outcome) < 0.1


def test_a_step_of_the_sensor_is_forgotten_in_seconds(
    bench: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = replace(SCENARIOS["noise"], disturbance=(BiasStep(0.1, 11.0),))
    monkeypatch.setitem(SCENARIOS, "early_step", step)
    monkeypatch.setattr(bench, "STEP", 11.0)
    monkeypatch.setattr(bench, "CALM", (7.0, 11.0))
    monkeypatch.setattr(bench, "HOLD", 3.0)
    outcome = judged(bench, "early_step", "ours")

    assert [events["sensor jumps"] for events in outcome.events] == [1, 1]
    assert (outcome.settled_after > 0.0).all()
    assert (outcome.settled_after < 4.0).all()


def test_the_ekf_with_the_true_arm_profits_from_knowing_it(bench: ModuleType) -> None:
    """The comparison is with an EKF that works, in the coordinates that are compared."""
    name = "soft_heavy_bias_step"
    knowing = judged(bench, name, "kalman", arm=SCENARIOS[name].true_arm)

    assert error(knowing) < 0.04
    assert knowing.inside.min() > 0.9
    assert error(judged(bench, name, "kalman")) > 5.0 * error(knowing)


def test_the_ekf_with_parameters_as_states_learns_them(bench: ModuleType) -> None:
    outcome = judged(bench, "stiff", "kalman", learns=True)

    assert error(outcome) < 0.04
    assert np.abs(outcome.theta).max() < 0.03


def test_a_lost_sample_is_lost_with_its_torque(bench: ModuleType) -> None:
    runs = simulate(SCENARIOS["dropouts"], SEEDS, 11.0)
    torques, known = runs.torques[..., 0], bench.received(runs)[..., 0]
    lost = (runs.times >= 10.0) & (runs.times < 10.5)

    assert (known[:, ~lost] == torques[:, ~lost]).all()
    assert (known[:, lost] == torques[:, 1999:2000]).all()


def test_claims_are_held_against_errors(bench: ModuleType) -> None:
    runs = simulated("noise")
    shape = runs.states.shape[:2]
    estimates = np.concatenate([runs.states, runs.disturbances], axis=2)
    claimed, hypothesis = np.ones(shape), np.zeros(shape)
    part = (runs.times >= WINDOW[0]) & (runs.times < WINDOW[1])
    first, second, third = np.split(np.flatnonzero(part)[:1500], 3)
    estimates[0, first, 1] += 3.1  # beyond three bounds, and claimed
    estimates[0, second, 2] -= 3.1  # beyond them, but the bounds are void
    claimed[0, second] = 0.0
    hypothesis[1, third] = Hypothesis.FORCE
    hypothesis[1, first[:7]] = Hypothesis.DRIFT
    conditions = {"claimed": claimed, "hypothesis": hypothesis}
    found = bench.Found(estimates, np.ones(estimates.shape), conditions=conditions)
    outcome = bench.outcome(SCENARIOS["noise"], runs, found)

    total = part.sum()
    assert outcome.inside[0] == pytest.approx([1, 1 - 500 / total, 1 - 500 / total, 1, 1])
    assert outcome.claimed == pytest.approx([1 - 500 / total, 1])
    assert outcome.broken == pytest.approx([500 / (total - 500), 0])
    assert outcome.honest == pytest.approx([1 - 500 / total, 1])
    assert outcome.foreign == pytest.approx([0, 2.5])


def test_demands_are_of_the_better_rival_and_of_the_bounds(
    benchmark: Callable[[str], ModuleType], bench: ModuleType
) -> None:
    judge, good = benchmark("acceptance_demands"), judged(bench, "many_outliers", "ours")
    rival = judged(bench, "many_outliers", "kalman", gated=True)
    lost = rival._replace(errors={name: 10.0 * each for name, each in rival.errors.items()})
    found = {"certified": good, "ekf_gated": rival, "ekf_gated_augmented": lost}

    def verdicts(**changes: Any) -> dict[str, bool]:
        results = {"many_outliers": found | {"certified": good._replace(**changes)}}
        return {one.kind: one.passed for one in judge.demands(results)}

    assert judge.rival(found) == "ekf_gated"
    assert verdicts() == {"ratio": True, "inside": True, "broken": True, "claimed": True}
    assert not verdicts(errors=lost.errors)["ratio"]
    assert not verdicts(errors={"settled": np.array([np.nan, 0.01])})["ratio"]
    assert not verdicts(inside=good.inside - [0.0, 0.04, 0.0, 0.0, 0.0])["inside"]
    assert not verdicts(broken=good.broken + 0.04)["broken"]
    assert not verdicts(claimed=0.8 * good.claimed)["claimed"]


def test_settled_again_means_to_stay(bench: ModuleType) -> None:
    times = np.arange(0.0, 60.0, 0.1)
    errors = np.ones((3, len(times)))
    errors[0, (times > 29.95) & (times < 32.05)] = 9.0
    errors[1, (times > 29.95) & (times < 32.05)] = 9.0
    errors[1, (times > 35.95) & (times < 36.15)] = 9.0
    errors[2, times > 29.95] = 9.0

    assert bench.settled_after(times, errors) == pytest.approx([2.0, 6.1, np.inf])


def test_contact_and_bias_are_told_apart(benchmark: Callable[[str], ModuleType]) -> None:
    pytest.importorskip("cvxpy")
    any_joint = benchmark("any_joint")
    name = "contact_and_bias"
    case = any_joint.CONTACTS[name]
    found = any_joint.contact(case, any_joint.synthesise(case.request), SEEDS)

    verdicts = list(any_joint.demands({name: found}))
    assert [one.text for one in verdicts if not one.passed] == []
    assert any("link_angle: bias" in one.text for one in verdicts)
