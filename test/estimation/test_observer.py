# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer: a Kalman filter while it settles, the plain certified recursion afterwards."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pytest
from bayesian_filters.kalman import ExtendedKalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from scipy.linalg import expm

from tsobs_ros.core.native import WINDOW
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import (
    PERIOD_TOLERANCE,
    Estimator,
    State,
    certified_estimator,
)
from tsobs_ros.estimation.options import CertifiedGain, GainMode, SupervisionOptions
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.resources import FIXED_DESIGN, config_path
from tsobs_ros.simulation.plant import Plant, Scenario
from tsobs_ros.simulation.signals import BiasStep

Array = NDArray[np.float64]
PROPERTY = settings(max_examples=60)
T = 0.005


class Data(NamedTuple):
    """Simulated runs, time first: true augmented states, measurements and torques."""

    truth: Array
    y: Array
    u: Array


@pytest.fixture(scope="module")
def design() -> Design:
    return load_design(config_path(FIXED_DESIGN))


@pytest.fixture(scope="module")
def runs() -> Data:
    """Four runs of 10 s with a bias of 0.1 rad from the start."""
    plant = Plant(Scenario(disturbance=(BiasStep(0.1, 0.0),)), range(4))
    samples = [plant.step() for _ in range(2000)]
    truth = [np.concatenate([sample.state, sample.disturbance], axis=-1) for sample in samples]
    return Data(
        np.stack(truth),
        np.stack([sample.measurement for sample in samples]),
        np.stack([sample.torque for sample in samples]),
    )


def observe(
    observer: Estimator, y: Array, u: Array, state: State | None = None
) -> Iterator[tuple[State, State]]:
    """Yield the states before and after the correction by each sample."""
    state = observer.initial(y.shape[1:-1]) if state is None else state
    for measured, torque in zip(y, u, strict=True):
        corrected, _ = observer.correct(state, measured)
        yield state, corrected
        state = observer.predict(corrected, torque, T)


def settled(observer: Estimator, design: Design, x: Any) -> State:
    """Return a state in which the certified gain is in use."""
    bound = design.covariance_bound
    return observer.initial().changed(x=x, covariance=bound, settling=0.0, certified=1)


def bounds(observer: Estimator, design: Design, state: State) -> Array:
    """Return the 1σ bounds of a readout in design coordinates, shape (..., 5)."""
    readout = observer.readout(state)
    own = design.request.arm.from_physical(readout.state_bound)
    return np.concatenate([own, readout.disturbance_bound], axis=-1)


def posterior(design: Design) -> Array:
    """Return the covariance after a sample under the certified gain, in Joseph's form."""
    closed = np.eye(5) - design.K @ design.request.flow.output_matrix
    own = closed @ design.covariance_bound @ closed.T
    return np.asarray(own + design.K @ design.request.measurement_covariance @ design.K.T)


def jacobian(flow: ArmFlow, x: Array, u: Array) -> Array:
    """Return ∂predict/∂x, a half kick, the linear flow and a half kick."""
    before, after = np.eye(5), np.eye(5)
    before[1, 0] = -0.5 * T * flow.arm.gravity_gain * math.cos(x[0])
    after[1, 0] = -0.5 * T * flow.arm.gravity_gain * math.cos(flow.predict(x, u, T)[0])
    return np.asarray(after @ expm(flow.drift * T) @ before)


class ReferenceEkf(ExtendedKalmanFilter):  # type: ignore[misc]
    """bayesian-filters' filter with the observer's prediction as its state function."""

    flow: ArmFlow

    def predict_x(self, u: Any = 0) -> None:
        self.x = self.flow.predict(self.x, u, T)


