# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Prediction of an arm whose torque is unknown."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

from tsobs_ros.design.file import load_design
from tsobs_ros.model.flow import GAP_MEMORY, GapFlow
from tsobs_ros.resources import FIXED_DESIGN, config_path

FLOW = load_design(config_path(FIXED_DESIGN)).request.flow
RATE = 0.7
GAP_FLOW = GapFlow(FLOW, RATE)
N = FLOW.state_count
START = np.diag(np.linspace(1e-4, 5e-4, N))


def begin(rate: float) -> NDArray[np.float64]:
    """Return the covariance at the start of a gap, when the torque itself is known."""
    return np.asarray(block_diag(START, np.diag([0.0, rate**2])))


def widen(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a state with the torque's change and rate, which are expected to be zero."""
    return np.append(x, [0.0, 0.0])


@pytest.mark.parametrize("duration", [0.0, 0.004, 0.0123, 0.3, 2.0])
def test_the_expected_motion_is_that_of_the_last_torque(duration: float) -> None:
    x, u = np.array([0.3, -0.2, 2.0, 1.0, 0.1]), np.array([1.5])
    moved, _ = GAP_FLOW.predict_with_covariance(widen(x), begin(RATE), u, duration)
    np.testing.assert_allclose(moved[:N], FLOW.predict(x, u, duration), rtol=1e-10, atol=1e-12)
    assert (moved[N:] == 0.0).all()


@pytest.mark.parametrize("duration", [0.02, 0.5, 5.0])
def test_the_torque_wanders_as_it_is_said_to(duration: float) -> None:
    x = np.zeros(N)
    _, covariance = GAP_FLOW.predict_with_covariance(widen(x), begin(RATE), np.zeros(1), duration)
    turns = duration / GAP_MEMORY
    variance = 2.0 * (RATE * GAP_MEMORY) ** 2 * (turns - 1.0 + math.exp(-turns))
    np.testing.assert_allclose(covariance[-2, -2], variance, rtol=1e-9)
    np.testing.assert_allclose(covariance[-1, -1], RATE**2, rtol=1e-9)
    assert GAP_FLOW.rate_variance == RATE**2


@pytest.mark.parametrize("duration", [0.02, 0.5, 3.0])
def test_its_covariance_is_that_of_the_linear_system(duration: float) -> None:
    """Hanging at rest, where the error system is linear and constant."""
    x, u = widen(np.zeros(N)), np.zeros(1)
    _, covariance = GAP_FLOW.predict_with_covariance(x, begin(RATE), u, duration)
    A = GAP_FLOW.drift.copy()
    A[:N, :N] = FLOW.slope_matrix(1.0)
    W = np.zeros_like(A)
    process = FLOW.process_noise
    W[1, 1] = process.link
    W[3, 3] = process.motor * (FLOW.arm.stiffness / FLOW.arm.link_inertia) ** 2
    W[4:N, 4:N] = FLOW.disturbance.G @ FLOW.disturbance.G.T
    W[-1, -1] = 2.0 * RATE**2 / GAP_MEMORY
    # After Van Loan, by parts short enough for the exponential of −A.
    exact, parts = begin(RATE), round(duration / 0.02)
    both = expm(np.block([[-A, W], [np.zeros_like(A), A.T]]) * duration / parts)
    phi = both[len(A) :, len(A) :].T
    for _ in range(parts):
        exact = phi @ exact @ phi.T + phi @ both[: len(A), len(A) :]
    scale = np.sqrt(np.outer(exact.diagonal(), exact.diagonal()))
    assert (np.abs(covariance - exact) <= 1e-3 * scale).all()


def test_without_a_rate_it_is_the_arm_with_a_known_torque() -> None:
    x, u = np.array([0.3, -0.2, 2.0, 1.0, 0.1]), np.array([1.5])
    still = GapFlow(FLOW, 0.0)
    _, covariance = still.predict_with_covariance(widen(x), begin(0.0), u, 0.7)
    _, known = FLOW.predict_with_covariance(x, START, u, 0.7)
    np.testing.assert_allclose(covariance[:N, :N], known, rtol=1e-8, atol=1e-15)


def test_what_is_measured_does_not_depend_on_the_torque() -> None:
    assert (GAP_FLOW.output_matrix[:, :N] == FLOW.output_matrix).all()
    assert (GAP_FLOW.output_matrix[:, N:] == 0.0).all()
