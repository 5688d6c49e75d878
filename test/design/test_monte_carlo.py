# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certified bound, and its multiples, against the errors of many simulated runs."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output, TorqueDisturbance
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation.records import Basis
from tsobs_ros.model.arm import SIDES
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.simulation.plant import Plant, Scenario, SimulatedOutput
from tsobs_ros.simulation.plant import TorqueDisturbance as TrueTorques
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import GaussMarkov, Sine

pytestmark = pytest.mark.xdist_group("monte carlo")  # its fixtures take seconds

Array = NDArray[np.float64]
RUNS = 800
INSTANTS = (200, 1000)
WALK = 1e6

"""Time constant of a drift that is a random walk for the length of a run [s]."""


class Campaign(NamedTuple):
    """Errors of the certified loop divided by s, shape (instants, runs, n), and the largest |q₁|.

    Both the true angle and the estimated one count for that.
    """

    design: Design
    errors: Array
    widest: float


@pytest.fixture(scope="module")
def contact() -> Design:
    """A design for encoders on both sides, the link's biased, and an unknown torque at the link."""
    drift = DisturbanceTerm("gauss_markov", {"std": 0.5, "time_constant": 0.5})
    return synthesise(
        ArmRequest(
            outputs=[
                Output("motor_angle", 0.002),
                Output("link_angle", 0.01, [DisturbanceTerm("bias")]),
            ],
            torque_disturbance=TorqueDisturbance(link=[drift]),
        )
    )


def outputs_of(asked: ArmRequest, scale: float, process: float) -> tuple[SimulatedOutput, ...]:
    """Return what a request measures, with sensors s times as noisy and biases that wander."""
    return tuple(
        SimulatedOutput(
            output.measures,
            Sensor(scale * output.measurement_std),
            tuple(
                GaussMarkov((0.5 * term["density"] * process**2 * WALK) ** 0.5, WALK)
                for term in output.disturbance
                if term.kind == "bias"
            ),
        )
        for output in asked.sensors
    )


@pytest.fixture(
    scope="module",
    params=[
        ("shipped", 1.5, 1.5),
        ("contact", 1.0, 1.0),
    ],
    ids=["all noise times 1.5", "two encoders, contact"],
)
def campaign(request: pytest.FixtureRequest) -> Campaign:
    """Simulate arms, a wandering bias and sensors for 5 s at 200 Hz, from errors as large as s²X.

    The sensor's noise is s times as large as designed, and the process noise as large or s times.
    The truth is the differential equation with random accelerations, not the prediction that the
    design was made with.
    """
    name, scale, process = request.param
    design: Design = request.getfixturevalue(name)
    asked, rng = design.arm_request, np.random.default_rng(20260101)
    noise = asked.process_noise
    scenario = Scenario(
        arm=asked.arm,
        rate=asked.rate,
        initial_state=(0.2, 0.0, 1.4, 0.0),
        initial_spread=(0.02, 0.02, 0.1, 0.1),
        process_noise=ProcessNoise(noise.link * process**2, noise.motor * process**2),
        excitation=Sine(0.8),
        outputs=outputs_of(asked, scale, process),
        torque_disturbance=TrueTorques(
            link=tuple(
                GaussMarkov(term["std"], term["time_constant"])
                for term in asked.torque_disturbance.link
            )
        ),
    )
    runs = Plant(scenario, range(RUNS)).run(INSTANTS[-1] + 1)
    # What is known to be zero is no state.
    disturbed = [output.model.state_count > 0 for output in asked.sensors]
    torques = runs.torque_disturbances[..., [side in asked.torque_sides for side in SIDES]]
    truth = np.concatenate([runs.states, runs.disturbances[..., disturbed], torques], axis=2)
    X = design.covariance_bound
    error = scale * rng.standard_normal((RUNS, len(X))) @ np.linalg.cholesky(X).T
    observer = design.observer()
    start = observer.initial((RUNS,)).changed(
        x=truth[:, 0] - error,
        covariance=np.tile(X, (RUNS, 1, 1)),
        settling=np.zeros(RUNS),
        certified=np.ones(RUNS),
    )
    errors, widest = [], float(np.abs(truth[..., 0]).max())
    for index in INSTANTS:
        # A last sample that is lost leaves the estimate as it is just before it.
        y = runs.measurements[:, : index + 1].copy()
        y[:, index] = np.nan
        known = observer.observe(y, runs.torques[:, : index + 1], start=start)
        assert (known.basis == Basis.CERTIFIED).all()
        widest = max(widest, float(np.abs(known.state[..., 0]).max()))
        estimate = asked.arm.from_physical(known.state[:, index])
        parts = [known.disturbance[:, index][:, disturbed], known.torque_disturbance[:, index]]
        errors.append((truth[:, index] - np.hstack([estimate, *parts])) / scale)
    return Campaign(design, np.array(errors), widest)


def test_the_covariance_of_the_errors_stays_below_the_bound(campaign: Campaign) -> None:
    """The largest eigenvalue of X⁻¹cov(e)/s² may exceed 1 only as far as sampling makes it.

    For `RUNS` normal samples of n = 5 numbers whose covariance is X itself, that eigenvalue tends
    to (1 + √(5/800))² = 1.16, with a deviation of about 0.04.
    """
    assert campaign.widest < campaign.design.arm_request.x_max
    root = np.linalg.cholesky(campaign.design.P)
    for errors in campaign.errors:
        spread = root.T @ (errors.T @ errors / RUNS) @ root
        assert np.linalg.eigvalsh(spread)[-1] < 1.25


def test_the_bound_is_not_idle(campaign: Campaign) -> None:
    """Each state's deviation is most of its certified one, so that the bound says something."""
    rms = np.sqrt((campaign.errors**2).mean(axis=(0, 1)))
    share = rms / np.sqrt(np.diag(campaign.design.covariance_bound))
    assert (share > 0.4).all()
    assert (share < 1.03).all()
