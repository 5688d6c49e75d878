# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The judgement of innovations: what is downweighted, what is a jump, what is lost."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.design.file import load_design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import Estimator, State, certified_estimator
from tsobs_ros.estimation.options import MAX_JUMP_BUDGET, CertifiedGain, SupervisionOptions
from tsobs_ros.resources import FIXED_DESIGN, config_path

PROPERTY = settings(max_examples=80)
PERIOD = 0.005
LONG_AGO = 100.0
DESIGN = load_design(config_path(FIXED_DESIGN))
# An innovation of exactly zero has no sign; it does not happen.
innovations = st.floats(-1e6, 1e6).filter(bool)
MEMORY = (
    "recent", "watched", "nis", "calm_nis", "magnitude", "strained", "watch_age", "jump_ages",
    "jump_count",
)  # fmt: skip


class Verdict(NamedTuple):
    """What one innovation has led to."""

    weight: float
    jumped: bool
    lost: bool


def supervised(**options: float) -> Estimator:
    """Return an estimator that expects innovations of 1, if its state is not uncertain."""
    request = DESIGN.request
    estimator = certified_estimator(
        request.flow,
        np.eye(1),
        request.initial_covariance,
        CertifiedGain(DESIGN.K, DESIGN.covariance_bound),
    )
    # The same value twice is no stuck sensor here.
    estimator.supervise(SupervisionOptions(**{"stuck_samples": 0, **options}))
    return estimator


ESTIMATOR = supervised()


def state_of(estimator: Estimator = ESTIMATOR, age: float = LONG_AGO, **fields: float) -> State:
    """Return a state whose innovation is the measurement itself, long after the start."""
    certain = {"x": 0.0, "covariance": 0.0, "certified": 0}
    return estimator.initial().changed(**certain, watch_age=age, **fields)


def memory_of(state: State) -> list[object]:
    return [np.asarray(getattr(state, name)).tolist() for name in MEMORY]


def judge(state: State, value: float, estimator: Estimator = ESTIMATOR) -> tuple[State, Verdict]:
    """Return the state after an innovation, and what has come of it."""
    after, correction = estimator.correct(state, [value])
    assert correction.innovation[0] == value
    assert correction.innovation_covariance[0, 0] == 1.0
    verdict = Verdict(
        float(correction.weight), after.jumps > state.jumps, after.losses > state.losses
    )
    return after, verdict


def follow(
    values: Iterable[float], state: State | None = None, estimator: Estimator = ESTIMATOR
) -> tuple[State, list[Verdict]]:
    """Judge innovations a period apart, long after the start unless told otherwise."""
    state = state_of(estimator) if state is None else state
    verdicts = []
    for value in values:
        state, verdict = judge(state, value, estimator)
        state = estimator.predict(state, [0.0], PERIOD).changed(x=0.0, covariance=0.0, certified=0)
        verdicts.append(verdict)
    return state, verdicts


def jumps(verdicts: Iterable[Verdict]) -> list[int]:
    return [index for index, verdict in enumerate(verdicts) if verdict.jumped]


@PROPERTY
@given(r=innovations, nis=st.floats(0.0, 25.0), gate=st.floats(0.1, 100.0))
def test_the_weight_leaves_what_the_gate_allows(r: float, nis: float, gate: float) -> None:
    estimator = supervised(gate=gate, reject=200.0)
    _, verdict = judge(state_of(nis=nis), r, estimator)
    limit = gate * math.sqrt(max(1.0, nis))
    assert 0.0 <= verdict.weight <= 1.0
    if abs(r) > 200.0:
        assert verdict.weight == 0.0
    elif abs(r) <= limit:
        assert verdict.weight == 1.0
    else:
        assert verdict.weight * abs(r) == pytest.approx(limit, rel=1e-12)


