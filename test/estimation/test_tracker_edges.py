# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Edges of the tracker: enormous numbers, gaps bridged late, no history at all."""

from typing import Any

import numpy as np
import pytest

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.records import Measurement, RejectReason
from tsobs_ros.estimation.supervised import SupervisedObserver
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

DESIGN = load_design(config_path("elastic_joint.design.yaml"))
RUN = simulate(SCENARIOS["noise"], [1], 15.0)
PERIOD, BEGIN, END = 5_000_000, 10**11, 10**18


def tracker(**options):
    return Tracker(SupervisedObserver(DESIGN.observer()), TrackerOptions(x_max=0.75, **options))


def sample(k, stamp=None):
    return Measurement(stamp or BEGIN + k * PERIOD, RUN.measurements[0, k], RUN.torques[0, k])


@pytest.mark.parametrize("size", [16.0, 1e6])
def test_one_outlier_of_any_size_does_little_harm(size):
    t = tracker()
    for k in range(2600):
        m = sample(k)
        if k == 2500:
            m = m._replace(y=np.array([size]))
        t.offer(m, END)
        if k >= 2500:
            e = t.estimate(m.stamp)
            error = np.abs(e.state - DESIGN.request.arm.to_physical(RUN.states[0, k]))
            assert (error < 6 * e.state_bound).all(), (k, error)
    assert t.events["losses of track"] == 0


def test_a_late_sample_that_bridges_a_gap_counts_as_in_order():
    second = 10**9
    stamps = [BEGIN, BEGIN + int(4.9 * second), BEGIN + int(5.2 * second)]
    in_order, late = tracker(), tracker()
    for k in (0, 1, 2):
        in_order.offer(sample(k, stamps[k]), END)
    for k in (0, 2, 1):
        late.offer(sample(k, stamps[k]), END)
    a, b = in_order.estimate(stamps[2]), late.estimate(stamps[2])
    assert (a.state == b.state).all()
    assert in_order.restarts == late.restarts


def test_history_longer_than_restart_after_rewinds_as_in_order():
    options = {"history": 10.0, "restart_after": 1.0}
    second = 10**9
    a, b = tracker(**options), tracker(**options)
    first = [sample(k) for k in range(3)]
    second_part = [sample(k, BEGIN + 3 * second + k * PERIOD) for k in range(3)]
    for m in first + second_part:
        a.offer(m, END)
    for m in second_part + first:
        b.offer(m, END)
    stamp = BEGIN + 4 * second
    assert (a.estimate(stamp).state == b.estimate(stamp).state).all()


def test_without_history_a_sample_ahead_of_the_clock_does_not_silence_the_estimates():
    t = tracker(history=0.0)
    for k in range(3):
        t.offer(sample(k), BEGIN + k * PERIOD - 1)
    assert t.estimate(BEGIN + 2 * PERIOD - 1) is not None


def test_a_burst_of_dense_stamps_takes_neither_memory_nor_a_rewind_without_bound():
    dense = 10_000
    t = tracker(max_steps=50)
    for k in range(200):
        t.offer(sample(k, BEGIN + k * dense), END)
    assert t.forgotten == 150
    assert len(t._history._steps) == 50
    assert t.offer(sample(7, BEGIN + 149 * dense), END) is RejectReason.TOO_OLD
    inside = sample(7, BEGIN + 170 * dense + 1)
    assert not isinstance(t.offer(inside, END), RejectReason)
    assert t.rewinds == 1
    assert len(t._history._steps) == 50


def test_what_a_full_history_still_reaches_is_put_in_its_place():
    order = [*range(120), 121, 122, 120]
    in_order, late = tracker(max_steps=50), tracker(max_steps=50)
    for k in sorted(order):
        in_order.offer(sample(k), END)
    for k in order:
        late.offer(sample(k), END)
    stamp = BEGIN + 123 * PERIOD
    assert (in_order.estimate(stamp).state == late.estimate(stamp).state).all()


@pytest.mark.parametrize("ahead", [5 * 10**9 + 1, 3600 * 10**9, 10**18])
def test_an_estimate_far_from_any_measurement_is_none_and_costs_nothing(ahead):
    t = tracker()
    t.offer(sample(0), END)
    assert t.estimate(BEGIN + 5 * 10**9) is not None
    assert t.estimate(BEGIN + ahead) is None
    assert t.failures == 0


class Fails:
    """An estimator that raises what numbers raise, in one of its steps and after so many calls."""

    def __init__(self, step: str, after: int, error: Exception) -> None:
        self._inner: Any = DESIGN.supervised()
        self._step, self._left, self._error = step, after, error

    def __getattr__(self, name: str) -> Any:
        if name == self._step:
            self._left -= 1
            if self._left < 0:
                raise self._error
        return getattr(self._inner, name)


@pytest.mark.parametrize("error", [OverflowError("too large"), np.linalg.LinAlgError("singular")])
@pytest.mark.parametrize("step", ["predict", "correct", "extrapolate", "readout"])
def test_what_numbers_raise_is_a_failure_like_those_that_are_not_finite(
    step: str, error: Exception
) -> None:
    tracker = Tracker(Fails(step, 20, error), TrackerOptions(x_max=1.0))
    outcomes, estimates = [], []
    for index in range(1, 31):
        given = Measurement(index * 5_000_000, np.array([0.01 * index]), np.array([0.1]))
        outcomes.append(tracker.offer(given, END))
        estimates.append(tracker.estimate(index * 5_000_000 + 1_000_000))
    assert tracker.failures > 0
    if step in ("extrapolate", "readout"):
        assert None not in estimates[:20]
        assert estimates[20:] == [None] * 10
        assert tracker.restarts == 0
    else:
        assert tracker.restarts == tracker.failures
        assert None not in estimates
    # Where not even a fresh start can take the sample, it is not used.
    assert outcomes[20:].count(RejectReason.GATED) == (10 if step == "correct" else 0)
    assert tracker.used == 30 - tracker.rejected.total()


def test_a_coasting_estimate_that_fails_is_none_and_a_failure() -> None:
    tracker = Tracker(Fails("predict", 0, OverflowError()), TrackerOptions(x_max=1.0))
    tracker.offer(Measurement(10**9, np.array([0.1]), np.array([0.1])), END)
    assert tracker.estimate(2 * 10**9) is None
    assert tracker.failures == 1
