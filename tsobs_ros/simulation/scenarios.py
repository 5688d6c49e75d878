# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The scenarios on which observers are compared, and Monte Carlo runs of them."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from tsobs_ros.simulation.plant import Friction, Mismatch, Payload, Plant, Scenario, Trajectories
from tsobs_ros.simulation.sensor import Sensor, SimulatedOutput
from tsobs_ros.simulation.signals import (
    BiasStep,
    Constant,
    GaussMarkov,
    Pulses,
    Ramp,
    Signal,
    Sine,
    Sinusoid,
    StuckSensor,
)

_PLAIN = Scenario()
_PERIOD = 1.0 / _PLAIN.rate


def arm_with(*parts: Any, **others: Any) -> Scenario:
    """Return the plain scenario with some parts replaced, each by its type.

    A sensor and signals belong to the link angle, the only measured output.
    """
    signals = tuple(part for part in parts if isinstance(part, Signal))
    placed = {part.kind: part for part in parts if part not in signals}
    output = SimulatedOutput(sensor=placed.pop("sensor", Sensor()), disturbance=signals)
    return replace(_PLAIN, outputs=(output,), **placed, **others)


def _correlated(pole: float) -> Sensor:
    """Return a sensor with coloured noise of the same variance and a given pole."""
    return Sensor(noise_time_constant=-1.0 / (_PLAIN.rate * math.log(pole)))


def _held(angle: float) -> Scenario:
    """Return an arm at rest, held at an angle by a constant torque."""
    arm = _PLAIN.arm
    torque = arm.gravity_torque * math.sin(angle)
    start = arm.from_physical([angle, 0.0, angle + torque / arm.stiffness, 0.0]).tolist()
    return replace(_REST, initial_state=tuple(start), inputs=(Constant(torque),))


def _hits(speed: float, start: float, interval: float) -> Pulses:
    """Return torque pulses of one sample each, which change the link's speed [rad/s]."""
    return Pulses(_PLAIN.arm.link_inertia * speed * _PLAIN.rate, start, _PERIOD, interval)


def _walk(density: float) -> GaussMarkov:
    """Return a drift that over a minute is a random walk of a given density [rad²/s]."""
    time = 1000.0
    return GaussMarkov(math.sqrt(0.5 * density * time), time)


_REST = arm_with(initial_state=(0.0,) * 4, initial_spread=(0.0,) * 4)
_STIFF, _HEAVY_LINK = Mismatch(stiffness=0.2), Mismatch(link_inertia=0.1)
_SIGMA = Sensor().noise_std
_LOUDER, _LOUD, _STUDENT = Sensor(1.5 * _SIGMA), Sensor(2.0 * _SIGMA), Sensor(noise_degrees=3)
_ENCODER = Sensor(resolution=2.0 * math.pi / 1024)
_OUTLIERS = Sensor(outlier_size=math.pi, outlier_is_uniform=True)
_MANY = replace(_OUTLIERS, outlier_probability=0.05)
_SLIGHT, _FRICTION = Friction(0.0, 0.0, 0.1, 0.05), Friction(0.0, 0.0, 0.3, 0.15)
_STEP, _DRIFT, _SINUSOID = BiasStep(0.1, 30.0), GaussMarkov(0.1, 20.0), Sinusoid(0.2, 3.0, 2.0)
_STEPS = (Pulses(0.15, 4.0, 4.0, 16.0), Pulses(-0.15, 12.0, 4.0, 16.0))
_PULSES = Pulses(0.5, 8.0, 1.5, 8.0)
_TONES = {0.03: (3.0, 8.0), 0.1: (1.0, 3.0, 8.0, 12.0), 0.3: (1.0, 3.0, 12.0), 0.6: (9.0,)}

