# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The places of joints' numbers in the topics of an observer and of a simulator."""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import accumulate
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

CONDITIONS = (*HEALTH[:-1], "measurement_age")
"""Names of the numbers of a joint's health in messages."""

_MAX_LAYOUTS = 256


def places_of(
    joint: str, signals: Signals, *, alone: bool, learnt: tuple[str, ...] = (), rated: bool = True
) -> Places:
    """Return the places of a joint's numbers, those of an estimate in the order of `ESTIMATES`.

    `alone` means that its observer has no other joint, `learnt` names the learnt parameters, and
    `rated` means that disturbances have rates.
    """
    channels = positions(signals.disturbances)
    rates = (Place(name, "velocity") for name in signals.disturbances if rated)
    before = "" if alone else f"{joint}/"
    parameters, conditions = (
        positions([before + name for name in names]) for names in (learnt, CONDITIONS)
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
    """The layout of messages that are made of columns of numbers, each column with its place."""

    def __init__(self, places: Sequence[Place]) -> None:
        names = list(dict.fromkeys(place.name for place in places))
        columns = {place: column for column, place in enumerate(places)}
        # Per field, the column of each entry, -1 if it has none; empty for a field without columns.
        self._columns = [
            [columns.get(Place(name, field), -1) for name in names] if field in used else []
            for used in [{place.field for place in places}]
            for field in FIELDS
        ]
        self._encoder = JointStateEncoder(names)

    def encode_one(self, stamp: int, values: Sequence[float]) -> bytes:
        """Return one message with a stamp [ns], in less time than `encode`."""
        numbers = [*values, math.nan]
        return self._encoder(stamp, *[[numbers[place] for place in own] for own in self._columns])

    def encode(self, stamps: Stamps, values: Array) -> NDArray[np.uint8]:
        """Return messages, one per row; fields in which no column has a place are empty.

        Stamps [ns] have the shape (m,), values (m, k) in the order of the places, NaN for none.
        """
        # One more column, of NaN, for entries without a place.
        numbers = np.append(values, np.full((len(values), 1), np.nan), axis=1)
        return self._encoder.encode_rows(stamps, *(numbers[:, own] for own in self._columns))


class Layouts:
    """The layouts of messages with any selection of parts, such as joints.

    `parts` has the places of each part's numbers; if two share a place, the later one counts. `of`
    returns the layout of selected parts, each given by its index and the count of its numbers.
    """

    def __init__(self, parts: Sequence[Sequence[Place]]) -> None:
        self.parts = parts
        self.of = lru_cache(_MAX_LAYOUTS)(
            lambda key: Layout([place for part, count in key for place in parts[part][:count]])
        )


def parts_of(topic: str, joints: Sequence[Places]) -> list[Sequence[Place]]:
    """Return the places of each part, which a topic's messages have or lack as a whole.

    A part is a joint; in innovations, it is an output.
    """
    if topic == topics.INNOVATION:
        return [[place] for one in joints for place in one[topic]]
    return [one[topic] for one in joints]


class EstimateEncoder:
    """Makes the messages of one observer from arrays, byte for byte those of the node.

    `topics` has the full names of their topics.
    """

    def __init__(self, prefix: str, joints: Sequence[Places]) -> None:
        self._prefix = prefix
        optional = (*topics.TORQUE_TOPICS, *topics.PARAMETER_TOPICS)
        there = [name for name in optional if any(one[name] for one in joints)]
        self._widths = {n: [len(one[n]) for one in joints] for n in (*topics.TOPICS, *there)}
        self._layouts = {n: Layouts(list(filter(None, parts_of(n, joints)))) for n in self._widths}
        self.topics = tuple(prefix + name for name in self._layouts)

    def messages(self, topic: str, at: Any, values: Sequence[Array]) -> list[MessageSeries]:
        """Return the messages of a topic, as far as there are values for them.

        `at` has the `stamps`, `log_times` and `publish_times` of m messages [ns]. `values` has an
        array per joint in the order of `places_of`, NaN for none, shape (m, width), or with fewer
        columns for a joint without values. A part is left out if its first number is not finite.
        """
        if topic not in self._layouts:
            return []
        layouts, found, widths = self._layouts[topic], [], self._widths[topic]
        numbers = np.full((len(at.stamps), sum(widths)), np.nan)
        for given, width, end in zip(values, widths, accumulate(widths), strict=True):
            count = min(given.shape[1], width)
            numbers[:, end - width : end - width + count] = given[:, :count]
        sizes = [len(part) for part in layouts.parts]
        there = np.isfinite(numbers[:, np.cumsum([0, *sizes])[:-1]])
        # Mostly no part is missing, and a check for that takes less time.
        for pattern in there[:1] if there.all() else np.unique(there, axis=0):
            if pattern.any():
                rows = np.flatnonzero((there == pattern).all(axis=1))
                chosen = np.flatnonzero(pattern).tolist()
                layout = layouts.of(tuple((part, sizes[part]) for part in chosen))
                data = layout.encode(at.stamps[rows], numbers[rows][:, np.repeat(pattern, sizes)])
                times = at.log_times[rows], at.publish_times[rows]
                found.append(MessageSeries(self._prefix + topic, JOINT_STATE, *times, data))
        return found
