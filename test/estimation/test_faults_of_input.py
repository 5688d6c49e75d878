# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bad samples and stamps between good ones: their outcome, and the way back of the estimate.

Faults of messages are in test/nodes/observer/test_io.py, those of arm and sensor in test_bank.py.
docs/faults.md lists them.
"""

import math
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from staging.stage import PERIOD, Arm

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.records import Innovation, Measurement, RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.resources import FIXED_DESIGN, config_path
from tsobs_ros.series import NANOSECONDS

DESIGN = load_design(config_path(FIXED_DESIGN))
BEGIN, BOOT = 100 * NANOSECONDS, 50 * NANOSECONDS
TICK, MS = 40_000_000, 1_000_000
# The node's defaults.
TOLERANCE, STALE_AFTER = 100 * MS, 5 * NANOSECONDS
USED, JUDGED = "used", "used or gated"

Event = tuple[int, Measurement, RejectReason | str]
"""Time of arrival [ns], sample and outcome; a judged one may be used or gated."""


class Kind(NamedTuple):
    """What a sample becomes, by its index, its outcome, when it arrives, and lengths in seconds."""

    change: Callable[[Measurement, int], Measurement]
    outcome: RejectReason | str = JUDGED
    arrival: Callable[[int, int], int] = lambda at, begin: at
    samples: float = 0.5
    lasts: float = 0.5
    warm_up: float = 1.0
    recovery: float = 2.0


def stamped(stamp: Callable[[int, int], int]) -> Callable[[Measurement, int], Measurement]:
    return lambda sample, k: sample._replace(stamp=stamp(sample.stamp, k))


def angle(change: Callable[[int], float]) -> Callable[[Measurement, int], Measurement]:
    return lambda sample, k: sample._replace(y=sample.y + change(k))


def since_boot(sample: Measurement, k: int) -> Measurement:
    return sample._replace(stamp=BOOT + k * 5 * MS)


KINDS: dict[str, Kind] = {
    "gap of minutes": Kind(angle(lambda k: 0.0), samples=0.0, lasts=160.0, recovery=3.0),
    "just inside the tolerance": Kind(stamped(lambda at, k: at + TOLERANCE), samples=0.005),
    "clock since boot": Kind(since_boot, RejectReason.TOO_OLD),
    "first ever since boot": Kind(since_boot, warm_up=0.0, recovery=3.0),
    "jittered stamps": Kind(stamped(lambda at, k: at + (k % 5 - 2) * MS)),
    "every fifth an outlier": Kind(angle(lambda k: 0.0 if k % 5 else 3.0 * math.sin(k))),
    "wrapped angle": Kind(angle(lambda k: math.tau), samples=1.0, lasts=1.0, recovery=5.0),
    "torque in other units": Kind(
        lambda sample, k: sample._replace(u=1e3 * sample.u), RejectReason.IMPLAUSIBLE_TORQUE
    ),
    # A whole second at once, of which half is too old.
    "burst": Kind(angle(lambda k: 0.0), arrival=lambda at, begin: begin + NANOSECONDS, samples=1.0,
                  lasts=1.0),
    "late by a second": Kind(
        angle(lambda k: 0.0), USED,
        lambda at, begin: min(at, begin + NANOSECONDS) + NANOSECONDS, samples=2.0, lasts=2.0,
    ),
}  # fmt: skip


def stamps(begin: int, seconds: float) -> range:
    return range(begin, begin + round(seconds * NANOSECONDS), PERIOD)


def script(arm: Arm, kind: Kind) -> list[Event]:
    """Return all samples from the arm's first on, in the order of arrival."""
    bad_from = BEGIN + round(kind.warm_up * NANOSECONDS)
    good_from = bad_from + round(kind.lasts * NANOSECONDS)
    good = [*stamps(BEGIN, kind.warm_up), *stamps(good_from, kind.recovery)]
    events: list[Event] = [(at, arm.measurement(at), USED) for at in good]
    for index, at in enumerate(stamps(bad_from, kind.samples)):
        sample = kind.change(arm.measurement(at), index)
        events.append((kind.arrival(at, bad_from), sample, kind.outcome))
    return sorted(events, key=lambda event: event[0])


@pytest.mark.parametrize("name", KINDS)
def test_bad_samples_have_their_outcome_and_the_estimate_recovers(name: str) -> None:
    arm, kind = Arm(BEGIN), KINDS[name]
    tracker = Tracker(DESIGN.supervised(), x_max=DESIGN.request.x_max)
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
    allowed = {JUDGED, USED, RejectReason.GATED, RejectReason.IMPLAUSIBLE_TORQUE}
    for wanted, outcome in seen:
        is_judged = kind.outcome == JUDGED and {wanted, outcome} <= allowed
        assert wanted == outcome or is_judged, (wanted, outcome)
    assert tracker.used + tracker.rejected.total() == len(events)
    assert estimate is not None
    error = np.abs(estimate.state - arm.truth(estimate.stamp))
    assert (error < 4.0 * estimate.state_bound).all()
