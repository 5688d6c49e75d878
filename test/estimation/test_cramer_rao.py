# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The posterior Cramér–Rao bound: a Kalman filter's covariance on a linear arm."""

import numpy as np
import pytest
from bayesian_filters.kalman import KalmanFilter
from numpy.typing import NDArray

from tsobs_ros.estimation.cramer_rao import cramer_rao_std, white_information
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.disturbance import gauss_markov
from tsobs_ros.model.flow import ArmFlow, ProcessNoise
from tsobs_ros.model.uncertainty import arm_uncertainty

Array = NDArray[np.float64]

COUNT, JUMP, STD = 1500, 700, 0.028
START = np.array([0.05, 0.1, 0.5, 0.5, 0.1])


def flow(gravity: float) -> ArmFlow:
    arm = ElasticJointArm(gravity_torque=gravity)
    return ArmFlow(arm, gauss_markov(0.1, 20.0), ProcessNoise(), 0.005)


def test_on_a_linear_arm_it_is_the_kalman_filters_covariance() -> None:
    linear = flow(1e-12)
    information = np.full(COUNT, white_information(STD))
    information[200:300] = 0.0

    bound = cramer_rao_std(
        linear, np.zeros((3, COUNT, 4)), np.zeros((3, COUNT)), information,
        initial_std=START, offset_std=0.3, jumps=[JUMP],
    )  # fmt: skip

    kalman = KalmanFilter(dim_x=6, dim_z=1)
    kalman.F, kalman.Q = np.eye(6), np.zeros((6, 6))
    kalman.F[:5, :5], kalman.Q[:5, :5] = linear.nominal.phi, linear.nominal.noise
    kalman.H, kalman.R = np.hstack([linear.output_matrix, [[1.0]]]), np.array([[STD * STD]])
    kalman.P = np.diag(np.append(START, 0.3) ** 2)
    for k in range(COUNT):
        if k > 0:
            kalman.predict()
        if k == JUMP:
            kalman.P[5], kalman.P[:, 5] = 0.0, 0.0
            kalman.P[5, 5] = 0.09
        if information[k] > 0.0:
            kalman.update(0.0)
        states = linear.arm.to_physical(np.sqrt(np.diag(kalman.P)[:4]))
        np.testing.assert_allclose(bound[k, :4], states, rtol=1e-8)
        np.testing.assert_allclose(bound[k, 4], np.sqrt(kalman.P[4:, 4:].sum()), rtol=1e-8)


def test_it_is_the_information_of_all_samples_about_what_does_not_move_by_chance() -> None:
    """Against least squares: sensitivities of a simulated run by finite differences."""
    arm = ElasticJointArm()
    still = ArmFlow(arm, gauss_markov(1e-6, 20.0), ProcessNoise(1e-14, 1e-14), 0.005)
    uncertain = arm_uncertainty(arm, {"stiffness": 0.3, "gravity": 0.3})
    torque = 2.0 * np.sin(np.arange(COUNT) * 0.005)

    def run(change: Array) -> Array:
        x = arm.from_physical([0.3, 0.0, 0.2, 0.0]) + change[:4]
        # θ acts on the accelerations; the coordinates are those of the nominal arm.
        step, states = still.nominal, []
        kicked = uncertain.directions[:, 0]
        for u in torque:
            states.append(x.copy())
            for kick in (True, False, True):
                if kick:
                    signals = np.concatenate([x, [np.sin(x[0]), u, 0.0]])
                    push = np.tensordot(change[5:], kicked, 1) @ signals
                    x = x + 0.5 * step.duration * push
                    x[1] -= step.half_kick * np.sin(x[0])
                else:
                    x = step.phi[:4, :4] @ x + step.gamma[:4, 0] * u
        return np.array(states)

    zero, small = np.zeros(7), 1e-6
    truth = run(zero)
    sensitivity = np.empty((COUNT, 7))
    for place in range(7):
        change = zero.copy()
        change[place] = small
        moved = run(change)[:, 0] + change[4]
        sensitivity[:, place] = (moved - truth[:, 0]) / small
    prior = np.concatenate([START[:4], [0.3, 0.2, 0.2]]) ** -2.0
    least = np.linalg.inv(np.diag(prior) + sensitivity.T @ sensitivity / STD**2)

    bound = cramer_rao_std(
        still, truth[np.newaxis], torque[np.newaxis], np.full(COUNT, white_information(STD)),
        initial_std=np.append(START[:4], 1e-9), offset_std=0.3, uncertainty=uncertain,
        theta_std=0.2,
    )  # fmt: skip

    np.testing.assert_allclose(bound[-1, 4:], np.sqrt(np.diag(least)[4:]), rtol=0.02)


@pytest.mark.parametrize("degrees", [3, 8])
def test_students_noise_has_the_information_of_its_density(degrees: int) -> None:
    t = np.linspace(-400.0, 400.0, 4_000_001)
    density = (1.0 + t * t / degrees) ** (-0.5 * (degrees + 1))
    slope = (degrees + 1) * t / (degrees + t * t)
    expected = float((slope**2 * density).sum() / density.sum())

    assert white_information(STD, degrees) * STD**2 == pytest.approx(expected, rel=1e-3)
