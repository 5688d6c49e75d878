# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of no use are refused in one line; a fit filters them as observers do."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from identified_joint import ARM, Recorded, recorded, request_of

import tsobs_ros as ts
from tsobs_ros.design.request import Output, TorqueDisturbance
from tsobs_ros.estimation.baselines import extended_kalman
from tsobs_ros.identification.diagnosis import output_fits
from tsobs_ros.identification.joint import Joint, with_values
from tsobs_ros.identification.likelihood import Recording, innovations
from tsobs_ros.identification.recordings import read
from tsobs_ros.model.arm import TorquePath
from tsobs_ros.model.disturbance import DisturbanceTerm

Spoil = Callable[[Any, Any, Any], tuple[Any, Any, Any]]

SPOILT: dict[str, tuple[Spoil, str]] = {
    "too short": (lambda t, y, u: (t[:200], y[:200], u[:200]), "too short: 200 samples"),
    "no angle": (lambda t, y, u: (t, y * np.nan, u), "too short: 0 samples"),
    "at rest": (
        lambda t, y, u: (t, 1e-4 * np.random.default_rng(0).standard_normal(y.shape), u),
        "at rest: no output moves",
    ),
    "no torque": (lambda t, y, u: (t, y, 0.0 * u), "N m throughout"),
    "sign": (lambda t, y, u: (t, y, -u), "its sign is the opposite"),
    "torque in mN m": (lambda t, y, u: (t, y, 1000.0 * u), "is its unit mN m"),
    "torque before a gear": (lambda t, y, u: (t, y, u / 50.0), "other side of a gear"),
    "exchanged encoders": (lambda t, y, u: (t, y[:, ::-1], u), "seems to be the other"),
    "one encoder inverted": (lambda t, y, u: (t, y * [1.0, -1.0], u), "have opposite signs"),
    "milliseconds": (lambda t, y, u: (1000.0 * t, y, u), "say so: --units time=ms"),
    "degrees": (lambda t, y, u: (t, np.degrees(y), u), "if these are degrees"),
    "motor before a gear": (
        lambda t, y, u: (t, y * np.array([5.0, 1.0]), u),
        "motor_angle moves 4.* times as far as link_angle",
    ),
}


@pytest.fixture(scope="module")
def log() -> Recorded:
    """A good recording of both encoders."""
    return recorded(request_of(), 6.0)


@pytest.mark.parametrize("name", SPOILT)
def test_a_recording_of_no_use_is_refused(log: Recorded, name: str) -> None:
    spoil, message = SPOILT[name]

    with pytest.raises(ts.TsobsError, match=message) as caught:
        ts.fit(request_of(), spoil(*log))

    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("error")
def test_what_is_asked_of_recordings_is_checked(log: Recorded) -> None:
    time, y, u = log
    for request, logs, options, message in (
        (request_of(x_max=0.1), [log], {}, r"beyond 0\.1 rad: .*widen x_max"),
        (request_of(), [(time, y[:, 0], u)], {}, r"outputs \(n, 2\)"),
        (request_of(), [], {}, "at least one recording"),
        (request_of(), [(time, y * [np.nan, 1.0], u)], {}, "motor_angle: only 0 samples"),
        (request_of(), [log], {"held_out": 1.0}, "held_out: expected a share"),
    ):
        with pytest.raises(ts.TsobsError, match=message):
            ts.fit(request, *logs, **options)


def test_recordings_are_put_right_and_remarks_say_how(log: Recorded) -> None:
    """Disorder, repetition, a gap, another rate, and encoders whose zero was never set."""
    time, y, u = log
    keep = np.flatnonzero((time < 2.0) | (time > 2.5))
    order = np.random.default_rng(0).permutation(np.repeat(keep, 2))
    spoilt = time[order], y[order] + np.array([0.0, 6.5]), u[order]
    request, (made,), notes = read(request_of(rate=200.0), [spoilt])

    np.testing.assert_allclose(made.y, y[keep], atol=0.05)
    np.testing.assert_array_equal(made.u, u[keep])
    assert (made.durations < 0.0).sum() == 1
    assert request.rate == 500.0
    assert "500 samples per second, the request 200" in notes[0]
    assert "the zeros of the angles differ" in notes[1]
    assert "gaps left out: 1" in notes[2]


