# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The places of joints' numbers in the topics of an observer and of a simulator."""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_states import JointStateEncoder
from tsobs_ros.checks import Array
from tsobs_ros.design.signals import Field, Place, Signals, positions
from tsobs_ros.estimation.records import HEALTH

Places: TypeAlias = Mapping[str, Sequence[Place]]
"""The places of a joint's numbers by topic."""


def places_of(
    joint: str, signals: Signals, *, alone: bool, learnt: tuple[str, ...] = (), rated: bool = True
) -> Places:
    """Return the places of a joint's numbers, in the order of `EstimateTable`.

    Args:
        joint: The joint's name.
        signals: The places of its signals.
        alone: Whether it is the only joint of its observer.
        learnt: Names of the parameters that are learnt.
        rated: Whether disturbances have rates.
    """
    channels = positions(signals.disturbances)
    rates = (Place(name, "velocity") for name in signals.disturbances if rated)
    parameters = positions(topics.parameter_names(joint, learnt, alone=alone))
    return {
        **dict.fromkeys((topics.STATES, topics.STATE_BOUNDS, topics.TRUE_STATES), signals.states),
        topics.DISTURBANCE: (*channels, *rates),
        **dict.fromkeys(
            (topics.DISTURBANCE_BOUND, topics.INNOVATION, topics.TRUE_DISTURBANCE), channels
        ),
        **dict.fromkeys(
            (topics.TORQUE_DISTURBANCE, topics.TORQUE_DISTURBANCE_BOUND, topics.TRUE_TORQUE),
            signals.torques,
        ),
        topics.RESTARTS: positions([joint]),
        topics.HEALTH: positions(topics.parameter_names(joint, topics.CONDITIONS, alone=alone)),
        **dict.fromkeys(topics.PARAMETER_TOPICS, parameters),
    }


ESTIMATES: Mapping[str, tuple[str, ...]] = {
    topics.STATES: ("state",),
    topics.STATE_BOUNDS: ("state_bound",),
    topics.DISTURBANCE: ("disturbance", "disturbance_rate"),
    topics.DISTURBANCE_BOUND: ("disturbance_bound",),
    topics.TORQUE_DISTURBANCE: ("torque_disturbance",),
    topics.TORQUE_DISTURBANCE_BOUND: ("torque_disturbance_bound",),
    topics.PARAMETERS: ("parameters",),
    topics.PARAMETER_BOUNDS: ("parameter_bound",),
    topics.HEALTH: HEALTH,
}
"""Fields of an `Estimate` by the topic that has them, in the order of `places_of`."""

FIELDS: tuple[Field, ...] = ("position", "velocity", "effort")
"""Fields of a JointState."""


class Layout:
    """The entries of messages about J joints, made of arrays.

    Args:
        joints: The places of each joint's numbers.

    Attributes:
        first: For each entry, the first one of its joint.
    """

    def __init__(self, joints: Sequence[Sequence[Place]]) -> None:
        self._names: list[str] = []
        self._columns: dict[Field, list[tuple[int, int] | None]] = {one: [] for one in FIELDS}
        first: list[int] = []
        for joint, places in enumerate(joints):
            begin = len(self._names)
            for column, (name, field) in enumerate(places):
                if name not in self._names[begin:]:
                    self._names.append(name)
                    first.append(begin)
                    for each in self._columns.values():
                        each.append(None)
                self._columns[field][self._names.index(name, begin)] = joint, column
        self.first = np.array(first, np.intp)
        self._encoders: dict[tuple[int, ...], JointStateEncoder] = {}

    def present(self, values: Array) -> NDArray[np.bool_]:
        """Return whether each entry has a number, shape (m, entries).

        Args:
            values: In the order of the places, NaN for none, shape (m, J, width).
        """
        every = range(len(self._names))
        there = np.zeros((len(values), len(self._names)), np.bool_)
        for field in FIELDS:
            numbers = self._numbers(field, every, values)
            there |= np.isfinite(numbers) if numbers.shape[1] else False
        return there

    def encode(
        self, stamps: NDArray[np.int64], values: Array, entries: Sequence[int] | None = None
    ) -> NDArray[np.uint8]:
        """Return messages of some entries, a row each; fields in which none has a place are empty.

        Args:
            stamps: Of the headers [ns], shape (m,).
            values: In the order of the places, NaN for none, shape (m, J, width).
            entries: Which ones; all if None.
        """
        chosen = tuple(range(len(self._names)) if entries is None else entries)
        if chosen not in self._encoders:
            self._encoders[chosen] = JointStateEncoder([self._names[entry] for entry in chosen])
        numbers = (self._numbers(field, chosen, values) for field in FIELDS)
        return self._encoders[chosen].encode_rows(stamps, *numbers)

    def _numbers(self, field: Field, entries: Sequence[int], values: Array) -> Array:
        columns = [self._columns[field][entry] for entry in entries]
        if all(column is None for column in columns):
            return np.zeros((1, 0))
        found = np.full((len(values), len(columns)), np.nan)
        for place, column in enumerate(columns):
            if column is not None:
                found[:, place] = values[:, column[0], column[1]]
        return found
