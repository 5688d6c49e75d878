# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The judgement of innovations: size of the noise, colour, weights, jumps, losses, doubts."""

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tsobs_ros.core.native import MAX_JUMP_BUDGET, WINDOW
from tsobs_ros.design.file import load_design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import Estimator, Readout, State, certified_estimator
from tsobs_ros.estimation.options import CertifiedGain, SupervisionOptions
from tsobs_ros.estimation.records import Basis
from tsobs_ros.resources import FIXED_DESIGN, config_path
from tsobs_ros.simulation.plant import Mismatch, Scenario, Trajectories
from tsobs_ros.simulation.scenarios import simulate
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=80)
PERIOD, RATE, STD = 0.005, 200, 0.028
LONG_AGO = 100.0
DESIGN = load_design(config_path(FIXED_DESIGN))
# An innovation of exactly zero has no sign; it does not happen.
innovations = st.floats(-1e6, 1e6).filter(bool)
MEMORY = ("recent", "watched", "nis", "magnitude", "coloured_power", "watch_age", "jump_count")


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
CERTAIN = {"x": 0.0, "covariance": 0.0, "certified": 0}


def state_of(estimator: Estimator = ESTIMATOR, age: float = LONG_AGO, **fields: float) -> State:
    """Return a state whose innovation is the measurement itself, long after the start."""
    return estimator.initial().changed(**CERTAIN, watch_age=age, **fields)


def memory_of(state: State) -> list[object]:
    return [np.asarray(getattr(state, name)).tolist() for name in MEMORY]