@pytest.mark.parametrize("back", [3.0, 1.7e9])
def test_a_clock_that_restarts_makes_two_recordings(log: Recorded, back: float) -> None:
    """In order of time, the samples of both would alternate."""
    time, y, u = log
    half = len(time) // 2
    _, made, notes = read(
        request_of(), [(np.where(np.arange(len(time)) < half, time + back, time), y, u)]
    )
    assert [each.count for each in made] == [half, len(time) - half]
    np.testing.assert_array_equal(np.concatenate([each.u for each in made]), u)
    assert "clock has restarted" in notes[0]


def test_samples_far_from_their_neighbours_are_left_out(log: Recorded) -> None:
    """Of either encoder, in any size; angles rounded to coarse steps are none."""
    time, y, u = log
    rng = np.random.default_rng(0)
    is_off = rng.random(y.shape) < 0.02
    off = rng.choice([-1.0, 1.0], y.shape) * np.geomspace(0.015, 6.0, len(time))[:, None]
    _, (made,), notes = read(request_of(), [(time, y + is_off * off, u)])
    _, (coarse,), _ = read(request_of(), [(time, 0.01 * np.round(y / 0.01), u)])

    lost = np.isnan(made.y)
    assert lost[is_off].mean() > 0.95
    assert lost[~is_off].mean() < 0.005
    assert f"{lost[:, 1].sum()} of 3,001 samples of link_angle are outliers" in notes[1]
    assert np.isfinite(coarse.y).all()


DRIFT = DisturbanceTerm("gauss_markov", {"std": 0.02, "time_constant": 0.5})


def recording_of(request: ts.ArmRequest, **changes: Any) -> Recording:
    time, y, u = recorded(request, 2.0, **changes)
    durations = np.full(len(time), request.period)
    return Recording(time, durations, y.reshape(len(time), -1), u)


@pytest.mark.parametrize("outputs", [("motor_angle",), ("motor_angle", "link_angle")])
def test_the_filter_is_the_plain_kalman_filter(outputs: tuple[str, ...]) -> None:
    request = request_of(
        ARM,
        *outputs,
        torque=TorquePath(0.9, 0.01, 0.005),
        torque_disturbance=TorqueDisturbance(motor=(DRIFT,)),
    )
    recording = recording_of(request)
    covariances = (request.measurement_covariance, request.initial_covariance)
    filtered = extended_kalman(request.flow, *covariances, gate=np.inf)
    state, expected = filtered.initial(), []
    for y, u in zip(recording.y, recording.u, strict=True):
        state, correction = filtered.correct(state, y)
        expected.append(correction.innovation[0])
        state = filtered.predict(state, [u], request.period)

    found = innovations(Joint.of(request), recording, gate=np.inf)

    np.testing.assert_allclose(found.errors[:, 0], expected, atol=1e-9)


def test_a_late_output_and_its_zero_are_those_of_the_design() -> None:
    late = (Output("motor_angle", 0.001), Output("link_angle", 0.001, delay=0.004))
    request = request_of(ARM, outputs=late)
    recording = recording_of(request)
    joint = Joint.of(request)
    shifted = with_values(joint, {"link_angle.offset": 0.3})
    moved = replace(recording, y=recording.y + np.array([0.0, 0.3]))

    np.testing.assert_allclose(
        innovations(shifted, moved).errors, innovations(joint, recording).errors, atol=1e-12
    )
    small = np.abs(innovations(joint, recording).errors).mean()
    blind = with_values(joint, {"link_angle.delay": 0.0})
    assert np.abs(innovations(blind, recording).errors).mean() > 1.05 * small


def test_outliers_do_not_count_as_wrong_predictions() -> None:
    request = request_of(ARM)
    clean = recording_of(request)
    spoilt = replace(clean, y=clean.y + 0.0)
    spoilt.y[600::100, 1] += 3.0
    ((_, one), _), ((_, other), _) = (
        output_fits(Joint.of(request), r, 500) for r in (clean, spoilt)
    )

    assert (one.outliers, other.outliers) == (0, 5)
    assert other.one_step == pytest.approx(one.one_step, abs=0.5)
