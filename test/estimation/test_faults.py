# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which fault of a sensor is found in what its estimator remembers."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.baselines import extended_kalman
from tsobs_ros.estimation.faults import Fault, FaultKind, FaultMonitor
from tsobs_ros.estimation.health import Level
from tsobs_ros.estimation.records import Estimate
from tsobs_ros.estimation.state import likeliest
from tsobs_ros.methods import make_tracker
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.plant import Mismatch, Scenario
from tsobs_ros.simulation.scenarios import arm_with, simulate
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep, GaussMarkov, Sinusoid, StuckSensor

SECOND = 1_000_000_000
PERIOD = SECOND // 200
STD = 0.028


def followed(design: Design, y: NDArray[np.float64], u: NDArray[np.float64]) -> list[list[Fault]]:
    """Return the faults of each sensor ten times a second."""
    tracker = make_tracker(design)
    monitor, found = FaultMonitor(tracker.estimator), []
    for begin in range(0, len(y), 20):
        part = slice(begin, begin + 20)
        stamps = SECOND + PERIOD * np.arange(begin, begin + 20)[: len(y[part])]
        tracker.offer_many(stamps, y[part], u[part], int(stamps[-1]))
        known = tracker.estimate(int(stamps[-1]))
        assert known is not None
        monitor.update(known, tracker.state)
        found.append(list(monitor.faults))
    return found


OUTLIERS, ENCODER = Sensor(outlier_probability=0.05), Sensor(0.0, resolution=math.tau / 1024)


@pytest.mark.parametrize(
    ("kind", "size", "level", "scenario"),
    [
        (FaultKind.NONE, None, Level.OK, arm_with(OUTLIERS)),
        (FaultKind.NONE, None, Level.OK, arm_with(Mismatch(stiffness=0.2))),
        (FaultKind.NONE, None, Level.OK, arm_with(ENCODER)),
        (FaultKind.OSCILLATION, 0.3, Level.WARN, arm_with(Sinusoid(0.3, 3.0, 2.0))),
        (FaultKind.DRIFT, None, Level.OK, arm_with(GaussMarkov(0.1, 20.0, 2.0))),
        (FaultKind.BIAS, 0.3, Level.WARN, arm_with(BiasStep(0.3, 15.0))),
        (FaultKind.NOISE, 3.0 * STD, Level.WARN, arm_with(Sensor(noise_std=3.0 * STD))),
        (FaultKind.STUCK, None, Level.ERROR, arm_with(StuckSensor(15.0, 20.0))),
    ],
)
def test_a_fault_is_named_with_its_size(
    kind: FaultKind, size: float | None, level: Level, scenario: Scenario
) -> None:
    run = simulate(scenario, [3], 30.0)
    design = load_design(config_path(SHIPPED_DESIGN))
    faults = [each for (each,) in followed(design, run.measurements[0], run.torques[0])]
    late, last = faults[200:], faults[-1]
    assert sum((each.kind, each.level) == (kind, level) for each in late) >= 0.9 * len(late)
    assert size is None or last.magnitude == pytest.approx(size, rel=0.25)
    tone = kind is FaultKind.OSCILLATION
    assert last.frequency == (pytest.approx(3.0, rel=0.05) if tone else None)
    if kind in (FaultKind.BIAS, FaultKind.STUCK):
        assert last.since is not None
        assert 15.0 <= last.since / SECOND - 1.0 <= 15.8
    status = last.status(32 * SECOND, "rad")
    assert (status.message, status.level) == (kind.value, level)
    assert ("since" in status.values) == (kind is not FaultKind.NONE)


def test_an_output_without_numbers_while_another_has_its_own_is_missing() -> None:
    design = load_design(Path(__file__).parent / "data" / "both_encoders.design.yaml")
    y, u = np.zeros((600, 2)), np.zeros((600, 1))
    y[200:400, 1] = math.nan
    kinds = [[each.kind for each in faults] for faults in followed(design, y, u)]
    assert all(first is not FaultKind.MISSING for first, _ in kinds)
    missing = [place for place, (_, second) in enumerate(kinds) if second is FaultKind.MISSING]
    assert missing == list(range(missing[0], missing[-1] + 1))
    assert 10 <= missing[0] <= 11
    assert 19 <= missing[-1] <= 25


STEP = math.tau / 1024
TIMES = np.arange(2000) * 1e-3
SWEEP = 0.3 * np.sin(5.0 * TIMES)
WHITE = np.random.default_rng(2).standard_normal(2000)


def coarse(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what a 10-bit encoder reads."""
    return STEP * np.round(angle / STEP)


@pytest.mark.parametrize(
    ("reading", "predicted", "stuck_after"),
    [
        (np.full(2000, 0.2), np.full(2000, 0.2), None),
        (coarse(SWEEP), SWEEP, None),
        (coarse(SWEEP + 0.1 * (TIMES > 1.0)), SWEEP + 0.1 * (TIMES > 1.02), None),
        # One odd value, between two steps.
        (coarse(SWEEP) + 0.001 * STEP * (np.arange(2000) == 700), SWEEP, None),
        # 50 new values a second in 1000 messages: a sensor slower than its messages.
        (np.repeat(STD * WHITE[::20], 20), np.zeros(2000), None),
        (np.where(TIMES < 1.0, STD * WHITE, 0.01), np.zeros(2000), 1.0),
        (np.where(TIMES < 1.0, coarse(STD * WHITE), STEP), np.zeros(2000), 1.0),
        (coarse(np.where(TIMES < 1.3, SWEEP, SWEEP[1300])), SWEEP, 1.3),
        (np.zeros(2000), SWEEP, 0.0),
    ],
    ids=[
        "encoder at rest", "encoder", "encoder that jumps",
        "odd value", "slow sensor", "noisy sensor at rest sticks",
        "noisy encoder at rest sticks", "moving encoder sticks", "stuck from the start",
    ],
)  # fmt: skip
def test_a_sensor_is_stuck_if_its_noise_is_gone_or_its_arm_moves(
    reading: NDArray[np.float64], predicted: NDArray[np.float64], stuck_after: float | None
) -> None:
    flow = load_design(config_path(FIXED_DESIGN)).request.flow
    x, spread = np.zeros(flow.state_count), 1e-9 * np.eye(flow.state_count)
    spread[0, 0] = 0.1 * STD**2
    observer = extended_kalman(flow, np.array([[STD**2]]), spread, gate=math.inf)
    monitor, seen, state = FaultMonitor(observer), [], observer.initial()
    for time, y, expected in zip(TIMES, reading, predicted, strict=True):
        x[0] = expected
        likeliest(state)["x"], likeliest(state)["covariance"] = x, spread
        state, _ = observer.correct(state, [y])
        monitor.update(Estimate(SECOND + round(time * SECOND)), state)
        seen.append(monitor.faults[0].kind is FaultKind.STUCK)
    if stuck_after is None:
        assert not any(seen)
    else:
        assert all(seen[round(1000.0 * stuck_after) + 310 :])
        assert not any(seen[: round(1000.0 * stuck_after) + 95])
