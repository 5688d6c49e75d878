# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer in time: any rates, any order, gaps; a clock that starts, stops, runs and jumps."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from faults.arm import Arm
from faults.stage import SIGMAS, Event, Stage, good
from rcl_interfaces.msg import Log
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.records import NANOSECONDS, RejectReason
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.nodes.messages import to_nanoseconds
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

BEGIN = 100 * NANOSECONDS
MS = 1_000_000
PERIOD = 5 * MS
DESIGN = load_design(config_path(SHIPPED_DESIGN))


class Recording:
    """The estimates of one observer, in the order of publication."""

    def __init__(self) -> None:
        self.states: list[tuple[int, bytes]] = []

    def keep(self, topic: str, message: JointState) -> None:
        """Take in a message of any of its topics."""
        if topic == "joint_states":
            numbers = np.array([*message.position, *message.velocity])
            self.states.append((to_nanoseconds(message.header.stamp), numbers.tobytes()))


@pytest.fixture
def stage(ros: Any) -> Stage:
    return Stage(ros)


@pytest.fixture
def recording() -> Recording:
    return Recording()


def tracker_of(observer: Any) -> Tracker[Any]:
    """Return a new tracker like the observer's."""
    own = observer.tracker
    return Tracker(own.estimator, own.options)


def agrees(recording: Recording, observer: Any, arm: Arm, sent: Iterable[tuple[int, int]]) -> int:
    """Hold estimates to those of a tracker that had, at each stamp, the same samples, in order.

    Args:
        recording: The estimates.
        observer: Whose they are.
        arm: Whose samples were sent.
        sent: When each sample was sent, and its stamp, in the order of stamps.
    """
    waiting, tracker = list(sent), tracker_of(observer)
    for stamp, numbers in recording.states:
        while waiting and waiting[0][0] <= stamp:
            tracker.offer(arm.measurement(waiting.pop(0)[1]), stamp)
        estimate = tracker.estimate(stamp)
        assert estimate is not None
        assert numbers == estimate.state[[0, 2, 1, 3]].tobytes(), stamp
    return len(recording.states)


def as_sampled(events: Iterable[Event]) -> list[tuple[int, int]]:
    return [(event.at, event.at) for event in events]


@pytest.mark.parametrize(
    ("sensor", "node"),
    [(50, 1000), (1000, 50), (333, 77), (200, 201), (950, 730)],
)
def test_sensor_and_node_may_have_any_rates(
    stage: Stage, recording: Recording, sensor: float, node: float
) -> None:
    observer = stage.add("", recording.keep, rate=float(node))
    period, arm = round(NANOSECONDS / node), Arm(BEGIN, rate=float(sensor), seconds=2.0)
    stage.step(BEGIN - period)
    seconds = 0.6 if node <= 500 else 0.3
    events = list(good(arm, BEGIN, seconds))
    until = BEGIN + round(seconds * NANOSECONDS)
    stage.play(events, until, period)

    assert stage.counts().used == stage.counts().received == len(events)
    stamps = [stamp for stamp, _ in recording.states]
    assert set(np.diff(stamps)) == {period}
    assert stamps[-1] >= until
    assert agrees(recording, observer, arm, as_sampled(events)) == len(stamps)
    assert stage.watchers[""].broken == []
    assert stage.watchers[""].sigmas(arm) < SIGMAS


@pytest.mark.parametrize("speed", [0.1, 10.0])
def test_time_may_run_at_any_speed(stage: Stage, recording: Recording, speed: float) -> None:
    """A clock of 200 Hz at some speed goes on by so many periods a message."""
    observer = stage.add("", recording.keep)
    arm, step = Arm(BEGIN), round(speed * PERIOD)
    stage.step(BEGIN - step)
    events = list(good(arm, BEGIN, 0.2 if speed < 1.0 else 1.0))
    stage.play(events, events[-1].at + 10 * PERIOD, step)

    assert stage.counts().used == len(events)
    stamps = [stamp for stamp, _ in recording.states]
    assert abs(np.diff(stamps) - max(step, PERIOD)).max() < step
    assert agrees(recording, observer, arm, as_sampled(events)) > 20
    assert stage.watchers[""].sigmas(arm) < SIGMAS


