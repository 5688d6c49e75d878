# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""JointStates of the observer: samples in, read from the bytes on the wire; estimates out.

Building rclpy's message objects would cost more than the whole estimation. The topics of estimates
are those of a replay.
"""

import math
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import accumulate, pairwise, zip_longest
from typing import NamedTuple

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Int64MultiArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import encode_tick
from tsobs_ros.bag.joint_states import JointStateDecoder
from tsobs_ros.checks import Array
from tsobs_ros.design.signals import Place, Signals
from tsobs_ros.errors import MessageError
from tsobs_ros.estimation.records import REASONS, USED, Estimate, RejectReason
from tsobs_ros.nodes.wire import QUIET, JointStatePublisher
from tsobs_ros.replay.places import ESTIMATES, parts_of, places_of
from tsobs_ros.series import Stamps

NOT_NAMED = -1
"""Code of a joint that a message does not name."""
WRONG = REASONS.index(RejectReason.WRONG_JOINT)
MISSING = REASONS.index(RejectReason.MISSING_INPUT)

_RESTARTS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# What follows a message's numbers, so that each number of a row has a place, and its places.
_CONSTANTS = (math.nan, 0.0)
_NOTHING, _ZERO = -2, -1
# Of messages, whose names anybody may choose.
_MAX_LAYOUTS = 256


class Batch(NamedTuple):
    """Messages in the order of their stamps, N of them, with samples of k joints.

    Attributes:
        order: Their places among those that were read.
        stamps: [ns]; 0 of a message that cannot be read; shape (N,).
        y: Measured outputs of each joint, NaN if there is none, k of shape (N, p).
        u: Inputs of each joint, NaN if there is none, k of shape (N, m).
        codes: `USED` of samples, else the code of the rejection or `NOT_NAMED`, shape (k, N).
    """

    order: Sequence[int]
    stamps: Stamps
    y: list[Array]
    u: list[Array]
    codes: Stamps


class MeasurementReader:
    """Finds the samples of the node's joints in messages of any joints, in any order.

    A sample has an output at least, and all inputs.
    """

    def __init__(self, joints: Mapping[str, Signals], assume_zero_torque: bool) -> None:
        self._joints = dict(joints)
        self._absent_effort = _ZERO if assume_zero_torque else _NOTHING
        self._decode = JointStateDecoder()
        # Messages hardly ever change their names and lengths.
        self._layout = lru_cache(_MAX_LAYOUTS)(self._find)
        # Where the outputs, inputs and other inputs of the joints are in a row.
        self._parts: list[list[slice]] = []
        end = 0
        for each in joints.values():
            counts = map(len, (each.outputs, each.inputs, each.other_inputs))
            ends = list(accumulate(counts, initial=end))
            self._parts.append([slice(*pair) for pair in pairwise(ends)])
            end = ends[-1]
        self._unreadable = [math.nan] * end, (WRONG,) * len(joints)

    def read(self, messages: Sequence[bytes]) -> Batch:
        """Return the samples in messages, in the order of the messages' stamps.

        Bytes that are no JointState, and messages with none of the joints, are wrong for all.
        """
        rows = [self._read(data) for data in messages]
        order = sorted(range(len(rows)), key=[row[0] for row in rows].__getitem__)
        stamps, numbers, codes = zip(*[rows[place] for place in order], strict=True)
        table, y, u = np.array(numbers, np.float64), [], []
        for outputs, inputs, others in self._parts:
            y.append(np.ascontiguousarray(table[:, outputs]))
            own = np.ascontiguousarray(table[:, inputs])
            if others.start < others.stop:
                own = np.where(np.isnan(own), table[:, others], own)
            u.append(own)
        return Batch(order, np.array(stamps, np.int64), y, u, np.array(codes, np.int64).T.copy())

    def _read(self, data: bytes) -> tuple[int, Sequence[float], tuple[int, ...]]:
        try:
            stamp, names, position, velocity, effort, _ = self._decode(data)
        except MessageError:
            return 0, *self._unreadable
        picked, codes = self._layout(names, len(position), len(velocity), len(effort))
        if codes.count(NOT_NAMED) == len(codes):
            return 0, *self._unreadable
        numbers = position + velocity + effort + _CONSTANTS
        return stamp, [numbers[place] for place in picked], codes

    def describe(self, data: bytes, joint: str) -> str:
        """Return what a message contains of a joint, for the log line of its rejection."""
        try:
            message = self._decode(data)
        except MessageError as error:
            return f"not a JointState: {error}"
        own, text = self._joints[joint], f"stamp {message.stamp * 1e-9:.3f}"
        for place in dict.fromkeys(own.outputs + own.inputs):
            named = zip(message.names, getattr(message, place.field), strict=False)
            number = next((str(number) for name, number in named if name == place.name), "missing")
            text += f", {place.described} {number}"
        # The publisher decides how many names there are, and how long.
        return f"{text}, names {reprlib.repr(list(message.names))}"

    def _find(
        self, names: tuple[str, ...], positions: int, velocities: int, efforts: int
    ) -> tuple[list[int], tuple[int, ...]]:
        """Return the places of a row in the numbers of messages with these names and lengths.

        The codes of the joints are those of `Batch`. Of a name that comes twice the first counts.
        """
        found = {name: place for place, name in reversed(list(enumerate(names)))}
        parts = {
            "position": (0, positions),
            "velocity": (positions, velocities),
            "effort": (positions + velocities, efforts),
        }

        def place_of(place: Place) -> int:
            begin, length = parts[place.field]
            index = found.get(place.name, length)
            if index < length:
                return begin + index
            return self._absent_effort if place.field == "effort" and not efforts else _NOTHING

        picked, codes = list[int](), []
        for each in self._joints.values():
            outputs, inputs, others = (
                [place_of(place) for place in places]
                for places in (each.outputs, each.inputs, each.other_inputs)
            )
            picked += outputs + inputs + others
            measured = any(place != _NOTHING for place in outputs)
            fed = all(
                {*pair} != {_NOTHING} for pair in zip_longest(inputs, others, fillvalue=_NOTHING)
            )
            if measured and fed:
                codes.append(USED)
            elif each.entries.isdisjoint(found):
                codes.append(NOT_NAMED)
            else:
                codes.append(MISSING if measured else WRONG)
        return picked, tuple(codes)


class EstimatePublisher:
    """Publishes estimates, innovations and ticks under the node's private names.

    There are topics of torque disturbances and of learnt parameters only if there are any. The
    topic of ticks is reliable, as a lost message would leave it open what the estimates include.
    """

    def __init__(
        self, node: Node, joints: Mapping[str, Signals], learnt: Sequence[tuple[str, ...]]
    ) -> None:
        alone = len(joints) == 1
        each = [
            places_of(joint, own, alone=alone, learnt=names)
            for (joint, own), names in zip(joints.items(), learnt, strict=True)
        ]
        self._outputs = {
            topic: JointStatePublisher(node, f"~/{topic}", parts_of(topic, each))
            for topic in (*ESTIMATES, topics.INNOVATION)
            if any(one[topic] for one in each)
        }
        self._innovation = self._outputs.pop(topics.INNOVATION)
        self._restarts = JointStatePublisher(
            node, f"~/{topics.RESTARTS}", parts_of(topics.RESTARTS, each), _RESTARTS
        )
        self._ticks = node.create_publisher(
            Int64MultiArray, f"~/{topics.TICKS}", 100, event_callbacks=QUIET
        )
        self._tick, self._taken = 0, list[bytes]()
        self._count = len(joints)
        self._slow_since = dict.fromkeys((topics.PARAMETERS, topics.HEALTH), -topics.SLOW_PERIOD)

    def publish(self, stamp: int, estimates: Mapping[int, Estimate]) -> None:
        """Publish estimates of joints, by index, at a stamp [ns]; what they lack is left out."""
        valid = {joint: each for joint, each in estimates.items() if each.parameters_valid}
        is_due = bool(valid) and self._is_due(topics.PARAMETERS, stamp)
        for topic, output in self._outputs.items():
            if topic in topics.PARAMETER_TOPICS:
                if is_due:
                    output.publish(stamp, _rows(topic, valid))
            elif topic != topics.HEALTH and output.publisher.get_subscription_count():
                output.publish(stamp, _rows(topic, estimates))

    def publish_health(self, stamp: int, estimates: Mapping[int, Estimate]) -> bool:
        """Publish what estimates at a stamp are worth, if that is due; return whether it is."""
        is_due = bool(estimates) and self._is_due(topics.HEALTH, stamp)
        if is_due:
            rows = {joint: each.health for joint, each in estimates.items()}
            self._outputs[topics.HEALTH].publish(stamp, rows)
        return is_due

    def publish_innovations(self, stamps: Stamps, innovations: Array) -> None:
        """Publish y − ŷ of messages, stamped as they are.

        Args:
            stamps: Of the messages [ns], shape (N,).
            innovations: Of the outputs of all joints, one after the other, NaN of those that are
                not used, shape (N, outputs).
        """
        if self._innovation.publisher.get_subscription_count():
            for stamp, values in zip(stamps.tolist(), innovations.tolist(), strict=True):
                rows = {place: (each,) for place, each in enumerate(values) if each == each}
                self._innovation.publish(stamp, rows)

    def publish_restart(self, stamp: int, number: int) -> None:
        """Publish at a stamp [ns] how many restarts there have been; ticks count from 1 again."""
        self._tick, self._taken = 0, []
        self._restarts.publish(stamp, dict.fromkeys(range(self._count), (float(number),)))

    def take(self, messages: Iterable[bytes]) -> None:
        """Note the measurement messages that the next tick includes."""
        self._taken += messages

    def publish_tick(self, stamp: int, *, estimated: bool) -> None:
        """Publish a tick at a stamp [ns] that has measurements or estimates, before these."""
        if self._taken or estimated:
            self._tick += 1
            if self._ticks.get_subscription_count():
                self._ticks.publish(encode_tick(stamp, self._tick, estimated, self._taken))
            self._taken.clear()

    def _is_due(self, topic: str, stamp: int) -> bool:
        """Return whether what changes slowly is published at a stamp, which may have gone back."""
        is_due = not 0 <= stamp - self._slow_since[topic] < topics.SLOW_PERIOD
        if is_due:
            self._slow_since[topic] = stamp
        return is_due


def _rows(topic: str, estimates: Mapping[int, Estimate]) -> dict[int, list[float]]:
    """Return a topic's numbers of those joints that have any."""
    rows = {}
    for joint, each in estimates.items():
        row = [number for field in ESTIMATES[topic] for number in getattr(each, field).tolist()]
        if row:
            rows[joint] = row
    return rows
