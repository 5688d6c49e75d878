# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What every estimator promises of its states: the same bits however they are stepped.

Run as a program, it prints the digests of its runs.
"""

import hashlib
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.core import native
from tsobs_ros.design.file import load_design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.baselines import high_gain, proportional_integral
from tsobs_ros.estimation.estimator import Estimator, Rows, SupervisionOptions
from tsobs_ros.estimation.records import Basis
from tsobs_ros.estimation.state import likeliest, numbers_of
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.prediction import Record
from tsobs_ros.paper.observer import paper_observer
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path

Array = NDArray[np.float64]
SYSTEM = Path(__file__).parents[1] / "design" / "data" / "system.design.yaml"
ARM, T, STD = ElasticJointArm(), 0.005, 0.02
SAMPLES = 140


def supervised_arm() -> Estimator:
    """The shipped adaptive design, that learns and reacts early."""
    design = load_design(config_path(SHIPPED_DESIGN))
    estimator = design.observer(settle_time=0.0, adapt=True)
    estimator.learn(
        design.request.uncertainty_model, covered=design.request.certify_uncertainty,
        initial_std=0.3, significance=1e-3, pass_time=0.02, memory=0.3,
    )  # fmt: skip
    estimator.supervise(SupervisionOptions(stuck_samples=10))
    return estimator


def pendulum() -> Estimator:
    """A T–S system: angle and rate are measured, the rate with a bias, gravity is learnt."""
    design = load_design(SYSTEM)
    estimator = design.observer(settle_time=0.2, adapt=True)
    estimator.learn(design.request.uncertainty_model, significance=1e-3)
    return estimator


ESTIMATORS: dict[str, Callable[[], Estimator]] = {
    "supervised arm": supervised_arm,
    "pendulum": pendulum,
    "proportional": lambda: high_gain(ARM, 20.0, T, STD),
    "proportional-integral": lambda: proportional_integral(ARM, 20.0, T, STD),
    "paper": lambda: paper_observer(ARM, T, STD),
}


DIGESTS = {
    "supervised arm": "ccb9763b9dbaffe5",
    "pendulum": "c04b162f32c968ec",
    "proportional": "770de7dfd97e1b18",
    "proportional-integral": "ad4c24c02e1d2d1b",
    "paper": "719788784b4300d9",
}
"""Of all runs; this file as a program prints them."""


@cache
def estimator_of(name: str) -> Estimator:
    return ESTIMATORS[name]()


def series(estimator: Estimator) -> tuple[Array, Array]:
    """Return samples with outliers, jumps and repetitions of a value, and inputs."""
    rng, shape = np.random.default_rng(17), estimator.shape
    times = T * np.arange(SAMPLES)[:, np.newaxis]
    y = 0.2 * np.sin(9.0 * times) + STD * rng.standard_normal((SAMPLES, shape.p))
    y[[40, 95]] += [[1.0], [-5.0]]
    y[60:] += 0.6
    y[85:105] += 30.0
    y[110:125] = y[110]
    y[125:] += 30.0
    return y, np.sin(7.0 * times) * rng.uniform(1.0, 2.0, (1, shape.m))


def stepped(estimator: Estimator) -> list[Record]:
    """Return the states of a run, with a gap, a short step and looks between two samples, and at
    the end numbers that are not finite, or too large, in sample and input."""
    states, state, T = [], estimator.initial(), estimator.period
    if estimator.supervised:  # as it would be some seconds later
        best = likeliest(state)
        best["covariance"], best["settling"], best["certified"] = estimator.model["X"][0], 0.0, 1
    for k, (y, u) in enumerate(zip(*series(estimator), strict=True)):
        state, _ = estimator.correct(state, y)
        states += [state, estimator.predict(state, u, 0.4 * T, between_samples=True)]
        state = estimator.predict(state, u, {70: 8.42 * T, 80: 0.7 * T}.get(k, T))
        states.append(state)
        if k % 10 == 3:
            state = estimator.predict(state, u, T)  # a sample is missing
            states.append(state)
    for bad in (np.nan, np.inf, -np.inf, 1e200):
        for sample, held in ((np.full_like(y, bad), u), (y, np.full_like(u, bad))):
            worse, _ = estimator.correct(state, sample)
            # `predict` refuses such inputs, but a program in C may have them.
            numbers = (numbers_of(one) for one in (estimator.model, worse))
            scratch = numbers_of(estimator.new_record("work"))
            native.estimator_predict(*numbers, held, T, False, scratch)
            states += [worse, estimator.predict(estimator.correct(worse, y)[0], u, 3.3 * T)]
    return states


def bits(row: Rows) -> list[bytes]:
    return [np.asarray(row[name]).tobytes() for name in row.dtype.names]


def digest(states: list[Record], estimator: Estimator) -> str:
    """Return a digest of the bits of states and of what is read of them; every NaN is alike."""
    found = hashlib.sha256()
    for state in states:
        of = state["hypotheses"]
        own = (of[name] for name in ("x", "covariance", "theta", "gamma", "sensitivity", "score"))
        for part in (*own, *estimator.readout(state)):
            numbers = np.array(part, np.float64)
            numbers[np.isnan(numbers)] = np.nan
            found.update(numbers.tobytes())
    return found.hexdigest()[:16]


def digests() -> dict[str, str]:
    """Return the digests of all runs, by estimator."""
    return {
        name: digest(stepped(made), made) for name in ESTIMATORS for made in [estimator_of(name)]
    }


@pytest.fixture(params=ESTIMATORS)
def estimator(request: pytest.FixtureRequest) -> Estimator:
    return estimator_of(request.param)


def test_the_bits_of_all_runs_stay() -> None:
    assert digests() == DIGESTS


def test_a_tracker_takes_the_steps_one_by_one_and_changes_no_state(estimator: Estimator) -> None:
    y, u = series(estimator)
    stamps = 10**9 + round(estimator.period * 1e9) * np.arange(SAMPLES)
    rows, state = Tracker(estimator).follow(stamps, y, u), estimator.initial()
    for k in range(SAMPLES):
        before = state.tobytes()
        predicted = estimator.predict(state, u[k - 1], estimator.period) if k else state
        corrected, _ = estimator.correct(predicted, y[k])
        assert bits(estimator.readout(corrected)) == bits(rows[k])
        assert state.tobytes() == before != corrected.tobytes()
        state = corrected


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.7, 1.0])
def test_the_bound_covers_the_time_between_samples_too(fraction: float) -> None:
    """What is claimed there, at every pair of ends of the slopes, to one in a million."""
    design = load_design(config_path(FIXED_DESIGN))
    observer, flow, u = design.observer(), design.request.flow, np.array([0.5])
    settled = observer.initial()
    best = likeliest(settled)
    best["x"][:5], best["settling"], best["certified"] = 0.1, 0.0, 1
    corrected, _ = observer.correct(settled, [0.1])
    between = observer.predict(corrected, u, fraction * T, between_samples=True)
    assert observer.readout(between).basis == Basis.CERTIFIED
    np.testing.assert_allclose(observer.readout(between).state_bound, design.bound_std[:4])
    root, step = np.linalg.cholesky(design.P), flow.transition(fraction * T)
    after = observer.model["posterior"][0, :5, :5]
    half = 0.5 * step.duration * flow.gravity_gain
    for first, second in product(design.request.slope_range, repeat=2):
        before, kick = np.eye(5), np.eye(5)
        before[1, 0], kick[1, 0] = -half * first, -half * second
        spread = step.phi @ before @ after @ before.T @ step.phi.T + step.noise
        assert np.linalg.eigvalsh(root.T @ kick @ spread @ kick.T @ root)[-1] <= 1.0 + 1e-6
    late = observer.predict(corrected, u, 3.0 * T, between_samples=True)
    assert observer.readout(late).basis != Basis.CERTIFIED


def test_numbers_of_another_shape_are_named() -> None:
    estimator = estimator_of("pendulum")
    state, y, u = estimator.initial(), np.zeros((2, 2)), np.zeros((1, 1))
    for call, message in (
        (lambda: estimator.correct(state, np.zeros(3)), r"y: expected shape \(2,\), got \(3,\)"),
        (lambda: estimator.predict(state, np.zeros(2), T), r"u: expected shape \(1,\), got \(2,\)"),
        (lambda: estimator.predict(state, [0.0], -T), "duration: expected a finite number"),
        (lambda: estimator.predict(state, [0.0], 5e6), "duration: expected at most 3600 s, got 5e"),
        (lambda: estimator.predict(state, [np.nan], T), "u: every entry must be finite, got .nan"),
        (
            lambda: estimator.predict(state, np.ma.array([0.0], mask=True), T),
            "u: every entry must be finite",
        ),
        (lambda: Tracker(estimator).offer_many([1, 2], y, u, 9), "measurements: expected y of"),
        (lambda: Tracker(estimator).offer_many([1.5], y, u, 9), "stamps: expected whole ns, got"),
    ):
        with pytest.raises(ModelError, match=message):
            call()


if __name__ == "__main__":
    for _name, _digest in digests().items():
        print(f'    "{_name}": "{_digest}",')
