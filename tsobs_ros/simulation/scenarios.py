# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The scenarios that observers are compared on, and Monte Carlo runs of them."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

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

_PLAIN = Scenario()
_PLACES = {Mismatch: "mismatch", Sensor: "sensor", Friction: "friction", Payload: "payload"}


def _with(*parts: Any, **others: Any) -> Scenario:
    """Return the plain scenario with other parts, each put in its place by its type."""
    signals = tuple(part for part in parts if isinstance(part, Signal))
    placed = {_PLACES[type(part)]: part for part in parts if type(part) in _PLACES}
    return replace(_PLAIN, disturbance=signals, **placed, **others)


def _anywhere(probability: float, size: float = math.pi) -> Sensor:
    """Return a sensor with outliers of any size up to a largest one."""
    return Sensor(outlier_probability=probability, outlier_size=size, outlier_is_uniform=True)


def _correlated(pole: float) -> Sensor:
    """Return a sensor with coloured noise of the same variance, by its pole."""
    return Sensor(noise_time_constant=-1.0 / (_PLAIN.rate * math.log(pole)))


def _held(angle: float) -> Scenario:
    """Return an arm at rest, held at an angle by a constant torque."""
    arm = _PLAIN.arm
    torque = arm.gravity_torque * math.sin(angle)
    start = arm.from_physical([angle, 0.0, angle + torque / arm.stiffness, 0.0]).tolist()
    return replace(_REST, initial_state=tuple(start), excitation=Constant(torque))


def _wrong_effort(size: float) -> Scenario:
    """Return a run in which one sample of the reported torque is wrong."""
    return _with(torque_error=(Pulses(size, 30.0, 1.0 / _PLAIN.rate, 0.0),))


def _tone(size: float, frequency: float) -> Sinusoid:
    return Sinusoid(size, frequency, 2.0)


def _walk(density: float) -> GaussMarkov:
    """Return a drift that is a random walk over a minute, by its density [rad²/s]."""
    time = 1000.0
    return GaussMarkov(math.sqrt(0.5 * density * time), time)


_REST = _with(initial_state=(0.0,) * 4, initial_spread=(0.0,) * 4)
_STIFF, _HEAVY_LINK = Mismatch(stiffness=0.2), Mismatch(link_inertia=0.1)
_DROPOUTS, _MISSING = Sensor(dropout_interval=10.0), Sensor(loss_probability=0.2)
_SIGMA = Sensor().noise_std
_LOUDER, _LOUD, _STUDENT = Sensor(1.5 * _SIGMA), Sensor(2.0 * _SIGMA), Sensor(noise_degrees=3)
_ENCODER = Sensor(resolution=2.0 * math.pi / 1024)
_MANY = _anywhere(0.05)
_SLIGHT, _FRICTION = Friction(0.0, 0.0, 0.1, 0.05), Friction(0.0, 0.0, 0.3, 0.15)
_LOAD, _SMALL_LOAD = Payload(0.2, 2.0, 30.0), Payload(0.1, 1.0, 25.0)
_STEP, _DRIFT, _SINUSOID = BiasStep(0.1, 30.0), GaussMarkov(0.1, 20.0), Sinusoid(0.2, 3.0, 2.0)
_STEPS = (Pulses(0.15, 4.0, 4.0, 16.0), Pulses(-0.15, 12.0, 4.0, 16.0))
_PULSES = Pulses(0.5, 8.0, 1.5, 8.0)

PLAIN: dict[str, Scenario] = {
    "noise": _PLAIN,
    "bias_step": _with(_STEP),
    "sinusoid": _with(_SINUSOID),
    "drift": _with(_DRIFT),
    "ramp": _with(Ramp(0.004, 10.0)),
    "stiff": _with(_STIFF),
    "stiff_bias_step": _with(_STIFF, _STEP),
    "soft_heavy_bias_step": _with(Mismatch(stiffness=-0.2, gravity_torque=0.2), _STEP),
    "stiff_sinusoid": _with(_STIFF, _SINUSOID),
    "outliers": _with(Sensor(outlier_probability=0.01)),
    "dropouts": _with(_DROPOUTS),
    "stiff_dropouts": _with(_STIFF, _DROPOUTS),
}
"""One minute each at 200 Hz, u = sin t; "stiff" is +20 % stiffness, "soft_heavy" is −20 % stiffness
with +20 % gravity."""

