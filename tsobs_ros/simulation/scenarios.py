# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The scenarios that the observers are compared on, and Monte Carlo runs of them."""

from collections.abc import Sequence
from dataclasses import replace

from tsobs_ros.simulation.plant import Mismatch, Plant, Scenario, Trajectories
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


def simulate(
    scenario: Scenario, seeds: Sequence[int], duration: float | None = None
) -> Trajectories:
    """Run a scenario once for each seed, all runs at once.

    Everything is kept: 88 bytes a run and sample, 63 MB for 60 runs of a minute.

    Args:
        scenario: What happens.
        seeds: One for each run.
        duration: How long [s]; the scenario's own by default.

    Raises:
        ModelError: A seed or the duration is negative, or there is no seed.
    """
    timed = scenario if duration is None else replace(scenario, duration=duration)
    return Plant(timed, list(seeds)).run(timed.sample_count)
