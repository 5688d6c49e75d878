# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The places of a design's signals in messages, which are all JointStates.

An arm has angles, velocities and torques. A driver publishes the side that its encoder is on under
the joint's name; only with encoders on both sides the motor has an entry of its own. A T–S system
has an entry per signal, whose value is its `position`.
"""

from collections.abc import Iterable
from typing import Literal, NamedTuple, TypeAlias

from tsobs_ros.design.request import AnyRequest, ArmRequest

Field: TypeAlias = Literal["position", "velocity", "effort"]


class Place(NamedTuple):
    """Where a number is in a JointState: the entry's name and the message's field."""

    name: str
    field: Field

    @property
    def described(self) -> str:
        """The place in words, such as "position of elbow"."""
        return f"{self.field} of {self.name}"


class Signals(NamedTuple):
    """The places of a joint's signals.

    Attributes:
        outputs: Of each measured output, p places.
        inputs: Of each input and then each scheduled signal, m places.
        states: Of each state of the plant in estimates.
        disturbances: Entry of each output in disturbances and innovations, p names.
        torques: Of each torque disturbance in estimates, the motor's first.
        other_inputs: Of each input if its place in `inputs` has no number; () if there are none.
        units: Of each output, empty texts if they are not known.
    """

    outputs: tuple[Place, ...]
    inputs: tuple[Place, ...]
    states: tuple[Place, ...]
    disturbances: tuple[str, ...]
    torques: tuple[Place, ...]
    other_inputs: tuple[Place, ...]
    units: tuple[str, ...]

    @property
    def entries(self) -> frozenset[str]:
        """The entries of measurements that have something of the joint."""
        return frozenset(place.name for place in self.outputs + self.inputs + self.other_inputs)


def signals(request: AnyRequest, joint: str, alone: bool, both_sides: bool = False) -> Signals:
    """Return the places of a joint's signals in measurements and estimates.

    The joint's name is before those of a T–S system's entries if it is not alone in its node. An
    arm may have encoders on both sides although its design measures one.

    >>> signals(ArmRequest(), "elbow", alone=True).outputs
    (Place(name='elbow', field='position'),)
    """
    if isinstance(request, ArmRequest):
        return _of_arm(request, joint, both_sides)
    outputs, inputs, states = (
        tuple(name if alone else f"{joint}/{name}" for name in names)
        for names in (request.output_names, request.input_names, request.state_names)
    )
    places = (positions(outputs), positions(inputs), positions(states))
    return Signals(*places, outputs, (), (), request.output_units)


def _of_arm(request: ArmRequest, joint: str, both_sides: bool) -> Signals:
    link, motor, names = f"{joint}_link", f"{joint}_motor", request.output_names
    sides = [name.partition("_")[0] for name in names]
    both = both_sides or len(set(sides)) == 2
    fields: list[Field] = ["position" if name.endswith("angle") else "velocity" for name in names]
    return Signals(
        tuple(
            Place(motor if both and side == "motor" else joint, field)
            for side, field in zip(sides, fields, strict=True)
        ),
        (Place(joint, "effort"),),
        tuple(Place(name, f) for name in (link, motor) for f in ("position", "velocity")),
        (joint,) if len(names) == 1 else tuple(f"{joint}/{name}" for name in names),
        tuple(Place(f"{joint}_{side}", "effort") for side in request.torque_sides),
        (Place(motor, "effort"),) if both else (),
        request.output_units,
    )


def positions(names: Iterable[str]) -> tuple[Place, ...]:
    """Return the places of numbers that are the `position` of entries."""
    return tuple(Place(name, "position") for name in names)
