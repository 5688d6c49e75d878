# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every kind of bad sample: its outcome, and the way back of the estimate, as in a node.

Kinds that are a matter of messages are in test/nodes/observer/test_io.py, those of topics in
test/nodes/test_bad_input.py. docs/faults.md lists them.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import pytest
from staging.arm import Arm

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.records import Innovation, Measurement, RejectReason
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.resources import FIXED_DESIGN, config_path
from tsobs_ros.series import NANOSECONDS

DESIGN = load_design(config_path(FIXED_DESIGN))
BEGIN = 100 * NANOSECONDS
BOOT = 50 * NANOSECONDS
TICK = 40_000_000
MS = 1_000_000
# The node's defaults.
HISTORY, TOLERANCE, STALE_AFTER = 500 * MS, 100 * MS, 5 * NANOSECONDS
USED, JUDGED = "used", "used or gated"

Event = tuple[int, Measurement, RejectReason | str]
"""Time of arrival [ns], sample and outcome; a judged one may be used or gated."""

Write = Callable[[Arm, int], Iterator[Event]]


class Kind(NamedTuple):
    """A bad stretch between good ones, lengths in seconds."""

    write: Write
    lasts: float = 0.5
    warm_up: float = 1.0
    recovery: float = 2.0


OLD, GATED = RejectReason.TOO_OLD, RejectReason.GATED
IMPLAUSIBLE = RejectReason.IMPLAUSIBLE_TORQUE


def changed(
    change: Callable[[Measurement, int], Measurement],
    outcome: RejectReason | str,
    seconds: float = 0.5,
    arrival: Callable[[int, int, int], int] = lambda at, index, begin: at,
) -> Write:
    """Return the arm's samples, each changed by its index, by default arriving at their time."""

    def write(arm: Arm, begin: int) -> Iterator[Event]:
        for index, at in enumerate(arm.stamps(begin, seconds)):
            yield arrival(at, index, begin), change(arm.measurement(at), index), outcome

    return write


def same(sample: Measurement, _: int) -> Measurement:
    return sample


def stamped(
    stamp: Callable[[int, int], int], outcome: RejectReason | str, seconds: float = 0.5
) -> Write:
    return changed(lambda s, k: s._replace(stamp=stamp(s.stamp, k)), outcome, seconds)


def angle(
    value: Callable[[float, int], float], outcome: RejectReason | str = JUDGED, seconds: float = 0.5
) -> Write:
    return changed(lambda s, k: s._replace(y=np.array([value(s.y[0], k)])), outcome, seconds)


def torque(
    value: Callable[[float, int], float], outcome: RejectReason | str = JUDGED, seconds: float = 0.5
) -> Write:
    return changed(lambda s, k: s._replace(u=np.array([value(s.u[0], k)])), outcome, seconds)


def twice(second: Callable[[Measurement, Arm], Measurement], outcome: RejectReason) -> Write:
    """Return the arm's samples, each followed by another."""

    def write(arm: Arm, begin: int) -> Iterator[Event]:
        for at in arm.stamps(begin, 0.5):
            sample = arm.measurement(at)
            yield at, sample, USED
            yield at, second(sample, arm), outcome

    return write


def absent(arm: Arm, begin: int) -> Iterator[Event]:
    return iter(())


def burst(arm: Arm, begin: int) -> Iterator[Event]:
    rng, at = np.random.default_rng(5), begin + NANOSECONDS
    for stamp in range(begin, at, 200_000):
        # The arm's own samples are 5 ms apart; the very same angle again would be a stuck sensor.
        sample = arm.measurement(stamp)
        stale = stamp < at - HISTORY
        yield at, sample._replace(y=sample.y + rng.normal(0.0, 0.01)), JUDGED if stale else USED


def stuck_angle(arm: Arm, begin: int) -> Iterator[Event]:
    frozen = arm.measurement(begin - arm.period).y
    for index, stamp in enumerate(arm.stamps(begin, 1.0)):
        outcome = JUDGED if index < 9 else GATED
        yield stamp, arm.measurement(stamp)._replace(y=frozen), outcome


KINDS: dict[str, Kind] = {
    "gap of minutes": Kind(absent, lasts=160.0, recovery=3.0),
    "just inside the tolerance": Kind(stamped(lambda at, k: at + TOLERANCE, JUDGED, 0.005)),
    "clock since boot": Kind(stamped(lambda at, k: BOOT + k * 5 * MS, OLD)),
    "first ever since boot": Kind(
        stamped(lambda at, k: BOOT + k * 5 * MS, JUDGED), warm_up=0.0, recovery=3.0
    ),
    "jittered stamps": Kind(stamped(lambda at, k: at + (k % 5 - 2) * MS, JUDGED)),
    "every fifth an outlier": Kind(angle(lambda y, k: y if k % 5 else y + 3.0 * math.sin(k))),
    "jump": Kind(angle(lambda y, k: y + 0.3, JUDGED, 3.0), lasts=3.0, warm_up=9.0, recovery=3.0),
    "wrapped angle": Kind(angle(lambda y, k: y + math.tau, JUDGED, 1.0), lasts=1.0, recovery=5.0),
    "wrong level of the torque": Kind(torque(lambda u, k: u + 10.0), warm_up=9.0, recovery=5.0),
    "torque in other units": Kind(torque(lambda u, k: 1e3 * u, IMPLAUSIBLE)),
    "burst of 5000": Kind(burst, lasts=1.0),
    "late by a second": Kind(
        changed(same, USED, 2.0, lambda at, k, begin: min(at, begin + NANOSECONDS) + NANOSECONDS),
        lasts=2.0,
    ),
    "older than the history": Kind(
        twice(lambda sample, arm: arm.measurement(sample.stamp - 2 * HISTORY), OLD)
    ),
    "stuck angle": Kind(stuck_angle, lasts=1.0),
}


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
    # A sample of a bad stretch may leave the estimate so lost that good ones are gated too, or a
    # step so doubtful that good torques are not used.
    judged = any(wanted == JUDGED for wanted, _ in seen)
    assert {
        (wanted, outcome)
        for wanted, outcome in seen
        if wanted != outcome
        and not (judged and {wanted, outcome} <= {JUDGED, USED, GATED, IMPLAUSIBLE})
    } == set()
    assert tracker.used + tracker.rejected.total() == len(events)
    assert estimate is not None
    error = np.abs(estimate.state - arm.truth(estimate.stamp))
    assert (error < 4.0 * estimate.state_bound).all()
