# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates are a function of the measurements and the stamp, however and whenever they came."""

import itertools
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import Correction, Estimator, Readout
from tsobs_ros.estimation.observer import TSObserver
from tsobs_ros.estimation.records import Estimate, Innovation, Measurement, RejectReason
from tsobs_ros.estimation.supervised import SupervisedObserver, SupervisionOptions
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

Array = NDArray[np.float64]
SECOND = 1_000_000_000
PERIOD = 5_000_000
BEGIN = 100 * SECOND
END_OF_TIME = 10**18
PROPERTY = settings(max_examples=40)
MakeTracker = Callable[..., Tracker[Any]]

DESIGN = load_design(config_path("elastic_joint.design.yaml"))


@pytest.fixture(scope="module")
def design() -> Design:
    return DESIGN


def unsettled(design: Design) -> SupervisedObserver:
    """The observer as the node runs it, from its start, with jumps looked for at once."""
    return SupervisedObserver(design.observer(), SupervisionOptions(jump_quiet=0.0))


def settled(design: Design) -> SupervisedObserver:
    """An observer in which the certified gain takes over after the first regular step."""
    request = design.request
    observer = TSObserver(
        request.flow,
        request.measurement_covariance,
        design.covariance_bound,
        design.observer().certified,
        settle_time=0.0,
    )
    return SupervisedObserver(observer)


ESTIMATORS = {"unsettled": unsettled, "settled": settled}


def tracker(kind: str = "unsettled", **options: Any) -> Tracker[Any]:
    return Tracker(ESTIMATORS[kind](DESIGN), TrackerOptions(x_max=0.75, **options))


RUN = simulate(SCENARIOS["noise"], [4], 3.0)


def sample(index: int, stamp: int | None = None, offset: float = 0.0) -> Measurement:
    """Return a sample of the simulated run, stamped as sampled unless told otherwise."""
    stamp = BEGIN + index * PERIOD if stamp is None else stamp
    return Measurement(stamp, RUN.measurements[0, index] + offset, RUN.torques[0, index])


def bits(record: Any) -> Any:
    """Return a record with its arrays as bytes, so that equal means equal to the last bit."""
    if record is None or isinstance(record, RejectReason):
        return record
    return tuple(item.tobytes() if isinstance(item, np.ndarray) else item for item in record)


def finite(estimate: Estimate) -> bool:
    return all(np.isfinite(field).all() for field in estimate)


def offer_all(tracker: Tracker[Any], measurements: Iterable[Measurement]) -> list[Any]:
    return [tracker.offer(m, END_OF_TIME) for m in measurements]


def counts(tracker: Tracker[Any]) -> dict[str, Any]:
    names = ("used", "rejected", "rewinds", "restarts", "failures", "events", "newest")
    return {name: getattr(tracker, name) for name in names}


def probes(tracker: Tracker[Any]) -> list[Any]:
    """Return the estimates, as bits, at, between and after the newest measurements."""
    newest = tracker.newest
    assert newest is not None
    offsets = (-97_000_000, -12_345_678, -PERIOD, -1, 0, 1, PERIOD, 11_111_111, 300_000_000)
    return [bits(tracker.estimate(newest + offset)) for offset in offsets]


class Arrival(NamedTuple):
    """What arrives: a measurement of the run, or junk of some kind."""

    time: int
    kind: str
    measurement: Measurement


