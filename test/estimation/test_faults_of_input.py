# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every kind of bad sample: its outcome, and the way back of the estimate, as in a node.

Kinds that are a matter of messages are in test/nodes/observer/test_io.py, those of topics in
test/nodes/test_bad_input.py. docs/robustness.md lists them all.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from faults.arm import Arm

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.records import NANOSECONDS, Innovation, Measurement, RejectReason
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

DESIGN = load_design(config_path(SHIPPED_DESIGN))
PAGE = Path(__file__).resolve().parents[2] / "docs" / "robustness.md"
BEGIN = 100 * NANOSECONDS
BOOT = 50 * NANOSECONDS
TICK = 40_000_000
MS = 1_000_000
# The node's defaults.
HISTORY, TOLERANCE, STALE_AFTER = 500 * MS, 100 * MS, 5 * NANOSECONDS
LARGEST, SMALLEST = 1.7976931348623157e308, 5e-324
USED, JUDGED = "used", "used or gated"

Event = tuple[int, Measurement, RejectReason | str]
"""Time of arrival [ns], sample and outcome; a judged one may be used or gated."""

Write = Callable[[Arm, int], Iterator[Event]]


class Kind(NamedTuple):
    """A bad stretch between good ones, lengths in seconds."""

    write: Write
    lasts: float
    warm_up: float
    recovery: float


KINDS: dict[str, Kind] = {}


def kind(name: str, *, lasts: float = 0.5, warm_up: float = 1.0, recovery: float = 2.0) -> Callable:
    def enter(write: Write) -> Write:
        KINDS[name] = Kind(write, lasts, warm_up, recovery)
        return write

    return enter


def changed(
    change: Callable[[Measurement, int], Measurement],
    outcome: RejectReason | str,
    seconds: float = 0.5,
) -> Write:
    """Return the arm's samples at their time, each changed by its index."""

    def write(arm: Arm, begin: int) -> Iterator[Event]:
        for index, at in enumerate(arm.stamps(begin, seconds)):
            yield at, change(arm.measurement(at), index), outcome

    return write


def stamped(stamp_of: Callable[[int, int], int]) -> Callable[[Measurement, int], Measurement]:
    return lambda sample, index: sample._replace(stamp=stamp_of(sample.stamp, index))


def angle(*angles: float) -> Callable[[Measurement, int], Measurement]:
    return lambda sample, index: sample._replace(y=np.array([angles[index % len(angles)]]))


def torque(*torques: float) -> Callable[[Measurement, int], Measurement]:
    return lambda sample, index: sample._replace(u=np.array([torques[index % len(torques)]]))


def off(by: Callable[[int], float]) -> Callable[[Measurement, int], Measurement]:
    return lambda sample, index: sample._replace(y=sample.y + by(index))


def noise_of(index: int) -> float:
    return float(np.random.default_rng(index).normal(0.0, 0.2))


FUTURE, OLD = RejectReason.FROM_FUTURE, RejectReason.TOO_OLD
ZERO, NON_FINITE = RejectReason.ZERO_STAMP, RejectReason.NON_FINITE
DUPLICATE, GATED = RejectReason.DUPLICATE, RejectReason.GATED
ABSENT: Write = lambda arm, begin: iter(())  # noqa: E731

