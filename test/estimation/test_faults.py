# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which fault is told from repeats, innovations and the history of the estimated disturbance."""

import math
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.baselines import extended_kalman
from tsobs_ros.estimation.fault_shapes import Fault, FaultKind, shape_of
from tsobs_ros.estimation.faults import FaultMonitor
from tsobs_ros.estimation.health import Level
from tsobs_ros.estimation.records import NON_FINITE, USED
from tsobs_ros.estimation.state import likeliest
from tsobs_ros.estimation.tracker import Outcomes
from tsobs_ros.methods import ObserverSettings, make_tracker
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.plant import Mismatch, Scenario
from tsobs_ros.simulation.scenarios import arm_with, simulate
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep, Sinusoid

SECOND = 1_000_000_000
PERIOD = SECOND // 200
STD, BOUND = 0.028, 0.007


def add(
    monitor: FaultMonitor, stamp: int, y: float, innovation: float, w: float, repeats: int = 0
) -> Fault:
    """Take in a sample and the estimate after it, and return the fault."""
    used = np.zeros((1, 1), np.int64)
    outcomes = Outcomes(used[0], used, np.array([[innovation]]), np.array([[STD]]))
    monitor.measured([stamp], [[y]], outcomes, [repeats])
    monitor.estimated(stamp, np.array([w]), np.array([BOUND]))
    return monitor.sensors[0].fault


def feed(
    monitor: FaultMonitor,
    disturbance: Callable[[float], float],
    seconds: float,
    *,
    begin: float = 1.0,
    noise: float = 1.0,
    colour: float = 0.0,
) -> list[Fault]:
    """Feed what an ideal estimator would give, 200 times a second; return each fault told."""
    rng, faults, r = np.random.default_rng(1), [], 0.0
    for k in range(round(200 * seconds)):
        stamp = round(begin * SECOND) + k * PERIOD
        now = stamp / SECOND
        r = colour * r + math.sqrt(1.0 - colour**2) * noise * float(rng.standard_normal())
        predicted = 0.3 * math.sin(now) + disturbance(now)
        wander = 0.003 * math.sin(7.3 * now)
        faults.append(add(monitor, stamp, predicted + STD * r, STD * r, disturbance(now) + wander))
    return faults


def test_a_bias_is_told_with_its_size_and_when_it_was_first_seen() -> None:
    faults = feed(FaultMonitor([STD]), lambda t: 0.1 if t >= 21.0 else 0.0, 30.0)
    kinds, last = [fault.kind for fault in faults], faults[-1]
    told = kinds.index(FaultKind.BIAS)
    assert 20.5 <= told / 200 <= 22.0
    assert set(kinds) == {FaultKind.NONE, FaultKind.BIAS}
    assert last.magnitude == pytest.approx(0.1, abs=0.005)
    assert last.bound == pytest.approx(BOUND, rel=0.1)
    assert last.since is not None
    assert told / 200 - 0.7 <= last.since / SECOND - 1.0 <= told / 200 - 0.5
    # Small by the limits, and a bias all the same.
    assert (last.level, last.rate, last.frequency) == (Level.OK, None, None)


def test_a_ramp_is_a_drift_with_its_rate() -> None:
    monitor = FaultMonitor([STD])
    last = feed(monitor, lambda t: 0.01 * (t - 1.0), 25.0)[-1]
    assert (last.kind, last.level, last.frequency) == (FaultKind.DRIFT, Level.WARN, None)
    assert last.rate == pytest.approx(0.01, rel=0.1)
    assert last.magnitude == pytest.approx(0.245, abs=0.01)
    values = monitor.sensors[0].status(27 * SECOND).values
    assert {"kind", "since", "rate [rad/s]"} < values.keys()
    assert monitor.sensors[0].innovation_status().level is Level.OK


def test_loud_innovations_are_noise_of_their_size_if_white_else_unknown() -> None:
    noise = 1.8
    monitor = FaultMonitor([STD])
    faults = feed(monitor, lambda _: 0.0, 10.0, noise=noise)
    assert {fault.kind for fault in faults[400:]} == {FaultKind.NOISE}
    assert monitor.sensors[0].innovation_status().level is Level.WARN
    last = faults[-1]
    assert last.level is Level.WARN
    # Innovations are clipped at five expected deviations.
    assert last.magnitude == pytest.approx(noise * STD, rel=0.15)
    assert last.bound == pytest.approx(last.magnitude * math.sqrt(1.0 / 800.0), rel=1e-3)

    last = feed(FaultMonitor([STD]), lambda _: 0.0, 10.0, noise=3.0, colour=0.9)[-1]
    assert (last.kind, last.level, last.bound) == (FaultKind.UNKNOWN, Level.WARN, math.inf)


