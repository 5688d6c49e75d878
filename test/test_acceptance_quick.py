# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A few runs of the acceptance benchmark, short and seeded: what it demands may not be lost.

The benchmark itself (`benchmarks/acceptance.py`) has more runs, of a minute each, and tighter
limits; here limits leave room for two seeds.
"""

from collections.abc import Callable
from functools import lru_cache
from types import ModuleType
from typing import Any

import pytest

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation import baselines
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.plant import Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

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