for name, write, options in (
    ("gap of a second", ABSENT, {"lasts": 1.0}),
    ("gap of minutes", ABSENT, {"lasts": 160.0, "recovery": 3.0}),
    ("zero stamp", changed(stamped(lambda at, k: 0), ZERO), {}),
    ("negative stamp", changed(stamped(lambda at, k: 1 - 5 * NANOSECONDS), ZERO), {}),
    ("most nanoseconds", changed(stamped(lambda at, k: at + 2**32), FUTURE), {}),
    ("end of time", changed(stamped(lambda at, k: 2**31 * NANOSECONDS), FUTURE), {}),
    ("an hour ahead", changed(stamped(lambda at, k: at + 3600 * NANOSECONDS), FUTURE), {}),
    (
        "just inside the tolerance",
        changed(stamped(lambda at, k: at + TOLERANCE), JUDGED, 0.005),
        {},
    ),
    (
        "just outside the tolerance",
        changed(stamped(lambda at, k: at + TOLERANCE + TICK), FUTURE),
        {},
    ),
    ("clock since boot", changed(stamped(lambda at, k: BOOT + k * 5 * MS), OLD), {}),
    (
        "first ever since boot",
        changed(stamped(lambda at, k: BOOT + k * 5 * MS), JUDGED),
        {"warm_up": 0.0, "recovery": 3.0},
    ),
    ("jittered stamps", changed(stamped(lambda at, k: at + (k % 5 - 2) * MS), JUDGED), {}),
    ("nan angle", changed(angle(math.nan), NON_FINITE), {}),
    ("infinite angle", changed(angle(math.inf, -math.inf), NON_FINITE), {}),
    ("nan torque", changed(torque(math.nan), NON_FINITE), {}),
    ("infinite torque", changed(torque(math.inf, -math.inf), NON_FINITE), {}),
    ("largest angle", changed(angle(LARGEST, -LARGEST), JUDGED), {}),
    ("largest torque", changed(torque(LARGEST, -LARGEST), JUDGED, 0.05), {}),
    (
        "denormal numbers",
        changed(lambda s, k: angle(SMALLEST)(torque(-SMALLEST)(s, k), k), JUDGED, 0.025),
        {"recovery": 3.0},
    ),
    ("single outlier", changed(off(lambda k: 1.0), JUDGED, 0.005), {}),
    (
        "every fifth an outlier",
        changed(off(lambda k: 0.0 if k % 5 else 3.0 * math.sin(k)), JUDGED),
        {},
    ),
    (
        "jump",
        changed(off(lambda k: 0.3), JUDGED, 3.0),
        {"warm_up": 9.0, "lasts": 3.0, "recovery": 3.0},
    ),
    ("short jump", changed(off(lambda k: 0.3), JUDGED), {"warm_up": 9.0, "recovery": 10.0}),
    (
        "wrapped angle",
        changed(off(lambda k: math.tau), JUDGED, 1.0),
        {"lasts": 1.0, "recovery": 5.0},
    ),
    (
        "degrees",
        changed(lambda s, k: s._replace(y=np.degrees(s.y)), JUDGED, 1.0),
        {"lasts": 1.0, "recovery": 5.0},
    ),
    ("noise", changed(off(noise_of), JUDGED, 1.0), {"lasts": 1.0, "recovery": 5.0}),
    ("torque steps", changed(torque(1e6, -1e6), JUDGED), {"recovery": 5.0}),
    (
        "torque in other units",
        changed(lambda s, k: s._replace(u=1e3 * s.u), JUDGED),
        {"recovery": 5.0},
    ),
):
    kind(name, **options)(write)


@kind("burst of 5000", lasts=1.0)
def burst(arm: Arm, begin: int) -> Iterator[Event]:
    rng, at = np.random.default_rng(5), begin + NANOSECONDS
    for stamp in range(begin, at, 200_000):
        # The arm's own samples are 5 ms apart; the very same angle again would be a stuck sensor.
        sample = arm.measurement(stamp)
        stale = stamp < at - HISTORY
        yield at, sample._replace(y=sample.y + rng.normal(0.0, 0.01)), JUDGED if stale else USED


@kind("held up", lasts=1.0)
def held_up(arm: Arm, begin: int) -> Iterator[Event]:
    for stamp in arm.stamps(begin, 1.0):
        yield begin + NANOSECONDS, arm.measurement(stamp), USED


@kind("late by a second", lasts=2.0)
def late_by_a_second(arm: Arm, begin: int) -> Iterator[Event]:
    for stamp in arm.stamps(begin, 2.0):
        yield min(stamp, begin + NANOSECONDS) + NANOSECONDS, arm.measurement(stamp), USED


@kind("late in turn", lasts=1.0)
def late_in_turn(arm: Arm, begin: int) -> Iterator[Event]:
    for index, stamp in enumerate(arm.stamps(begin, 0.7)):
        yield stamp + index % 2 * 300 * MS, arm.measurement(stamp), USED


@kind("every tenth alone", lasts=2.0)
def every_tenth_alone(arm: Arm, begin: int) -> Iterator[Event]:
    for stamp in list(arm.stamps(begin, 2.0))[::10]:
        yield stamp, arm.measurement(stamp), USED


@kind("same again")
def same_again(arm: Arm, begin: int) -> Iterator[Event]:
    for stamp in arm.stamps(begin, 0.5):
        yield stamp, arm.measurement(stamp), USED
        yield stamp, arm.measurement(stamp), DUPLICATE


@kind("same stamp other value")
def same_stamp_other_value(arm: Arm, begin: int) -> Iterator[Event]:
    for stamp in arm.stamps(begin, 0.5):
        sample = arm.measurement(stamp)
        yield stamp, sample, USED
        yield stamp, sample._replace(y=np.ones(1)), DUPLICATE


