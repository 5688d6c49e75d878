# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the observer node would have published, a block of ticks at a time.

The messages are those of the node, byte for byte; made many at once they cost a tenth.
"""

from collections.abc import Iterator, Sequence
from itertools import repeat
from operator import itemgetter
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.messages import estimate_topics as topics
from tsobs_ros.bag.messages.joint_series import Times
from tsobs_ros.bag.messages.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.checks import Array
from tsobs_ros.estimation.records import Estimate

Record: TypeAlias = tuple[str, str, bytes, int, int]
"""A `BagMessage` without its class, which costs more than all the rest of it."""

by_log_time = itemgetter(3)

_ANGLES, _RATES = [0, 2], [1, 3]


class Stamped(NamedTuple):
    """Where messages are in time, m of them.

    Attributes:
        stamps: Of the headers [ns], shape (m,).
        log_times: ns since the epoch, shape (m,).
        publish_times: ns since the epoch, shape (m,).
    """

    stamps: Times
    log_times: Times
    publish_times: Times

    def take(self, places: NDArray[np.intp] | NDArray[np.bool_]) -> "Stamped":
        """Return some of them."""
        return Stamped(*(array[places] for array in self))


class Publishing:
    """Makes messages of arrays.

    Args:
        prefix: Of the topics' names, with a slash at its end.
        learnt: By the names of the joints, those of their parameters that are learnt.
    """

    def __init__(self, prefix: str, learnt: dict[str, tuple[str, ...]]) -> None:
        self._prefix = prefix
        own = [(joint,) for joint in learnt]
        arms = [topics.sides(joint) for joint in learnt]
        parameters = [
            topics.parameter_names(joint, names, alone=len(learnt) == 1)
            for joint, names in learnt.items()
        ]
        self._learns = any(learnt.values())
        self._names: dict[str, Sequence[tuple[str, ...]]] = {
            **dict.fromkeys((topics.STATES, topics.STATE_BOUNDS), arms),
            **dict.fromkeys((topics.DISTURBANCE, topics.DISTURBANCE_BOUND, topics.INNOVATION), own),
            **dict.fromkeys(topics.PARAMETER_TOPICS, parameters),
        }
        self._encoders: dict[tuple[str, tuple[int, ...]], JointStateEncoder] = {}
        self._parameters_due = 0

    @property
    def topics(self) -> tuple[str, ...]:
        """The full names of the topics that there may be messages of."""
        names = topics.TOPICS + (topics.PARAMETER_TOPICS if self._learns else ())
        return tuple(self._prefix + name for name in names)

    def restart(self) -> None:
        """Forget when parameters were last published, as stamps may have gone back."""
        self._parameters_due = 0

    def motion(self, topic: str, at: Stamped, values: Array) -> Iterator[Record]:
        """Yield angles and velocities.

        Args:
            topic: Of states or their bounds.
            at: Where the messages are in time.
            values: [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), all NaN without any, shape (m, J, 4).
        """
        for joints, rows in _alike(np.isfinite(values[..., 0])):
            chosen = values[rows][:, joints]
            flat = (len(rows), 2 * len(joints))
            position = chosen[..., _ANGLES].reshape(flat)
            velocity = chosen[..., _RATES].reshape(flat)
            yield from self._records(topic, joints, at.take(rows), position, velocity)

    def scalars(self, topic: str, at: Stamped, values: Array) -> Iterator[Record]:
        """Yield one number a joint, and its rate where it has one.

        Args:
            topic: Of innovations, disturbances or their bounds.
            at: Where the messages are in time.
            values: The number, and perhaps its rate, NaN without any, shape (m, J, 1 or 2).
        """
        for joints, rows in _alike(np.isfinite(values[..., 0])):
            chosen = values[rows][:, joints]
            rate = chosen[..., 1:].reshape(len(rows), -1)
            if np.isnan(rate).all():
                rate = rate[:, :0]
            yield from self._records(topic, joints, at.take(rows), chosen[..., 0], rate)

    def parameters(
        self, at: Stamped, estimates: list[Sequence[Estimate | None]]
    ) -> Iterator[Record]:
        """Yield the parameters that are learnt, as often as they are published."""
        if not self._learns:
            return
        for place, (stamp, each) in enumerate(zip(at.stamps.tolist(), estimates, strict=True)):
            valid = [(joint, one) for joint, one in enumerate(each) if one and one.parameters_valid]
            if stamp < self._parameters_due or not valid:
                continue
            self._parameters_due = stamp + topics.PARAMETER_PERIOD
            joints, known = zip(*valid, strict=True)
            own = at.take(np.array([place]))
            for topic, arrays in (
                (topics.PARAMETERS, [one.parameters for one in known]),
                (topics.PARAMETER_BOUNDS, [one.parameter_bound for one in known]),
            ):
                values = np.concatenate(arrays)[np.newaxis]
                yield from self._records(topic, list(joints), own, values, values[:, :0])

    def _records(
        self, topic: str, joints: list[int], at: Stamped, position: Array, velocity: Array
    ) -> Iterator[Record]:
        encode = self._encoders.get((topic, tuple(joints)))
        if encode is None:
            names = [name for joint in joints for name in self._names[topic][joint]]
            encode = self._encoders[topic, tuple(joints)] = JointStateEncoder(names)
        data = encode.encode_all(at.stamps, position, velocity)
        times = (at.log_times.tolist(), at.publish_times.tolist())
        return zip(repeat(self._prefix + topic), repeat(JOINT_STATE), data, *times)


def _alike(present: NDArray[np.bool_]) -> Iterator[tuple[list[int], NDArray[np.intp]]]:
    """Yield each set of joints that messages are about, and which messages those are."""
    everybody = list(range(present.shape[1]))
    if present.all():
        if len(present):
            yield everybody, np.arange(len(present))
        return
    for pattern in np.unique(present, axis=0):
        if pattern.any():
            yield np.flatnonzero(pattern).tolist(), np.flatnonzero((present == pattern).all(axis=1))
