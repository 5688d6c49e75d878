# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The supervised observer on simulated data: outliers, jumps and losses, and otherwise nothing."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.options import SupervisionOptions
from tsobs_ros.estimation.records import Basis
from tsobs_ros.resources import FIXED_DESIGN, config_path
from tsobs_ros.simulation.plant import Scenario
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate
from tsobs_ros.simulation.signals import BiasStep, StuckSensor

Array = NDArray[np.float64]
T = 0.005
SCALE = np.array([0.226, 0.60, 3.55, 4.64])
DESIGN = load_design(config_path(FIXED_DESIGN))
ARM = DESIGN.request.arm


class Run(NamedTuple):
    """Estimates after each sample, in design coordinates, and the truth."""

    states: Array
    disturbance: Array
    true_states: Array
    true_disturbance: Array
    innovations: Array
    events: list[dict[str, int]]

    def first(self, event: str) -> list[int]:
        """Return the samples at which an event was counted."""
        counts = [0, *(events[event] for events in self.events)]
        return np.flatnonzero(np.diff(counts)).tolist()

    @property
    def error(self) -> float:
        """Normalised RMSE over the four states, from 8 s on."""
        error = (self.states - self.true_states)[1600:] / SCALE
        return float(np.sqrt((error**2).mean()))


def observe(
    estimator: Estimator, scenario: Scenario, seed: int, duration: float, offset: float = 0.0,
    offset_from: float = 0.0,
) -> Run:  # fmt: skip
    """Simulate a scenario, with an offset of the sensor the simulation does not call one."""
    runs = simulate(scenario, [seed], duration)
    y = runs.measurements[0] + offset * (runs.times[:, np.newaxis] >= offset_from)
    state = estimator.initial()
    states, disturbance, innovations, events = [], [], [], []
    for measured, torque in zip(y, runs.torques[0], strict=True):
        state, correction = estimator.correct(state, measured)
        readout = estimator.readout(state)
        states.append(ARM.from_physical(readout.state))
        disturbance.append(readout.disturbance)
        innovations.append(correction.innovation / np.sqrt(correction.innovation_covariance[0, 0]))
        events.append(estimator.events(state))
        state = estimator.predict(state, torque, T)
    return Run(
        np.stack(states),
        np.stack(disturbance)[:, 0],
        runs.states[0],
        runs.disturbances[0, :, 0],
        np.stack(innovations)[:, 0],
        events,
    )


def supervised(**options: float) -> Estimator:
    return DESIGN.supervised(options=SupervisionOptions(**options))


def test_without_anything_to_notice_it_is_the_observer_bit_for_bit() -> None:
    watched = observe(supervised(), SCENARIOS["noise"], 1, 15.0)
    plain = observe(DESIGN.observer(), SCENARIOS["noise"], 1, 15.0)
    assert set(watched.events[-1]) >= {"outliers downweighted", "sensor jumps", "losses of track"}
    assert not any(watched.events[-1].values())
    assert plain.events[-1] == {}
    for field in ("states", "disturbance", "innovations"):
        assert (getattr(watched, field) == getattr(plain, field)).all()


def test_a_loss_is_a_restart_with_the_sensor_in_doubt() -> None:
    observer, plain = supervised(disturbance_limit=2.0), DESIGN.observer()
    bound = DESIGN.covariance_bound
    state = observer.initial().changed(covariance=bound, settling=0.0, certified=1)
    for k in range(400):
        state, correction = observer.correct(state, [8.0 + 0.001 * (k % 2)])
        if observer.events(state)["losses of track"]:
            break
        state = observer.predict(state, np.zeros(1), T)
    assert observer.events(state)["losses of track"] == 1
    assert observer.events(state)["outliers downweighted"] > 0  # counts go on
    assert correction.weight == 0.0  # the sample that gave the estimate up is not used
    came, fresh = observer.readout(state), plain.readout(plain.initial())
    assert (came.state == fresh.state).all()
    assert (came.state_bound == fresh.state_bound).all()
    assert (came.disturbance == fresh.disturbance).all()
    np.testing.assert_allclose(came.disturbance_bound, np.hypot(fresh.disturbance_bound, 2.0))
    assert came.basis == Basis.STARTING