SCENARIOS: dict[str, Scenario] = {
    "noise": _PLAIN,
    "bias_step": arm_with(_STEP),
    "sinusoid": arm_with(_SINUSOID),
    "drift": arm_with(_DRIFT),
    "ramp": arm_with(Ramp(0.004, 10.0)),
    "stiff": arm_with(_STIFF),
    "soft_heavy_bias_step": arm_with(Mismatch(stiffness=-0.2, gravity_torque=0.2), _STEP),
    "outliers": arm_with(Sensor(outlier_probability=0.01)),
    "dropouts": arm_with(Sensor(dropout_interval=10.0)),
    # Deviations from the design that an observer has to cope with.
    "loud": arm_with(Sensor(3.0 * _SIGMA)),
    "stiff_loud_1.5": arm_with(_STIFF, _LOUDER),
    "stiff_loud_2": arm_with(_STIFF, _LOUD),
    "stiffer_loud_1.5": arm_with(Mismatch(stiffness=0.3), _LOUDER),
    "stiff_loud_2_dropouts": arm_with(_STIFF, Sensor(2.0 * _SIGMA, dropout_interval=10.0)),
    "student": arm_with(_STUDENT),
    "stiff_bursts": arm_with(_STIFF, Sensor(burst_interval=7.0)),
    "many_outliers": arm_with(_MANY),
    "stiff_more_outliers": arm_with(_STIFF, replace(_OUTLIERS, outlier_probability=0.1)),
    "stiff_small_outliers": arm_with(
        _STIFF, replace(_OUTLIERS, outlier_probability=0.02, outlier_size=0.5)
    ),
    "pulses": arm_with(_PULSES),
    "stiff_small_pulses": arm_with(_STIFF, Pulses(0.3, 5.0, 1.0, 5.0)),
    "steps": arm_with(*_STEPS),
    "softer_heavier": arm_with(Mismatch(stiffness=-0.25, gravity_torque=0.15)),
    "coarse": arm_with(_ENCODER),
    "stiff_coarse": arm_with(_STIFF, replace(_ENCODER, noise_std=0.0)),
    "stuck": arm_with(StuckSensor(50.0, 2.0)),
    "hits": arm_with(torque_disturbance=((), (_hits(1.0, 5.0, 7.0), _hits(-0.8, 9.3, 8.0)))),
    "rest": _held(0.0),
    "held": _held(0.5),
    **{  # one sample of the reported torque
        f"wrong_effort_{size:g}": arm_with(torque_error=(Pulses(size, 30.0, _PERIOD, 0.0),))
        for size in (10.0, 50.0, 200.0, 1000.0)
    },
    # Errors of the model that are not learnt.
    "slight_friction": arm_with(_SLIGHT),
    "friction": arm_with(_FRICTION),
    "link_friction": arm_with(Friction(link_viscous=0.1, link_coulomb=0.05)),
    **{f"correlated_{pole}": arm_with(_correlated(pole)) for pole in (0.8, 0.9, 0.97)},
    "late_10ms": arm_with(Sensor(latency=0.01)),
    "late_20ms": arm_with(Sensor(latency=0.02)),
    "payload": arm_with(Mismatch(link_inertia=0.2, gravity_torque=0.2)),
    # A sensor that oscillates, with size [rad] and frequency [rad/s]; no design models it.
    **{
        f"tone_{size}_{frequency:g}": arm_with(Sinusoid(size, frequency, 2.0))
        for size, frequencies in _TONES.items()
        for frequency in frequencies
    },
    "tone_pair": arm_with(Sinusoid(0.1, 2.0, 2.0), Sinusoid(0.08, 7.0, 2.0)),
    # Drifts, inertias, payloads and backlash; other rates and motions; mixtures of three effects.
    "wander": arm_with(_walk(1e-4)),
    "wander_3": arm_with(_walk(3e-4)),
    "light_link": arm_with(Mismatch(link_inertia=-0.1)),
    "heavy_link": arm_with(_HEAVY_LINK),
    "light_motor": arm_with(Mismatch(motor_inertia=-0.1)),
    "heavy_motor": arm_with(Mismatch(motor_inertia=0.1)),
    "late_payload": arm_with(Payload(0.2, 2.0, 30.0)),
    "backlash_0.005": arm_with(backlash=0.005),
    "backlash_0.03": arm_with(backlash=0.03),
    "quiet": arm_with(Sensor(0.5 * _SIGMA)),
    "missing": arm_with(Sensor(loss_probability=0.2)),
    "missing_outliers": arm_with(replace(_MANY, loss_probability=0.2)),
    "half_rate": arm_with(rate=100.0),
    "near_rest": replace(_REST, inputs=(Sine(0.05),)),
    "mix_stiff_outliers_step": arm_with(_STIFF, _MANY, _STEP),
    "mix_stiff_missing_loud": arm_with(
        Mismatch(stiffness=0.25), Sensor(2.0 * _SIGMA, loss_probability=0.2)
    ),
    "mix_stiff_pulses_outliers": arm_with(_STIFF, _MANY, _PULSES),
    "mix_heavy_tone_outliers": arm_with(
        Mismatch(gravity_torque=0.15), _MANY, Sinusoid(0.1, 3.0, 2.0)
    ),
    "mix_friction_loud_steps": arm_with(_SLIGHT, _LOUD, *_STEPS),
    "mix_inertia_wander_student": arm_with(_HEAVY_LINK, _STUDENT, _walk(1e-4)),
    "mix_payload_correlated_step": arm_with(Payload(0.1, 1.0, 25.0), _correlated(0.9), _STEP),
}
SCENARIOS |= {
    f"stiff_{name}": replace(SCENARIOS[name], mismatch=_STIFF)
    for name in (
        "bias_step", "sinusoid", "dropouts", "student", "many_outliers", "pulses", "steps",
        "friction", "correlated_0.9", "tone_0.1_3", "tone_0.1_8", "wander", "late_payload",
        "backlash_0.03", "missing", "half_rate", "near_rest", "tone_pair", "stuck", "hits",
    )
}  # fmt: skip
"""All by name, a minute each at 200 Hz with u = sin t unless specified otherwise; "stiff" is +20 %
stiffness, "soft_heavy" −20 % stiffness and +20 % gravity. docs/acceptance.md describes them."""


def simulate(
    scenario: Scenario, seeds: Sequence[int], duration: float | None = None
) -> Trajectories:
    """Run a scenario once per seed, all runs together; `duration` [s] replaces the scenario's.

    Raises:
        ModelError: A seed or the duration is negative, or there is no seed.
    """
    timed = scenario if duration is None else replace(scenario, duration=duration)
    return Plant(timed, list(seeds)).run(timed.sample_count)
