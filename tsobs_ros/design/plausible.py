# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The arm of a request in plain words, and questions about numbers that look wrong.

A number in another unit often makes a valid request, whose design is good for nothing.
"""

import math
from collections.abc import Iterator

from tsobs_ros.design.request import AnyRequest, ArmRequest
from tsobs_ros.model.arm import ElasticJointArm

_ENTRIES = {
    "link_inertia": ("kg m^2", 1e5, "kg mm^2", 1e-6),
    "motor_inertia": ("kg m^2", 1e5, "kg mm^2", 1e-6),
    "stiffness": ("N m/rad", 1e8, "N mm/rad", 1e-3),
    "gravity_torque": ("N m", 1e6, "N mm", 1e-3),
    "link_damping": ("N m s/rad", math.inf, "", 1.0),
    "motor_damping": ("N m s/rad", math.inf, "", 1.0),
}
"""Unit of each number of an arm, the largest plausible one, and the unit it may be in if larger.

An excavator's boom has some 1e5 kg m^2 and N m.
"""
_LARGEST_STD = 0.5
"""No arm is estimated with a noisier angle [rad]."""
_SAMPLES_PER_PERIOD, _SLOWEST = 10.0, 5.0


def resonances(arm: ElasticJointArm) -> tuple[float, float]:
    """Return the frequencies of link against a motor that is held, and against a free one [Hz]."""
    held = arm.stiffness / arm.link_inertia
    free = held + arm.stiffness / arm.motor_inertia
    return math.sqrt(held) / math.tau, math.sqrt(free) / math.tau


def description(request: ArmRequest) -> list[str]:
    """Return the arm that a request describes, its resonances and the rate they want, as lines."""
    arm = request.arm
    entries = [f"{name} {getattr(arm, name):g} {unit}" for name, (unit, *_) in _ENTRIES.items()]
    held, free = resonances(arm)
    return [
        f"arm: {', '.join(entries)}",
        f"resonances: {held:.3g} Hz with the motor held, {free:.3g} Hz with both free; they want "
        f"{_SAMPLES_PER_PERIOD * free:.3g} Hz and more, the request has {request.rate:g} Hz",
    ]


def questions(request: AnyRequest) -> Iterator[str]:
    """Yield a question about each number that may be in another unit."""
    wanted, rate = 0.0, request.rate
    if isinstance(request, ArmRequest):
        wanted = _SAMPLES_PER_PERIOD * resonances(request.arm)[1]
        for name, (unit, largest, other, factor) in _ENTRIES.items():
            if (value := getattr(request.arm, name)) > largest:
                yield f"{name}: {value:g} {unit}? As {other} it would be {factor * value:g} {unit}"
        angles = [
            (f"outputs[{i}].measurement_std" if request.outputs else "measurement_std",
             output.measurement_std, _LARGEST_STD)
            for i, output in enumerate(request.sensors) if output.measures.endswith("angle")
        ]  # fmt: skip
        angles += [(f"initial_std[{i}]", request.initial_std[i], math.tau) for i in (0, 2)]
        for name, value, largest in angles:
            if value > largest:
                degrees = math.radians(value)
                yield f"{name}: {value:g} rad? As degrees it would be {degrees:.4g} rad"
    slow = f", below the {wanted:.3g} Hz that the arm's resonance wants" if rate < wanted else ""
    if slow or rate < _SLOWEST:
        unit, period = ("seconds", 1.0) if rate < 1.0 else ("milliseconds", 1e3)
        yield f"rate: {rate:g} Hz{slow}? As {unit} between samples it would be {period / rate:g} Hz"
