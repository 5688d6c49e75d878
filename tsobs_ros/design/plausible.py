# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a request says of the arm in plain words, and questions about numbers that look wrong.

A number in another unit often makes a valid request, whose design is good for nothing.
"""

import math
from collections.abc import Iterator

from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.model.arm import ElasticJointArm

_UNITS = {
    "link_inertia": "kg m^2",
    "motor_inertia": "kg m^2",
    "stiffness": "N m/rad",
    "gravity_torque": "N m",
    "link_damping": "N m s/rad",
    "motor_damping": "N m s/rad",
}
_SAMPLES_A_PERIOD = 10.0
# An excavator's boom has some 1e5 kg m^2 and N m; nothing with a sensor of 0.5 rad is estimated.
_LARGEST_INERTIA, _LARGEST_TORQUE, _LARGEST_STIFFNESS = 1e5, 1e6, 1e8
_LARGEST_STD = 0.5
_SLOWEST = 5.0


def resonances(arm: ElasticJointArm) -> tuple[float, float]:
    """Return the frequencies of link against a motor that is held, and against a free one [Hz]."""
    held = arm.stiffness / arm.link_inertia
    free = held + arm.stiffness / arm.motor_inertia
    return math.sqrt(held) / math.tau, math.sqrt(free) / math.tau


def wanted_rate(arm: ElasticJointArm) -> float:
    """Return the rate at which an arm's fastest resonance has ten samples a period [Hz]."""
    return _SAMPLES_A_PERIOD * resonances(arm)[1]


def description(request: ArmRequest) -> list[str]:
    """Return the arm that a request describes, its resonances and the rate they want, as lines."""
    arm = request.arm
    entries = ", ".join(f"{name} {getattr(arm, name):g} {unit}" for name, unit in _UNITS.items())
    held, free = resonances(arm)
    return [
        f"arm: {entries}",
        f"resonances: {held:.3g} Hz with the motor held, {free:.3g} Hz with both free; they want "
        f"{wanted_rate(arm):.3g} Hz and more, the request has {request.rate:g} Hz",
    ]


def questions(request: ArmRequest | TSRequest) -> list[str]:
    """Return a question about each number that may be in another unit."""
    return list(_of_arm(request) if isinstance(request, ArmRequest) else _of_rate(request.rate))


def _of_arm(request: ArmRequest) -> Iterator[str]:
    arm = request.arm
    for name in ("link_inertia", "motor_inertia"):
        if (value := getattr(arm, name)) > _LARGEST_INERTIA:
            yield f"{name}: {value:g} kg m^2? As kg mm^2 it would be {1e-6 * value:g} kg m^2"
    if arm.stiffness > _LARGEST_STIFFNESS:
        value = arm.stiffness
        yield f"stiffness: {value:g} N m/rad? As N mm/rad it would be {1e-3 * value:g} N m/rad"
    if arm.gravity_torque > _LARGEST_TORQUE:
        value = arm.gravity_torque
        yield f"gravity_torque: {value:g} N m? As N mm it would be {1e-3 * value:g} N m"
    for place, output in enumerate(request.sensors):
        name = f"outputs[{place}].measurement_std" if request.outputs else "measurement_std"
        if output.measures.endswith("angle"):
            yield from _of_angle(name, output.measurement_std, _LARGEST_STD)
    for place in (0, 2):
        yield from _of_angle(f"initial_std[{place}]", request.initial_std[place], math.tau)
    yield from _of_rate(request.rate, wanted_rate(arm))


def _of_angle(name: str, value: float, largest: float) -> Iterator[str]:
    if value > largest:
        yield f"{name}: {value:g} rad? As degrees it would be {math.radians(value):.4g} rad"


def _of_rate(rate: float, wanted: float = 0.0) -> Iterator[str]:
    slow = f", below the {wanted:.3g} Hz that the arm's resonance wants" if rate < wanted else ""
    if slow or rate < _SLOWEST:
        unit, period = ("seconds", 1.0) if rate < 1.0 else ("milliseconds", 1e3)
        yield (
            f"rate: {rate:g} Hz{slow}? As {unit} between samples it would be {period / rate:g} Hz"
        )