def test_the_riccati_mode_is_an_extended_kalman_filter(design: Design, runs: Data) -> None:
    observer = design.observer(gain_mode=GainMode.RICCATI)
    flow, C = design.request.flow, design.request.flow.output_matrix
    ekf = ReferenceEkf(dim_x=5, dim_z=1)
    ekf.flow = flow
    ekf.x, ekf.P = np.zeros(5), design.request.initial_covariance.copy()
    ekf.R = design.request.measurement_covariance
    y, u = runs.y[:400, 0], runs.u[:400, 0]
    for (before, after), measured, torque in zip(observe(observer, y, u), y, u, strict=True):
        np.testing.assert_allclose(before.x, ekf.x, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(before.covariance, ekf.P, rtol=1e-8, atol=1e-12)
        ekf.update(measured, lambda _: C, lambda x: C @ x)
        np.testing.assert_allclose(after.x, ekf.x, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(after.covariance, ekf.P, rtol=1e-8, atol=1e-12)
        ekf.F = jacobian(flow, ekf.x, torque)
        second_kick = np.eye(5)
        angle = flow.predict(ekf.x, torque, T)[0]
        second_kick[1, 0] = -0.5 * T * 10.0 * math.cos(angle)
        ekf.Q = second_kick @ flow.nominal.noise @ second_kick.T
        ekf.predict(torque)
    assert not before.certified


def test_the_certified_mode_is_the_plain_recursion(design: Design, runs: Data) -> None:
    """x̂⁺ = f(x̂ + K(y − C̄x̂), u): one gain, whatever the state."""
    observer, flow = design.observer(), design.request.flow
    x = np.array([0.2, 0.0, 1.0, 0.0, 0.0])
    y, u = runs.y[:400, 0], runs.u[:400, 0]
    for (before, after), measured, torque in zip(
        observe(observer, y, u, settled(observer, design, x)), y, u, strict=True
    ):
        np.testing.assert_allclose(before.x, x, rtol=1e-12, atol=1e-13)
        assert before.certified
        assert after.certified
        assert (before.covariance == design.covariance_bound).all()
        x = flow.predict(x + design.K[:, 0] * (measured[0] - x[0] - x[4]), torque, T)


def test_corrections_say_what_they_did(design: Design) -> None:
    observer, bound = design.observer(), design.covariance_bound
    x, y = np.array([0.3, 0.0, 2.0, 0.0, 0.1]), np.array([0.55])
    C, R = design.request.flow.output_matrix, design.request.measurement_covariance

    state, correction = observer.correct(settled(observer, design, x), y)
    assert correction.innovation == pytest.approx([0.15])
    np.testing.assert_allclose(correction.innovation_covariance, C @ bound @ C.T + R, rtol=1e-12)
    assert (correction.gain == design.K).all()
    assert correction.weight == 1.0
    np.testing.assert_allclose(state.x - x, 0.15 * design.K[:, 0], rtol=1e-12)
    assert state.corrected
    assert (state.y == y).all()

    wide = design.request.initial_covariance
    state, correction = observer.correct(observer.initial().changed(x=x), y)
    spread = C @ wide @ C.T + R
    np.testing.assert_allclose(correction.innovation_covariance, spread, rtol=1e-12)
    np.testing.assert_allclose(correction.gain, wide @ C.T / spread, rtol=1e-12)
    np.testing.assert_allclose(state.x - x, 0.15 * correction.gain[:, 0], rtol=1e-9)
    reduced = wide - correction.gain @ spread @ correction.gain.T
    np.testing.assert_allclose(state.covariance, reduced, rtol=1e-9, atol=1e-9)


@PROPERTY
@given(root=hnp.arrays(np.float64, (5, 5), elements=st.floats(-3.0, 3.0)))
def test_covariances_stay_symmetric_and_positive(design: Design, root: Array) -> None:
    observer = design.observer(gain_mode=GainMode.RICCATI)
    start = observer.initial().changed(covariance=root @ root.T)
    corrected, _ = observer.correct(start, np.array([0.2]))
    predicted = observer.predict(corrected, np.array([1.0]), T)
    for state in (corrected, predicted):
        size = np.abs(state.covariance).max()
        assert np.abs(state.covariance - state.covariance.T).max() <= 1e-12 * size
        assert np.linalg.eigvalsh(state.covariance)[0] >= -1e-12 * size
    loss = np.linalg.eigvalsh(root @ root.T - corrected.covariance)[0]
    assert loss >= -1e-9 * (1.0 + np.abs(root).max() ** 2)


@pytest.mark.parametrize("settle_time", [0.0, 5.0, 9.0])
def test_the_certified_gain_takes_over_once_settled_and_covered(
    design: Design, runs: Data, settle_time: float
) -> None:
    observer = design.observer(settle_time=settle_time)
    flow, root = design.request.flow, np.linalg.cholesky(design.P)
    y, u = runs.y[:, 0], runs.u[:, 0]
    handed_over, covered, waited = None, False, False
    certified = np.sqrt(np.diag(design.covariance_bound))
    for index, (before, after) in enumerate(observe(observer, y, u)):
        bound = bounds(observer, design, before)
        if before.certified:
            handed_over = index
            np.testing.assert_allclose(bound, certified, rtol=1e-12)
            break
        own = np.sqrt(np.diag(before.covariance))
        np.testing.assert_allclose(bound, np.maximum(certified, own), rtol=1e-12)
        _, covariance = flow.predict_with_covariance(after.x, after.covariance, u[index], T)
        covered = np.linalg.eigvalsh(root.T @ covariance @ root)[-1] <= 1.0
        waited = (index + 1) * T >= settle_time - 1e-9
        if not (covered and waited):
            assert not observer.predict(after, u[index], T).certified
    assert handed_over is not None
    assert covered
    assert waited
    assert (before.covariance == design.covariance_bound).all()
    # The covariance needs a few seconds of its own, however short the settling time.
    if settle_time == 9.0:
        assert handed_over == 1800
    else:
        assert 4.0 < handed_over * T < 9.0


def test_a_missed_sample_leaves_the_certified_mode_and_returns(design: Design, runs: Data) -> None:
    observer, flow = design.observer(), design.request.flow
    y, u = runs.y[:, 0], runs.u[:, 0]
    state = settled(observer, design, runs.truth[0, 0])
    state, _ = observer.correct(state, y[0])
    state = observer.predict(state, u[0], T)
    assert state.certified

    # No measurement now: the bound itself is propagated, without one.
    x, covariance = flow.predict_with_covariance(state.x, design.covariance_bound, u[1], T)
    state = observer.predict(state, u[1], T)
    assert not state.certified
    assert (state.x == x).all()
    assert (state.covariance == covariance).all()
    assert (bounds(observer, design, state) >= (1.0 - 1e-12) * design.bound_std).all()

    states = list(observe(observer, y[2:1002], u[2:1002], state))
    certified = [before.certified for before, _ in states]
    first = certified.index(True)
    # The settling time is for unknown starts; a miss costs only as long as it takes.
    assert 0 < first * T < 1.0
    assert all(certified[first:])


def test_the_bound_grows_with_every_sample_missed(design: Design) -> None:
    observer, u = design.observer(torque_rate=0.0), np.array([0.5])
    root = np.linalg.cholesky(design.P)
    state = settled(observer, design, np.zeros(5))
    sizes = [1.0]
    for _ in range(10):
        state = observer.predict(state, u, T)
        assert not state.certified
        sizes.append(np.linalg.eigvalsh(root.T @ state.covariance @ root)[-1])
    assert (np.diff(sizes) > 0.0).all()
    long = observer.predict(settled(observer, design, np.zeros(5)), u, 10 * T)
    np.testing.assert_allclose(long.x, state.x, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(long.covariance, state.covariance, rtol=1e-8, atol=1e-14)


@pytest.mark.parametrize(
    ("fraction", "regular"),
    [(1.0, True), (0.95, True), (1.05, True), (0.85, False), (1.2, False), (2.0, False)],
)
def test_steps_far_from_the_period_are_not_covered(
    design: Design, fraction: float, regular: bool
) -> None:
    assert PERIOD_TOLERANCE == 0.1
    observer = design.observer()
    state, _ = observer.correct(settled(observer, design, np.zeros(5)), np.array([0.01]))
    after = observer.predict(state, np.array([0.0]), fraction * T)
    if regular:
        assert after.certified
    elif fraction > 1.0:
        # A shorter step may still be covered, by its own covariance; a longer one is not.
        assert not after.certified


@pytest.mark.parametrize("fraction", [0.0, 0.2, 0.5, 0.8, 1.0])
def test_the_bound_covers_the_time_between_samples_too(design: Design, fraction: float) -> None:
    """What `extrapolate` claims, at every pair of ends of the slopes, to one in a million."""
    observer, u = design.observer(), np.array([0.5])
    corrected, _ = observer.correct(settled(observer, design, np.full(5, 0.1)), np.array([0.1]))
    between = observer.extrapolate(corrected, u, fraction * T)
    assert between.certified
    assert (between.covariance == design.covariance_bound).all()
    np.testing.assert_allclose(
        between.x, design.request.flow.predict(corrected.x, u, fraction * T), rtol=1e-14
    )
    root = np.linalg.cholesky(design.P)
    step = design.request.flow.transition(fraction * T)
    for first, second in product(design.request.slope_range, repeat=2):
        before, after = np.eye(5), np.eye(5)
        before[1, 0], after[1, 0] = -step.half_kick * first, -step.half_kick * second
        spread = step.phi @ before @ posterior(design) @ before.T @ step.phi.T + step.noise
        relative = np.linalg.eigvalsh(root.T @ after @ spread @ after.T @ root)
        assert relative[-1] <= 1.0 + 1e-6


def test_the_readout_is_in_physical_units(design: Design) -> None:
    observer = design.observer()
    readout = observer.readout(settled(observer, design, [0.1, 0.2, 3.0, 4.0, 0.05]))
    np.testing.assert_allclose(readout.state, [0.1, 0.2, 0.3, 0.4], rtol=1e-14)
    np.testing.assert_allclose(readout.state_bound, design.bound_std[:4], rtol=1e-12)
    np.testing.assert_allclose(readout.disturbance, [0.05], rtol=1e-14)
    np.testing.assert_allclose(readout.disturbance_bound, design.bound_std[4:], rtol=1e-12)
    assert (readout.disturbance_rate == [0.0]).all()
    assert readout.certified
    assert not observer.readout(observer.initial()).certified


def test_a_jump_of_the_sensor_reopens_the_disturbance(design: Design) -> None:
    observer = design.supervised(options=SupervisionOptions(jump_std=0.15, jump_duration=1.5))
    # Seven innovations that lean already, after many of nothing.
    start = settled(observer, design, np.zeros(5)).changed(
        recent=np.repeat([0.0, 3.0], [WINDOW - 7, 7]), watched=WINDOW, watch_age=60.0
    )
    y = 3.0 * np.sqrt(observer.correct(start, [0.0])[1].innovation_covariance[0])
    start = start.changed(sizes=y[0])
    state, correction = observer.correct(start, y)
    assert correction.weight == 1.0
    assert (int(state.jumps), state.certified, state.corrected) == (1, 0, 1)
    assert (state.settling, state.pause) == (1.5, 1.5)
    # What they lean by is taken for the step of the sensor.
    moved = y * design.K[:, 0] + [0.0, 0.0, 0.0, 0.0, y[0]]
    np.testing.assert_allclose(state.x, moved, rtol=1e-12)
    expected = posterior(design) + np.diag([0.0, 0.0, 0.0, 0.0, 0.15**2])
    np.testing.assert_allclose(state.covariance, expected, rtol=1e-9, atol=1e-16)
    # The next gain trusts the measurement of the bias more than the certified one does.
    _, correction = observer.correct(observer.predict(state, np.zeros(1), T), np.array([0.1]))
    assert correction.gain[4, 0] > 10.0 * design.K[4, 0]


@pytest.mark.parametrize("gain_mode", list(GainMode))
def test_each_arm_of_a_batch_hands_over_by_itself(
    design: Design, runs: Data, gain_mode: GainMode
) -> None:
    observer = design.observer(settle_time=0.0, gain_mode=gain_mode)
    y, u = runs.y[:1800], runs.u[:1800]
    batch, alone = observer.initial((4,)), [observer.initial() for _ in range(4)]
    handed_over = set()
    for k in range(1800):
        batch = observer.predict(observer.correct(batch, y[k])[0], u[k], T)
        for run, state in enumerate(alone):
            corrected, _ = observer.correct(state, y[k, run])
            alone[run] = observer.predict(corrected, u[k, run], T)
        handed_over.add(tuple(batch.certified))
        together = batch.records.tobytes()
        assert together == b"".join(state.records.tobytes() for state in alone)
    # The Riccati mode never hands over, although the bound covers it as well.
    assert batch.certified.all() == (gain_mode is GainMode.CERTIFIED)
    if gain_mode is GainMode.CERTIFIED:
        assert len(handed_over) > 2
    else:
        root = np.linalg.cholesky(design.P)
        relative = np.linalg.eigvalsh(root.T @ batch.covariance @ root)
        assert relative[..., -1].max() < 1.0
        assert handed_over == {(0, 0, 0, 0)}


@pytest.mark.parametrize("gain_mode", list(GainMode))
def test_it_converges_within_three_seconds_from_a_wrong_start(
    design: Design, runs: Data, gain_mode: GainMode
) -> None:
    """From zero: the link, the motor and the bias are all far away, by the certified bound."""
    observer = design.observer(gain_mode=gain_mode)
    states = np.stack([before.x for before, _ in observe(observer, runs.y, runs.u)])
    errors = np.abs(states - runs.truth)
    bound = np.sqrt(np.diag(design.covariance_bound))
    assert (errors[0].max(axis=0) > 5.0 * bound)[[0, 2, 4]].all()
    # Five deviations: 4 runs, 5 states and 1400 correlated samples.
    assert (errors[600:] < 5.0 * bound).all()
    rms = np.sqrt((errors[600:] ** 2).mean(axis=(0, 1)))
    assert (rms < 1.5 * bound).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"settle_time": -1.0}, "settle_time: expected a finite number of at least 0, got -1.0"),
        ({"measurement_covariance": np.eye(2)}, r"R: expected shape \(1, 1\), got \(2, 2\)"),
        ({"initial_covariance": np.eye(4)}, r"initial covariance: expected shape \(5, 5\), got"),
        ({"certified": CertifiedGain(np.zeros((4, 1)), np.eye(5))}, r"K: expected shape \(5, 1\)"),
        ({"certified": CertifiedGain(np.zeros((5, 1)), np.eye(4))}, r"X: expected shape \(5, 5\)"),
        ({"certified": CertifiedGain(np.full((5, 1), np.nan), np.eye(5))}, "K: every entry must"),
    ],
)
def test_a_matrix_of_the_wrong_shape_is_named(
    design: Design, change: dict[str, Any], message: str
) -> None:
    arguments: dict[str, Any] = {
        "flow": design.request.flow,
        "measurement_covariance": design.request.measurement_covariance,
        "initial_covariance": design.request.initial_covariance,
        "certified": CertifiedGain(design.K, design.covariance_bound),
    }
    with pytest.raises(ModelError, match=message):
        certified_estimator(**(arguments | change))