@st.composite
def schedules(draw: st.DrawFn) -> tuple[list[Measurement], list[Arrival]]:
    """Draw measurements at irregular stamps, some dropped, and how they and junk arrive."""
    count = draw(st.integers(2, 40))
    steps = draw(
        st.lists(
            st.sampled_from([PERIOD, PERIOD, PERIOD, 1_000_000, 7_654_321, 40_000_000]),
            min_size=count,
            max_size=count,
        )
    )
    stamps = [BEGIN + sum(steps[: k + 1]) for k in range(count)]
    # A rad is an outlier; eight times .2 rad are a jump.
    offset = st.sampled_from([0.0, 0.0, 0.0, 0.2, -1.0])
    kept = [
        sample(k, stamp, draw(offset))
        for k, stamp in enumerate(stamps)
        if k == 0 or draw(st.integers(0, 9)) > 0
    ]
    # Less than the history of half a second.
    delays = draw(
        st.lists(st.integers(0, 80).map(lambda ms: ms * 1_000_000 + 1), min_size=len(kept),
                 max_size=len(kept))
    )  # fmt: skip
    arrivals = [Arrival(m.stamp + delay, "good", m) for m, delay in zip(kept, delays, strict=True)]
    arrivals.sort(key=lambda arrival: arrival.time)
    kinds = st.sampled_from(["duplicate", "nan", "infinite torque", "zero", "future", "old"])
    for place, kind in draw(st.lists(st.tuples(st.integers(1, len(kept)), kinds), max_size=8)):
        time, _, measurement = arrivals[place - 1]
        arrivals.insert(place, Arrival(time, kind, measurement))
    return kept, arrivals


