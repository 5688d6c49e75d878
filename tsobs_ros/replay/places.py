# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The places of joints' numbers in the topics of an observer and of a simulator."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import MessageSeries
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.checks import Array
from tsobs_ros.design.signals import Field, Place, Signals, positions
from tsobs_ros.estimation.records import HEALTH
from tsobs_ros.series import Stamps

Places: TypeAlias = Mapping[str, Sequence[Place]]
"""The places of a joint's numbers by topic."""

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


def places_of(
    joint: str, signals: Signals, *, alone: bool, learnt: tuple[str, ...] = (), rated: bool = True
) -> Places:
    """Return the places of a joint's numbers, those of an estimate in the order of `ESTIMATES`.

    Args:
        joint: The joint's name.
        signals: The places of its signals.
        alone: Whether it is the only joint of its observer.
        learnt: Names of the parameters that are learnt.
        rated: Whether disturbances have rates.
    """
    channels = positions(signals.disturbances)
    rates = (Place(name, "velocity") for name in signals.disturbances if rated)
    parameters, conditions = (
        positions(topics.parameter_names(joint, names, alone=alone))
        for names in (learnt, topics.CONDITIONS)
    )
    return {
        **dict.fromkeys((topics.STATES, topics.STATE_BOUNDS, topics.TRUE_STATES), signals.states),
        topics.DISTURBANCE: (*channels, *rates),
        **dict.fromkeys(
            (topics.DISTURBANCE_BOUND, topics.INNOVATION, topics.TRUE_DISTURBANCE), channels
        ),
        **dict.fromkeys((*topics.TORQUE_TOPICS, topics.TRUE_TORQUE), signals.torques),
        topics.RESTARTS: positions([joint]),
        topics.HEALTH: conditions,
        **dict.fromkeys(topics.PARAMETER_TOPICS, parameters),
    }


class Layout:
    """The entries of messages made of columns of numbers.

    Args:
        places: The place of each column.
    """

    def __init__(self, places: Sequence[Place]) -> None:
        self._names = list(dict.fromkeys(place.name for place in places))
        self._columns: dict[Field, dict[int, int]] = {field: {} for field in FIELDS}
        for column, (name, field) in enumerate(places):
            self._columns[field][self._names.index(name)] = column
        self._encoders: dict[tuple[int, ...], JointStateEncoder] = {}
        self._encode_one = JointStateEncoder(self._names)
        # The columns of all entries, -1 for one without a place, of each field.
        entries = range(len(self._names))
        self._all = [
            [own.get(each, -1) for each in entries if own] for own in self._columns.values()
        ]

    def encode_one(self, stamp: int, values: Sequence[float]) -> bytes:
        """Return one message of all entries, as `encode` does at a higher cost.

        Args:
            stamp: Of its header [ns].
            values: In the order of the places.
        """
        numbers = [*values, math.nan]
        return self._encode_one(stamp, *[[numbers[place] for place in own] for own in self._all])

    def entries_of(self, columns: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return whether each entry has any of some columns of m messages, shape (m, entries)."""
        there = np.zeros((len(columns), len(self._names)), np.bool_)
        for chosen in self._columns.values():
            there[:, list(chosen)] |= columns[:, list(chosen.values())]
        return there

    def encode(
        self, stamps: Stamps, values: Array, entries: Sequence[int] | None = None
    ) -> NDArray[np.uint8]:
        """Return messages of some entries, a row each; fields in which none has a place are empty.

        Args:
            stamps: Of the headers [ns], shape (m,).
            values: In the order of the places, NaN for none, shape (m, k).
            entries: Which ones; all if None.
        """
        chosen = tuple(range(len(self._names)) if entries is None else entries)
        if chosen not in self._encoders:
            self._encoders[chosen] = JointStateEncoder([self._names[entry] for entry in chosen])
        # One more column, for entries without a place.
        numbers = np.append(values, np.full((len(values), 1), np.nan), axis=1)
        fields = []
        for columns in self._columns.values():
            own = [columns.get(entry, -1) for entry in chosen]
            fields.append(numbers[:, own] if max(own, default=-1) >= 0 else numbers[:1, :0])
        return self._encoders[chosen].encode_rows(stamps, *fields)


class EstimateEncoder:
    """Makes the messages of one observer from arrays, byte for byte those of the node.

    Args:
        prefix: Of the topics' names, with a slash at its end.
        joints: The places of each joint's numbers.
    """

    def __init__(self, prefix: str, joints: Sequence[Places]) -> None:
        self._prefix = prefix
        optional = (*topics.TORQUE_TOPICS, *topics.PARAMETER_TOPICS)
        there = {name for places in joints for name in optional if places[name]}
        names = [*topics.TOPICS, *(name for name in optional if name in there)]
        self._layouts = {n: Layout([place for one in joints for place in one[n]]) for n in names}
        self._widths = {name: [len(one[name]) for one in joints] for name in names}

    @property
    def topics(self) -> tuple[str, ...]:
        """Full names of the topics."""
        return tuple(self._prefix + name for name in self._layouts)

    def messages(self, topic: str, at: Any, values: Sequence[Array]) -> list[MessageSeries]:
        """Return messages of what there is.

        Args:
            topic: One of `bag.estimate_topics`.
            at: Records with `stamps`, `log_times` and `publish_times` of m messages [ns].
            values: Of each joint in the order of `places_of`, NaN for none, shape (m, width);
                a joint without any may have fewer.
        """
        if topic not in self._layouts:
            return []
        layout, found = self._layouts[topic], []
        numbers, there = [], []
        for given, width in zip(values, self._widths[topic], strict=True):
            own = np.full((len(at.stamps), width), np.nan)
            own[:, : given.shape[1]] = given[:, :width]
            is_there = np.isfinite(own)
            if topic != topics.INNOVATION and width:
                # The first number of a joint decides on all of them.
                is_there = np.repeat(is_there[:, :1], width, axis=1)
            numbers.append(own)
            there.append(is_there)
        together = np.hstack(numbers)
        for entries, rows in _alike(layout.entries_of(np.hstack(there))):
            data = layout.encode(at.stamps[rows], together[rows], entries)
            times = at.log_times[rows], at.publish_times[rows]
            found.append(MessageSeries(self._prefix + topic, JOINT_STATE, *times, data))
        return found


def _alike(present: NDArray[np.bool_]) -> Iterator[tuple[list[int], NDArray[np.intp]]]:
    """Yield each set of entries that messages have, and the places of those messages."""
    if len(present) and present.all():
        yield list(range(present.shape[1])), np.arange(len(present))
        return
    for pattern in np.unique(present, axis=0):
        if pattern.any():
            yield np.flatnonzero(pattern).tolist(), np.flatnonzero((present == pattern).all(axis=1))
