# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Gaps in the measurements, during which the torque goes on changing as u = sin t."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from tsobs_ros.checks import Array
from tsobs_ros.design.file import load_design, load_request
from tsobs_ros.design.record import Design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import certified_estimator
from tsobs_ros.estimation.options import CertifiedGain
from tsobs_ros.estimation.records import NANOSECONDS, Basis, Estimate, Measurement, RejectReason
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.model.flow import GapFlow
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

DESIGN = load_design(config_path(FIXED_DESIGN))
ADAPTIVE = load_design(config_path(SHIPPED_DESIGN))
SCENARIO = SCENARIOS["noise"]
STARTS = [1800, 1920, 2040, 2160]
"""Samples at which the gap begins in each run: at four parts of the torque's turn."""
RUN = simulate(SCENARIO, list(range(len(STARTS))), 16.0)
TRUTH = SCENARIO.arm.to_physical(RUN.states)
T = DESIGN.request.period
PERIOD, BEGIN = round(T * NANOSECONDS), 10**12


def stamp_of(index: int) -> int:
    return BEGIN + index * PERIOD


def sample(run: int, index: int) -> Measurement:
    return Measurement(stamp_of(index), RUN.measurements[run, index], RUN.torques[run, index])


def tracker_of(design: Design, torque_rate: float = 1.0) -> Tracker:
    return Tracker(design.supervised(torque_rate=torque_rate), TrackerOptions(design.request.x_max))


def feed(tracker: Tracker, run: int, begin: int, end: int) -> None:
    for index in range(begin, end):
        tracker.offer(sample(run, index), stamp_of(index))


def estimate(tracker: Tracker, index: int) -> Estimate:
    found = tracker.estimate(stamp_of(index))
    assert found is not None
    return found


def sigmas(found: Estimate, run: int, index: int) -> Array:
    return np.abs(found.state - TRUTH[run, index]) / found.state_bound


