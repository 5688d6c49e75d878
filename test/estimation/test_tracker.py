# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates are a function of the measurements and the stamp, however and whenever they came."""

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.design.file import load_design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import Estimator, TorqueLimits
from tsobs_ros.estimation.records import Measurement, RejectReason
from tsobs_ros.estimation.state import likeliest
from tsobs_ros.estimation.tracker import Tracker, step_joints
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.model.arm import TorquePath
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

SECOND = 1_000_000_000
PERIOD = 5_000_000
BEGIN = 100 * SECOND
END = 10**18
PROPERTY = settings(max_examples=30)
DESIGN = load_design(config_path(FIXED_DESIGN))
ADAPTIVE = load_design(config_path(SHIPPED_DESIGN))
X_MAX = DESIGN.request.x_max
SOON = ObserverSettings(settle_time=0.5)
JUDGED = (RejectReason.IMPLAUSIBLE_TORQUE, RejectReason.UNKNOWN_INPUT, RejectReason.GATED)


@cache
def estimator(delay: float) -> Estimator:
    """Return the node's observer, which hands over to the certified gain soon."""
    torque = TorquePath(0.9, 0.2, delay) if delay else TorquePath()
    design = replace(DESIGN, request=replace(DESIGN.arm_request, torque=torque))
    return make_estimator(design, ObserverSettings(settle_time=0.05))


def tracker(delay: float = 0.0, **options: Any) -> Tracker:
    """Return a new tracker of an observer, of a torque that is late [s] if not 0."""
    return Tracker(estimator(delay), x_max=X_MAX, **options)


RUN = simulate(SCENARIOS["noise"], [4], 3.0)


def sample(
    index: int, stamp: int | None = None, offset: float = 0.0, torque: float = 0.0
) -> Measurement:
    """Return a sample of the simulated run, stamped as sampled unless told otherwise."""
    stamp = BEGIN + index * PERIOD if stamp is None else stamp
    return Measurement(stamp, RUN.measurements[0, index] + offset, RUN.torques[0, index] + torque)


def bits(record: Any) -> Any:
    """Return a record with its arrays as bytes, so that equal means equal to the last bit."""
    if record is None:
        return record
    return tuple(item.tobytes() if isinstance(item, np.ndarray) else item for item in record)


def offer_all(tracker: Tracker, measurements: Iterable[Measurement]) -> list[int]:
    return [int(tracker.offer(m, END).codes[0]) for m in measurements]


def probes(tracker: Tracker) -> list[Any]:
    """Return the estimates, as bits, at, between and after the newest measurements."""
    newest = tracker.newest or 0
    offsets = (-97_000_000, -12_345_678, -PERIOD, -1, 0, 1, PERIOD, 11_111_111, 300_000_000)
    return [bits(tracker.estimate(newest + offset)) for offset in offsets]


@st.composite
def schedules(draw: st.DrawFn) -> tuple[list[Measurement], list[Measurement]]:
    """Draw measurements at irregular stamps, some dropped, and the order in which they arrive."""
    count = draw(st.integers(2, 40))
    step = st.sampled_from([PERIOD, PERIOD, PERIOD, 1_000_000, 7_654_321, 40_000_000])
    stamps = BEGIN + np.cumsum(draw(st.lists(step, min_size=count, max_size=count)))
    # A rad is an outlier; eight times .2 rad are a jump.
    offset = st.sampled_from([0.0, 0.0, 0.0, 0.2, -1.0])
    # Twenty N m for one sample are doubtful.
    torque = st.sampled_from([0.0, 0.0, 0.0, 0.0, 20.0, np.nan, 1e6])
    kept = [
        sample(k, int(stamp), draw(offset), draw(torque))
        for k, stamp in enumerate(stamps)
        if k == 0 or draw(st.integers(0, 9)) > 0
    ]
    # Delays of less than the history of half a second.
    late = {m.stamp: m.stamp + draw(st.integers(0, 80)) * 1_000_000 for m in kept}
    return kept, sorted(kept, key=lambda m: late[m.stamp])


@pytest.mark.parametrize("batch", [1, 20])
def test_late_samples_change_no_bit_while_hypotheses_compete(batch: int) -> None:
    """A jump, outliers, a tone and torques that the arm did not get, in reversed batches."""
    count = 560
    y, u = RUN.measurements[0, :count].copy(), RUN.torques[0, :count].copy()
    y[120:] += 0.4
    y[200:, 0] += 0.2 * np.sin(0.03 * np.arange(count - 200))
    y[[60, 61, 300]] += [[3.0], [-1e9], [0.5]]
    u[400:420], u[440:460] = u[400:420] + 30.0, np.nan
    stamps = BEGIN + PERIOD * np.arange(count)
    results, seen = [], set()
    for order in (np.arange(count), np.arange(count).reshape(-1, 20)[:, ::-1].ravel()):
        one = Tracker(make_estimator(ADAPTIVE, SOON), x_max=X_MAX)
        for part in np.split(order, range(batch, count, batch)):
            one.offer_many(stamps[part], y[part], u[part], END)
            seen |= {*np.flatnonzero(one.state["hypotheses"]["live"][0]).tolist()}
        results.append((probes(one), one.state.tobytes(), one.rejected))
    assert len(seen) > 8  # standing ones, and forks
    assert results[0] == results[1]
    whole = Tracker(make_estimator(ADAPTIVE, SOON), x_max=X_MAX)
    whole.follow(stamps, y, u)
    assert probes(whole) == results[0][0]