@PROPERTY
@given(values=st.lists(innovations, max_size=40), last=innovations)
def test_judging_is_odd_and_changes_nothing_it_was_given(values: list[float], last: float) -> None:
    state, verdicts = follow(values)
    mirrored, opposite = follow([-value for value in values])
    assert verdicts == opposite
    assert memory_of(mirrored.changed(recent=-mirrored.recent)) == memory_of(
        state.changed(recent=state.recent + 0.0)
    )
    kept = state.copy()
    first, again = judge(state, last), judge(state, last)
    assert state == kept
    assert first == again


def test_averages_follow_their_time_constants() -> None:
    state, _ = follow([2.0] * 200)
    # A second of r = 2 after a past of 1: e⁻¹ of the way is left, for |r| e⁻².
    assert state.nis == pytest.approx(4.0 - 3.0 * math.exp(-1.0), rel=1e-9)
    assert state.magnitude == pytest.approx(2.0 - math.exp(-2.0), rel=1e-9)
    assert state.watch_age == pytest.approx(LONG_AGO + 1.0)


def test_one_outlier_counts_as_five_sigma_in_the_average() -> None:
    small, _ = judge(state_of(), 5.0)
    large, _ = judge(state_of(), 400.0)
    assert small.nis == large.nis == pytest.approx(1.0 + 24.0 * PERIOD, rel=0.01)
    assert small.recent.tolist() == large.recent.tolist() == [5.0, *[0.0] * 7]


LEANING = [3.0] * 8


@PROPERTY
@given(window=st.lists(st.floats(-8.0, 8.0).filter(bool), min_size=8, max_size=8))
def test_a_jump_is_eight_innovations_that_lean_to_one_side(window: list[float]) -> None:
    state, before = follow(window[:7])
    verdict = judge(state, window[7])[1]
    clipped = np.clip(window, -5.0, 5.0)
    agreeing = max((clipped > 0).sum(), (clipped < 0).sum())
    assert not jumps(before)
    # The sum is taken in another order here; at the threshold either is right.
    if abs(abs(clipped.sum()) - 6.0 * math.sqrt(8.0)) > 1e-9:
        assert verdict.jumped == (agreeing >= 7 and abs(clipped.sum()) > 6.0 * math.sqrt(8.0))


@pytest.mark.parametrize(
    ("window", "jumped"),
    [
        ([3.0] * 8, True),
        ([-3.0] * 8, True),
        ([3.0] * 7 + [-1.0], True),
        ([4.0] * 6 + [-0.1, -0.1], False),
        ([2.13] * 8, True),
        ([2.12] * 8, False),
        # One outlier alone does not make the others lean.
        ([1.0] * 7 + [1e9], False),
        ([3.0] * 7, False),
    ],
)
def test_windows_that_jump_and_that_do_not(window: list[float], jumped: bool) -> None:
    _, verdicts = follow(window)
    assert jumps(verdicts) == ([len(window) - 1] if jumped else [])


@pytest.mark.parametrize(("size", "jumped"), [(1.2, True), (1.3, True), (1.6, False), (3.0, False)])
def test_innovations_that_were_large_before_are_no_jump(size: float, jumped: bool) -> None:
    """A model that does not fit makes everything lean: the average before must be below 2."""
    state, calm = follow([size, -size] * 500)
    assert (state.nis < 2.0) == jumped
    assert not jumps(calm)
    _, verdicts = follow(LEANING, state)
    assert bool(jumps(verdicts)) == jumped


def test_the_window_itself_does_not_count_as_before() -> None:
    state, _ = follow([1.38, -1.38] * 500)
    leaning, verdicts = follow([5.0] * 5, state)
    assert state.nis < 2.0 < leaning.nis
    assert not jumps(verdicts)
    assert judge(leaning, 5.0)[1].jumped


@pytest.mark.parametrize(("age", "jumped"), [(0.0, False), (7.9, False), (8.0, True)])
def test_no_jump_is_looked_for_soon_after_a_start(age: float, jumped: bool) -> None:
    _, verdicts = follow(LEANING, state_of(age=age))
    assert bool(jumps(verdicts)) == jumped


