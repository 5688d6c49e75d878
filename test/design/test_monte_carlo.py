# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certified bound, and its multiples, against the errors of many simulated runs."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.design.record import Design
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.simulation.plant import Plant, Scenario
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import GaussMarkov, Sine

Array = NDArray[np.float64]
RUNS = 800
INSTANTS = (200, 1000)
WALK = 1e6
"""Time constant of a drift that is a random walk for the length of a run [s]."""


class Campaign(NamedTuple):
    """Errors of the certified loop divided by s, shape (instants, runs, n), and the largest |q₁|.

    Both the true angle and the estimated one count for that.
    """

    errors: Array
    widest: float


@pytest.fixture(
    scope="module",
    params=[(1.0, 1.0), (1.5, 1.5), (3.0, 1.0)],
    ids=["as designed", "all noise times 1.5", "sensor noise times 3"],
)
def campaign(request: pytest.FixtureRequest, shipped: Design) -> Campaign:
    """Simulate arms, a wandering bias and sensors for 5 s at 200 Hz, from errors as large as s²X.

    The sensor's noise is s times as large as designed, and the process noise as large or s times.
    The truth is the differential equation with random accelerations, not the prediction that the
    design was made with.
    """
    scale, process = request.param
    asked, rng = shipped.arm_request, np.random.default_rng(20260101)
    density = float(asked.disturbance[0]["density"]) * process**2
    noise = asked.process_noise
    scenario = Scenario(
        arm=asked.arm,
        rate=asked.rate,
        initial_state=(0.2, 0.0, 1.4, 0.0),
        initial_spread=(0.02, 0.02, 0.1, 0.1),
        process_noise=ProcessNoise(noise.link * process**2, noise.motor * process**2),
        excitation=Sine(0.8),
        disturbance=(GaussMarkov((0.5 * density * WALK) ** 0.5, WALK),),
        sensor=Sensor(scale * asked.measurement_std),
    )
    runs = Plant(scenario, range(RUNS)).run(INSTANTS[-1] + 1)
    truth = np.concatenate([runs.states, runs.disturbances], axis=2)
    error = scale * rng.standard_normal((RUNS, 5)) @ np.linalg.cholesky(shipped.covariance_bound).T
    observer = shipped.observer()
    start = observer.initial((RUNS,)).changed(
        x=truth[:, 0] - error,
        covariance=np.tile(shipped.covariance_bound, (RUNS, 1, 1)),
        settling=np.zeros(RUNS),
        certified=np.ones(RUNS),
    )
    errors, widest = [], float(np.abs(truth[..., 0]).max())
    for index in INSTANTS:
        # A last sample that is lost leaves the estimate as it is just before it.
        y = runs.measurements[:, : index + 1].copy()
        y[:, index] = np.nan
        known = observer.observe(y, runs.torques[:, : index + 1], start=start)
        assert known.certified.all()
        widest = max(widest, float(np.abs(known.state[..., 0]).max()))
        estimate = asked.arm.from_physical(known.state[:, index])
        errors.append(
            (truth[:, index] - np.hstack([estimate, known.disturbance[:, index]])) / scale
        )
    return Campaign(np.array(errors), widest)


def test_the_covariance_of_the_errors_stays_below_the_bound(
    campaign: Campaign, shipped: Design
) -> None:
    """The largest eigenvalue of X⁻¹cov(e)/s² may exceed 1 only as far as sampling makes it.

    For `RUNS` normal samples of n = 5 numbers whose covariance is X itself, that eigenvalue tends
    to (1 + √(5/800))² = 1.16, with a deviation of about 0.04.
    """
    assert campaign.widest < shipped.arm_request.x_max
    root = np.linalg.cholesky(shipped.P)
    for errors in campaign.errors:
        spread = root.T @ (errors.T @ errors / RUNS) @ root
        assert np.linalg.eigvalsh(spread)[-1] < 1.25


def test_the_bound_is_not_idle(campaign: Campaign, shipped: Design) -> None:
    """Each state's deviation is most of its certified one, so that the bound says something."""
    rms = np.sqrt((campaign.errors**2).mean(axis=(0, 1)))
    share = rms / np.sqrt(np.diag(shipped.covariance_bound))
    assert (share > 0.4).all()
    assert (share < 1.03).all()
