# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Phases, the innovation average and the debounced fault level, as pure logic."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.health import (
    Debounce,
    DisturbanceLimits,
    InnovationMonitor,
    Level,
    Phase,
    phase_of,
)

PROPERTY = settings(max_examples=100)
SECOND = 1_000_000_000
PERIOD = 5_000_000
LIMITS = DisturbanceLimits(warn=0.2, error=0.5, hold=0.5)


@pytest.mark.parametrize(
    ("age", "phase"),
    [
        (None, Phase.WAITING),
        (0.0, Phase.TRACKING),
        (0.1, Phase.TRACKING),
        (0.1000001, Phase.COASTING),
        (5.0, Phase.COASTING),
        (5.0000001, Phase.STALE),
        (math.inf, Phase.STALE),
    ],
)
def test_the_phase_is_the_age_against_its_limits(age: float | None, phase: Phase) -> None:
    assert phase_of(age, 0.1, 5.0) is phase


@pytest.mark.parametrize("rate", [10, 200, 1000])
def test_the_average_does_not_depend_on_the_rate(rate: int) -> None:
    monitor = InnovationMonitor()
    for k in range(2 * rate + 1):
        monitor.update(SECOND + k * SECOND // rate, 2.0)
    assert monitor.nis == pytest.approx(4.0 - 3.0 * math.exp(-2.0), rel=1e-9)


def test_a_lone_outlier_is_clipped_and_white_noise_is_consistent() -> None:
    monitor = InnovationMonitor()
    stamp = SECOND
    for value in np.random.default_rng(1).standard_normal(4000):
        stamp += PERIOD
        monitor.update(stamp, float(value))
        assert monitor.status().level is Level.OK
    before = monitor.nis
    monitor.update(stamp + PERIOD, 1e200)
    assert monitor.nis - before == pytest.approx((25.0 - before) * PERIOD / SECOND, rel=0.01)
    assert monitor.status().level is Level.OK


def test_consistency_is_lost_at_twice_the_expected_variance_and_comes_back() -> None:
    monitor, levels = InnovationMonitor(), []
    for k in range(1600):
        monitor.update(SECOND + k * PERIOD, 2.0 if k < 800 else 1.0)
        levels.append(monitor.status().level)
        assert (levels[-1] is Level.OK) == (monitor.nis <= 2.0)
    assert levels[0] is levels[-1] is Level.OK
    assert levels[799] is Level.WARN


def levels_of(values: list[float], limits: DisturbanceLimits = LIMITS) -> list[Level]:
    """Return the levels reported for disturbances a tenth of a second apart."""
    level = Debounce(Level.OK)
    return [
        level.update(SECOND + k * SECOND // 10, limits.level_of(abs(value)), limits.hold)
        for k, value in enumerate(values)
    ]


OK, WARN, ERROR = Level.OK, Level.WARN, Level.ERROR


@pytest.mark.parametrize(
    ("values", "levels"),
    [
        ([0.0] * 6, [OK] * 6),
        ([0.3] * 7, [OK] * 5 + [WARN] * 2),
        ([-0.7] * 7, [OK] * 5 + [ERROR] * 2),
        # The limits themselves count.
        ([0.2] * 6, [OK] * 5 + [WARN]),
        ([0.5] * 6, [OK] * 5 + [ERROR]),
        # A blip on the way starts the count anew.
        ([0.3] * 4 + [0.0] + [0.3] * 6, [OK] * 10 + [WARN]),
        # From one level to the next one, without OK in between.
        ([0.3] * 6 + [0.6] * 6, [OK] * 5 + [WARN] * 6 + [ERROR]),
        # Back down only once it has been gone for as long.
        ([0.6] * 6 + [0.0] * 4 + [0.6] + [0.0] * 6, [OK] * 5 + [ERROR] * 11 + [OK]),
    ],
)
def test_a_level_must_last_before_it_is_reported(values: list[float], levels: list[Level]) -> None:
    assert levels_of(values) == levels


@PROPERTY
@given(values=st.lists(st.floats(-1.0, 1.0), max_size=60))
def test_a_level_is_only_ever_left_for_one_that_lasted(values: list[float]) -> None:
    levels = levels_of(values)
    raw = levels_of(values, DisturbanceLimits(0.2, 0.5, 0.0))
    assert raw == [ERROR if abs(v) >= 0.5 else WARN if abs(v) >= 0.2 else OK for v in values]
    for k in range(1, len(levels)):
        if levels[k] != levels[k - 1]:
            assert raw[k - 5 : k + 1] == [levels[k]] * 6


def test_innovations_are_averaged_over_a_second_of_stamps() -> None:
    monitor = InnovationMonitor()
    assert monitor.status().level is Level.OK
    monitor.update(7 * SECOND, 3.0)
    assert monitor.nis == 1.0  # a first one has no time to count for
    monitor.update(8 * SECOND, -3.0)
    assert monitor.nis == pytest.approx(9.0 - 8.0 * math.exp(-1.0))
    assert monitor.status().level is Level.WARN
    assert monitor.status().values == {"normalised innovation squared": f"{monitor.nis:.3g}"}
    before = monitor.nis
    monitor.update(7 * SECOND, 50.0)  # late: no weight
    assert monitor.nis == before


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: DisturbanceLimits(warn=0.0), "warn"),
        (lambda: DisturbanceLimits(warn=0.4, error=0.3), "error level"),
        (lambda: DisturbanceLimits(error=math.nan), "error level"),
        (lambda: InnovationMonitor(0.0), "time_constant"),
    ],
)
def test_senseless_limits_are_refused(make: Callable[[], object], reason: str) -> None:
    with pytest.raises(ModelError, match=reason):
        make()
