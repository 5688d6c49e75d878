# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Events and levels as pure functions of conditions: each change once, and never a flood."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.estimation.events import Event, EventKind, EventLog
from tsobs_ros.estimation.health import Level
from tsobs_ros.estimation.records import Basis, Estimate, Hypothesis, Learning

SECOND = 1_000_000_000
BEGIN = 1_700_000_000 * SECOND
GOOD = Estimate(BEGIN, basis=Basis.CERTIFIED, learning=Learning.ACTIVE, age=0.002)


class Play:
    """Conditions a tenth of a second apart, and the events they gave."""

    def __init__(self, settled: float = 60.0) -> None:
        self.log = EventLog("/sensor", coast_after=0.1, stale_after=5.0)
        self.events: list[Event] = []
        self.now = BEGIN - SECOND // 10
        self.goes_on(settled)

    def goes_on(self, seconds: float, **changes: Any) -> list[Event]:
        """Return the events of some seconds in which the condition is changed so."""
        before = len(self.events)
        for _ in range(round(10 * seconds)):
            self.now += SECOND // 10
            self.events += self.log.update(GOOD._replace(stamp=self.now, **changes))
        return self.events[before:]

    def silent(self, seconds: float, *, live: bool = True) -> list[Event]:
        """Return the events of some seconds without measurements, as a recording has them or live.

        A recording has estimates only.
        """
        newest = self.now - 2_000_000
        end, before = self.now + round(seconds * SECOND), len(self.events)
        while self.now + SECOND // 10 <= end:
            self.now += SECOND // 10
            if self.now - newest <= 5 * SECOND:
                age = (self.now - newest) / SECOND
                self.events += self.log.update(GOOD._replace(stamp=self.now, age=age))
            elif live:
                self.events += self.log.silence(self.now)
        return self.events[before:]


def seconds(event: Event) -> float:
    return (event.stamp - BEGIN) / SECOND


def test_a_start_is_reported_in_two_lines_and_then_nothing() -> None:
    play = Play(settled=0.0)
    play.goes_on(4.0, basis=Basis.STARTING)
    play.goes_on(600.0)
    assert [(seconds(each), each.level, each.text) for each in play.events] == [
        (0.0, Level.OK, "TRACKING: measurements arrive on /sensor"),
        (4.0, Level.OK, "the bound is certified"),
    ]


def test_a_recording_which_lacks_the_silence_gives_the_same_events() -> None:
    plays = []
    for live in (True, False):
        plays.append(Play())
        for length in (20.0, 4.0, 6.0, 5.3, 7.0):
            plays[-1].silent(length, live=live)
            plays[-1].goes_on(0.5)
    there, again = (play.events[3:] for play in plays)
    assert len(there) >= 5
    assert again == there


@pytest.mark.parametrize(
    ("kind", "changes", "text", "at_once"),
    [
        (EventKind.BOUND, {"basis": Basis.GAP}, Basis.GAP.judged[1], False),
        (EventKind.BOUND, {"basis": Basis.OUTSIDE}, Basis.OUTSIDE.judged[1], True),
        (EventKind.HYPOTHESIS, {"hypothesis": Hypothesis.FORCE}, Hypothesis.FORCE.judged[1], False),
        (EventKind.NOISE, {"noise_scale": 1.5}, "the sensor's noise is 1.5 times", False),
    ],
)
def test_what_lasts_is_reported_once_and_so_is_its_end(
    kind: EventKind, changes: dict[str, Any], text: str, at_once: bool
) -> None:
    """What is over at once is not, unless the bound was void."""
    play = Play()
    begin, (event,) = play.now + SECOND // 10, play.goes_on(100.0, **changes)
    assert (event.stamp, event.kind) == (begin, kind)
    assert event.text.startswith(text)
    end, (event,) = play.now + SECOND // 10, play.goes_on(100.0)
    assert (event.stamp, event.kind, event.level) == (end, kind, Level.OK)
    for _ in range(15):
        play.goes_on(0.8, **changes)
        play.goes_on(30.0)
    assert bool(play.events[5:]) is at_once


def test_a_node_that_waits_reports_it_once_after_a_second() -> None:
    log = EventLog("/sensor", coast_after=0.1, stale_after=5.0)
    found = [
        (tick, event.text)
        for tick in range(1000)
        for event in log.silence(BEGIN + tick * SECOND // 10)
    ]
    assert found == [(10, "WAITING for the first measurement on /sensor")]
    (event,) = log.update(GOOD._replace(basis=Basis.STARTING))
    assert event.text == "TRACKING: measurements arrive on /sensor"


ESTIMATES = st.builds(
    GOOD._replace,
    noise_scale=st.floats(1.0, 3.0),
    basis=st.sampled_from(Basis),
    learning=st.sampled_from(Learning),
    hypothesis=st.sampled_from(Hypothesis),
    age=st.floats(0.0, 5.0),
)


@settings(max_examples=12, deadline=None)
@given(data=st.data())
def test_whatever_happens_there_is_no_flood_and_it_can_be_repeated(data: st.DataObject) -> None:
    some = data.draw(st.lists(ESTIMATES, min_size=1, max_size=8))
    order = data.draw(st.lists(st.integers(0, len(some) - 1), min_size=300, max_size=300))
    restarts = data.draw(st.sets(st.integers(0, 299), max_size=40))
    runs = []
    for _ in range(2):
        log, events = EventLog("/sensor", 0.1, 5.0), []
        for tick, which in enumerate(order):
            if tick in restarts:
                log.restart()
            stamp = BEGIN + (tick % 150) * SECOND // 10  # time goes back once
            if tick == 150:
                log.restart()
            events += log.update(some[which]._replace(stamp=stamp))
        runs.append(events)
    assert runs[0] == runs[1]
    for kind in EventKind:
        # The first five, and one every ten seconds of twice fifteen.
        assert sum(each.kind is kind for each in runs[0]) <= 5 + 3
