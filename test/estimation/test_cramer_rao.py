# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The posterior Cramér–Rao bound: a Kalman filter's covariance on a linear arm."""

import numpy as np
from bayesian_filters.kalman import KalmanFilter
from numpy.typing import NDArray

from tsobs_ros.estimation.cramer_rao import cramer_rao_std, white_information
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.disturbance import gauss_markov
from tsobs_ros.model.flow import ArmFlow, ProcessNoise

Array = NDArray[np.float64]

COUNT, JUMP, STD = 700, 400, 0.028
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
