# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Phases, the innovation average and the debounced fault level, as pure logic."""

from hypothesis import given
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


@given(changes=st.lists(st.integers(-500, 500), max_size=130))
def test_a_sliding_minute_has_what_was_counted_in_it(changes: list[int]) -> None:
    """What falls is a count that starts over."""
    recent, total, grown = LastMinute(), 0, list[int]()
    for change in changes:
        grown.append(max(change, -total, 0))
        total = max(0, total + change)
        recent.update({"n": total, "still": 7})
        assert recent.growth["n"] == sum(grown[-60:])