@pytest.mark.parametrize("design", [DESIGN, ADAPTIVE], ids=["shipped", "adaptive"])
def test_the_bound_covers_the_error_in_gaps_and_after_them(design: Design) -> None:
    """Of 0.02 to 3 s; and it is not called certified before the covariance is covered."""
    settled = {}
    for run, begin in enumerate(STARTS):
        tracker = tracker_of(design)
        feed(tracker, run, 0, begin)
        settled[run] = estimate(tracker, begin - 1).certified, tracker
    for gap in (4, 40, 200, 600):
        errors = []
        for run, begin in enumerate(STARTS):
            certified, before = settled[run]
            assert certified == (design is DESIGN)
            tracker = before.copy()
            again = begin + gap
            for index in range(begin + 2, again, max(1, gap // 10)):
                found = estimate(tracker, index)
                assert not found.certified
                errors.append(sigmas(found, run, index))
            for index in range(again, again + 200):
                feed(tracker, run, index, index + 1)
                if (index - again) % 10 == 0:
                    found = estimate(tracker, index)
                    assert tracker.state is not None
                    covered = bool(tracker.state.certified)
                    assert found.certified == (covered and design is DESIGN)
                    errors.append(sigmas(found, run, index))
        assert np.median(np.max(errors, axis=1)) < 2.0
        assert np.quantile(errors, 0.95) < 3.0


def test_a_torque_that_is_taken_to_hold_leaves_the_bound_as_it_was() -> None:
    held, moving = tracker_of(DESIGN, 0.0), tracker_of(DESIGN)
    for tracker in (held, moving):
        feed(tracker, 0, 0, 1800)
    for index in (1800, 1900, 2000):
        one, other = estimate(held, index), estimate(moving, index)
        np.testing.assert_allclose(one.state, other.state, rtol=1e-9, atol=1e-12)
        assert (one.state_bound <= other.state_bound).all()
    assert (estimate(held, 2000).state_bound < 0.3 * estimate(moving, 2000).state_bound).all()


def test_without_gaps_nothing_of_it_is_computed() -> None:
    held, moving = tracker_of(DESIGN, 0.0), tracker_of(DESIGN)
    for index in range(600):
        one = held.offer(sample(0, index), stamp_of(index))
        other = moving.offer(sample(0, index), stamp_of(index))
        assert str(one) == str(other)
        ends = estimate(held, index + 1), estimate(moving, index + 1)
        assert ends[0].state.tobytes() == ends[1].state.tobytes()
        assert ends[0].state_bound.tobytes() == ends[1].state_bound.tobytes()
    assert moving.state is not None
    assert not moving.state.in_gap
    assert not moving.state.records["covariance"][0, 5:].any()


@pytest.mark.parametrize("design", [DESIGN, ADAPTIVE], ids=["shipped", "adaptive"])
def test_a_late_sample_widens_the_bound_by_its_factor_and_a_missing_one_voids_its_name(
    design: Design,
) -> None:
    errors = []
    for run, begin in enumerate(STARTS):
        tracker = tracker_of(design)
        feed(tracker, run, 0, begin)
        due, late = estimate(tracker, begin), estimate(tracker, begin + 1)
        assert due.basis is late.basis is (Basis.CERTIFIED if design is DESIGN else Basis.LEARNT)
        assert (due.state_bound < late.state_bound).all()
        if design is DESIGN:
            expected = design.late_factor * due.state_bound
            np.testing.assert_allclose(late.state_bound, expected, rtol=1e-12)
        missing = tracker.estimate(stamp_of(begin + 1) + 1)
        assert missing is not None
        assert missing.basis is Basis.GAP
        errors.append(sigmas(late, run, begin + 1))
    assert np.max(errors) < 3.0


def test_a_torque_is_known_even_if_its_angle_is_not_used() -> None:
    """A sensor that is stuck after a gap: no gap any more, only no angle."""
    tracker = tracker_of(DESIGN)
    feed(tracker, 0, 0, 1000)
    stuck = RUN.measurements[0, 999]
    outcomes = []
    for index in (*range(1000, 1030), *range(1060, 1090)):
        given = Measurement(stamp_of(index), stuck, RUN.torques[0, index])
        outcomes.append(tracker.offer(given, stamp_of(index)))
        assert tracker.state is not None
        assert not tracker.state.in_gap
    assert outcomes[-30:] == [RejectReason.GATED] * 30
    assert not estimate(tracker, 1090).certified


def test_a_batch_goes_through_a_gap_as_each_of_it() -> None:
    observer = DESIGN.observer()
    x = np.linspace(-0.3, 0.3, 10).reshape(2, 5)
    u = np.array([[0.5], [-1.0]])
    batch = observer.initial((2,)).changed(x=x)
    batch = observer.predict(observer.predict(batch, u, 0.3), u, T)
    assert batch.in_gap.all()
    gap_flow = GapFlow(DESIGN.request.flow, 1.0)
    for place in range(2):
        alone = observer.initial().changed(x=x[place])
        start = block_diag(alone.covariance, np.diag([0.0, 1.0]))
        alone = observer.predict(observer.predict(alone, u[place], 0.3), u[place], T)
        assert batch.records[place : place + 1].tobytes() == alone.records.tobytes()
        wide = gap_flow.predict_with_covariance(np.append(x[place], [0, 0]), start, u[place], 0.3)
        wide = gap_flow.predict_with_covariance(*wide, u[place], T)
        np.testing.assert_allclose(alone.x, wide[0][:5], rtol=1e-12, atol=1e-14)
        covariance = alone.records["covariance"][0, :7, :7]
        np.testing.assert_allclose(covariance, wide[1], rtol=1e-12, atol=1e-16)


def test_a_torque_rate_must_make_sense() -> None:
    with pytest.raises(ModelError, match=r"torque_rate: expected a finite number .* got -1"):
        DESIGN.observer(torque_rate=-1.0)
    request = load_request(config_path("ts_example.request.yaml"))
    n, p = request.flow.state_count, len(request.flow.output_matrix)
    gain = CertifiedGain(np.zeros((n, p)), np.eye(n))
    known = certified_estimator(request.flow, np.eye(p), np.eye(n), gain)
    assert known.shape.gap == 0
    with pytest.raises(ModelError, match=r"torque_rate: expected 0 for any system but an arm"):
        certified_estimator(request.flow, np.eye(p), np.eye(n), gain, torque_rate=1.0)