def judge(state: State, value: float, estimator: Estimator = ESTIMATOR) -> tuple[State, Verdict]:
    """Return the state after an innovation, and what has come of it."""
    after, correction = estimator.correct(state, [value])
    assert correction.innovation[0] == value
    assert correction.innovation_covariance[0, 0] == 1.0
    verdict = Verdict(
        float(correction.weight[0]),
        bool(after.jumps > state.jumps),
        bool(after.losses > state.losses),
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
        state = estimator.predict(state, [0.0], PERIOD).changed(**CERTAIN)
        verdicts.append(verdict)
    return state, verdicts


def jumps(verdicts: Iterable[Verdict]) -> list[int]:
    return [index for index, verdict in enumerate(verdicts) if verdict.jumped]


def alternating(size: float, count: int) -> list[float]:
    return [size * (-1.0) ** k for k in range(count)]


@cache
def observed(
    scenario: Scenario, seeds: int = 10, duration: float = 30.0
) -> tuple[Trajectories, Readout]:
    """Return some runs and what the supervised observer, which learns nothing, makes of them."""
    runs = simulate(scenario, range(seeds), duration)
    return runs, DESIGN.supervised().observe(runs.measurements, runs.torques)


def noisy(factor: float, **numbers: float) -> Scenario:
    return Scenario(sensor=Sensor(noise_std=factor * STD, **numbers))


def outside(runs: Trajectories, found: Readout) -> NDArray[np.bool_]:
    """Return whether any error exceeds three bounds, shape (runs, samples)."""
    errors = np.concatenate(
        [runs.physical - found.state, runs.disturbances - found.disturbance], axis=2
    )
    bounds = np.concatenate([found.state_bound, found.disturbance_bound], axis=2)
    return np.asarray((np.abs(errors) > 3.0 * bounds).any(axis=2))


# What it learns of the noise.


@pytest.mark.parametrize("factor", [1.0, 1.5, 3.0])
def test_the_scale_finds_the_size_of_white_noise_and_the_bounds_follow(factor: float) -> None:
    runs, found = observed(noisy(factor))
    scale = found.noise_scale
    assert (scale >= 1.0).all()
    np.testing.assert_allclose(scale[:, 4 * RATE], factor, rtol=0.25)
    np.testing.assert_allclose(scale[:, 10 * RATE :].mean(axis=1), factor, rtol=0.05)
    assert np.abs(found.coloured_power[:, 10 * RATE :].mean(axis=1)).max() < 0.15
    certified = found.basis == Basis.CERTIFIED
    assert certified[:, 12 * RATE :].mean() > 0.95
    expected = scale[..., np.newaxis] * DESIGN.bound_std[:4]
    np.testing.assert_allclose(found.state_bound[certified], expected[certified], rtol=1e-12)
    assert outside(runs, found)[:, 10 * RATE :].mean() < 0.01


def test_the_scale_follows_changes_within_seconds() -> None:
    """After a minute without noise too, in which a scale without a floor would vanish."""
    quiet, loud = observed(noisy(1.0), 4, 90.0)[0], observed(noisy(3.0), 4, 90.0)[0]
    y = quiet.measurements.copy()
    y[:, : 60 * RATE] = quiet.physical[:, : 60 * RATE, :1]
    y[:, 70 * RATE : 80 * RATE] = loud.measurements[:, 70 * RATE : 80 * RATE]
    y[:, 70 * RATE : 80 * RATE] += (quiet.physical - loud.physical)[:, 70 * RATE : 80 * RATE, :1]
    scale = DESIGN.supervised().observe(y, quiet.torques).noise_scale
    assert (scale[:, 65 * RATE : 70 * RATE] < 1.3).all()
    # ln 3 takes 2.2 s at the full rate, and somewhat longer as the median comes near.
    assert (scale[:, 75 * RATE : 80 * RATE] > 2.2).all()
    assert (scale[:, 84 * RATE :] < 1.3).all()


@pytest.mark.parametrize(
    ("scenario", "coloured"),
    [
        (Scenario(mismatch=Mismatch(stiffness=0.2)), True),
        (noisy(1.0, noise_time_constant=0.0475), True),
        (noisy(1.0, outlier_probability=0.1, outlier_is_uniform=True), False),
    ],
    ids=["wrong stiffness", "correlated noise", "outliers"],
)
def test_what_is_smooth_or_rare_is_no_larger_noise(scenario: Scenario, coloured: bool) -> None:
    _, found = observed(scenario)
    settled = slice(12 * RATE, None)
    assert found.noise_scale[:, settled].mean() < 1.15
    if coloured:
        assert np.median(found.coloured_power[:, settled]) > 0.5
        assert (found.basis[:, settled] == Basis.CERTIFIED).mean() < 0.1
    else:
        assert found.coloured_power[:, settled].mean() < 0.3


def test_averages_follow_their_time_constants() -> None:
    state, _ = follow([2.0] * 200)
    # A second of r = 2 after a past of 1: e⁻¹ of the way is left, for |r| e⁻².
    assert state.nis == pytest.approx(4.0 - 3.0 * math.exp(-1.0), rel=1e-9)
    assert state.magnitude == pytest.approx(2.0 - math.exp(-2.0), rel=1e-9)
    assert state.coloured_power == pytest.approx(4.0 - 4.0 * math.exp(-0.995), rel=1e-9)
    assert state.watch_age == pytest.approx(LONG_AGO + 1.0)


def test_one_outlier_counts_as_five_sigma_in_the_averages() -> None:
    small, _ = judge(state_of(), 5.0)
    large, _ = judge(state_of(), 400.0)
    assert small.nis == large.nis == pytest.approx(1.0 + 24.0 * PERIOD, rel=0.01)
    assert small.recent.tolist() == large.recent.tolist() == [[5.0, *[0.0] * (WINDOW - 1)]]


# Weights.


@PROPERTY
@given(r=innovations, coloured=st.floats(-1.0, 25.0), gate=st.floats(0.1, 100.0))
def test_what_is_far_beyond_the_gate_has_no_influence(
    r: float, coloured: float, gate: float
) -> None:
    estimator = supervised(gate=gate, reject=200.0)
    _, verdict = judge(state_of(coloured_power=coloured), r, estimator)
    limit = gate * math.sqrt(max(1.0, coloured))
    assert 0.0 <= verdict.weight <= 1.0
    if abs(r) > 200.0:
        assert verdict.weight == 0.0
    elif abs(r) <= limit:
        assert verdict.weight == 1.0
    else:
        assert verdict.weight == pytest.approx((limit / r) ** 2, rel=1e-12)


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


# Jumps.

CALM = alternating(0.1, WINDOW - 8)
LEANING = [*CALM, *[3.0] * 8]


@pytest.mark.parametrize(
    ("window", "jumped"),
    [
        ([3.0] * 8, True),
        ([-3.0] * 8, True),
        ([2.13] * 8, True),
        ([2.12] * 8, False),
        ([-1.0, *[3.0] * 7], True),
        ([-1.0, -1.0, *[4.0] * 6], False),
        # One outlier, or two, do not make the others lean.
        ([1.0] * 7 + [1e9], False),
        ([0.9] * 5 + [9.0] * 3, False),
        # They differ as much among themselves, as in a burst of noise.
        ([1.1, 5.0] * 4, False),
        ([3.0] * 5, False),
    ],
)
def test_windows_that_jump_and_that_do_not(window: list[float], jumped: bool) -> None:
    calm = alternating(0.1, WINDOW - len(window))
    _, verdicts = follow([*calm, *window])
    assert jumps(verdicts) == ([WINDOW - 1] if jumped else [])


def test_what_grows_little_by_little_is_no_jump() -> None:
    """A wrong model makes everything lean, but not at once."""
    _, verdicts = follow(np.linspace(0.0, 3.0, 200).tolist())
    assert jumps(verdicts) == []
    _, verdicts = follow(np.linspace(1.0, 3.0, WINDOW).tolist())
    assert jumps(verdicts) == []


@pytest.mark.parametrize("jumped", [False, True])
def test_no_jump_is_looked_for_if_innovations_are_coloured_already(jumped: bool) -> None:
    state = state_of(coloured_power=0.3 if jumped else 1.5, calm=0.3 if jumped else 1.5)
    _, verdicts = follow(LEANING, state)
    assert bool(jumps(verdicts)) == jumped


@pytest.mark.parametrize(("age", "jumped"), [(0.0, False), (7.8, False), (8.0, True)])
def test_no_jump_is_looked_for_soon_after_a_start(age: float, jumped: bool) -> None:
    estimator = supervised(jump_quiet=8.0)
    _, verdicts = follow(LEANING, state_of(estimator, age), estimator)
    assert bool(jumps(verdicts)) == jumped


def test_a_jump_forgets_the_averages() -> None:
    after, verdict = judge(follow(LEANING[:-1])[0], 3.0)
    assert verdict.jumped
    assert (after.watched, after.nis, after.magnitude, after.coloured_power) == (0, 1.0, 1.0, 0.0)
    assert (after.jump_count[0], after.jump_ages[0, 0]) == (1, after.watch_age)


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"jump_budget": 3}, [0.0, 2.1, 4.2, 21.0, 23.1, 25.2, 42.0]),
        ({"jump_budget": 1}, [0.0, 21.0, 42.0]),
        ({"jump_budget": 0}, []),
        ({"jump_std": 0.0}, []),
        ({"jump_duration": 4.0}, [0.0, 4.2, 8.4, 12.6, 16.8, 21.0, 25.2, 29.4, 33.6, 37.8, 42.0]),
    ],
)
def test_there_are_so_many_jumps_in_twenty_seconds(
    options: dict[str, float], found: list[float]
) -> None:
    estimator = supervised(**options)
    state, times, time = state_of(estimator), [], 0.0
    while time < 43.0:
        state, verdicts = follow([*LEANING, *alternating(0.1, 420 - WINDOW)], state, estimator)
        times += [round(time, 1) for _ in jumps(verdicts)]
        time += 2.1
    assert times == found