def test_an_observer_starts_with_the_numbers_of_its_design(design: Design) -> None:
    quiet = replace(design.request, initial_std=(0.1, 0.1, 0.1, 0.1))
    observer = replace(design, request=quiet).observer(settle_time=2.0)
    state = observer.initial((3,))
    assert state.x.shape == (3, 5)
    assert not state.x.any()
    assert (state.covariance == np.tile(quiet.initial_covariance, (3, 1, 1))).all()
    for name, value in (("settling", 2.0), ("certified", 0), ("corrected", 0)):
        assert (getattr(state, name) == [value] * 3).all()
    expected = quiet.initial_covariance.diagonal() ** 0.5
    np.testing.assert_allclose(bounds(observer, design, state), np.tile(expected, (3, 1)))


def test_extrapolation_beyond_the_next_sample_is_not_certified(design: Design) -> None:
    observer, u = design.observer(torque_rate=0.0), np.array([0.5])
    corrected, _ = observer.correct(settled(observer, design, np.full(5, 0.1)), np.array([0.1]))
    late = observer.extrapolate(corrected, u, 3 * T)
    x, covariance = design.request.flow.predict_with_covariance(
        corrected.x, posterior(design), u, 3 * T
    )
    assert not late.certified
    assert (late.x == x).all()
    np.testing.assert_allclose(late.covariance, covariance, rtol=1e-9, atol=1e-16)
