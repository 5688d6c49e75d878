# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certified bound against the errors of many simulated runs."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.design.record import Design

Array = NDArray[np.float64]
RUNS = 800
SUBSTEPS = 5


class Campaign(NamedTuple):
    """Errors of the certified loop, shape (checkpoints, runs, n), and the largest |q₁|."""

    errors: Array
    widest: float


@pytest.fixture(scope="module")
def campaign(shipped: Design, runge_kutta: Callable[..., Array]) -> Campaign:
    """Simulate arms, a wandering bias and sensors for 8 s at 200 Hz, from errors as large as X.

    The truth is the differential equation with random accelerations every millisecond, not the
    prediction the design was made with.
    """
    rng = np.random.default_rng(20260101)
    request = shipped.request
    arm, period, std = request.arm, request.period, request.measurement_std
    substep = period / SUBSTEPS
    gain = arm.stiffness / arm.link_inertia
    kick_std = np.sqrt([0.0, 1e-4 * substep, 0.0, 1e-5 * gain**2 * substep])

    x = np.array([0.3, 0.0, 2.0, 0.0]) + rng.standard_normal((RUNS, 4)) * [0.05, 0.1, 0.5, 0.5]
    bias = 0.1 * rng.standard_normal((RUNS, 1))
    start = rng.standard_normal((RUNS, 5)) @ np.linalg.cholesky(shipped.covariance_bound).T
    observer = shipped.observer()
    truth = np.hstack([x, bias])
    bound = np.tile(shipped.covariance_bound, (RUNS, 1, 1))
    state = observer.initial((RUNS,)).changed(
        x=truth + start, covariance=bound, settling=np.zeros(RUNS), certified=np.ones(RUNS)
    )
    errors, widest = [], 0.0
    for k in range(1600):
        widest = max(widest, float(np.abs(x[:, 0]).max()))
        if k % 200 == 199:
            errors.append(state.x - np.hstack([x, bias]))
        u = np.full((RUNS, 1), math.sin(k * period))
        y = x[:, :1] + bias + std * rng.standard_normal((RUNS, 1))
        state, _ = observer.correct(state, y)
        state = observer.predict(state, u, period)
        assert state.certified.all()
        for _ in range(SUBSTEPS):
            x = runge_kutta(lambda z, u=u: arm.derivative(z, u), x, substep)
            x = x + kick_std * rng.standard_normal((RUNS, 4))
        bias = bias + math.sqrt(1e-4 * period) * rng.standard_normal((RUNS, 1))
    return Campaign(np.array(errors), widest)


def test_the_runs_stay_in_the_certified_domain(campaign: Campaign, shipped: Design) -> None:
    assert campaign.widest < shipped.request.x_max


def test_the_covariance_of_the_errors_stays_below_the_bound(
    campaign: Campaign, shipped: Design
) -> None:
    """The largest eigenvalue of X⁻¹cov(e) may exceed 1 only as far as sampling makes it.

    For `RUNS` normal samples of n = 5 numbers whose covariance is X itself, that eigenvalue tends
    to (1 + √(5/800))² = 1.16, with a deviation of about 0.04.
    """
    root = np.linalg.cholesky(shipped.P)
    for errors in campaign.errors:
        spread = root.T @ (errors.T @ errors / RUNS) @ root
        assert np.linalg.eigvalsh(spread)[-1] < 1.25


def test_the_bound_is_not_idle(campaign: Campaign, shipped: Design) -> None:
    """Each state's deviation is most of its certified one, so that the bound says something."""
    rms = np.sqrt((campaign.errors**2).mean(axis=(0, 1)))
    share = rms / np.sqrt(np.diag(shipped.covariance_bound))
    assert (share > 0.7).all()
    assert (share < 1.03).all()