@pytest.mark.parametrize(
    ("sensor", "most"),
    [
        # In fifty bursts of four times the noise, which last until the scale has followed.
        ({"burst_interval": 5.0}, 15),
        ({"outlier_probability": 0.1, "outlier_size": 3.0, "outlier_is_uniform": True}, 2),
    ],
)
def test_bursts_of_noise_and_outliers_are_seldom_taken_for_jumps(
    sensor: dict[str, float], most: int
) -> None:
    _, found = observed(noisy(1.0, **sensor))
    jumped = (found.basis == Basis.JUMP).astype(int)
    assert (np.diff(jumped, axis=1) > 0).sum() <= most


# Losses, and what the bounds rest on.


def test_a_long_average_that_is_far_too_large_is_a_loss() -> None:
    estimator = supervised(jump_budget=0)
    _, verdicts = follow([8.0] * 128, state_of(estimator), estimator)
    # 8 − 7 e^{−2t} passes 6 at t = ln(3.5)/2 = .626 s.
    first = next(index for index, verdict in enumerate(verdicts) if verdict.lost)
    assert (first + 1) * PERIOD == pytest.approx(math.log(3.5) / 2.0, abs=2 * PERIOD)
    after, verdict = judge(follow([8.0] * first, state_of(estimator), estimator)[0], 8.0, estimator)
    assert verdict.lost
    # As after a start, quiet time included.
    assert memory_of(after) == memory_of(estimator.initial())