def test_large_noise_is_no_loss_of_track() -> None:
    observer = supervised()
    state, loud = observer.initial(), 0.3 * np.random.default_rng(3).standard_normal(4000)
    for y in loud:
        state, _ = observer.correct(state, [y])
        state = observer.predict(state, np.zeros(1), T)
    assert observer.events(state)["losses of track"] == 0
    assert observer.readout(state).noise_scale == pytest.approx(10.0, rel=0.2)


def test_the_disturbance_is_kept_within_its_limit() -> None:
    observer = supervised(disturbance_limit=0.05)
    run = observe(observer, SCENARIOS["noise"], 5, 12.0, 0.3, 9.0)
    assert np.abs(run.disturbance).max() <= 0.05 + 1e-12


def test_a_jump_moves_the_disturbance_and_opens_its_bound_and_nothing_else() -> None:
    observer, plain = supervised(jump_std=0.2, jump_duration=0.7), DESIGN.observer()
    step = replace(SCENARIOS["noise"], disturbance=(BiasStep(0.1, 12.0),))
    runs = simulate(step, [0], 16.0)
    watched, alone = observer.initial(), plain.initial()
    found, certified_again = None, None
    for k, (y, u) in enumerate(zip(runs.measurements[0], runs.torques[0], strict=True)):
        watched, _ = observer.correct(watched, y)
        alone, _ = plain.correct(alone, y)
        came, other = observer.readout(watched), plain.readout(alone)
        if found is None:
            wide = came.noise_scale * other.state_bound
            np.testing.assert_allclose(came.state_bound, wide, rtol=1e-14)
            assert (came.state == other.state).all()
            if observer.events(watched)["sensor jumps"]:
                found = k
                assert 0.05 < came.disturbance[0] - other.disturbance[0] < 0.1
                assert other.certified
                assert not came.certified
                own = came.disturbance_bound[0] / came.noise_scale
                assert 0.2 <= own <= np.hypot(0.2, other.disturbance_bound[0])
            else:
                assert (came.disturbance == other.disturbance).all()
        elif came.certified and certified_again is None:
            certified_again = k
        watched, alone = observer.predict(watched, u, T), plain.predict(alone, u, T)
    assert found is not None
    assert certified_again is not None
    # Three seconds without a contradiction, not only those of the Riccati gains.
    assert 600 <= certified_again - found <= 620


@pytest.mark.parametrize(("seed", "size"), [(0, 0.1), (1, -0.1)])
def test_a_step_of_the_sensor_is_found_at_once_and_forgiven_soon(seed: int, size: float) -> None:
    step = replace(SCENARIOS["noise"], disturbance=(BiasStep(size, 12.0),))
    run = observe(supervised(), step, seed, 16.0)
    (found,) = run.first("sensor jumps")
    assert 12.0 < found * T < 12.1
    assert run.events[-1]["losses of track"] == 0
    error = np.abs(run.disturbance - run.true_disturbance)
    assert error[2401] > 0.5 * abs(size)
    # 3 s after the step the errors are what they were before it.
    bound = np.sqrt(np.diag(DESIGN.covariance_bound))
    assert error[3000:].max() < 4.0 * bound[4]
    assert (np.abs(run.states - run.true_states)[3000:].max(axis=0) < 4.0 * bound[:4]).all()


@pytest.mark.parametrize("size", [-0.3, 1.0, 3.0])
def test_bounds_hold_soon_after_a_jump_of_any_size(size: float) -> None:
    """With redescending weights and a covariance that shrank all the same, 1 rad took seconds."""
    runs = simulate(Scenario(disturbance=(BiasStep(size, 12.0),)), range(10), 16.0)
    found = supervised().observe(runs.measurements, runs.torques)
    errors = np.concatenate(
        [runs.physical - found.state, runs.disturbances - found.disturbance], axis=2
    )
    bounds = np.concatenate([found.state_bound, found.disturbance_bound], axis=2)
    jumped = round(12.0 / T)
    # A jump is found after eight samples.
    after = jumped + 20
    assert (np.abs(errors) <= 3.5 * bounds)[:, after:].all()
    bases = found.basis[:, jumped:]
    assert not (bases[:, after - jumped : after - jumped + 500] == Basis.CERTIFIED).any()
    assert (bases[:, 20] == Basis.JUMP).all()
    assert (bases[:, -1] == Basis.CERTIFIED).all()


