# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whatever a random stream brings, the tracker's books balance and its numbers are numbers."""

import gc
import tracemalloc
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from staging.arm import Arm
from staging.streams import Arrival, Mix, arrivals, mixes

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.records import NANOSECONDS, Innovation, RejectReason
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path

DESIGN = load_design(config_path(FIXED_DESIGN))
ADAPTIVE = load_design(config_path(SHIPPED_DESIGN))
BEGIN = 100 * NANOSECONDS
TICK = 20_000_000
PROPERTY = settings(max_examples=3)
MANY = 600


def tracker(design: Any = DESIGN) -> Tracker:
    return Tracker(design.supervised(), TrackerOptions(x_max=design.request.x_max))


def bits(record: Any) -> Any:
    """Return a record with its arrays as bytes, so that equal means equal to the last bit."""
    if record is None or isinstance(record, RejectReason):
        return record
    return tuple(item.tobytes() if isinstance(item, np.ndarray) else item for item in record)


def fed(tracker: Tracker, stream: list[Arrival]) -> list[Any]:
    """Offer a stream, ask for the estimate at every tick, and return the bits of all answers.

    As the node does, it asks for none once the newest measurement is older than five seconds.
    """
    answers, tick = [], stream[0].at
    for at, measurement in stream:
        while tick < at:
            newest = tracker.newest
            if newest is not None and tick - newest <= 5 * NANOSECONDS:
                estimate = tracker.estimate(tick)
                assert estimate is None or all(np.isfinite(field).all() for field in estimate)
                answers.append(bits(estimate))
            tick += TICK
        if measurement is None:
            tracker.reject(RejectReason.WRONG_JOINT)
            continue
        outcome = tracker.offer(measurement, at)
        if isinstance(outcome, Innovation):
            assert np.isfinite(outcome.value).all()
            assert np.isfinite(outcome.expected_std).all()
        answers.append(bits(outcome))
    return answers


def books(tracker: Tracker) -> list[Any]:
    names = ("used", "rejected", "rewinds", "restarts", "failures", "events", "newest")
    return [getattr(tracker, name) for name in names]


@PROPERTY
@given(mix=mixes(), other=mixes(), adaptive=st.booleans())
def test_the_books_balance_and_a_reset_tracker_is_a_new_one(
    mix: Mix, other: Mix, adaptive: bool
) -> None:
    used, fresh = (tracker(ADAPTIVE if adaptive else DESIGN) for _ in range(2))
    arm = Arm(BEGIN)
    with np.errstate(all="ignore"):
        fed(used, arrivals(mix, arm, BEGIN, MANY))
        assert used.used + used.rejected.total() == MANY
        assert used.used > 0
        used.reset()
        stream = arrivals(other, arm, BEGIN + NANOSECONDS, MANY)
        assert fed(used, stream) == fed(fresh, stream)
    assert books(used) == books(fresh)


def test_memory_does_not_grow_with_the_stream() -> None:
    mix = Mix(seed=3, weights=(20, 1, 1, 1, 1, 1, 2, 1, 4, 1, 1), period=5_000_000, bias=0.0)
    arm, long_running = Arm(BEGIN), tracker()
    stream = arrivals(mix, arm, BEGIN, 3000)
    sizes = []
    tracemalloc.start()
    try:
        with np.errstate(all="ignore"):
            for first in range(0, 3000, 1000):
                for at, measurement in stream[first : first + 1000]:
                    if measurement is not None:
                        long_running.offer(measurement, at)
                gc.collect()
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    # A third of the stream, if it were kept, would be megabytes.
    assert abs(sizes[2] - sizes[1]) < 100_000, sizes