def test_joints_in_one_call_have_the_numbers_of_each_alone() -> None:
    alone, together = ([tracker(delay) for delay in (0.0, 0.0015, 0.03)] for _ in range(2))
    for k in range(200):
        now = BEGIN + (k + 1) * PERIOD
        late = [(k % (4 + joint) == 3) * 2 * PERIOD + joint for joint in range(3)]
        row = [sample(k, now - late[joint], 0.4 * joint * (k > 99)) for joint in range(3)]
        outcomes = [one.offer(m, now) for one, m in zip(alone, row, strict=True)]
        stamps, y, u = map(np.array, zip(*row, strict=True))
        run = step_joints(together, stamps, y, u, now)
        assert bits(run.outcomes) == bits(map(np.concatenate, zip(*outcomes, strict=True)))
        rows = [bits(row[["state", "state_bound"]]) for row in run.rows]
        assert [bits(one.estimate(now))[1:3] for one in alone] == rows
    assert [one.state.tobytes() for one in alone] == [one.state.tobytes() for one in together]
    with pytest.raises(ModelError, match="expected one for each of 2 joints, got 3"):
        step_joints(together[:2], stamps, y, u, now)
    with pytest.raises(ModelError, match="expected one or more of the same sizes, got "):
        step_joints([*together, Tracker(make_estimator(ADAPTIVE, SOON))], stamps, y, u, now)


JUNK: dict[RejectReason, Callable[[Measurement], Measurement]] = {
    RejectReason.DUPLICATE: lambda good: good,
    RejectReason.NON_FINITE: lambda good: good._replace(y=np.nan * good.y, u=np.nan * good.u),
    RejectReason.ZERO_STAMP: lambda good: good._replace(stamp=0),
    RejectReason.FROM_FUTURE: lambda good: good._replace(stamp=END + SECOND),
    RejectReason.TOO_OLD: lambda good: good._replace(stamp=BEGIN - SECOND),
}


@PROPERTY
@given(
    schedule=schedules(),
    most=st.sampled_from([1, 12]),
    delay=st.sampled_from([0.0, 0.0, 0.0015, 0.0075, 0.03]),
    data=st.data(),
)
def test_batches_in_any_order_give_the_estimates_of_arrival_in_order(
    schedule: tuple[list[Measurement], list[Measurement]],
    most: int,
    delay: float,
    data: st.DataObject,
) -> None:
    kept, arrived = schedule
    together, in_order = tracker(delay), tracker(delay)
    expected: Counter[RejectReason] = Counter()
    late = steps = place = 0
    while place < len(arrived):
        good = arrived[place : place + data.draw(st.integers(1, most))]
        known, place = arrived[:place], place + len(good)
        oldest, newest = min(m.stamp for m in good), together.newest or 0
        late += sum(m.stamp < newest for m in good)
        steps += len(good) + sum(m.stamp > oldest for m in known)
        kinds = st.sampled_from([*JUNK][: 5 if known else 4])
        junk = data.draw(st.lists(st.tuples(kinds, st.sampled_from(good)), max_size=4))
        batch = data.draw(st.permutations([*good, *(JUNK[reason](m) for reason, m in junk)]))
        stamps, y, u = (np.array(column) for column in zip(*batch, strict=True))
        outcomes = together.offer_many(stamps, y, u, END)
        expected.update(reason for reason, _ in junk)
        found = Counter(RejectReason(code) if code else None for code in outcomes.codes.tolist())
        assert all(found[reason] == n for reason, n in Counter(r for r, _ in junk).items())
        assert found[None] + sum(found[reason] for reason in JUDGED) == len(good)
        assert np.isfinite(outcomes.innovations[outcomes.codes == 0]).all()
        if most == 1:  # asking in between must not matter
            together.estimate(newest + 3 * PERIOD)
    offer_all(in_order, kept)

    assert probes(together) == probes(in_order)
    assert together.events == in_order.events
    assert together.rejected == expected + in_order.rejected
    assert (together.used, together.rewinds) == (in_order.used, late)
    assert (together.failures, together.restarts) == (0, 0)
    # One pass over what is newer than the oldest of a batch.
    assert together.memory["steps"][0] == steps