@kind("stopped clock")
def stopped_clock(arm: Arm, begin: int) -> Iterator[Event]:
    for stamp in arm.stamps(begin, 0.3):
        sample = arm.measurement(stamp)._replace(stamp=begin - arm.period)
        yield stamp, sample, DUPLICATE


@kind("out of order")
def out_of_order(arm: Arm, begin: int) -> Iterator[Event]:
    stamps = list(arm.stamps(begin, 0.5))
    for first in range(0, len(stamps), 20):
        block = stamps[first : first + 20]
        for stamp in reversed(block):
            yield block[-1], arm.measurement(stamp), USED


@kind("older than the history")
def older_than_the_history(arm: Arm, begin: int) -> Iterator[Event]:
    for stamp in arm.stamps(begin, 0.5):
        yield stamp, arm.measurement(stamp), USED
        yield stamp, arm.measurement(stamp - 2 * HISTORY), OLD


@kind("two clocks in turn")
def two_clocks_in_turn(arm: Arm, begin: int) -> Iterator[Event]:
    for index, stamp in enumerate(arm.stamps(begin, 0.5)):
        sample = arm.measurement(stamp)
        if index % 2 == 0:
            yield stamp, sample, USED
        elif index % 4 == 1:
            yield stamp, sample._replace(stamp=BOOT + index), OLD
        else:
            yield stamp, sample._replace(stamp=stamp + 7200 * NANOSECONDS), FUTURE


@kind("stuck angle", lasts=1.0)
def stuck_angle(arm: Arm, begin: int) -> Iterator[Event]:
    frozen = arm.measurement(begin - arm.period).y
    for index, stamp in enumerate(arm.stamps(begin, 1.0)):
        outcome = JUDGED if index < 9 else GATED
        yield stamp, arm.measurement(stamp)._replace(y=frozen), outcome


def script(arm: Arm, kind: Kind) -> list[Event]:
    """Return all samples from the arm's first on, in the order of arrival."""
    bad_from = BEGIN + round(kind.warm_up * NANOSECONDS)
    good_from = bad_from + round(kind.lasts * NANOSECONDS)

    def good(begin: int, seconds: float) -> Iterator[Event]:
        return ((at, arm.measurement(at), USED) for at in arm.stamps(begin, seconds))

    events = [
        *good(BEGIN, kind.warm_up),
        *kind.write(arm, bad_from),
        *good(good_from, kind.recovery),
    ]
    return sorted(events, key=lambda event: event[0])


def test_the_page_lists_every_kind() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert [name for name in KINDS if f"| {name} |" not in page] == []


@pytest.mark.parametrize("name", KINDS)
def test_bad_samples_have_their_outcome_and_the_estimate_recovers(name: str) -> None:
    arm, kind = Arm(BEGIN), KINDS[name]
    tracker = Tracker(DESIGN.supervised(), TrackerOptions(x_max=DESIGN.request.x_max))
    events = script(arm, kind)
    seen: Counter[tuple[RejectReason | str, RejectReason | str]] = Counter()
    estimate, place = None, 0
    for now in range(BEGIN, events[-1][0] + TICK, TICK):
        arrived = place
        while arrived < len(events) and events[arrived][0] <= now:
            arrived += 1
        for _, sample, wanted in sorted(events[place:arrived], key=lambda e: e[1].stamp):
            outcome = tracker.offer(sample, now)
            assert not isinstance(outcome, Innovation) or np.isfinite(outcome.value).all()
            seen[wanted, USED if isinstance(outcome, Innovation) else outcome] += 1
        place = arrived
        if tracker.newest is not None and now - tracker.newest <= STALE_AFTER:
            estimate = tracker.estimate(now)
            assert estimate is None or all(np.isfinite(field).all() for field in estimate)
    # A sample of a bad stretch may leave the estimate so lost that good ones are gated too.
    judged = any(wanted == JUDGED for wanted, _ in seen)
    assert {
        (wanted, outcome)
        for wanted, outcome in seen
        if wanted != outcome and not (judged and {wanted, outcome} <= {JUDGED, USED, GATED})
    } == set()
    assert tracker.used + tracker.rejected.total() == len(events)
    assert estimate is not None
    error = np.abs(estimate.state - arm.truth(estimate.stamp))
    assert (error < 4.0 * estimate.state_bound).all()
