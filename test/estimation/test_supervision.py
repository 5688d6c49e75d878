# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The judgement of innovations: what is downweighted, what is a jump, what is lost."""

import math
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.supervised import SupervisionOptions, Verdict, Watch, judge

PROPERTY = settings(max_examples=80)
PERIOD = 0.005
OPTIONS = SupervisionOptions()
LONG_AGO = 100.0
# An innovation of exactly zero has no sign; it does not happen.
innovations = st.floats(-1e6, 1e6).filter(bool)


def follow(
    values: Iterable[float], watch: Watch | None = None, options: SupervisionOptions = OPTIONS
) -> tuple[Watch, list[Verdict]]:
    """Judge innovations a period apart, long after the start unless told otherwise."""
    watch = Watch(age=LONG_AGO) if watch is None else watch
    verdicts = []
    for value in values:
        watch, verdict = judge(watch, value, PERIOD, options)
        watch = watch.after(PERIOD)
        verdicts.append(verdict)
    return watch, verdicts


def jumps(verdicts: Iterable[Verdict]) -> list[int]:
    return [index for index, verdict in enumerate(verdicts) if verdict.jumped]


@PROPERTY
@given(r=innovations, nis=st.floats(0.0, 25.0), gate=st.floats(0.1, 100.0))
def test_the_weight_leaves_what_the_gate_allows(r: float, nis: float, gate: float) -> None:
    options = SupervisionOptions(gate=gate, reject=200.0)
    _, verdict = judge(Watch(nis=nis), r, PERIOD, options)
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
    watch, verdicts = follow(values)
    mirrored, opposite = follow([-value for value in values])
    assert verdicts == opposite
    assert mirrored == watch._replace(recent=tuple(-value for value in watch.recent))
    kept = Watch(*watch)
    judge(watch, last, PERIOD, OPTIONS)
    assert watch == kept
    assert judge(watch, last, PERIOD, OPTIONS) == judge(kept, last, PERIOD, OPTIONS)


def test_averages_follow_their_time_constants() -> None:
    watch, _ = follow([2.0] * 200)
    # A second of r = 2 after a past of 1: e⁻¹ of the way is left, for |r| e⁻².
    assert watch.nis == pytest.approx(4.0 - 3.0 * math.exp(-1.0), rel=1e-9)
    assert watch.magnitude == pytest.approx(2.0 - math.exp(-2.0), rel=1e-9)
    assert watch.age == pytest.approx(LONG_AGO + 1.0)


def test_one_outlier_counts_as_five_sigma_in_the_average() -> None:
    small, _ = judge(Watch(), 5.0, PERIOD, OPTIONS)
    large, _ = judge(Watch(), 400.0, PERIOD, OPTIONS)
    assert small.nis == large.nis == pytest.approx(1.0 + 24.0 * PERIOD, rel=0.01)
    assert small.recent == large.recent == (5.0,)


LEANING = [3.0] * 8


@PROPERTY
@given(window=st.lists(st.floats(-8.0, 8.0).filter(bool), min_size=8, max_size=8))
def test_a_jump_is_eight_innovations_that_lean_to_one_side(window: list[float]) -> None:
    watch, before = follow(window[:7])
    verdict = judge(watch, window[7], PERIOD, OPTIONS)[1]
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
    watch, calm = follow([size, -size] * 500)
    assert (watch.nis < 2.0) == jumped
    assert not jumps(calm)
    _, verdicts = follow(LEANING, watch)
    assert bool(jumps(verdicts)) == jumped


def test_the_window_itself_does_not_count_as_before() -> None:
    watch, _ = follow([1.38, -1.38] * 500)
    leaning, verdicts = follow([5.0] * 5, watch)
    assert watch.nis < 2.0 < leaning.nis
    assert not jumps(verdicts)
    assert judge(leaning, 5.0, PERIOD, OPTIONS)[1].jumped


@pytest.mark.parametrize(("age", "jumped"), [(0.0, False), (7.9, False), (8.0, True)])
def test_no_jump_is_looked_for_soon_after_a_start(age: float, jumped: bool) -> None:
    _, verdicts = follow(LEANING, Watch(age=age))
    assert bool(jumps(verdicts)) == jumped


def test_a_jump_forgets_the_averages_and_waits_for_its_duration() -> None:
    _, verdicts = follow(LEANING * 30)
    first, *others = jumps(verdicts)
    assert first == 7
    assert others == []
    # 1.5 s after the first one the next is looked for.
    _, verdicts = follow(LEANING * 20, Watch(age=LONG_AGO, jumps=(LONG_AGO,)).after(1.5))
    assert jumps(verdicts) == [7]
    after, verdict = judge(follow(LEANING[:7])[0], 3.0, PERIOD, OPTIONS)
    assert verdict.jumped
    assert (after.recent, after.nis, after.magnitude, after.calm_nis) == ((), 1.0, 1.0, ())
    assert after.age == pytest.approx(LONG_AGO + 7 * PERIOD)
    assert after.jumps == (after.age,)


def test_at_most_three_jumps_in_twenty_seconds() -> None:
    watch, found, time = Watch(age=LONG_AGO), [], 0.0
    while time < 60.0:
        watch, verdicts = follow([*LEANING, *[0.0] * 412], watch)
        found += [round(time, 1) for _ in jumps(verdicts)]
        time += 2.1
    assert found == [0.0, 2.1, 4.2, 21.0, 23.1, 25.2, 42.0, 44.1, 46.2]


def test_a_long_average_that_is_far_too_large_is_a_loss() -> None:
    large = [(-1.0) ** k * 8.0 for k in range(400)]
    watch, verdicts = follow(large)
    # 8 − 7 e^{−2t} passes 6 at t = ln(3.5)/2 = .626 s.
    first = next(index for index, verdict in enumerate(verdicts) if verdict.lost)
    assert (first + 1) * PERIOD == pytest.approx(math.log(3.5) / 2.0, abs=2 * PERIOD)
    assert not any(verdict.jumped and verdict.lost for verdict in verdicts)
    after, verdict = judge(follow(large[:first])[0], large[first], PERIOD, OPTIONS)
    assert verdict.lost
    assert after == Watch()  # as after a start, quiet time included
    assert watch.age < LONG_AGO


def test_white_noise_raises_no_alarm() -> None:
    """Expected of 40 000 samples: 1e-4 jumps, .02 outliers, no loss."""
    values = np.random.default_rng(2026).standard_normal(40_000).tolist()
    watch, verdicts = follow(values)
    assert sum(verdict.jumped for verdict in verdicts) == 0
    assert sum(verdict.lost for verdict in verdicts) == 0
    assert sum(verdict.weight < 1.0 for verdict in verdicts) <= 2
    assert watch.nis == pytest.approx(1.0, abs=0.5)


def test_a_smaller_average_is_never_a_loss() -> None:
    _, verdicts = follow([5.9, -5.9] * 1000)
    assert not any(verdict.lost for verdict in verdicts)


@pytest.mark.parametrize("option", ["jump_std", "jump_budget"])
def test_jumps_can_be_switched_off(option: str) -> None:
    _, verdicts = follow(LEANING * 10, options=SupervisionOptions(**{option: 0}))
    assert jumps(verdicts) == []


@pytest.mark.parametrize(
    "name",
    ["gate", "reject", "jump_std", "jump_duration", "jump_quiet", "jump_budget",
     "jump_budget_window", "lost"],
)  # fmt: skip
def test_senseless_options_are_refused(name: str) -> None:
    with pytest.raises(ModelError, match=name):
        SupervisionOptions(**{name: -1})