HARD: dict[str, Scenario] = {
    # The world is not as designed, in ways that an observer has to cope with.
    "loud": _with(Sensor(3.0 * _SIGMA)),
    "stiff_loud_1.5": _with(_STIFF, _LOUDER),
    "stiff_loud_2": _with(_STIFF, _LOUD),
    "stiffer_loud_1.5": _with(Mismatch(stiffness=0.3), _LOUDER),
    "stiff_loud_2_dropouts": _with(_STIFF, replace(_DROPOUTS, noise_std=2.0 * _SIGMA)),
    "student": _with(_STUDENT),
    "stiff_student": _with(_STIFF, _STUDENT),
    "stiff_bursts": _with(_STIFF, Sensor(burst_interval=7.0)),
    "many_outliers": _with(_MANY),
    "stiff_many_outliers": _with(_STIFF, _MANY),
    "stiff_more_outliers": _with(_STIFF, _anywhere(0.1)),
    "stiff_small_outliers": _with(_STIFF, _anywhere(0.02, 0.5)),
    "pulses": _with(_PULSES),
    "stiff_pulses": _with(_STIFF, _PULSES),
    "stiff_small_pulses": _with(_STIFF, Pulses(0.3, 5.0, 1.0, 5.0)),
    "steps": _with(*_STEPS),
    "stiff_steps": _with(_STIFF, *_STEPS),
    "softer_heavier": _with(Mismatch(stiffness=-0.25, gravity_torque=0.15)),
    "coarse": _with(_ENCODER),
    "stiff_coarse": _with(_STIFF, replace(_ENCODER, noise_std=0.0)),
    "rest": _held(0.0),
    "held": _held(0.5),
    "wrong_effort_10": _wrong_effort(10.0),
    "wrong_effort_50": _wrong_effort(50.0),
    "wrong_effort_200": _wrong_effort(200.0),
    "wrong_effort_1000": _wrong_effort(1000.0),
    # The model is wrong in ways that are not learnt.
    "slight_friction": _with(_SLIGHT),
    "friction": _with(_FRICTION),
    "link_friction": _with(Friction(link_viscous=0.1, link_coulomb=0.05)),
    "stiff_friction": _with(_STIFF, _FRICTION),
    "correlated_0.8": _with(_correlated(0.8)),
    "correlated_0.9": _with(_correlated(0.9)),
    "correlated_0.97": _with(_correlated(0.97)),
    "stiff_correlated_0.9": _with(_STIFF, _correlated(0.9)),
    "late_10ms": _with(Sensor(latency=0.01)),
    "late_20ms": _with(Sensor(latency=0.02)),
    "payload": _with(Mismatch(link_inertia=0.2, gravity_torque=0.2)),
}
"""The same with noise, outliers, faults, forces and torques that no design foresees: noise of three
times the design's or of Student's t with three degrees of freedom, bursts of four times the noise,
outliers anywhere in ±π, pulses of 0.5 rad, steps of ±0.15 rad every four seconds, an encoder of ten
bits, one wrong sample of the torque, friction of the motor of 0.3 N m s/rad and 0.15 N m, and noise
with a pole from sample to sample."""

_TONES = ["0.03_3", "0.03_8", "0.1_1", "0.1_3", "0.1_8", "0.1_12", "0.3_1", "0.3_3", "0.3_12"]
TONES: dict[str, Scenario] = {
    **{f"tone_{name}": _with(_tone(*map(float, name.split("_")))) for name in _TONES},
    "stiff_tone_0.1_3": _with(_STIFF, _tone(0.1, 3.0)),
    "stiff_tone_0.1_8": _with(_STIFF, _tone(0.1, 8.0)),
}
"""A sensor that oscillates by so many rad at so many rad/s, of which no design knows."""

FURTHER: dict[str, Scenario] = {
    "wander": _with(_walk(1e-4)),
    "wander_3": _with(_walk(3e-4)),
    "stiff_wander": _with(_STIFF, _walk(1e-4)),
    "light_link": _with(Mismatch(link_inertia=-0.1)),
    "heavy_link": _with(_HEAVY_LINK),
    "light_motor": _with(Mismatch(motor_inertia=-0.1)),
    "heavy_motor": _with(Mismatch(motor_inertia=0.1)),
    "late_payload": _with(_LOAD),
    "stiff_late_payload": _with(_STIFF, _LOAD),
    "backlash_0.005": _with(backlash=0.005),
    "backlash_0.03": _with(backlash=0.03),
    "stiff_backlash_0.03": _with(_STIFF, backlash=0.03),
    "quiet": _with(Sensor(0.5 * _SIGMA)),
    "missing": _with(_MISSING),
    "stiff_missing": _with(_STIFF, _MISSING),
    "missing_outliers": _with(replace(_MANY, loss_probability=0.2)),
    "half_rate": _with(rate=100.0),
    "stiff_half_rate": _with(_STIFF, rate=100.0),
    "near_rest": replace(_REST, excitation=Sine(0.05)),
    "stiff_near_rest": replace(_REST, excitation=Sine(0.05), mismatch=_STIFF),
    "mix_stiff_outliers_step": _with(_STIFF, _MANY, _STEP),
    "mix_stiff_missing_loud": _with(
        Mismatch(stiffness=0.25), replace(_MISSING, noise_std=2.0 * _SIGMA)
    ),
    "mix_stiff_pulses_outliers": _with(_STIFF, _MANY, _PULSES),
    "mix_heavy_tone_outliers": _with(Mismatch(gravity_torque=0.15), _MANY, _tone(0.1, 3.0)),
    "mix_friction_loud_steps": _with(_SLIGHT, _LOUD, *_STEPS),
    "mix_inertia_wander_student": _with(_HEAVY_LINK, _STUDENT, _walk(1e-4)),
    "mix_payload_correlated_step": _with(_SMALL_LOAD, _correlated(0.9), _STEP),
}
"""A bias that wanders as designed and three times as much; inertias 10 % off; a payload of 20 %
from 30 s on; play of the gear [rad]; every fifth sample missing at random; half the rate; a motion
of a twentieth; and mixtures of three."""

SCENARIOS: dict[str, Scenario] = PLAIN | HARD | TONES | FURTHER
"""All of them by name."""


def simulate(
    scenario: Scenario, seeds: Sequence[int], duration: float | None = None
) -> Trajectories:
    """Run a scenario once for each seed, all runs at once; `duration` [s] replaces its own.

    Everything is kept: 104 bytes per run and sample, 75 MB for 60 runs of a minute.

    Raises:
        ModelError: A seed or the duration is negative, or there is no seed.
    """
    timed = scenario if duration is None else replace(scenario, duration=duration)
    return Plant(timed, list(seeds)).run(timed.sample_count)
