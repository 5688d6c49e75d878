# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The likelihood of recordings: its filter is the package's own, and its derivatives are right."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from identified_joint import ARM, recorded, request_of

import tsobs_ros as ts
from tsobs_ros.design.problem import DisturbanceTerm
from tsobs_ros.design.request import Output, TorqueDisturbance
from tsobs_ros.estimation.baselines import extended_kalman
from tsobs_ros.identification.joint import Joint, with_values
from tsobs_ros.identification.likelihood import Recording, innovations
from tsobs_ros.model.arm import TorquePath

DRIFT = DisturbanceTerm("gauss_markov", {"std": 0.02, "time_constant": 0.5})


def recording_of(request: ts.ArmRequest, **changes: Any) -> Recording:
    time, y, u = recorded(request, 2.0, **changes)
    durations = np.full(len(time), request.period)
    return Recording("test", time, durations, y.reshape(len(time), -1), u)


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
