# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certified bound against the errors of many simulated runs."""

import numpy as np

from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output, TorqueDisturbance
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation.records import Basis
from tsobs_ros.simulation.plant import Plant, Scenario, SimulatedOutput
from tsobs_ros.simulation.plant import TorqueDisturbance as TrueTorques
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import GaussMarkov, Sine

RUNS, SAMPLES = 800, 1000
WALK = 1e6
"""Time constant of a drift that is a random walk for the length of a run [s]."""


def test_the_covariance_of_the_errors_stays_below_the_bound_and_not_far() -> None:
    """Encoders on both sides, the link's biased, and an unknown torque at the link, for 5 s.

    The truth is the differential equation with random accelerations, not the prediction that the
    design was made with. The largest eigenvalue of X⁻¹cov(e) may exceed 1 only as far as sampling
    makes it: for `RUNS` normal samples of n numbers whose covariance is X itself, it tends to
    (1 + √(n/800))², 1.18 for n = 6, with a deviation of about 0.04.
    """
    drift = DisturbanceTerm("gauss_markov", {"std": 0.5, "time_constant": 0.5})
    bias = DisturbanceTerm("bias")
    asked = ArmRequest(
        outputs=[Output("motor_angle", 0.002), Output("link_angle", 0.01, [bias])],
        torque_disturbance=TorqueDisturbance(link=[drift]),
    )
    design, rng = synthesise(asked), np.random.default_rng(20260101)
    wander = GaussMarkov((0.5 * bias["density"] * WALK) ** 0.5, WALK)
    scenario = Scenario(
        rate=asked.rate,
        initial_state=(0.2, 0.0, 1.4, 0.0),
        initial_spread=(0.02, 0.02, 0.1, 0.1),
        process_noise=asked.process_noise,
        excitation=Sine(0.8),
        outputs=(
            SimulatedOutput("motor_angle", Sensor(0.002)),
            SimulatedOutput("link_angle", Sensor(0.01), (wander,)),
        ),
        torque_disturbance=TrueTorques(link=(GaussMarkov(0.5, 0.5),)),
    )
    runs = Plant(scenario, range(RUNS)).run(SAMPLES + 1)
    parts = [runs.states, runs.disturbances[..., 1:], runs.torque_disturbances[..., 1:]]
    truth, X = np.concatenate(parts, axis=2), design.covariance_bound
    observer = design.observer()
    start = observer.initial((RUNS,)).changed(
        x=truth[:, 0] - rng.standard_normal((RUNS, len(X))) @ np.linalg.cholesky(X).T,
        covariance=np.tile(X, (RUNS, 1, 1)),
        settling=np.zeros(RUNS),
        certified=np.ones(RUNS),
    )
    # A last sample that is lost leaves the estimate as it is just before it.
    y = runs.measurements.copy()
    y[:, -1] = np.nan
    known = observer.observe(y, runs.torques, start=start)
    assert (known.basis == Basis.CERTIFIED).all()
    assert max(np.abs(truth[..., 0]).max(), np.abs(known.state[..., 0]).max()) < asked.x_max
    estimate = asked.arm.from_physical(known.state[:, -1])
    found = [estimate, known.disturbance[:, -1, 1:], known.torque_disturbance[:, -1]]
    errors = truth[:, -1] - np.hstack(found)
    root, covariance = np.linalg.cholesky(design.P), errors.T @ errors / RUNS
    assert np.linalg.eigvalsh(root.T @ covariance @ root)[-1] < 1.27
    share = np.sqrt(np.diag(covariance) / np.diag(X))
    assert ((share > 0.4) & (share < 1.05)).all()