def test_the_domain_is_left_where_the_angle_is_too_large() -> None:
    for angle in (1.4, -1.4, 1.6, -1.6):  # the first sample counts as half angle, half bias
        (one := tracker()).offer(sample(0)._replace(y=np.array([angle])), END)
        estimate = one.estimate(BEGIN)
        assert estimate is not None
        assert estimate.in_domain == (abs(angle) < 2.0 * X_MAX)


@pytest.mark.parametrize(("nanoseconds", "restarts"), [(0, 0), (1, 1), (SECOND, 1)])
def test_a_gap_longer_than_allowed_is_a_restart(nanoseconds: int, restarts: int) -> None:
    gap = tracker(restart_after=2.0)
    offer_all(gap, map(sample, range(50)))
    after = [sample(k, BEGIN + (49 + k) * PERIOD + 2 * SECOND + nanoseconds) for k in range(50)]
    offer_all(gap, after)
    fresh = tracker(restart_after=2.0)
    offer_all(fresh, after)
    assert (gap.restarts, gap.used, gap.failures) == (restarts, 100, 0)
    assert (probes(gap) == probes(fresh)) == bool(restarts)


@pytest.mark.parametrize("size", [1e150, 1.7e308])
@pytest.mark.parametrize("field", ["y", "u"])
def test_enormous_numbers_never_give_an_estimate_that_is_not_finite(
    field: str, size: float
) -> None:
    # Without supervision: what overflows here is the observer itself.
    enormous = Tracker(DESIGN.observer(), x_max=X_MAX)
    enormous.estimator.limit_torque(TorqueLimits(math.inf, math.inf, 1.0))
    for k in range(120):
        measurement = sample(k)
        if k in (0, 40, 80):
            measurement = measurement._replace(**{field: np.array([(-1) ** k * size])})
        outcome = enormous.offer(measurement, END)
        assert not outcome.codes.any()
        assert np.isfinite(outcome.innovations).all()
        for offset in (0, PERIOD - 1, 5 * PERIOD):
            estimate = enormous.estimate(BEGIN + k * PERIOD + offset)
            assert all(np.isfinite(field).all() for field in estimate or ())
    assert enormous.used == 120
    assert enormous.restarts <= enormous.failures
    # An enormous torque alone leaves numbers that are absurd, but numbers.
    assert (enormous.failures > 0) == (field == "y" and size > 1e307)


@pytest.mark.parametrize("field", ["x", "nis", "colour"])
def test_numbers_that_are_not_finite_give_no_estimate(field: str) -> None:
    (broken := tracker()).offer(sample(0), END)
    likeliest(broken.state)[field] = np.nan
    assert broken.estimate(BEGIN) is None


def test_stamps_of_the_past_are_refused_by_their_reason() -> None:
    old, reasons = tracker(history=0.02), RejectReason
    offer_all(old, map(sample, range(1, 10)))
    # The state before sample 1 has been given up: nothing older can be put in its place.
    past = [sample(4), sample(0), sample(6), sample(0, 0), sample(0, -1)]
    assert offer_all(old, past) == [
        reasons.TOO_OLD, reasons.TOO_OLD, reasons.DUPLICATE, reasons.ZERO_STAMP, reasons.ZERO_STAMP
    ]  # fmt: skip
    old.reject(reasons.WRONG_JOINT)
    assert old.rejected == {
        reasons.TOO_OLD: 2, reasons.DUPLICATE: 1, reasons.ZERO_STAMP: 2, reasons.WRONG_JOINT: 1,
    }  # fmt: skip
    assert old.used == 9


BUSY = *range(0, 150 * PERIOD, PERIOD), *range(10**9, 10**9 + 90)


@pytest.mark.parametrize(
    ("options", "stamps", "order"),
    [
        # A late sample bridges a gap that would have been a restart.
        ({}, [0, 980 * PERIOD, 1040 * PERIOD], [0, 2, 1]),
        ({"history": 10.0, "restart_after": 1.0}, [0, 1, 2, 600, 601, 602], [3, 4, 5, 0, 1, 2]),
        ({"max_steps": 50}, [k * PERIOD for k in range(123)], [*range(120), 121, 122, 120]),
        ({"max_steps": 1}, [0, PERIOD, 2 * PERIOD], [0, 2, 1]),
        # A burst for which the ring is widened when it does not begin at its first place.
        ({}, [*BUSY], [*range(110), *range(111, 240), 110]),
    ],
)
def test_whatever_the_history_reaches_is_put_in_its_place(
    options: dict[str, Any], stamps: list[int], order: list[int]
) -> None:
    in_order, late = tracker(**options | {"history": 10.0, "max_steps": 1024}), tracker(**options)
    given = [sample(k, BEGIN + stamp) for k, stamp in enumerate(stamps)]
    offer_all(in_order, given)
    offer_all(late, [given[k] for k in order])
    assert probes(late) == probes(in_order)
    if not options:
        assert late.restarts == in_order.restarts == 0
