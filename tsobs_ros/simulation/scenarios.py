# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The scenarios that the observers are compared on, and Monte Carlo runs of them."""

import math
from collections.abc import Sequence
from dataclasses import replace

from tsobs_ros.simulation.integrator import Friction
from tsobs_ros.simulation.plant import Mismatch, Plant, Scenario, Trajectories
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import (
    BiasStep,
    Component,
    Constant,
    GaussMarkov,
    Pulses,
    Ramp,
    Sinusoid,
)

_NOISE = Scenario()
_STIFF = Mismatch(stiffness=0.2)
_SOFT_HEAVY = Mismatch(stiffness=-0.2, gravity_torque=0.2)
_DROPOUTS = Sensor(dropout_interval=10.0, dropout_duration=0.5)
_SIGMA = Sensor().noise_std


def _with(sensor: Sensor, mismatch: Mismatch | None = None) -> Scenario:
    return replace(_NOISE, sensor=sensor, mismatch=mismatch or Mismatch())


def _stiff(*disturbance: Component) -> Scenario:
    return replace(_NOISE, mismatch=_STIFF, disturbance=disturbance)


def _anywhere(probability: float, size: float = math.pi) -> Sensor:
    """Return a sensor with outliers of any size."""
    return Sensor(outlier_probability=probability, outlier_size=size, outlier_is_uniform=True)


def _correlated(pole: float) -> Sensor:
    """Return a sensor whose noise is alike from sample to sample, of the same variance."""
    return Sensor(noise_time_constant=-1.0 / (_NOISE.rate * math.log(pole)))


def _held(angle: float) -> Scenario:
    """Return an arm at rest, held at an angle by a constant torque."""
    arm = _NOISE.arm
    torque = arm.gravity_torque * math.sin(angle)
    start = arm.from_physical([angle, 0.0, angle + torque / arm.stiffness, 0.0])
    return replace(
        _NOISE,
        initial_state=tuple(start.tolist()),
        initial_spread=(0.0,) * 4,
        excitation=Constant(torque),
    )


def _wrong_effort(size: float) -> Scenario:
    """Return a run in which one sample of the reported torque is wrong."""
    return replace(_NOISE, torque_error=(Pulses(size, 30.0, 1.0 / _NOISE.rate, 0.0),))


_STEPS = (Pulses(0.15, 4.0, 4.0, 16.0), Pulses(-0.15, 12.0, 4.0, 16.0))
_PULSES = Pulses(0.5, 8.0, 1.5, 8.0)

PLAIN: dict[str, Scenario] = {
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

HARD: dict[str, Scenario] = {
    # The world is not as designed, in ways that an observer has to cope with.
    "loud": _with(Sensor(3.0 * _SIGMA)),
    "stiff_loud_1.5": _with(Sensor(1.5 * _SIGMA), _STIFF),
    "stiff_loud_2": _with(Sensor(2.0 * _SIGMA), _STIFF),
    "stiffer_loud_1.5": _with(Sensor(1.5 * _SIGMA), Mismatch(stiffness=0.3)),
    "stiff_loud_2_dropouts": _with(replace(_DROPOUTS, noise_std=2.0 * _SIGMA), _STIFF),
    "student": _with(Sensor(noise_degrees=3)),
    "stiff_student": _with(Sensor(noise_degrees=3), _STIFF),
    "stiff_bursts": _with(Sensor(burst_interval=7.0), _STIFF),
    "many_outliers": _with(_anywhere(0.05)),
    "stiff_many_outliers": _with(_anywhere(0.05), _STIFF),
    "stiff_more_outliers": _with(_anywhere(0.1), _STIFF),
    "stiff_small_outliers": _with(_anywhere(0.02, 0.5), _STIFF),
    "pulses": replace(_NOISE, disturbance=(_PULSES,)),
    "stiff_pulses": _stiff(_PULSES),
    "stiff_small_pulses": _stiff(Pulses(0.3, 5.0, 1.0, 5.0)),
    "steps": replace(_NOISE, disturbance=_STEPS),
    "stiff_steps": _stiff(*_STEPS),
    "softer_heavier": replace(_NOISE, mismatch=Mismatch(stiffness=-0.25, gravity_torque=0.15)),
    "coarse": _with(Sensor(resolution=2.0 * math.pi / 1024)),
    "stiff_coarse": _with(Sensor(0.0, resolution=2.0 * math.pi / 1024), _STIFF),
    "rest": _held(0.0),
    "held": _held(0.5),
    "wrong_effort_10": _wrong_effort(10.0),
    "wrong_effort_50": _wrong_effort(50.0),
    "wrong_effort_200": _wrong_effort(200.0),
    "wrong_effort_1000": _wrong_effort(1000.0),
    # The model is wrong in ways that are not learnt.
    "slight_friction": replace(_NOISE, friction=Friction(motor_viscous=0.1, motor_coulomb=0.05)),
    "friction": replace(_NOISE, friction=Friction(motor_viscous=0.3, motor_coulomb=0.15)),
    "link_friction": replace(_NOISE, friction=Friction(link_viscous=0.1, link_coulomb=0.05)),
    "stiff_friction": replace(
        _NOISE, mismatch=_STIFF, friction=Friction(motor_viscous=0.3, motor_coulomb=0.15)
    ),
    "correlated_0.8": _with(_correlated(0.8)),
    "correlated_0.9": _with(_correlated(0.9)),
    "correlated_0.97": _with(_correlated(0.97)),
    "stiff_correlated_0.9": _with(_correlated(0.9), _STIFF),
    "late_10ms": _with(Sensor(latency=0.01)),
    "late_20ms": _with(Sensor(latency=0.02)),
    "payload": replace(_NOISE, mismatch=Mismatch(link_inertia=0.2, gravity_torque=0.2)),
}
"""The same with noise, outliers, faults, forces and torques that no design foresees: noise of three
times the design's or of Student's t with three degrees of freedom, bursts of four times the noise,
outliers anywhere in ±π, pulses of 0.5 rad, steps of ±0.15 rad every four seconds, an encoder of ten
bits, one wrong sample of the torque, friction of the motor of 0.3 N m s/rad and 0.15 N m, and noise
with a pole from sample to sample."""

SCENARIOS: dict[str, Scenario] = PLAIN | HARD
"""All of them by name."""


def simulate(
    scenario: Scenario, seeds: Sequence[int], duration: float | None = None
) -> Trajectories:
    """Run a scenario once for each seed, all runs at once.

    Everything is kept: 104 bytes a run and sample, 75 MB for 60 runs of a minute.

    Args:
        scenario: What happens.
        seeds: One for each run.
        duration: How long [s]; the scenario's own by default.

    Raises:
        ModelError: A seed or the duration is negative, or there is no seed.
    """
    timed = scenario if duration is None else replace(scenario, duration=duration)
    return Plant(timed, list(seeds)).run(timed.sample_count)
