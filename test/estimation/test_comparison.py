# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""PO, PIO and EKFs against their definitions."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag

from tsobs_ros.design.file import load_design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.baselines import THETA_STD, THETA_WANDER, high_gain_matrix
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.methods import ObserverSettings, make_tracker
from tsobs_ros.model.arm import LINK_VELOCITY, MOTOR_VELOCITY, ElasticJointArm
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

Array = NDArray[np.float64]

ARM = ElasticJointArm()
PERIOD = 0.005
RUN = simulate(SCENARIOS["noise"], [3], 20.0)
SHIPPED = load_design(config_path(SHIPPED_DESIGN))


@pytest.mark.parametrize("theta", [2.0, 5.0])
def test_observers_have_their_poles(theta: float) -> None:
    arm = ARM.slope_matrix(1.0)
    high = arm - high_gain_matrix(ARM, theta) @ ARM.output_matrix
    joined = block_diag(0.0, arm)
    joined[0, 1] = 1.0  # the integral of the error
    joined[:, :1] -= high_gain_matrix(ARM, theta, integral=True)
    for closed, spread in ((high, [1.3, 1.2, 1.1, 1.0]), (joined, [1.4, 1.3, 1.2, 1.1, 1.0])):
        poles = np.sort(np.linalg.eigvals(closed).real)
        np.testing.assert_allclose(poles, -theta * np.array(spread), rtol=1e-5)


def stamps_of(count: int) -> NDArray[np.int64]:
    return 10**9 + 5_000_000 * np.arange(count)


def test_parameters_of_an_ekf_are_as_states() -> None:
    """Two stages against the filter of [x; w; θ], whose Jacobian is that of its own steps."""
    request, count = SHIPPED.arm_request, 400
    flow, uncertainty = request.flow, request.uncertainty_model
    step, n, k = flow.nominal, flow.state_count, uncertainty.count
    rows, effects = [LINK_VELOCITY, MOTOR_VELOCITY], uncertainty.directions[:, 0]
    phi, noise = np.eye(n + k), np.zeros((n + k, n + k))
    phi[:n, :n], noise[:n, :n] = step.phi, step.noise
    noise[n:, n:] = THETA_WANDER * PERIOD * np.eye(k)
    C = np.c_[flow.output_matrix, np.zeros((1, k))]
    x, P = np.zeros(n + k), block_diag(request.initial_covariance, THETA_STD**2 * np.eye(k))

    def kicked(x: Array, torque: float) -> Array:
        push = effects[:, rows] @ [*x[:4], np.sin(x[0]), torque, 0.0, torque]
        after = x.copy()
        after[rows] += 0.5 * step.duration * (x[n:] @ push)
        after[LINK_VELOCITY] -= 0.5 * step.duration * flow.gravity_gain * np.sin(x[0])
        return after

    def slope(x: Array, torque: float) -> Array:
        columns = 1e-6 * np.eye(n + k)
        sides = [kicked(x + each, torque) - kicked(x - each, torque) for each in columns]
        return np.array(sides).T / 2e-6

    ekf = make_tracker(SHIPPED, ObserverSettings(method="ekf_augmented"))
    found = ekf.follow(stamps_of(count), RUN.measurements[0, :count], RUN.torques[0, :count])
    to_physical = request.arm.to_physical
    for y, (u,), row in zip(RUN.measurements[0], RUN.torques[0], found, strict=False):
        gain = P @ C.T / (C @ P @ C.T + request.measurement_covariance)
        x, P = x + gain @ (y - C @ x), P - gain @ C @ P
        std = np.sqrt(np.diag(P))
        for name, expected in (
            ("state", to_physical(x[:4])),
            ("state_bound", to_physical(std[:4])),
            ("parameters", x[n:]),
            ("parameter_bound", std[n:]),
        ):
            np.testing.assert_allclose(row[name], expected, rtol=0.01, atol=1e-3)
        F, x = slope(x, u), kicked(x, u)
        x = phi @ x
        x[:n] += step.gamma[:, 0] * u
        F, x = slope(x, u) @ phi @ F, kicked(x, u)
        P = F @ P @ F.T + noise


def test_an_ekf_that_leaves_out_most_samples_starts_its_covariance_again() -> None:
    y, u = RUN.measurements[0].copy(), RUN.torques[0]
    y[2000:] += 1.0
    ekf, plain = (
        make_tracker(SHIPPED, ObserverSettings(method=method)) for method in ("ekf", "ekf_plain")
    )
    rows, others = (each.follow(stamps_of(len(y)), y, u) for each in (ekf, plain))
    bounds, left_out = rows.state_bound, ekf.rejected

    assert left_out[RejectReason.GATED] == pytest.approx(0.3 / PERIOD, abs=5)
    assert not plain.rejected
    assert bounds[2070:2200].max() > 10.0 * bounds[1999].max()
    assert rows.disturbance[-200:].mean() == pytest.approx(1.0, abs=0.05)
    assert rows[:2000].tobytes() == others[:2000].tobytes()


def test_samples_that_are_followed_ascend() -> None:
    with pytest.raises(ModelError, match="stamps: expected them to ascend from 0 ns on"):
        make_tracker(SHIPPED).follow([5, 5, 7], np.zeros((3, 1)), np.zeros((3, 1)))