def test_samples_that_repeat_are_stuck_within_a_tenth_of_a_second() -> None:
    monitor = FaultMonitor([STD])
    feed(monitor, lambda _: 0.0, 5.0)
    faults = [add(monitor, 6 * SECOND + k * PERIOD, 0.2, 0.0, 0.0, k) for k in range(200)]
    kinds = [fault.kind for fault in faults]
    assert kinds.index(FaultKind.STUCK) == 20
    assert set(kinds[20:]) == {FaultKind.STUCK}
    assert {fault.level for fault in faults[20:]} == {Level.ERROR}
    # The estimate has to recover before its shape says anything.
    later = [fault.kind for fault in feed(monitor, lambda _: 0.1, 30.0, begin=7.0)]
    assert set(later[:100]) == {FaultKind.STUCK}
    assert set(later[120:1900]) == {FaultKind.UNKNOWN}
    assert later[-1] is FaultKind.BIAS


def test_an_output_without_numbers_while_another_has_its_own_is_missing() -> None:
    monitor = FaultMonitor([STD, STD])
    for k in range(250):
        stamp, code = SECOND + k * PERIOD, np.array([USED, NON_FINITE if 20 <= k < 50 else USED])
        numbers = np.zeros((1, 2))
        outcomes = Outcomes(code[:1], code[np.newaxis], numbers, numbers + STD)
        monitor.measured([stamp], [[0.001 * k, 0.001 * k]], outcomes, [0, 0])
        monitor.estimated(stamp, np.zeros(2), np.full(2, BOUND))
        kinds = [sensor.fault.kind for sensor in monitor.sensors]
        assert kinds[0] is FaultKind.NONE
        assert kinds[1] is FaultKind.MISSING or not 40 <= k < 50
        assert kinds[1] is not FaultKind.MISSING or k >= 40
    assert FaultKind.MISSING not in kinds


@pytest.mark.parametrize(
    ("kind", "scenario"),
    [
        (FaultKind.NONE, arm_with(Sensor(outlier_probability=0.01))),
        (FaultKind.OSCILLATION, arm_with(Sinusoid(0.2, 3.0, 2.0))),
        (FaultKind.NONE, arm_with(Mismatch(stiffness=0.2))),
        # Most of them are gated.
        (FaultKind.NOISE, arm_with(Sensor(outlier_probability=0.04, outlier_size=3.0))),
        (FaultKind.NONE, arm_with(Sensor(0.0, resolution=math.tau / 1024))),
        # So are many in a row, before the estimate is given up.
        (FaultKind.BIAS, arm_with(BiasStep(2.0, 15.0))),
    ],
)
def test_frequent_outliers_are_noise_and_the_steps_of_an_encoder_are_not(
    kind: FaultKind, scenario: Scenario
) -> None:
    """As the node has it, which the gated samples do not pass by."""
    design = load_design(config_path(SHIPPED_DESIGN))
    tracker, std = make_tracker(design, ObserverSettings()), design.request.measurement_std
    monitor, run = FaultMonitor([std]), simulate(scenario, [3], 40.0)
    kinds: Counter[FaultKind] = Counter()
    for k, (y, u) in enumerate(zip(run.measurements[0], run.torques[0], strict=False)):
        stamp = SECOND + k * PERIOD
        outcomes = tracker.offer_many([stamp], [y], [u], stamp)
        monitor.measured([stamp], [y], outcomes, tracker.repeats)
        known = tracker.estimate(stamp)
        assert known is not None
        monitor.estimated(stamp, known.disturbance, known.disturbance_bound)
        if k >= 4000:
            kinds[monitor.sensors[0].fault.kind] += 1
    assert kinds[kind] >= 0.9 * kinds.total()


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
        (np.where(TIMES < 1.0, STD * WHITE, 0.01), np.zeros(2000), 1.1),
        (np.where(TIMES < 1.0, coarse(STD * WHITE), STEP), np.zeros(2000), 1.1),
        (coarse(np.where(TIMES < 1.3, SWEEP, SWEEP[1300])), SWEEP, 1.4),
        (np.zeros(2000), SWEEP, 0.1),
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
    monitor, seen, state = FaultMonitor([STD]), [], observer.initial()
    for time, y, expected in zip(TIMES, reading, predicted, strict=True):
        stamp, x[0] = SECOND + round(time * SECOND), expected
        likeliest(state)["x"], likeliest(state)["covariance"] = x, spread
        state, _ = observer.correct(state, [y])
        fault = add(monitor, stamp, y, y - expected, 0.0, int(state["sensors"]["repeats"][0, 0]))
        seen.append(fault.kind is FaultKind.STUCK)
    if stuck_after is None:
        assert not any(seen)
    else:
        assert all(seen[round(1000.0 * stuck_after) + 10 :])
        assert not any(seen[: round(1000.0 * stuck_after) - 5])


def test_a_history_has_a_shape() -> None:
    blocks = np.arange(150)
    for values, kind in (
        (0.2 * (blocks >= 140), FaultKind.BIAS),
        (0.2 * (blocks < 75), FaultKind.NONE),
        (0.3 * np.sin(0.02 * blocks - 1.5), FaultKind.DRIFT),  # less than half a slow swing
        (0.1 * WHITE[:150], FaultKind.UNKNOWN),
    ):
        assert shape_of(0.1 * blocks, values, np.zeros(150), BOUND).kind is kind
