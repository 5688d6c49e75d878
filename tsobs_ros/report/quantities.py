# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The quantities that are estimated with a design: their names, units and places."""

import math
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from tsobs_ros.design.request import ArmRequest, TSRequest

Kind: TypeAlias = Literal["state", "disturbance", "torque_disturbance"]

_JUMP = 0.03
"""Change of an angle's true disturbance from one sample to the next that counts as a jump [rad].

It is about 1σ of the sensor's noise, and several times the change per sample at 200 Hz of a fault
of 0.4 rad at 3 rad/s."""


class Quantity(NamedTuple):
    """An estimated quantity.

    Attributes:
        key: Name for programs.
        name: Name for people.
        column: Its place among the quantities of its kind.
        jump: A larger change of its truth between samples is a jump; infinite if none is.
    """

    key: str
    name: str
    unit: str
    kind: Kind = "state"
    column: int = 0
    jump: float = math.inf


def quantities_of(request: ArmRequest | TSRequest) -> tuple[Quantity, ...]:
    """Return the quantities estimated with a design: states, disturbances, torque disturbances.

    A disturbance that the design lacks is left out, unless it is that of an arm's only output.
    """
    is_arm, outputs = isinstance(request, ArmRequest), outputs_of(request)
    alone, names = is_arm and len(outputs) == 1, _said(request, request.state_names)
    states = zip(request.state_names, names, request.state_units, strict=True)
    found = [Quantity(*each, column=place) for place, each in enumerate(states)]
    for place, (key, (name, unit)) in enumerate(zip(request.output_names, outputs, strict=True)):
        if alone or request.disturbance_model.H[place].any():
            key_name = f"disturbance_{key}", f"disturbance of {name}"
            if alone:
                key_name = "disturbance", "sensor disturbance"
            jump = _JUMP if is_arm and key.endswith("_angle") else math.inf
            found.append(Quantity(*key_name, unit, "disturbance", place, jump))
    if isinstance(request, ArmRequest):
        # Torques have no jumps: friction reverses all the time, and its estimate soon follows.
        for place, side in enumerate(request.torque_sides):
            key, name = f"torque_disturbance_{side}", f"torque disturbance at {side}"
            found.append(Quantity(key, name, "N m", "torque_disturbance", place))
    return tuple(found)


def outputs_of(request: ArmRequest | TSRequest) -> list[tuple[str, str]]:
    """Return the names of the outputs, for people, with their units."""
    return list(zip(_said(request, request.output_names), request.output_units, strict=True))


def inputs_of(request: ArmRequest | TSRequest) -> list[tuple[str, str]]:
    """Return the names of the inputs, for people, with their units."""
    names = ("applied torque",) if isinstance(request, ArmRequest) else request.input_names
    return list(zip(names, request.input_units, strict=True))


def _said(request: ArmRequest | TSRequest, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return names for people: an arm's names as words, a T–S system's names unchanged."""
    is_arm = isinstance(request, ArmRequest)
    return tuple(name.replace("_", " ") for name in names) if is_arm else names


def measured_states(request: ArmRequest | TSRequest) -> dict[str, int]:
    """Return the place of each output that measures one state only, by the state's key."""
    if isinstance(request, ArmRequest):
        return {name: place for place, name in enumerate(request.output_names)}
    found = {}
    for place, row in enumerate(np.asarray(request.model.C)):
        (there,) = np.nonzero(row)
        if len(there) == 1 and row[there[0]] == 1.0:
            found[request.state_names[int(there[0])]] = place
    return found