def test_large_innovations_of_either_sign_are_no_loss() -> None:
    _, verdicts = follow(alternating(8.0, 1000))
    assert not any(verdict.lost for verdict in verdicts)
    _, verdicts = follow([5.9] * 1000)
    assert not any(verdict.lost for verdict in verdicts)


def test_white_noise_raises_no_alarm() -> None:
    """Expected of 40 000 samples: 1e-4 jumps, .02 outliers, no loss."""
    values = np.random.default_rng(2026).standard_normal(40_000).tolist()
    state, verdicts = follow(values)
    assert sum(verdict.jumped for verdict in verdicts) == 0
    assert sum(verdict.lost for verdict in verdicts) == 0
    assert sum(verdict.weight < 1.0 for verdict in verdicts) <= 2
    assert state.nis == pytest.approx(1.0, abs=0.5)


def test_the_basis_names_the_last_event_until_the_certificate_holds_again() -> None:
    step = replace(noisy(1.0), disturbance=(BiasStep(0.2, 20.0),))
    runs = simulate(step, range(4), 40.0)
    y = runs.measurements.copy()
    y[:, 30 * RATE : 31 * RATE] = np.nan
    basis = DESIGN.supervised().observe(y, runs.torques).basis
    assert (basis[:, 0] == Basis.STARTING).all()
    for run in basis:
        changes = np.flatnonzero(np.diff(run)) + 1
        times = (changes / RATE).tolist()
        assert run[changes].tolist() == [
            Basis.CERTIFIED, Basis.JUMP, Basis.CERTIFIED, Basis.GAP, Basis.CERTIFIED,
        ]  # fmt: skip
        start, jump, after, gap, again = times
        assert 5.0 <= start < 9.0
        assert 20.0 < jump < 20.1
        assert after == pytest.approx(jump + 3.0, abs=0.02)
        assert gap == pytest.approx(30.0, abs=0.006)
        assert 31.0 < again < 33.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, -1) for name in (
            "gate", "reject", "jump_std", "jump_duration", "jump_quiet", "jump_budget",
            "jump_budget_window", "lost", "strain", "relearn_budget",
        )),
        ("relearn_time", 0.0),
        ("jump_budget", MAX_JUMP_BUDGET + 1),
    ],
)  # fmt: skip
def test_senseless_options_are_refused(name: str, value: int) -> None:
    with pytest.raises(ModelError, match=name):
        SupervisionOptions(**{name: value})
