# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bad samples and stamps between good ones: their outcome, and the way back of the estimate.

Faults of messages are in test/nodes/observer/test_io.py, those of arm and sensor in test_bank.py.
docs/faults.md lists them.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.records import Innovation, Measurement, RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.resources import FIXED_DESIGN, config_path
from tsobs_ros.series import NANOSECONDS
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

DESIGN = load_design(config_path(FIXED_DESIGN))
BEGIN, PERIOD, TICK, MS = 100 * NANOSECONDS, 5_000_000, 40_000_000, 1_000_000
SECONDS, BAD = 6, (200, 300)
"""Length of a run, and its bad samples."""


@cache
def simulated() -> Any:
    return simulate(SCENARIOS["noise"], [8], SECONDS)


class Kind(NamedTuple):
    """What a bad sample becomes, by its number; its outcome; and by how much it comes late [ns]."""

    change: Callable[[Measurement, int], Measurement] = lambda sample, _: sample
    outcome: RejectReason | None = None
    late: Callable[[int], int] = lambda k: 0


def stamped(by: Callable[[int], int]) -> Callable[[Measurement, int], Measurement]:
    return lambda sample, k: sample._replace(stamp=sample.stamp + by(k))


def angle(by: Callable[[int], float]) -> Callable[[Measurement, int], Measurement]:
    return lambda sample, k: sample._replace(y=sample.y + by(k))


def torque(factor: float) -> Callable[[Measurement, int], Measurement]:
    return lambda sample, _: sample._replace(u=factor * sample.u)


KINDS: dict[str, Kind] = {
    "clock since boot": Kind(stamped(lambda k: -BEGIN // 2), RejectReason.TOO_OLD),
    "clock ahead": Kind(stamped(lambda k: NANOSECONDS), RejectReason.FROM_FUTURE),
    "jittered stamps": Kind(stamped(lambda k: (k % 5 - 2) * MS)),
    "every fifth an outlier": Kind(angle(lambda k: 0.0 if k % 5 else 3.0 * math.sin(k))),
    "wrapped angle": Kind(angle(lambda k: math.tau)),
    "torque in other units": Kind(torque(1e3), RejectReason.IMPLAUSIBLE_TORQUE),
    "late": Kind(late=lambda k: (BAD[1] - k) * PERIOD),
}


@pytest.mark.parametrize("name", KINDS)
def test_bad_samples_have_their_outcome_and_the_estimate_recovers(name: str) -> None:
    kind, run = KINDS[name], simulated()
    events = []
    for k, (y, u) in enumerate(zip(run.measurements[0], run.torques[0], strict=False)):
        sample, arrival = Measurement(BEGIN + k * PERIOD, y, u), BEGIN + k * PERIOD
        if BAD[0] <= k < BAD[1]:
            sample, arrival = kind.change(sample, k), arrival + kind.late(k)
        events.append((arrival, sample, k))
    tracker = Tracker(DESIGN.supervised(), x_max=DESIGN.request.x_max)
    estimate, seen = None, set()
    for now in range(BEGIN, BEGIN + SECONDS * NANOSECONDS, TICK):
        arrived = [each for each in events if now - TICK < each[0] <= now]
        for _, sample, k in sorted(arrived, key=lambda event: event[1].stamp):
            outcome = tracker.offer(sample, now)
            assert not isinstance(outcome, Innovation) or np.isfinite(outcome.value).all()
            if BAD[0] <= k < BAD[1]:
                seen.add(outcome if isinstance(outcome, RejectReason) else None)
        estimate = tracker.estimate(now)
        assert estimate is None or all(np.isfinite(field).all() for field in estimate)
    # Outliers are gated, and so may be what follows a torque of other units.
    assert kind.outcome in seen
    assert seen <= {
        kind.outcome,
        RejectReason.GATED,
        None if kind.outcome is None else kind.outcome,
    }
    assert estimate is not None
    truth = run.physical[0, round((estimate.stamp - BEGIN) / PERIOD)]
    assert (np.abs(estimate.state - truth) < 4.0 * estimate.state_bound).all()