def test_outliers_do_little_harm() -> None:
    watched = observe(supervised(), SCENARIOS["outliers"], 0, 24.0)
    plain = observe(DESIGN.observer(), SCENARIOS["outliers"], 0, 24.0)
    assert plain.error > 1.5 * watched.error
    assert watched.error < 0.02  # without outliers it is .013
    wrong = int((np.abs(watched.innovations) > 15.0).sum())
    assert wrong > 25
    assert watched.events[-1]["outliers downweighted"] == pytest.approx(wrong, abs=2)
    assert watched.events[-1]["sensor jumps"] == watched.events[-1]["losses of track"] == 0


@pytest.mark.parametrize(("y", "weighed"), [(7.0, True), (1e300, False)])
def test_outliers_have_less_influence_the_larger_they_are_and_none_beyond_reason(
    y: float, weighed: bool
) -> None:
    observer, plain = supervised(gate=4.0), DESIGN.observer()
    wide, correction = plain.correct(plain.initial(), np.array([y]))
    state, same = observer.correct(observer.initial(), np.array([y]))
    r = y / np.sqrt(correction.innovation_covariance[0, 0])
    assert r > 4.0
    assert (same.innovation == correction.innovation).all()
    assert same.weight == pytest.approx((4.0 / r) ** 2 if weighed else 0.0, rel=1e-12)
    whole, part = plain.readout(wide), observer.readout(state)
    np.testing.assert_allclose(part.state, whole.state * same.weight, rtol=1e-12)
    np.testing.assert_allclose(part.disturbance, whole.disturbance * same.weight, rtol=1e-12)
    # The covariance shrinks by the weighted gain alone: K = w PC̄ᵀ/s in Joseph's form.
    gain = same.weight * correction.gain
    closed = np.eye(5) - gain @ DESIGN.request.flow.output_matrix
    prior, R = DESIGN.request.initial_covariance, DESIGN.request.measurement_covariance
    np.testing.assert_allclose(
        state.covariance, closed @ prior @ closed.T + gain @ R @ gain.T, rtol=1e-9, atol=1e-12
    )
    assert observer.events(state)["outliers downweighted"] == 1


@pytest.mark.parametrize("offset", [1.0, -3.0])
def test_a_lost_arm_is_found_again(offset: float) -> None:
    # From 2 s on: sooner than jumps are looked for, and far more than the gate lets through.
    run = observe(supervised(), SCENARIOS["noise"], 5, 8.0, offset, 2.0)
    (lost,) = run.first("losses of track")
    assert 2.0 < lost * T < 2.2
    assert run.events[-1]["sensor jumps"] == 0
    assert np.abs(run.innovations[lost + 100 :]).max() < 6.0
    # It is the sensor that moved, and the estimate says so.
    assert run.disturbance[-1] == pytest.approx(offset, abs=0.15)


def test_a_stuck_sensor_is_not_used() -> None:
    scenario = replace(SCENARIOS["noise"], disturbance=(StuckSensor(12.0, 3.0),))
    run, worst = simulate(scenario, [0], 16.0), {}
    for samples in (0, 10):
        observer = supervised(stuck_samples=samples)
        state, errors = observer.initial(), []
        for k, y in enumerate(run.measurements[0]):
            state, correction = observer.correct(state, y)
            if k * T > 12.0:
                errors.append(abs(observer.readout(state).state[0] - run.states[0, k, 0]))
            if 12.1 < k * T < 14.9:
                assert (correction.weight == 0.0) == (samples > 0)
            state = observer.predict(state, run.torques[0, k], T)
        worst[samples] = max(errors)
    # Three seconds without a sensor cost little; three seconds of a wrong one cost much.
    assert worst[10] < 0.02
    assert worst[0] > 5.0 * worst[10]