def test_a_jump_forgets_the_averages_and_waits_for_its_duration() -> None:
    _, verdicts = follow(LEANING * 30)
    first, *others = jumps(verdicts)
    assert first == 7
    assert others == []
    # 1.5 s after the first one the next is looked for.
    after, verdict = judge(follow(LEANING[:7])[0], 3.0)
    assert verdict.jumped
    assert (after.watched, after.nis, after.magnitude) == (0, 1.0, 1.0)
    assert after.watch_age == pytest.approx(LONG_AGO + 7 * PERIOD)
    assert (after.jump_count, after.jump_ages[0]) == (1, after.watch_age)
    certain = {"x": 0.0, "covariance": 0.0, "certified": 0}
    _, verdicts = follow(LEANING * 20, after.changed(**certain, watch_age=after.watch_age + 1.5))
    assert jumps(verdicts) == [7]


@pytest.mark.parametrize(
    ("budget", "found"),
    [(3, [0.0, 2.1, 4.2, 21.0, 23.1, 25.2, 42.0]), (1, [0.0, 21.0, 42.0])],
)
def test_there_are_so_many_jumps_in_twenty_seconds(budget: int, found: list[float]) -> None:
    estimator = supervised(jump_budget=budget)
    state, times, time = state_of(estimator), [], 0.0
    while time < 43.0:
        state, verdicts = follow([*LEANING, *[0.0] * 412], state, estimator)
        times += [round(time, 1) for _ in jumps(verdicts)]
        time += 2.1
    assert times == found


def test_a_long_average_that_is_far_too_large_is_a_loss() -> None:
    large = [(-1.0) ** k * 8.0 for k in range(400)]
    state, verdicts = follow(large)
    # 8 − 7 e^{−2t} passes 6 at t = ln(3.5)/2 = .626 s.
    first = next(index for index, verdict in enumerate(verdicts) if verdict.lost)
    assert (first + 1) * PERIOD == pytest.approx(math.log(3.5) / 2.0, abs=2 * PERIOD)
    assert not any(verdict.jumped and verdict.lost for verdict in verdicts)
    after, verdict = judge(follow(large[:first])[0], large[first])
    assert verdict.lost
    # As after a start, quiet time included.
    assert memory_of(after) == memory_of(ESTIMATOR.initial())
    assert state.watch_age < LONG_AGO


def test_white_noise_raises_no_alarm() -> None:
    """Expected of 40 000 samples: 1e-4 jumps, .02 outliers, no loss."""
    values = np.random.default_rng(2026).standard_normal(40_000).tolist()
    state, verdicts = follow(values)
    assert sum(verdict.jumped for verdict in verdicts) == 0
    assert sum(verdict.lost for verdict in verdicts) == 0
    assert sum(verdict.weight < 1.0 for verdict in verdicts) <= 2
    assert state.nis == pytest.approx(1.0, abs=0.5)


def test_a_smaller_average_is_never_a_loss() -> None:
    _, verdicts = follow([5.9, -5.9] * 1000)
    assert not any(verdict.lost for verdict in verdicts)


@pytest.mark.parametrize("option", ["jump_std", "jump_budget"])
def test_jumps_can_be_switched_off(option: str) -> None:
    estimator = supervised(**{option: 0})
    _, verdicts = follow(LEANING * 10, state_of(estimator), estimator)
    assert jumps(verdicts) == []


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, -1) for name in (
            "gate", "reject", "jump_std", "jump_duration", "jump_quiet", "jump_budget",
            "jump_budget_window", "lost",
        )),
        ("jump_budget", MAX_JUMP_BUDGET + 1),
    ],
)  # fmt: skip
def test_senseless_options_are_refused(name: str, value: int) -> None:
    with pytest.raises(ModelError, match=name):
        SupervisionOptions(**{name: value})
