# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The arm of a request in plain words, and questions about numbers that look wrong.

A number in another unit often makes a valid request, whose design is good for nothing.
"""

import math
from collections.abc import Iterator

from tsobs_ros.design.request import AnyRequest, ArmRequest
from tsobs_ros.model.arm import ANGLES, ElasticJointArm

_ENTRIES = {
    "link_inertia": ("kg m^2", 1e5, "kg mm^2"),
    "motor_inertia": ("kg m^2", 1e5, "kg mm^2"),
    "stiffness": ("N m/rad", 1e8, "N mm/rad"),
    "gravity_torque": ("N m", 1e6, "N mm"),
    "link_damping": ("N m s/rad", math.inf, ""),
    "motor_damping": ("N m s/rad", math.inf, ""),
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
    wanted = _SLOWEST
    if isinstance(request, ArmRequest):
        wanted = max(wanted, _SAMPLES_PER_PERIOD * resonances(request.arm)[1])
        for name, (unit, largest, other) in _ENTRIES.items():
            if (value := getattr(request.arm, name)) > largest:
                yield f"{name}: {value:g} {unit}, or {other}?"
        for output in request.sensors:
            if output.measures in ANGLES and (std := output.measurement_std) > _LARGEST_STD:
                yield f"measurement_std of {output.measures}: {std:g} rad, or degrees?"
    if request.rate < wanted:
        yield f"rate: {request.rate:g} Hz, although {wanted:.3g} Hz are wanted, or seconds?"
