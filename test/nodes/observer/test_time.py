# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Timing in the diagnostics, and estimates as soon as measurements come."""

from typing import Any

import pytest
from observer.bench import PERIOD, SECOND, Bench, replayed, values


@pytest.fixture
def bench(ros: Any) -> Bench:
    return Bench(ros)


def test_simulated_time_that_stands_still_between_ticks_misses_none(bench: Bench) -> None:
    observer = bench.start_simulated()
    bench.feed(range(20))
    bench.wait_for_quiet()
    missed = int(values(bench.status("timing"))["missed ticks"])
    for index in range(20, 60):
        bench.send(index, bench.now + PERIOD)
        bench.set_clock(bench.now + PERIOD)
        bench.wait_until(lambda: bench.estimates[-1].stamp == bench.now, "the tick's estimate")
    assert int(values(bench.status("timing"))["missed ticks"]) == missed
    assert observer.tracker.used == 60


def test_a_jump_ahead_by_minutes_is_survived_and_its_ticks_are_not_missed(bench: Bench) -> None:
    observer = bench.start_simulated()
    bench.feed(range(40))
    bench.wait_for_quiet()
    before = values(bench.status("timing"))
    last = bench.estimates[-1].stamp
    bench.set_clock(bench.now + 300 * SECOND)
    assert bench.status("state").message == "STALE"
    assert bench.estimates[-1].stamp == last
    bench.feed(range(100, 140), bench.now)
    bench.wait_until(lambda: len(bench.innovations) == 80, "the innovations")
    bench.wait_for_quiet()
    stamps = [each.stamp for each in bench.estimates]
    assert stamps == sorted(set(stamps))
    assert observer.tracker.restarts == 1
    after = values(bench.status("timing"))
    assert int(after["clock jumps ahead"]) >= 1
    assert int(after["missed ticks"]) - int(before["missed ticks"]) < 1000


def test_estimates_may_come_with_the_measurements_instead_of_the_ticks(bench: Bench) -> None:
    observer = bench.start_simulated(rate=1.0, publish_on="measurement")
    for index in range(40):
        bench.send(index, bench.now)
        bench.wait_until(lambda n=index: len(bench.innovations) > n, "the innovation")
        bench.wait_until(lambda: bench.estimates[-1].stamp == bench.now, "its estimate")
        bench.set_clock(bench.now + PERIOD)
    # Long before the first tick.
    assert len(bench.estimates) == len(bench.innovations) == 40
    assert replayed(bench) == 40
    # Without measurements, the ticks go on.
    bench.advance_until(lambda: len(bench.estimates) > 42, "estimates of ticks", 50 * PERIOD)
    assert bench.status("state").message == "COASTING"
    assert observer.tracker.used == 40
    latency = values(bench.status("timing"))
    assert "missed ticks" in latency


def test_a_process_of_its_own_wakes_up_for_measurements(bench: Bench, ros_process: Any) -> None:
    """The ticks, one a second, cannot have made the estimates."""
    process = ros_process("observer", parameters={"rate": 1.0, "publish_on": "measurement"})
    process.wait_for_line("certificate holds")
    bench.wait_for_matches()
    clock = bench.node.get_clock()
    # Here everything is matched; there it is once a measurement has an answer.
    indices = iter(range(1000))
    bench.node.create_timer(0.02, lambda: bench.send(next(indices), clock.now().nanoseconds))
    bench.wait_until(lambda: len(bench.innovations) >= 30, "thirty innovations")
    bench.wait_until(
        lambda: bench.estimates[-1].stamp >= bench.innovations[29].stamp, "the last one's estimate"
    )
    stamps = [each.stamp for each in bench.estimates]
    assert stamps == sorted(set(stamps))
    assert len(stamps) > 3 * (stamps[-1] - stamps[0]) / SECOND