def test_while_time_stands_still_nothing_is_published_twice(
    stage: Stage, recording: Recording
) -> None:
    observer = stage.add("", recording.keep)
    arm = Arm(BEGIN)
    stage.step(BEGIN - PERIOD)
    stage.play(good(arm, BEGIN, 0.2), BEGIN + 200 * MS, PERIOD)
    before = len(recording.states)
    for stamp in arm.stamps(stage.now, 0.05):
        stage.step(stage.now, [Event(stage.now, arm.message(stamp))])
    assert len(recording.states) == before
    stage.play(good(arm, BEGIN + 250 * MS, 0.2), BEGIN + 500 * MS, PERIOD)

    assert stage.counts().used == stage.counts().received == 90
    held = range(BEGIN + 200 * MS, BEGIN + 250 * MS)
    first_tick = BEGIN + 205 * MS
    sent = [(first_tick if at in held else at, at) for at in arm.stamps(BEGIN, 0.45)]
    assert agrees(recording, observer, arm, sent) >= before + 50
    assert stage.watchers[""].broken == []


def test_of_what_waited_for_the_time_to_begin_the_future_is_refused(stage: Stage) -> None:
    """The clock begins in the middle; a tenth of a second ahead of it is tolerated."""
    stage.add()
    arm = Arm(BEGIN)
    for event in good(arm, BEGIN, 1.0):
        stage.sensor.publish(event.message)
    stage.step(BEGIN + 500 * MS)
    stage.step(BEGIN + 505 * MS)
    counts = stage.counts()
    # What lies exactly at the tolerance is inside, and the first tick is one of the two.
    assert counts.used in (121, 122)
    assert counts.rejected == {RejectReason.FROM_FUTURE: 200 - counts.used}
    assert stage.watchers[""].stamp() == stage.now


@pytest.mark.parametrize("gap", [0.005, 0.3, 4.9, 5.1, 600.0], ids=lambda gap: f"{gap:g} s")
def test_after_a_gap_of_any_length_it_goes_on(
    stage: Stage, recording: Recording, gap: float
) -> None:
    rate, stale_after = 50.0, 5.0
    period = round(NANOSECONDS / rate)
    observer = stage.add("", recording.keep, rate=rate)
    stage.step(BEGIN - period)
    arm = Arm(BEGIN)
    stage.play(good(arm, BEGIN, 1.0), BEGIN + NANOSECONDS, period)
    again = BEGIN + NANOSECONDS + round(gap * NANOSECONDS)
    events = list(good(arm, again, 1.0))
    stage.play(events, again + NANOSECONDS, period)

    assert stage.watchers[""].broken == []
    assert stage.counts().used == stage.counts().received == 200 + len(events)
    assert observer.tracker.restarts == (gap > stale_after)
    newest = BEGIN + 995 * MS
    coasting = [stamp for stamp, _ in recording.states if newest < stamp < again]
    assert all(stamp <= newest + stale_after * NANOSECONDS for stamp in coasting)
    assert len(coasting) >= int(min(gap, stale_after) * rate) - 1
    sent = [(stamp, stamp) for stamp in (*arm.stamps(BEGIN, 1.0), *arm.stamps(again, 1.0))]
    assert agrees(recording, observer, arm, sent)


