# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer in time: any rates, any order, gaps; a clock that starts, stops, runs and jumps."""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from staging import values
from staging.stage import BEGIN, MS, OUTPUTS, PERIOD, Arm, Event, Stage, good, replayed

from tsobs_ros.nodes.observer import Observer
from tsobs_ros.series import NANOSECONDS


def used(observer: Observer) -> int:
    """Return how many samples were used, as all that were received must be."""
    assert observer.joints[0].tracker.used == observer.joints[0].received
    return observer.joints[0].received


@pytest.mark.parametrize(("sensor", "node"), [(50, 500), (333, 77)])
def test_estimates_are_the_trackers_bit_for_bit_at_any_rates(
    stage: Stage, sensor: int, node: int
) -> None:
    observer, arm = stage.add(rate=float(node)), Arm(BEGIN)
    period = round(NANOSECONDS / node)
    stage.step(BEGIN - period)
    events, until = good(arm, BEGIN, 0.4, round(NANOSECONDS / sensor)), BEGIN + 400 * MS
    stage.play(events, until, period)

    assert used(observer) == len(events)
    assert set(np.diff(stage.watcher.stamps)) == {period}
    assert stage.watcher.stamps[-1] >= until
    assert replayed(stage.watcher, observer, events) > 20
    for topic in OUTPUTS:
        sides = [f"{arm.joint}_link", f"{arm.joint}_motor"]
        names = sides if topic in ("joint_states", "error_bound") else [arm.joint]
        assert all(list(each.message.name) == names for each in stage.watcher.of(topic))


def test_without_a_clock_an_observer_says_what_it_waits_for(
    stage: Stage, capfd: pytest.CaptureFixture[str]
) -> None:
    stage.add()
    status = stage.statuses()["observer: state"]
    assert status.level == DiagnosticStatus.WARN
    assert status.message.startswith("waiting for /clock")
    assert "waiting for /clock" in capfd.readouterr().err


def test_a_clock_that_goes_back_may_be_waited_for_instead(stage: Stage) -> None:
    observer, arm = stage.add(reset_on_backward_jump=False), Arm(BEGIN)
    stage.step(BEGIN - PERIOD)
    stage.play(good(arm, BEGIN, 0.2), BEGIN + 200 * MS)
    last = stage.watcher.stamps[-1]
    stage.step(stage.now - 50 * MS)
    stage.play((), stage.now + 50 * MS)
    assert stage.watcher.stamps[-1] == last
    stage.play(good(arm, stage.now + PERIOD, 0.1), stage.now + 105 * MS)
    assert stage.watcher.stamps == sorted(set(stage.watcher.stamps))
    assert stage.watcher.stamps[-1] == stage.now > last
    assert used(observer) == 60


def test_a_clock_that_goes_back_restarts_each_time(
    stage: Stage, capfd: pytest.CaptureFixture[str]
) -> None:
    observer = stage.add()
    stage.step(BEGIN)
    for back in (50 * MS, 30 * NANOSECONDS):
        arm = Arm(stage.now + PERIOD)
        events = good(arm, arm.origin, 0.1)
        stage.play(events, arm.origin + 100 * MS)
        assert used(observer) == len(events)
        assert replayed(stage.watcher, observer, events) >= 19
        stage.watcher.published.clear()
        stage.step(stage.now - back)
        stage.step(stage.now + PERIOD)
        assert observer.joints[0].received == 0
        assert stage.watcher.published == []
    assert "the clock went back by" in capfd.readouterr().err


def test_a_leap_of_the_clock_is_a_gap_and_no_missed_tick(stage: Stage) -> None:
    observer, sent = stage.add(), list[Event]()
    stage.step(BEGIN)
    missed = int(values(stage.statuses()["observer: timing"])["missed ticks"])
    # Within coast_after, while coasting, to the edge of that, beyond: an hour, a year.
    for leap in (0.05, 1.0, 4.9, 5.1, 3600.0, 3.15e7):
        arm = Arm(stage.now + round(leap * NANOSECONDS))
        events = good(arm, arm.origin, 0.1)
        stage.step(arm.origin + 100 * MS, events)
        sent += events
        assert used(observer) == len(sent)
        assert stage.watcher.stamps[-1] == stage.now
    assert observer.joints[0].tracker.restarts == 3
    assert replayed(stage.watcher, observer, sent) >= 6
    timing = values(stage.statuses()["observer: timing"])
    assert int(timing["missed ticks"]) - missed < 10_000  # of 6 million
