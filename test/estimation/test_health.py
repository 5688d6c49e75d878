# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Phases, the innovation average and the debounced fault level, as pure logic."""

from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.estimation.health import Debounce, DisturbanceLimits, LastMinute, Level

SECOND = 1_000_000_000


def test_a_level_must_last_before_it_is_reported() -> None:
    """A blip restarts the count; down again, too, it must have lasted."""
    level, limits = Debounce(Level.OK), DisturbanceLimits(warn=0.2, error=0.5, hold=0.5)
    values = [0.2] * 4 + [0.0] + [0.2] * 6 + [0.6] * 6 + [0.0] * 4 + [0.6] + [0.0] * 6
    levels = [
        level.update(SECOND + k * SECOND // 10, limits.level_of(value), limits.hold)
        for k, value in enumerate(values)
    ]
    OK, WARN, ERROR = Level.OK, Level.WARN, Level.ERROR
    assert levels == [OK] * 10 + [WARN] * 6 + [ERROR] * 11 + [OK]


@settings(max_examples=100)
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