@pytest.mark.parametrize(("sensor", "seed"), [(200.0, 0), (730.0, 2)])
def test_whatever_the_order_of_arrival_the_estimate_is_that_of_the_order_of_stamps(
    stage: Stage, recording: Recording, sensor: float, seed: int
) -> None:
    """Outliers, a jump and a stuck stretch included: what the supervision decides rewinds too."""
    observer = stage.add("", recording.keep, rate=50.0, supervision__jump_quiet=0.0)
    arm = Arm(BEGIN, rate=sensor, seconds=2.0)
    rng = np.random.default_rng(seed)
    samples, frozen = {}, arm.measurement(BEGIN).y
    for index, stamp in enumerate(arm.stamps(BEGIN, 200.0 / sensor)):
        sample = arm.measurement(stamp)
        offset = 0.3 * (index > 90) + rng.choice([0.0, 2.0], p=[0.95, 0.05])
        samples[stamp] = sample._replace(y=frozen if 40 <= index < 60 else sample.y + offset)
    arrivals = sorted((stamp + int(rng.integers(0, 300 * MS)), stamp) for stamp in samples)
    events = [
        Event(at, arm.message(stamp, position=samples[stamp].y.tolist())) for at, stamp in arrivals
    ]
    stage.step(BEGIN - 20 * MS)
    stage.play(events, arrivals[-1][0], 20 * MS)

    tracker = observer.tracker
    assert tracker.used + tracker.rejected[RejectReason.GATED] == len(samples)
    assert tracker.rejected[RejectReason.GATED] > 0
    assert tracker.rewinds > 100
    for stamp, numbers in recording.states[::15] + recording.states[-1:]:
        in_order = tracker_of(observer)
        for arrived in sorted(taken for at, taken in arrivals if at <= stamp):
            in_order.offer(samples[arrived], stamp)
        estimate = in_order.estimate(stamp)
        assert estimate is not None
        assert numbers == estimate.state[[0, 2, 1, 3]].tobytes()
    assert tracker.events == in_order.events
    assert tracker.rejected == in_order.rejected


def test_a_clock_that_goes_back_may_be_waited_for_instead(
    stage: Stage, recording: Recording
) -> None:
    observer = stage.add("", recording.keep, reset_on_backward_jump=False)
    arm = Arm(BEGIN)
    stage.step(BEGIN - PERIOD)
    stage.play(good(arm, BEGIN, 0.2), BEGIN + 200 * MS, PERIOD)
    last = recording.states[-1][0]
    stage.step(stage.now - 50 * MS)
    stage.play((), stage.now + 50 * MS, PERIOD)
    assert recording.states[-1][0] == last
    stage.play(good(arm, stage.now + PERIOD, 0.1), stage.now + 105 * MS, PERIOD)
    stamps = [stamp for stamp, _ in recording.states]
    assert stamps == sorted(set(stamps))
    assert stamps[-1] == stage.now > last
    assert observer.tracker.used == observer.received == 60


def test_a_reset_while_time_stands_still_repeats_no_stamp(stage: Stage) -> None:
    stage.add()
    arm = Arm(BEGIN)
    stage.step(BEGIN - PERIOD)
    stage.play(good(arm, BEGIN, 0.1), BEGIN + 100 * MS, PERIOD)
    assert stage.call(Trigger, "/observer/reset", Trigger.Request()).message == "restarted"
    stage.step(stage.now, [Event(stage.now, arm.message(stage.now))])
    stage.play(good(arm, stage.now + PERIOD, 0.1), stage.now + 100 * MS, PERIOD)
    assert stage.watchers[""].broken == []
    assert stage.watchers[""].stamp() == stage.now


@pytest.mark.parametrize("back", [0.05, 30.0], ids=lambda back: f"{back:g} s")
def test_a_clock_that_goes_back_begins_anew_each_time(
    stage: Stage, recording: Recording, back: float, capfd: pytest.CaptureFixture[str]
) -> None:
    observer = stage.add("", recording.keep)
    stage.step(BEGIN)
    for _ in range(3):
        arm = Arm(stage.now + PERIOD)
        events = list(good(arm, arm.origin, 0.3))
        stage.play(events, arm.origin + 300 * MS, PERIOD)
        assert stage.counts().used == stage.counts().received == len(events)
        assert agrees(recording, observer, arm, as_sampled(events)) >= 59
        assert stage.watchers[""].broken == []
        recording.states.clear()
        stage.step(stage.now - round(back * NANOSECONDS))
        stage.step(stage.now + PERIOD)
        assert stage.counts().received == 0
        stage.step(stage.now + NANOSECONDS)
        assert recording.states == []
    assert "the clock went back by" in capfd.readouterr().err


