# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The scenarios that the observers are compared on, and Monte Carlo runs of them."""

import math
from collections.abc import Sequence
from dataclasses import replace

from tsobs_ros.simulation.integrator import Friction, Payload
from tsobs_ros.simulation.plant import Mismatch, Plant, Scenario, Trajectories
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import (
    BiasStep,
    Constant,
    GaussMarkov,
    Pulses,
    Ramp,
    Signal,
    Sine,
    Sinusoid,
)

_NOISE = Scenario()
_STIFF = Mismatch(stiffness=0.2)
_SOFT_HEAVY = Mismatch(stiffness=-0.2, gravity_torque=0.2)
_DROPOUTS = Sensor(dropout_interval=10.0, dropout_duration=0.5)
_SIGMA = Sensor().noise_std


def _with(sensor: Sensor, mismatch: Mismatch | None = None) -> Scenario:
    return replace(_NOISE, sensor=sensor, mismatch=mismatch or Mismatch())


def _stiff(*disturbance: Signal) -> Scenario:
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


def _tone(size: float, frequency: float) -> Sinusoid:
    return Sinusoid(size, frequency, 2.0)


def _wander(density: float) -> GaussMarkov:
    """Return a bias that wanders, so slowly that a minute of it is a random walk [rad²/s]."""
    time = 1000.0
    return GaussMarkov(math.sqrt(0.5 * density * time), time)


_NEAR_REST = replace(
    _NOISE, initial_state=(0.0,) * 4, initial_spread=(0.0,) * 4, excitation=Sine(0.05, 1.0)
)
_MISSING = Sensor(loss_probability=0.2)
_LOAD, _SMALL_LOAD = Payload(0.2, 2.0, 30.0), Payload(0.1, 1.0, 25.0)
_MANY = _anywhere(0.05)
_SLIGHT = Friction(motor_viscous=0.1, motor_coulomb=0.05)

TONES: dict[str, Scenario] = {
    f"tone_{size:g}_{frequency:g}": replace(_NOISE, disturbance=(_tone(size, frequency),))
    for size, frequency in (
        (0.03, 3.0), (0.03, 8.0), (0.1, 1.0), (0.1, 3.0), (0.1, 8.0), (0.1, 12.0), (0.3, 1.0),
        (0.3, 3.0), (0.3, 12.0),
    )
} | {
    "stiff_tone_0.1_3": _stiff(_tone(0.1, 3.0)),
    "stiff_tone_0.1_8": _stiff(_tone(0.1, 8.0)),
}  # fmt: skip
"""A sensor that oscillates by so many rad at so many rad/s, of which no design knows."""

FURTHER: dict[str, Scenario] = {
    "wander": replace(_NOISE, disturbance=(_wander(1e-4),)),
    "wander_3": replace(_NOISE, disturbance=(_wander(3e-4),)),
    "stiff_wander": _stiff(_wander(1e-4)),
    "light_link": replace(_NOISE, mismatch=Mismatch(link_inertia=-0.1)),
    "heavy_link": replace(_NOISE, mismatch=Mismatch(link_inertia=0.1)),
    "light_motor": replace(_NOISE, mismatch=Mismatch(motor_inertia=-0.1)),
    "heavy_motor": replace(_NOISE, mismatch=Mismatch(motor_inertia=0.1)),
    "late_payload": replace(_NOISE, payload=_LOAD),
    "stiff_late_payload": replace(_NOISE, mismatch=_STIFF, payload=_LOAD),
    "backlash_0.005": replace(_NOISE, backlash=0.005),
    "backlash_0.03": replace(_NOISE, backlash=0.03),
    "stiff_backlash_0.03": replace(_NOISE, mismatch=_STIFF, backlash=0.03),
    "quiet": _with(Sensor(0.5 * _SIGMA)),
    "missing": _with(_MISSING),
    "stiff_missing": _with(_MISSING, _STIFF),
    "missing_outliers": _with(replace(_MANY, loss_probability=0.2)),
    "half_rate": replace(_NOISE, rate=100.0),
    "stiff_half_rate": replace(_NOISE, rate=100.0, mismatch=_STIFF),
    "near_rest": _NEAR_REST,
    "stiff_near_rest": replace(_NEAR_REST, mismatch=_STIFF),
    "mix_stiff_outliers_step": replace(
        _NOISE, mismatch=_STIFF, sensor=_MANY, disturbance=(BiasStep(0.1, 30.0),)
    ),
    "mix_stiff_missing_loud": _with(
        Sensor(2.0 * _SIGMA, loss_probability=0.2), Mismatch(stiffness=0.25)
    ),
    "mix_stiff_pulses_outliers": replace(
        _NOISE, mismatch=_STIFF, sensor=_MANY, disturbance=(_PULSES,)
    ),
    "mix_heavy_tone_outliers": replace(
        _NOISE,
        mismatch=Mismatch(gravity_torque=0.15),
        sensor=_MANY,
        disturbance=(_tone(0.1, 3.0),),
    ),
    "mix_friction_loud_steps": replace(
        _NOISE, friction=_SLIGHT, sensor=Sensor(2.0 * _SIGMA), disturbance=_STEPS
    ),
    "mix_inertia_wander_student": replace(
        _NOISE,
        mismatch=Mismatch(link_inertia=0.1),
        sensor=Sensor(noise_degrees=3),
        disturbance=(_wander(1e-4),),
    ),
    "mix_payload_correlated_step": replace(
        _NOISE,
        payload=_SMALL_LOAD,
        sensor=_correlated(0.9),
        disturbance=(BiasStep(0.1, 30.0),),
    ),
}
"""A bias that wanders as designed and three times as much; inertias 10 % off; a payload of 20 %
from 30 s on; play of the gear [rad]; every fifth sample missing at random; half the rate; a motion
of a twentieth; and mixtures of three."""

SCENARIOS: dict[str, Scenario] = PLAIN | HARD | TONES | FURTHER
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
