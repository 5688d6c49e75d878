# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer in any time: fast, slow, paused, late, and back to where it was."""

from typing import Any

import numpy as np
import pytest
from observer.bench import PERIOD, RUN, SECOND, Bench, replayed, truth, values
from std_srvs.srv import Trigger


@pytest.fixture
def bench(ros: Any) -> Bench:
    return Bench(ros)


@pytest.mark.parametrize(("rate", "every"), [(200.0, 1), (100.0, 2), (25.0, 8)])
def test_estimates_come_at_the_rate_of_the_nodes_clock(
    bench: Bench, rate: float, every: int
) -> None:
    bench.start_simulated(rate=rate)
    bench.feed(range(20))
    first = len(bench.estimates)
    for k in range(10 * every):
        bench.set_clock(bench.now + PERIOD)
        # Whatever a tick publishes has come before the time goes on.
        wanted = first + k // every
        bench.wait_until(lambda n=wanted: len(bench.estimates) >= n, f"{wanted} estimates")
    stamps = [each.stamp for each in bench.estimates]
    steps = np.diff(stamps[first + 1 :])
    assert len(steps) >= 7
    assert set(steps) == {every * PERIOD}


def test_a_clock_that_goes_back_starts_afresh_and_says_so(
    bench: Bench, capfd: pytest.CaptureFixture[str]
) -> None:
    observer = bench.start_simulated()
    bench.feed(range(40))
    bench.wait_for_quiet()
    stamps = [each.stamp for each in bench.estimates]
    assert stamps == sorted(set(stamps))
    bench.forget()
    bench.sent.clear()

    bench.set_clock(20 * SECOND)
    bench.advance_until(lambda: observer.received == 0, "the reset")
    bench.feed(range(50, 90), bench.now)
    bench.wait_until(lambda: len(bench.innovations) == 40, "the innovations")
    bench.wait_for_quiet()
    assert list(bench.innovations[0].message.position) == RUN.measurements[0, 50].tolist()
    stamps = [each.stamp for each in bench.estimates]
    assert stamps == sorted(set(stamps))
    assert stamps[0] < 30 * SECOND
    assert replayed(bench) > 20
    assert values(bench.status("state"))["resets"] == "1"
    assert "the clock went back by 8" in capfd.readouterr().err


@pytest.mark.parametrize("speed", [0.5, 1.0, 5.0])
def test_simulated_time_may_run_at_any_speed(bench: Bench, speed: float) -> None:
    """The time and the samples come from a steady timer; a tick of it is up to five samples."""
    observer = bench.start_simulated(begin=0)
    begin, period = 50 * SECOND, 10_000_000
    clock, sent, ticks = [0], [0], [0]

    def tick() -> None:
        if ticks[0] >= 150:
            return
        ticks[0] += 1
        clock[0] += round(speed * period)
        while sent[0] * PERIOD <= clock[0]:
            bench.send(sent[0], begin + sent[0] * PERIOD)
            sent[0] += 1
        bench.publish_clock(begin + clock[0])

    bench.node.create_timer(period / SECOND, tick)
    bench.wait_until(lambda: ticks[0] >= 150, "a second and a half")
    bench.now = begin + clock[0]
    bench.advance_until(lambda: observer.received == sent[0], "the samples' arrival")
    bench.wait_for_quiet()
    assert observer.tracker.used == sent[0]
    stamps = [each.stamp for each in bench.estimates]
    assert stamps == sorted(set(stamps))
    assert min(stamps) >= begin
    assert replayed(bench) > 40
    last = bench.estimates[-1]
    index = min((last.stamp - begin) // PERIOD, 1600)
    bound = bench.of("error_bound")[-1].message
    q1, v1, q2, v2 = truth(index)
    error = np.array([*last.message.position, *last.message.velocity]) - [q1, q2, v1, v2]
    # The truth is at the sample before the estimate, half a period away at most.
    slack = 0.005 * np.array([abs(v1), abs(v2), 10.0, 10.0])
    assert (np.abs(error) < 4.0 * np.array([*bound.position, *bound.velocity]) + slack).all()


def test_before_simulated_time_begins_nothing_is_judged(bench: Bench) -> None:
    observer = bench.start_simulated(begin=0)
    begin = 50 * SECOND
    for index in range(20):
        bench.send(index, begin + index * PERIOD)
    status = bench.status("state")
    assert status.message == "WAITING"
    assert observer.received == 0
    assert bench.published == []
    # They have waited; the clock comes late and starts in the middle.
    bench.set_clock(begin + 20 * PERIOD)
    bench.advance_until(lambda: observer.received == 20, "the use of what has waited")
    assert observer.tracker.used == 20
    bench.wait_until(lambda: len(bench.innovations) == 20, "the innovations")
    bench.advance_until(lambda: len(bench.estimates) > 5, "estimates")
    bench.wait_for_quiet()
    assert replayed(bench) > 4
    assert values(bench.status("state"))["resets"] == "0"


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


def test_a_clock_that_goes_back_may_be_waited_for_instead(bench: Bench) -> None:
    observer = bench.start_simulated(reset_on_backward_jump=False)
    bench.feed(range(40))
    bench.wait_for_quiet()
    last = bench.estimates[-1].stamp
    bench.set_clock(bench.now - 10 * PERIOD)
    for _ in range(10):
        bench.set_clock(bench.now + PERIOD)
    status = bench.status("state")
    assert (values(status)["resets"], bench.estimates[-1].stamp) == ("0", last)
    bench.feed(range(45, 60), 100 * SECOND)
    bench.wait_for_quiet()
    assert observer.tracker.used == 55
    stamps = [each.stamp for each in bench.estimates]
    assert stamps == sorted(set(stamps))
    assert stamps[-1] > last


def test_a_reset_while_the_time_stands_still_repeats_no_stamp(bench: Bench) -> None:
    bench.start_simulated()
    bench.feed(range(20))
    bench.wait_for_quiet()
    bench.call(Trigger, "reset", Trigger.Request())
    bench.send(0, bench.now)
    bench.publish_clock(bench.now)
    bench.feed(range(30, 40), 100 * SECOND)
    bench.wait_for_quiet()
    stamps = [each.stamp for each in bench.estimates]
    assert stamps == sorted(set(stamps))


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


def test_the_time_from_a_measurements_arrival_to_its_estimate_is_told(bench: Bench) -> None:
    bench.start_simulated()
    bench.feed(range(40))
    timing = values(bench.status("timing"))
    assert 0.0 < float(timing["latency p50 [ms]"]) <= float(timing["latency p99 [ms]"])


def test_a_process_of_its_own_wakes_up_for_measurements(bench: Bench, ros_process: Any) -> None:
    """There the runtime makes the ticks, here one a second, and waits for messages in between."""
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
    # A tick a second cannot have made them.
    assert len(stamps) > 3 * (stamps[-1] - stamps[0]) / SECOND
