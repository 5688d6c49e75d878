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

import numpy as np
import pytest

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation import baselines
from tsobs_ros.estimation.options import GainMode
from tsobs_ros.resources import FIXED_DESIGN, config_path
from tsobs_ros.simulation.plant import Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate
from tsobs_ros.simulation.signals import BiasStep

DESIGN = load_design(config_path(FIXED_DESIGN))
SEEDS = [71, 72]
DURATION = 18.0
WINDOW = {"settled": (10.0, DURATION)}


@pytest.fixture(scope="module")
def bench(benchmark: Callable[[str], ModuleType]) -> ModuleType:
    """Return the benchmark's module of runs."""
    return benchmark("acceptance_runs")


@pytest.fixture(autouse=True)
def short(bench: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """Judge the last seconds."""
    monkeypatch.setattr(bench, "WINDOWS", WINDOW)


@lru_cache
def simulated(name: str) -> Trajectories:
    """Return runs of a scenario, made once."""
    return simulate(SCENARIOS[name], SEEDS, DURATION)


def ours(bench: ModuleType, name: str, adaptive: bool = True):
    scenario, runs = SCENARIOS[name], simulated(name)
    found = bench.observe(
        DESIGN, lambda: bench.supervised(DESIGN, GainMode.CERTIFIED, adaptive), runs
    )
    return bench.outcome(scenario, runs, *found)


def error(outcome) -> float:
    return float(outcome.errors["settled"].mean())


def test_a_stiffer_joint_is_learnt(bench: ModuleType) -> None:
    learning, fixed = (ours(bench, "stiff", adaptive) for adaptive in (True, False))

    assert error(learning) < 0.025
    assert error(learning) < 0.1 * error(fixed)
    assert np.abs(learning.theta).max() < 0.02
    assert fixed.theta is None


def test_under_plain_noise_it_is_as_good_as_an_ekf_and_better_than_high_gains(
    bench: ModuleType,
) -> None:
    scenario, runs = SCENARIOS["noise"], simulated("noise")
    ekf = bench.outcome(scenario, runs, bench.knowing(DESIGN, scenario, runs))
    high_gain = bench.high_gain(baselines.high_gain, DESIGN, runs)
    mine = error(ours(bench, "noise"))

    assert mine < 1.3 * error(ekf)
    assert mine < 0.9 * error(high_gain)


def test_outliers_hurt_an_ekf_more(bench: ModuleType) -> None:
    scenario, runs = SCENARIOS["outliers"], simulated("outliers")
    ekf = bench.outcome(scenario, runs, bench.knowing(DESIGN, scenario, runs))

    assert error(ours(bench, "outliers")) < 0.85 * error(ekf)


def test_a_step_of_the_sensor_is_forgotten_in_seconds(
    bench: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = replace(SCENARIOS["noise"], disturbance=(BiasStep(0.1, 11.0),))
    monkeypatch.setitem(SCENARIOS, "early_step", step)
    monkeypatch.setattr(bench, "STEP", 11.0)
    monkeypatch.setattr(bench, "CALM", (7.0, 11.0))
    monkeypatch.setattr(bench, "HOLD", 3.0)
    outcome = ours(bench, "early_step")

    assert [events["sensor jumps"] for events in outcome.events] == [1, 1]
    assert (outcome.settled_after > 0.0).all()
    assert (outcome.settled_after < 4.0).all()


def test_the_ekf_with_the_true_arm_profits_from_knowing_it(bench: ModuleType) -> None:
    """The comparison is with an EKF that works, in the coordinates that are compared."""
    scenario, runs = SCENARIOS["soft_heavy_bias_step"], simulated("soft_heavy_bias_step")
    knowing = bench.outcome(scenario, runs, bench.knowing(DESIGN, scenario, runs))
    deceived = bench.outcome(scenario, runs, bench.knowing(DESIGN, SCENARIOS["noise"], runs))

    assert error(knowing) < 0.04
    assert error(deceived) > 5.0 * error(knowing)


def test_the_ekf_with_parameters_as_states_learns_them(bench: ModuleType) -> None:
    scenario, runs = SCENARIOS["stiff"], simulated("stiff")
    outcome = bench.outcome(scenario, runs, *bench.augmented(DESIGN, runs))

    assert error(outcome) < 0.04
    assert np.abs(outcome.theta).max() < 0.03


def test_settled_again_means_to_stay(bench: ModuleType) -> None:
    times = np.arange(0.0, 60.0, 0.1)
    errors = np.ones((3, len(times)))
    errors[0, (times > 29.95) & (times < 32.05)] = 9.0
    errors[1, (times > 29.95) & (times < 32.05)] = 9.0
    errors[1, (times > 35.95) & (times < 36.15)] = 9.0
    errors[2, times > 29.95] = 9.0

    assert bench.settled_after(times, errors) == pytest.approx([2.0, 6.1, np.inf])
