# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Signals of a design: their names and units, and their places in messages, all JointStates.

An arm has angles, velocities and torques. A driver publishes the side that its encoder is on under
the joint's name; only with encoders on both sides the motor has an entry of its own. A T–S system
has an entry per signal, named as its file does, whose value is its `position`.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, TypeAlias

from tsobs_ros.checks import shown
from tsobs_ros.errors import ModelError

Field: TypeAlias = Literal["position", "velocity", "effort"]

_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_MAX_LENGTH = 60


@dataclass(frozen=True)
class Labels:
    """Names, or units, of signals in the order of the model; a group left out has none.

    Attributes:
        states: Of x.
        outputs: Of y.
        inputs: Of u, scheduled signals not among them.
        scheduled: Of s.
    """

    OMIT_EMPTY: ClassVar[bool] = True
    """Groups without names are left out of files."""

    states: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    scheduled: tuple[str, ...] = ()


NO_LABELS = Labels()
"""Those of a request that gives none."""


def checked_labels(names: Labels, units: Labels, counts: Sequence[int]) -> tuple[Labels, Labels]:
    """Return the names and units of all signals, of which a request may give some.

    Groups without names get x1, y1, u1, s1 and so on; units without any are empty texts. A
    scheduled signal with the name of an output is that measurement. Else the names of outputs,
    inputs and scheduled signals differ, as these are entries of one message, and so do those of
    the states.

    Raises:
        ModelError: There is not one text per signal, one is not plain, or two signals share a name;
            the text has the place of the entry.
    """
    groups = zip(vars(names).values(), counts, "xyus", strict=True)
    names = Labels(
        *(given or tuple(f"{x}{i + 1}" for i in range(count)) for given, count, x in groups)
    )
    if units == NO_LABELS:
        units = Labels(*(("",) * count for count in counts))
    for entry, labels in (("names", names), ("units", units)):
        for (group, given), count in zip(vars(labels).items(), counts, strict=True):
            if len(given) != count:
                raise ModelError(
                    f"{entry}.{group}: expected {count}, one per signal, got {len(given)}"
                )
            for i, text in enumerate(given):
                is_good = _PLAIN.fullmatch(text) if entry == "names" else text.isprintable()
                if len(text) > _MAX_LENGTH or not is_good:
                    plain = "a letter, then letters, digits and underscores"
                    what = plain if entry == "names" else "printable characters"
                    raise ModelError(
                        f"{entry}.{group}[{i}]: expected {what}, {_MAX_LENGTH} at most, "
                        f"got {shown(text)}"
                    )
    for together in (("states",), ("outputs", "inputs"), ("inputs", "scheduled")):
        each = [name for group in together for name in getattr(names, group)]
        if twice := [name for name in each if each.count(name) > 1]:
            where = " and ".join(together)
            raise ModelError(f"names of {where}: expected all to differ, got {twice[0]!r} twice")
    return names, units


def labelled(names: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """Return each name with its unit, if it has one, as in "angle [rad]"."""
    pairs = zip(names, units, strict=True)
    return tuple(f"{name} [{unit}]" if unit else name for name, unit in pairs)


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


def positions(names: Iterable[str]) -> tuple[Place, ...]:
    """Return the places of numbers that are the `position` of entries."""
    return tuple(Place(name, "position") for name in names)
