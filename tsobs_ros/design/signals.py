# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Signals of a design: their names, their units, and their places in JointState messages.

An arm has angles, velocities and torques. A driver with an encoder on one side publishes that side
under the joint's name; with encoders on both sides the motor has its own entry. A T–S system has
one entry per signal, named as in its file; the `position` holds the value.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, TypeAlias

from tsobs_ros.checks import shown
from tsobs_ros.errors import ModelError

Field: TypeAlias = Literal["position", "velocity", "effort"]

_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_TIMES = ("time", "stamp", "timestamp")
"""Titles under which a CSV log is searched for its times; `t` is left to signals."""

_MAX_LENGTH = 60


@dataclass(frozen=True)
class Labels:
    """Names or units of signals in the order of the model; an omitted group has none.

    Attributes:
        states: Labels of x.
        outputs: Labels of y.
        inputs: Labels of u, without scheduled signals.
        scheduled: Labels of s.
    """

    OMIT_EMPTY: ClassVar[bool] = True
    """Groups without names are left out of files."""

    states: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    scheduled: tuple[str, ...] = ()


NO_LABELS = Labels()
"""The labels of a request that gives none."""


def checked_labels(names: Labels, units: Labels, counts: Sequence[int]) -> tuple[Labels, Labels]:
    """Return the names and units of all signals; a request may give only some of them.

    Groups without names get x1, y1, u1, s1 and so on; without units, all units are empty texts. A
    scheduled signal with the name of an output is that measurement. Otherwise the names of outputs,
    inputs and scheduled signals must differ, because they are entries of one message. The names of
    the states must differ, too.

    Raises:
        ModelError: A group has not one text per signal, a text is not plain, or two signals share a
            name or have that of a log's times; the message names the entry.
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
    for name in names.outputs + names.inputs + names.scheduled:
        if name.lower() in _TIMES:
            raise ModelError(f"names: expected none of a log's column of times, got {name!r}")
    return names, units


def labelled(names: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """Return each name with its unit, if it has one, as in "angle [rad]"."""
    pairs = zip(names, units, strict=True)
    return tuple(f"{name} [{unit}]" if unit else name for name, unit in pairs)


class Place(NamedTuple):
    """The place of a number in a JointState: the entry's name and the message's field."""

    name: str
    field: Field

    @property
    def described(self) -> str:
        """The place in words, such as "position of elbow"."""
        return f"{self.field} of {self.name}"


class Signals(NamedTuple):
    """The places of a joint's signals.

    Attributes:
        outputs: Places of the p measured outputs.
        inputs: Places of the inputs and then of the scheduled signals, m in all.
        states: Places of the plant's states in estimates.
        disturbances: Entry of each output in disturbances and innovations, p names.
        torques: Places of the torque disturbances in estimates, the motor's first.
        other_inputs: Places of the inputs if `inputs` has no number; () if there are none.
        other_outputs: Places of the outputs in messages with these entries; () if there are none.
        units: Units of the outputs, empty texts if they are not known.
    """

    outputs: tuple[Place, ...]
    inputs: tuple[Place, ...]
    states: tuple[Place, ...]
    disturbances: tuple[str, ...]
    torques: tuple[Place, ...]
    other_inputs: tuple[Place, ...]
    units: tuple[str, ...]
    other_outputs: tuple[Place, ...] = ()

    @property
    def entries(self) -> frozenset[str]:
        """The entries of measurement messages that belong to the joint."""
        others = self.other_outputs + self.other_inputs
        return frozenset(place.name for place in self.outputs + self.inputs + others)


def positions(names: Iterable[str]) -> tuple[Place, ...]:
    """Return the places of numbers in the `position` of entries."""
    return tuple(Place(name, "position") for name in names)
