# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What every estimator promises of its states: the same bits however they are stepped.

Run as a program, it prints the digests of its runs.
"""

import copy
import hashlib
import pickle
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.design.file import load_design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.baselines import high_gain, proportional_integral
from tsobs_ros.estimation.estimator import Estimator, Rows, SupervisionOptions
from tsobs_ros.estimation.records import Basis
from tsobs_ros.estimation.state import State
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.model.arm import ElasticJointArm
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
        initial_std=0.3, start=0.0, significance=1e-3, pass_time=0.02, memory=0.3,
    )  # fmt: skip
    estimator.supervise(SupervisionOptions(stuck_samples=10))
    return estimator


def pendulum() -> Estimator:
    """A T–S system: angle and rate are measured, the rate with a bias, gravity is learnt."""
    design = load_design(SYSTEM)
    estimator = design.observer(settle_time=0.2, adapt=True)
    estimator.learn(design.request.uncertainty_model, start=0.05, significance=1e-3)
    return estimator


ESTIMATORS: dict[str, Callable[[], Estimator]] = {
    "supervised arm": supervised_arm,
    "pendulum": pendulum,
    "proportional": lambda: high_gain(ARM, 20.0, T, STD),
    "proportional-integral": lambda: proportional_integral(ARM, 20.0, T, STD),
    "paper": lambda: paper_observer(ARM, T, STD),
}


DIGESTS = {
    "supervised arm": "0d3b62e2f9c38f9a",
    "pendulum": "97a7fb23a4e28265",
    "proportional": "3bed2344d081223c",
    "proportional-integral": "6e7e29fca59d261d",
    "paper": "c76a1c01f51f83e5",
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


def stepped(estimator: Estimator) -> list[State]:
    """Return the states of a run, with a gap, a short step and looks between two samples, and at
    the end numbers that are not finite, or too large, in sample and input."""
    states, state, T = [], estimator.initial(), estimator.period
    if estimator.supervised:  # as it would be some seconds later
        bound = estimator.shape.trim("covariance", estimator.model["X"])[0]
        state = state.changed(covariance=bound, settling=0.0, certified=1)
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
            worse = estimator.predict(worse, held, T)
            states += [worse, estimator.predict(estimator.correct(worse, y)[0], u, 3.3 * T)]
    return states


def bits(rows: Rows) -> list[bytes]:
    return [rows[name].tobytes() for name in rows.dtype.names]


def digest(states: list[State], estimator: Estimator) -> str:
    """Return a digest of the bits of states and of what is read of them; every NaN is alike."""
    found = hashlib.sha256()
    for state in states:
        every = state.records["hypotheses"]
        own = (every[name] for name in ("x", "covariance", "theta", "gamma", "upsilon", "score"))
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


def test_whole_runs_are_their_steps_one_by_one(estimator: Estimator) -> None:
    """One call for many runs, a batch and single states: the same bits."""
    y, u = series(estimator)
    runs, inputs = np.stack([y, -0.5 * y, y[::-1]]), np.stack([u, -u, u[::-1]])
    runs[1:, 7::20] = np.nan
    whole, batch = estimator.observe(runs, inputs), estimator.initial((3,))
    single = estimator.initial()
    for k in range(SAMPLES):
        if k > 0:
            batch = estimator.predict(batch, inputs[:, k - 1], estimator.period)
            single = estimator.predict(single, inputs[0, k - 1], estimator.period)
        if np.isfinite(runs[:, k]).all():
            batch, _ = estimator.correct(batch, runs[:, k])
            single, _ = estimator.correct(single, runs[0, k])
        else:  # only of the first run there is a sample
            single, _ = estimator.correct(single, runs[0, k])
            batch.records[:1] = single.records
        assert bits(whole[:, k]) == bits(estimator.readout(batch))
        assert batch.records[:1].tobytes() == single.records.tobytes()

    middle = estimator.initial((3,)).changed(stamp=[1, 2, 3])
    from_there = estimator.observe(runs, inputs, start=middle)
    assert from_there.state.tobytes() == whole.state.tobytes()
    assert (middle.stamp == [1, 2, 3]).all()


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.7, 1.0])
def test_the_bound_covers_the_time_between_samples_too(fraction: float) -> None:
    """What is claimed there, at every pair of ends of the slopes, to one in a million."""
    design = load_design(config_path(FIXED_DESIGN))
    observer, flow, u = design.observer(), design.request.flow, np.array([0.5])
    settled = observer.initial().changed(x=np.full(5, 0.1), settling=0.0, certified=1)
    corrected, _ = observer.correct(settled, [0.1])
    between = observer.predict(corrected, u, fraction * T, between_samples=True)
    assert observer.readout(between).basis == Basis.CERTIFIED
    np.testing.assert_allclose(observer.readout(between).state_bound, design.bound_std[:4])
    root, step = np.linalg.cholesky(design.P), flow.transition(fraction * T)
    after = observer.model["posterior"][0, :5, :5]
    for first, second in product(design.request.slope_range, repeat=2):
        before, kick = np.eye(5), np.eye(5)
        before[1, 0], kick[1, 0] = -step.half_kick * first, -step.half_kick * second
        spread = step.phi @ before @ after @ before.T @ step.phi.T + step.noise
        assert np.linalg.eigvalsh(root.T @ kick @ spread @ kick.T @ root)[-1] <= 1.0 + 1e-6
    late = observer.predict(corrected, u, 3.0 * T, between_samples=True)
    assert observer.readout(late).basis != Basis.CERTIFIED


def test_a_state_is_not_changed_by_a_step_and_copied_by_its_bytes(estimator: Estimator) -> None:
    y, u = series(estimator)
    state, _ = estimator.correct(estimator.initial(), y[0])
    before = state.records.tobytes()
    corrected, _ = estimator.correct(state, y[1])
    predicted = estimator.predict(state, u[0], 2.5 * T)
    assert state.records.tobytes() == before
    assert predicted != state != corrected
    for same in (state.copy(), copy.deepcopy(state), pickle.loads(pickle.dumps(state))):
        assert same == state
    moved = state.changed(x=state.x + 1.0)
    np.testing.assert_array_equal(moved.x, state.x + 1.0)
    assert moved != state
    assert moved.changed(x=state.x) == state
    with pytest.raises(AttributeError, match="a state has no 'y_hat'; it has"):
        state.changed(y_hat=0.0)


def test_numbers_of_another_shape_are_named() -> None:
    estimator = estimator_of("pendulum")
    state, batch = estimator.initial(), estimator.initial((3,))
    y, u = np.zeros((4, 5, 2)), np.zeros((4, 6, 1))
    for call, message in (
        (lambda: estimator.correct(state, np.zeros(3)), r"y: expected shape \(2,\), got \(3,\)"),
        (lambda: estimator.correct(batch, np.zeros((2, 2))), r"y: expected shape \(3, 2\), got"),
        (lambda: estimator.predict(state, np.zeros(2), T), r"u: expected shape \(1,\), got \(2,\)"),
        (lambda: estimator.predict(state, [0.0], -T), "duration: expected a finite number"),
        (lambda: estimator.observe(y[0], 0.0), r"y: expected shape \(runs, samples, 2"),
        (lambda: estimator.observe(y, u), r"u: expected shape \(4, 5, 1\), got \(4, 6, 1\)"),
        (lambda: estimator.observe(y, u[:, :5], -1.0), "period: expected a finite number"),
        (lambda: estimator.observe(y, u[:, :5], start=batch), r"start: expected a batch of \(4,\)"),
        (lambda: Tracker(estimator).offer_many([1, 2], y[0, :2], u[0, :1], 9), "measurements: exp"),
    ):
        with pytest.raises(ModelError, match=message):
            call()


if __name__ == "__main__":
    for _name, _digest in digests().items():
        print(f'    "{_name}": "{_digest}",')