def spoilt(arrival: Arrival, tracker: Tracker[Any]) -> tuple[Measurement, RejectReason | None]:
    """Return what really arrives, and why it must be rejected."""
    good, newest = arrival.measurement, tracker.newest
    if arrival.kind == "good":
        return good, None
    assert newest is not None
    return {
        "duplicate": (good._replace(stamp=newest), RejectReason.DUPLICATE),
        "nan": (good._replace(y=np.array([np.nan])), RejectReason.NON_FINITE),
        "infinite torque": (good._replace(u=np.array([-np.inf])), RejectReason.NON_FINITE),
        "zero": (good._replace(stamp=0), RejectReason.ZERO_STAMP),
        "future": (
            good._replace(stamp=arrival.time + SECOND // 10 + 1),
            RejectReason.FROM_FUTURE,
        ),
        "old": (good._replace(stamp=newest - SECOND // 2 - 1), RejectReason.TOO_OLD),
    }[arrival.kind]


@pytest.mark.parametrize("kind", ESTIMATORS)
@PROPERTY
@given(schedule=schedules(), interrupted=st.booleans())
def test_any_order_of_arrival_gives_the_estimates_of_arrival_in_order(
    kind: str, schedule: tuple[list[Measurement], list[Arrival]], interrupted: bool
) -> None:
    kept, arrivals = schedule
    shuffled, in_order = tracker(kind), tracker(kind)
    expected: Counter[RejectReason] = Counter()
    late = 0
    for arrival in arrivals:
        measurement, reason = spoilt(arrival, shuffled)
        if reason is None:
            late += shuffled.newest is not None and measurement.stamp < shuffled.newest
        else:
            expected[reason] += 1
        outcome = shuffled.offer(measurement, arrival.time)
        if reason is None:
            assert isinstance(outcome, Innovation)
            assert outcome.stamp == measurement.stamp
        else:
            assert outcome is reason
        if interrupted:  # asking in between must not matter
            shuffled.estimate(arrival.time)
    offer_all(in_order, kept)

    assert probes(shuffled) == probes(in_order)
    assert shuffled.events == in_order.events
    assert shuffled.rejected == expected
    assert (shuffled.used, shuffled.rewinds) == (len(kept), late)
    assert len(arrivals) == shuffled.used + sum(shuffled.rejected.values())
    assert (shuffled.failures, shuffled.restarts) == (0, 0)


def test_the_innovations_of_a_rewound_sample_are_those_of_its_place() -> None:
    in_order, swapped = tracker(), tracker()
    expected = offer_all(in_order, map(sample, range(6)))
    came = offer_all(swapped, map(sample, [0, 1, 2, 4, 3, 5]))
    # Sample 4 came without sample 3, so its innovation is another one.
    for k, place in ((0, 0), (1, 1), (2, 2), (4, 3), (5, 5)):
        assert bits(came[k]) == bits(expected[place])
    assert bits(came[3]) != bits(expected[4])


@PROPERTY
@given(
    stamps=st.lists(
        st.integers(-20 * PERIOD, 200 * PERIOD) | st.integers(-10, 100).map(PERIOD.__mul__),
        min_size=1,
        max_size=8,
    )
)
def test_an_estimate_depends_on_no_earlier_one(stamps: list[int]) -> None:
    asked = tracker("settled")
    offer_all(asked, map(sample, range(30)))
    newest = BEGIN + 29 * PERIOD
    answers = [bits(asked.estimate(newest + stamp)) for stamp in stamps]
    for stamp, answer in zip(stamps, answers, strict=True):
        fresh = tracker("settled")
        offer_all(fresh, map(sample, range(30)))
        assert bits(fresh.estimate(newest + stamp)) == answer


def test_coasting_is_forgotten_with_the_measurement_it_began_at() -> None:
    coasted, straight = tracker(), tracker()
    offer_all(coasted, map(sample, range(20)))
    coasted.estimate(BEGIN + 60 * PERIOD)
    for each in (coasted, straight):
        each.offer(sample(25), END_OF_TIME)
    offer_all(straight, map(sample, range(20)))
    assert bits(coasted.estimate(BEGIN + 90 * PERIOD)) == bits(
        straight.estimate(BEGIN + 90 * PERIOD)
    )
    assert probes(coasted) == probes(straight)


def test_estimates_between_measurements_come_from_the_one_before() -> None:
    whole = tracker()
    offer_all(whole, map(sample, range(60)))
    for index, offset in itertools.product((12, 33, 59), (0, 1, PERIOD // 2, PERIOD - 1)):
        part = tracker()
        offer_all(part, map(sample, range(index + 1)))
        stamp = BEGIN + index * PERIOD + offset
        estimate = whole.estimate(stamp)
        assert estimate is not None
        assert bits(estimate) == bits(part.estimate(stamp))
        assert (estimate.stamp, estimate.age) == (stamp, offset / SECOND)


def test_there_is_no_estimate_before_the_first_measurement() -> None:
    young = tracker()
    assert young.estimate(BEGIN) is None
    assert young.newest is None
    assert young.events == {}
    young.offer(sample(0), END_OF_TIME)
    assert young.estimate(BEGIN - 1) is None
    at_once = young.estimate(BEGIN)
    assert at_once is not None
    assert at_once.age == 0.0
    assert young.failures == 0


def test_the_domain_is_left_where_the_angle_is_too_large() -> None:
    for angle, inside in ((1.4, True), (-1.4, True), (1.6, False), (-1.6, False)):
        # The first sample is believed to be half angle, half bias.
        one = tracker()
        one.offer(sample(0)._replace(y=np.array([angle])), END_OF_TIME)
        estimate = one.estimate(BEGIN)
        assert estimate is not None
        assert estimate.state[0] == pytest.approx(angle / 2, rel=0.01)
        assert estimate.in_domain is inside


@pytest.mark.parametrize(("nanoseconds", "restarts"), [(0, 0), (1, 1), (SECOND, 1)])
def test_a_gap_longer_than_allowed_starts_afresh(nanoseconds: int, restarts: int) -> None:
    gap = tracker(restart_after=2.0)
    offer_all(gap, map(sample, range(50)))
    again = BEGIN + 49 * PERIOD + 2 * SECOND + nanoseconds
    after = [sample(k, again + k * PERIOD) for k in range(50)]
    offer_all(gap, after)
    fresh = tracker(restart_after=2.0)
    offer_all(fresh, after)
    assert gap.restarts == restarts
    assert gap.used == 100
    assert (probes(gap) == probes(fresh)) == bool(restarts)
    assert gap.failures == 0


def test_the_edges_of_history_and_future_are_inside() -> None:
    edges = tracker(history=0.1, future_tolerance=0.05)
    now = BEGIN + 100 * PERIOD
    offer_all(edges, [sample(0), sample(20), sample(40)])
    assert isinstance(edges.offer(sample(60, now + SECOND // 20), now), Innovation)
    newest = now + SECOND // 20
    assert edges.offer(sample(61, newest + 1), now) is RejectReason.FROM_FUTURE
    assert edges.offer(sample(61, newest - SECOND // 10 - 1), now) is RejectReason.TOO_OLD
    assert isinstance(edges.offer(sample(61, newest - SECOND // 10), now), Innovation)
    assert edges.rewinds == 1


def test_a_sample_the_estimate_was_already_past_is_too_old_whatever_the_history() -> None:
    # The state before sample 0 has been given up: nothing older can be put in its place.
    old = tracker(history=0.02)
    offer_all(old, map(sample, range(1, 10)))
    assert old.offer(sample(4), END_OF_TIME) is RejectReason.TOO_OLD
    assert old.offer(sample(0), END_OF_TIME) is RejectReason.TOO_OLD
    assert old.offer(sample(6), END_OF_TIME) is RejectReason.DUPLICATE


def test_without_history_every_late_sample_is_too_old() -> None:
    none = tracker(history=0.0)
    offer_all(none, map(sample, [0, 2]))
    assert none.offer(sample(1), END_OF_TIME) is RejectReason.TOO_OLD
    assert none.offer(sample(2), END_OF_TIME) is RejectReason.DUPLICATE
    assert bits(none.estimate(BEGIN + 3 * PERIOD)) is not None


def test_stamps_before_the_epoch_count_as_zero() -> None:
    negative = tracker()
    assert negative.offer(sample(0, -1), END_OF_TIME) is RejectReason.ZERO_STAMP
    assert negative.offer(sample(0, 1), END_OF_TIME) is not RejectReason.ZERO_STAMP


def test_callers_rejections_are_counted_too() -> None:
    counted = tracker()
    counted.reject(RejectReason.WRONG_JOINT)
    counted.reject(RejectReason.WRONG_JOINT)
    assert counted.rejected == {RejectReason.WRONG_JOINT: 2}
    assert counted.used == 0


def test_a_reset_tracker_is_a_new_one() -> None:
    old = tracker()
    junk = [sample(k)._replace(y=np.array([30.0])) for k in range(30)]
    offer_all(old, [*junk, sample(3), sample(5, 0), sample(50)._replace(y=np.array([np.nan]))])
    offer_all(old, [sample(90, BEGIN + 20 * SECOND), sample(91, BEGIN + 20 * SECOND - 1)])
    old.estimate(BEGIN + 21 * SECOND)
    before = counts(old)
    assert min(before[n] for n in ("used", "rewinds", "restarts")) > 0
    assert sum(before["rejected"].values()) > 0

    old.reset()
    new = tracker()
    assert counts(old) == counts(new)
    assert old.estimate(BEGIN) is None
    order = [0, 1, 2, 4, 3, 5, 5, *range(8, 40), 6]
    for index in order:
        # Its stamps lie before what it had seen: nothing of that may be remembered.
        assert bits(old.offer(sample(index), END_OF_TIME)) == bits(
            new.offer(sample(index), END_OF_TIME)
        )
        assert counts(old) == counts(new)
        assert probes(old) == probes(new)


def test_long_coasting_stays_finite_and_its_bounds_grow() -> None:
    coasting = tracker("settled")
    offer_all(coasting, map(sample, range(100)))
    newest = BEGIN + 99 * PERIOD
    estimates = [coasting.estimate(newest + k * SECOND // 4) for k in range(21)]
    for estimate in estimates:
        assert estimate is not None
        assert finite(estimate)
    bounds = [e.disturbance_bound[0] for e in estimates if e is not None]
    assert bounds == sorted(bounds)
    assert bounds[-1] > bounds[0]
    assert coasting.failures == 0


class Exploding:
    """An unstable scalar estimator: its state overflows after a few predictions."""

    period = 0.005

    def __init__(self, growth: float) -> None:
        self.growth = growth

    def initial(self) -> Array:
        return np.zeros(1)

    def correct(self, state: Array, y: Array) -> tuple[Array, Correction]:
        innovation = y - state
        return state + 0.5 * innovation, Correction(innovation, np.eye(1), 0.5 * np.eye(1))

    def predict(self, state: Array, u: Array, duration: float) -> Array:
        with np.errstate(over="ignore"):
            return state * np.float64(self.growth) ** round(duration / self.period)

    def extrapolate(self, state: Array, u: Array, duration: float) -> Array:
        return self.predict(state, u, duration)

    def readout(self, state: Array) -> Readout:
        one = np.ones(1)
        return Readout(np.repeat(state, 4), np.ones(4), one, one, one, certified=False)

    def events(self, state: Array) -> dict[str, int]:
        return {}


def exploding(growth: float) -> Tracker[Array]:
    estimator: Estimator[Array] = Exploding(growth)
    return Tracker(estimator, TrackerOptions(x_max=0.75))


def test_an_overflowing_estimate_is_counted_and_never_returned() -> None:
    overflowing = exploding(1e100)
    overflowing.offer(sample(0), END_OF_TIME)
    assert overflowing.estimate(BEGIN + PERIOD) is not None
    assert overflowing.estimate(BEGIN + 40 * PERIOD) is None
    assert (overflowing.failures, overflowing.restarts) == (1, 0)
    # The next measurement finds the prediction beyond all numbers too, and restarts there.
    fresh = exploding(1e100)
    with np.errstate(invalid="ignore"):
        for each in (overflowing, fresh):
            each.offer(sample(50), END_OF_TIME)
    stamp = BEGIN + 51 * PERIOD
    assert bits(overflowing.estimate(stamp)) == bits(fresh.estimate(stamp))
    assert (overflowing.used, overflowing.failures, overflowing.restarts) == (2, 2, 1)


@pytest.mark.parametrize("size", [1e100, 1e150, 1e200, 1e300, 1.7e308])
@pytest.mark.parametrize("field", ["y", "u"])
def test_enormous_numbers_never_give_an_estimate_that_is_not_finite(
    design: Design, field: str, size: float
) -> None:
    # Without supervision: what overflows here is the observer itself.
    enormous = Tracker(design.observer(), TrackerOptions(x_max=0.75))
    with np.errstate(all="ignore"):
        for k in range(120):
            measurement = sample(k)
            if k in (0, 40, 80):
                measurement = measurement._replace(**{field: np.array([(-1) ** k * size])})
            innovation = enormous.offer(measurement, END_OF_TIME)
            assert isinstance(innovation, Innovation)
            assert np.isfinite(innovation.value).all()
            for offset in (0, PERIOD - 1, 5 * PERIOD):
                estimate = enormous.estimate(BEGIN + k * PERIOD + offset)
                assert estimate is None or finite(estimate)
    assert enormous.used == 120
    assert enormous.restarts <= enormous.failures
    # An enormous torque alone leaves numbers that are absurd, but numbers.
    assert (enormous.failures > 0) == (field == "y" and size > 1e307)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"x_max": 0.0}, "x_max"),
        ({"x_max": 0.75, "history": -0.1}, "history"),
        ({"x_max": 0.75, "future_tolerance": float("nan")}, "future_tolerance"),
        ({"x_max": 0.75, "restart_after": 0.0}, "restart_after"),
    ],
)
def test_senseless_limits_are_refused(options: dict[str, float], reason: str) -> None:
    with pytest.raises(ModelError, match=reason):
        TrackerOptions(**options)
