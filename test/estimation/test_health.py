# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Phases, the innovation average and the debounced fault level, as pure logic."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.estimation.health import (
    Debounce,
    DisturbanceLimits,
    LastMinute,
    Level,
)

PROPERTY = settings(max_examples=100)
SECOND = 1_000_000_000
PERIOD = 5_000_000
LIMITS = DisturbanceLimits(warn=0.2, error=0.5, hold=0.5)


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
        ([0.3] * 7, [OK] * 5 + [WARN] * 2),
        # The limits themselves count.
        ([0.2] * 6, [OK] * 5 + [WARN]),
        # A blip on the way restarts the count.
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
@given(
    steps=st.lists(st.tuples(st.integers(0, 30 * SECOND), st.integers(-500, 500)), max_size=60),
    begin=st.integers(0, 10**18),
)
def test_a_sliding_minute_has_what_was_counted_in_it(
    steps: list[tuple[int, int]], begin: int
) -> None:
    """At any stamp, with any intervals; what falls is a count that starts over."""
    recent, now, total = LastMinute(), begin, 0
    grown: list[tuple[int, int]] = []
    for elapsed, change in steps:
        now, before = now + elapsed, total
        total = max(0, total + change)
        recent.update(now, {"n": total, "still": 7})
        grown.append((now, max(0, total - before)))
        assert recent.growth["n"] == sum(n for at, n in grown if at > now - 60 * SECOND)
    if steps:
        recent.update(now + 60 * SECOND, {"n": total, "still": 7})
        assert not recent.growth
