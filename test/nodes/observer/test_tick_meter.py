# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The tick meter counts what falls out; only orders of magnitude of real time are looked at."""

import time

from tsobs_ros.estimation.health import Level
from tsobs_ros.nodes.observer.statuses import TickMeter


def wait(seconds: float) -> None:
    """Let at least so much time pass on the meter's clock, by working."""
    end = time.monotonic_ns() + round(seconds * 1e9)
    while time.monotonic_ns() < end:
        pass


def test_without_ticks_there_is_nothing_to_report() -> None:
    status = TickMeter(200.0).status()
    assert (status.name, status.level, status.message) == ("timing", Level.STALE, "no ticks")
    assert status.values == {"wanted rate [Hz]": "200", "missed ticks": "0"}


def tick(meter: TickMeter, *times_ms: float) -> None:
    for now in times_ms:
        meter.begin(round(now * 1e6))
        meter.end()


def test_ticks_that_come_in_time_are_not_missed() -> None:
    meter = TickMeter(200.0)
    tick(meter, 0.0, 5.0, 10.1, 14.9, 20.0)
    status = meter.status()
    assert (status.level, status.message, meter.missed) == (Level.OK, "on time", 0)
    assert status.values["achieved rate [Hz]"] == "200.0"


def test_a_late_tick_that_the_next_makes_good_is_not_missed() -> None:
    meter = TickMeter(1000.0)
    tick(meter, 0.0, 1.7, 2.0, 3.9, 4.0, 5.0)
    assert meter.missed == 0
    tick(meter, 7.2, 8.0)
    assert meter.missed == 1


def test_periods_without_a_tick_are_missed() -> None:
    meter = TickMeter(1000.0)
    tick(meter, 0.0, 20.0)
    # 20 periods went by, of which the second tick is one.
    assert meter.missed == 19
    status = meter.status()
    assert status.level is Level.WARN
    assert status.message == "missed 19 ticks"
    assert status.values["missed ticks"] == "19"
    assert status.values["achieved rate [Hz]"] == "50.0"


def test_each_status_begins_a_new_interval_but_the_count_goes_on() -> None:
    meter = TickMeter(1000.0)
    tick(meter, 0.0, 10.0)
    meter.status()
    status = meter.status()
    assert (status.level, status.message) == (Level.STALE, "no ticks")
    assert (meter.missed, status.values["missed ticks"]) == (9, "9")
    tick(meter, 11.0)
    status = meter.status()
    # A single tick is enough: its period began with the last tick of the interval before.
    assert (status.level, status.message) == (Level.OK, "on time")
    assert status.values["achieved rate [Hz]"] == "1000.0"


def test_a_clock_that_is_ahead_at_once_has_jumped() -> None:
    meter = TickMeter(100.0)
    tick(meter, 1000.0, 1010.0, 61010.0, 61020.0)
    assert (meter.missed, meter.jumps) == (0, 1)
    values = meter.status().values
    assert (values["achieved rate [Hz]"], values["clock jumps ahead"]) == ("100.0", "1")


def test_work_between_the_ticks_belongs_to_the_rate_and_makes_no_tick_missing() -> None:
    meter = TickMeter(100.0)
    for now, is_tick in ((0, True), (15, False), (30, False), (50, True), (60, True)):
        meter.begin(now * 1_000_000, tick=is_tick)
        meter.end()
    assert meter.missed == 0
    assert meter.status().values["achieved rate [Hz]"] == "66.7"


def test_the_latency_is_told_where_there_is_one() -> None:
    meter = TickMeter(100.0)
    tick(meter, 0.0)
    for latency in range(1, 101):
        meter.answered(latency * 10_000)
    values = meter.status().values
    assert (values["latency p50 [ms]"], values["latency p99 [ms]"]) == ("0.500", "0.990")
    tick(meter, 10.0)
    assert "latency p50 [ms]" not in meter.status().values


def test_the_tick_time_is_that_of_the_work() -> None:
    meter = TickMeter(0.001)
    for seconds in (0.0, 0.0, 0.0, 0.02):
        meter.begin(0)
        wait(seconds)
        meter.end()
    values = meter.status().values
    median, slow = (float(values[f"tick time {p} [ms]"]) for p in ("p50", "p99"))
    assert slow >= 20.0
    assert 0.0 <= median <= slow
