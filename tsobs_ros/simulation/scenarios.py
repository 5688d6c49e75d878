# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The scenarios that the observers are compared on, and Monte Carlo runs of them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.simulation.plant import Mismatch, Plant, Scenario
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep, GaussMarkov, Ramp, Sinusoid

_NOISE = Scenario()
_STIFF = Mismatch(stiffness=0.2)
_SOFT_HEAVY = Mismatch(stiffness=-0.2, gravity_torque=0.2)
_DROPOUTS = Sensor(dropout_interval=10.0, dropout_duration=0.5)

SCENARIOS: dict[str, Scenario] = {
    "noise": _NOISE,
    "bias_step": replace(_NOISE, disturbance=(BiasStep(0.1, 30.0),)),
    "sinusoid": replace(_NOISE, disturbance=(Sinusoid(0.2, 3.0, 2.0),)),
    "drift": replace(_NOISE, disturbance=(GaussMarkov(0.1, 20.0),)),
    "ramp": replace(_NOISE, disturbance=(Ramp(0.004, 10.0),)),
    "stiff": replace(_NOISE, mismatch=_STIFF),
    "stiff_bias_step": replace(_NOISE, mismatch=_STIFF, disturbance=(BiasStep(0.1, 30.0),)),
    "soft_heavy_bias_step": replace(
        _NOISE, mismatch=_SOFT_HEAVY, disturbance=(BiasStep(0.1, 30.0),)
    ),
    "stiff_sinusoid": replace(_NOISE, mismatch=_STIFF, disturbance=(Sinusoid(0.2, 3.0, 2.0),)),
    "outliers": replace(_NOISE, sensor=Sensor(outlier_probability=0.01, outlier_size=1.0)),
    "dropouts": replace(_NOISE, sensor=_DROPOUTS),
    "stiff_dropouts": replace(_NOISE, mismatch=_STIFF, sensor=_DROPOUTS),
}
"""One minute each at 200 Hz, u = sin t; "stiff" is +20 % stiffness, "soft_heavy" is −20 % stiffness
with +20 % gravity."""


class Trajectories(NamedTuple):
    """A batch of runs.

    Attributes:
        times: [s], shape (samples,).
        states: True states in the nominal arm's design coordinates, shape (runs, samples, 4).
        disturbances: True disturbances [rad], shape (runs, samples, 1).
        measurements: y [rad], NaN if lost, shape (runs, samples, 1).
        torques: Torque held from each sample to the next [N m], shape (runs, samples, 1).
    """

    times: Array
    states: Array
    disturbances: Array
    measurements: Array
    torques: Array


def simulate(
    scenario: Scenario, seeds: Sequence[int], duration: float | None = None
) -> Trajectories:
    """Run a scenario once for each seed, all runs at once.

    Everything is kept: 56 bytes a run and sample, 40 MB for 60 runs of a minute. A campaign that
    needs less of it steps a `Plant` with the same seeds instead, to the same numbers.

    Args:
        scenario: What happens.
        seeds: One for each run.
        duration: How long [s]; the scenario's own by default.

    Raises:
        ModelError: A seed or the duration is negative, or there is no seed.
    """
    timed = scenario if duration is None else replace(scenario, duration=duration)
    plant, samples, runs = Plant(timed, list(seeds)), timed.sample_count, len(seeds)
    # Filled sample by sample, so the samples lead in memory; callers see the runs first.
    times = np.empty(samples)
    kept = [np.empty((samples, runs, width)) for width in (4, 1, 1, 1)]
    for index in range(samples):
        sample = plant.step()
        times[index] = sample.time
        values = (sample.state, sample.disturbance, sample.measurement, sample.torque)
        for array, value in zip(kept, values, strict=True):
            array[index] = value
    return Trajectories(times, *(np.moveaxis(array, 0, 1) for array in kept))