def test_a_leap_of_the_clock_is_a_gap(stage: Stage) -> None:
    observer = stage.add()
    stage.step(BEGIN)
    wanted = 0
    # Within coast_after, while coasting, to the edge of that, beyond: an hour, a year.
    for leap in (0.05, 1.0, 4.9, 5.1, 3600.0, 3.15e7):
        arm = Arm(stage.now + round(leap * NANOSECONDS))
        events = list(good(arm, arm.origin, 0.1))
        stage.step(arm.origin + 100 * MS, events)
        wanted += len(events)
        assert stage.counts().used == stage.counts().received == wanted
        assert stage.watchers[""].stamp() == stage.now
    assert observer.tracker.restarts == 3
    assert stage.watchers[""].broken == []


def test_what_a_tick_finds_is_used_in_the_order_of_stamps(stage: Stage) -> None:
    """Half a second of a sensor at 1 kHz backwards: as cheap as forwards, and the same."""
    observer = stage.add(rate=50.0)
    stage.step(BEGIN)
    arm = Arm(BEGIN, rate=1000.0)
    stamps = list(arm.stamps(BEGIN + PERIOD, 0.45))
    last = stamps[-1]
    events = [Event(last, arm.message(stamp)) for stamp in reversed(stamps)]
    events.insert(7, Event(last, arm.message(last, position=[])))
    events.insert(9, Event(last, arm.message(stamps[3])))
    stage.step(last, events)

    alone = Tracker(DESIGN.supervised(), TrackerOptions(x_max=DESIGN.request.x_max))
    for stamp in stamps:
        alone.offer(arm.measurement(stamp), last)
    assert observer.tracker.used == alone.used == len(stamps)
    assert observer.tracker.rejected == {
        RejectReason.WRONG_JOINT: 1,
        RejectReason.DUPLICATE: 1,
    }
    assert observer.tracker.rewinds <= 1  # of those that came after the tick
    ours, theirs = observer.tracker.estimate(last), alone.estimate(last)
    assert ours is not None
    assert theirs is not None
    assert ours.state.tobytes() == theirs.state.tobytes()


def test_two_clocks_at_odds_do_no_worse_than_begin_anew(
    stage: Stage, capfd: pytest.CaptureFixture[str]
) -> None:
    stage.add()
    stage.step(BEGIN)
    arm = Arm(BEGIN)
    for turn in range(300):
        clock = BEGIN * (1 + turn // 3 % 2) + turn * PERIOD
        stage.step(clock, [Event(clock, arm.message(clock))])
    assert stage.watchers[""].broken == []
    lines = capfd.readouterr().err.count("restarting")
    assert 1 <= lines <= 10  # of 50
    stage.step(3 * BEGIN)
    arm = Arm(stage.now + PERIOD)
    stage.play(good(arm, arm.origin, 0.5), arm.origin + 500 * MS, PERIOD)
    assert stage.watchers[""].sigmas(arm) < SIGMAS


def test_ten_thousand_rejections_are_a_few_lines_of_log(stage: Stage) -> None:
    lines: list[str] = []
    stage.node.create_subscription(Log, "/rosout", lambda message: lines.append(message.msg), 1000)
    stage.add(rate=50.0)
    arm = Arm(BEGIN)
    stage.step(BEGIN - 20 * MS)
    stage.play(good(arm, BEGIN, 0.1), BEGIN + 100 * MS, 20 * MS)
    bad = [
        arm.message(BEGIN, position=[float("nan")]),
        arm.message(BEGIN, name=["elbow"]),
        arm.message(BEGIN, effort=[]),
        arm.message(BEGIN),
        arm.message(BEGIN - NANOSECONDS),
        arm.message(BEGIN + 3600 * NANOSECONDS),
        arm.message(0),
    ]
    stage.step(stage.now + 20 * MS, [Event(0, arm.message(BEGIN, name=["x" * 100_000]))])
    for _ in range(10):
        batch = [Event(0, bad[index % len(bad)]) for index in range(1000)]
        stage.step(stage.now + 20 * MS, batch)
    assert stage.counts().rejected.total() == 10_001
    stage.wait_until(lambda: any("zero stamp" in line for line in lines), "the last warning")
    rejections = [line for line in lines if "rejected" in line]
    assert {line.partition("rejected: ")[2].partition(" (")[0] for line in rejections} == {
        reason.value for reason in RejectReason if reason is not RejectReason.GATED
    }
    assert len(rejections) <= 60  # six reasons, anew after every five seconds
    assert max(map(len, lines)) < 2000
