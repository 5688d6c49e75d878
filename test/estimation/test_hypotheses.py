# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What arm and sensor are taken for, if they are not as designed, and what is published then."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.estimator import Estimator, Readout
from tsobs_ros.estimation.records import Basis, Hypothesis
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.plant import Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

PERIOD = 0.005
SCALE = np.array([0.226, 0.60, 0.355, 0.464])
SECOND = 200
SEEDS = (5, 6, 7)
DESIGN = load_design(config_path(SHIPPED_DESIGN))


@cache
def estimator() -> Estimator:
    return make_estimator(DESIGN, ObserverSettings())


@cache
def observed(name: str) -> tuple[Trajectories, Readout]:
    runs = simulate(SCENARIOS[name], SEEDS)
    return runs, estimator().observe(runs.measurements, runs.torques)


def errors(runs: Trajectories, readout: Readout) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the normalised errors and the shares inside three bounds of each run from 20 s on."""
    error = (readout.state - runs.physical)[:, 20 * SECOND :]
    inside = np.abs(error) <= 3.0 * readout.state_bound[:, 20 * SECOND :]
    return np.sqrt(((error / SCALE) ** 2).mean(axis=(1, 2))), inside.mean(axis=1).min(axis=1)


@pytest.mark.parametrize(
    ("name", "taken_for", "size"),
    [
        ("slight_friction", {Hypothesis.FORCE}, 0.045),
        ("friction", {Hypothesis.STRONG_FORCE}, 0.11),
        ("correlated_0.9", {Hypothesis.COLOURED_NOISE}, 0.036),
        ("correlated_0.97", {Hypothesis.COLOURED_NOISE}, 0.08),
        ("payload", {Hypothesis.STRONG_FORCE}, 0.5),
        ("drift", {Hypothesis.DRIFT}, 0.15),
    ],
)
def test_what_the_design_lacks_is_told_and_its_bound_covers(
    name: str, taken_for: set[Hypothesis], size: float
) -> None:
    runs, readout = observed(name)
    selected = readout.hypothesis[:, 20 * SECOND :]
    assert np.isin(selected, list(taken_for)).mean() > 0.7
    published = readout.basis[readout.hypothesis != Hypothesis.AS_DESIGNED]
    assert np.isin(published, [Basis.HYPOTHESIS, Basis.CONTRADICTED]).all()
    assert not readout.parameters_valid[readout.hypothesis != Hypothesis.AS_DESIGNED].any()
    error, inside = errors(runs, readout)
    assert error.mean() < size
    assert inside.mean() > 0.9


@pytest.mark.parametrize(
    "name",
    [
        "noise",
        "stiff",
        "loud",
        "stiff_loud_2",
        "stiff_student",
        "stiff_bursts",
        "stiff_more_outliers",
        "stiff_pulses",
        "stiff_dropouts",
        "bias_step",
        "steps",
        "held",
        "coarse",
    ],
)
def test_what_the_estimator_copes_with_is_not_taken_for_something_else(name: str) -> None:
    _, readout = observed(name)
    for run in readout.hypothesis != Hypothesis.AS_DESIGNED:
        changes = np.flatnonzero(np.diff(np.concatenate([[0], run, [0]])))
        assert max(changes[1::2] - changes[::2], default=0) <= SECOND


def pushed(begin: float) -> tuple[Trajectories, NDArray[np.float64]]:
    """Return runs, and their torques without a part that the arm is pushed by for 18 s."""
    runs = simulate(SCENARIOS["noise"], SEEDS)
    phase = np.clip((runs.times - begin) / 4.5, 0.0, 4.0)
    return runs, runs.torques - 0.5 * np.tanh(8.0 * np.sin(np.pi * phase))[:, np.newaxis]


def test_a_hypothesis_is_left_soon_after_it_has_become_wrong() -> None:
    runs, torques = pushed(15.0)
    readout = estimator().observe(runs.measurements, torques)
    selected = readout.hypothesis
    assert not selected[:, : 15 * SECOND].any()
    during = selected[:, 20 * SECOND : 33 * SECOND]
    assert during.all()
    assert (during == Hypothesis.STRONG_FORCE).mean() > 0.8
    after = selected[:, 40 * SECOND :]
    assert np.isin(after, [Hypothesis.AS_DESIGNED, Hypothesis.FORCE]).all()
    assert not selected[:, 58 * SECOND :].any()
    assert errors(runs, readout)[1].min() > 0.9


def test_late_samples_change_no_bit_while_a_hypothesis_is_selected() -> None:
    runs, torques = pushed(11.0)
    count = 18 * SECOND
    stamps = 10**9 + np.round(runs.times[:count] * 1e9).astype(np.int64)
    y, u = runs.measurements[0, :count], torques[0, :count]
    order = np.arange(count).reshape(-1, 20)[:, ::-1].ravel()
    estimates = []
    for arrival in (np.arange(count), order):
        tracker = Tracker(estimator(), TrackerOptions(DESIGN.request.x_max, history=0.5))
        for part in np.split(arrival, count // 20):
            now = int(stamps[part].max())
            outcomes = tracker.offer_many(stamps[part], y[part], u[part], now)
            assert not outcomes.codes.any()
        estimates.append(tracker.estimate(int(stamps[-1]) + 3_000_000))
    first, second = estimates
    assert first is not None
    assert second is not None
    assert first.hypothesis is Hypothesis.STRONG_FORCE
    assert first.basis is Basis.HYPOTHESIS
    batch = estimator().observe(y[np.newaxis], u[np.newaxis])
    at_last = Tracker(estimator(), TrackerOptions(DESIGN.request.x_max, history=0.5))
    rows = at_last.follow(stamps, y, u)
    assert rows[-1, :4].tobytes() == batch.state[0, -1].tobytes()
    for name in ("state", "state_bound", "disturbance", "disturbance_bound", "basis"):
        assert np.asarray(getattr(first, name)).tobytes() == (
            np.asarray(getattr(second, name)).tobytes()
        )
