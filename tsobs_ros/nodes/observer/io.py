# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""JointState messages in and estimates out, as the bytes on the wire.

Building, converting and taking rclpy's message objects would cost more than the whole estimation.
"""

import math
import reprlib
import sys
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_states import JointStateDecoder, JointStateEncoder
from tsobs_ros.checks import Array
from tsobs_ros.errors import MessageError
from tsobs_ros.estimation.events import Condition
from tsobs_ros.estimation.records import Estimate

MEASUREMENT_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Sensor data, with room for a second of samples: the queue is only emptied once a tick."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Of what stays valid until the next message."""

_RELIABLE = QoSProfile(depth=10)
_RESTARTS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_MAX_KNOWN = 256
_ABSENT = sys.maxsize

_Row: TypeAlias = tuple[int, list[float], list[float], list[bool], list[bool]]
"""A row of a `Batch`."""
_Motion: TypeAlias = tuple[int, Sequence[float], Sequence[float]]
"""A joint's index, its positions and its velocities."""
Stamps: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.bool_]


class Batch(NamedTuple):
    """Messages in the order of their stamps, m of them, with samples of k joints.

    Attributes:
        order: Their places among those that were read.
        stamps: [ns]; 0 of a message that cannot be read; shape (m,).
        y: Measured angles, NaN if there is none [rad], shape (k, m).
        u: Torques, NaN if there is none [N m], shape (k, m).
        given: Whether a message has a sample of a joint, shape (k, m); None: all have.
        wrong: Whether it should have one and has none, shape (k, m); None: none is.
    """

    order: Sequence[int]
    stamps: Stamps
    y: Array
    u: Array
    given: Flags | None
    wrong: Flags | None


class MeasurementReader:
    """Finds the samples of the node's joints in messages of any joints, in any order.

    Args:
        joints: Names of the joints.
        assume_zero_torque: Whether a message without effort means torque 0.
    """

    def __init__(self, joints: Sequence[str], assume_zero_torque: bool) -> None:
        self._joints = tuple(joints)
        self._assume_zero_torque = assume_zero_torque
        self._decode = JointStateDecoder()
        # Places of the joints, by the names in a message, which hardly ever change.
        self._places: dict[tuple[str, ...], list[int]] = {}
        nothing = [math.nan] * len(joints)
        self._unreadable: _Row = (0, nothing, nothing, [False] * len(joints), [True] * len(joints))
        self._all, self._none = [True] * len(joints), [False] * len(joints)

    def read(self, messages: Sequence[bytes]) -> Batch:
        """Return the samples in messages, in the order of the messages' stamps.

        Bytes that are no JointState, and messages with none of the joints, are wrong for all.
        """
        rows = [self._read(data) for data in messages]
        order = sorted(range(len(rows)), key=[row[0] for row in rows].__getitem__)
        stamps, y, u, given, wrong = zip(*[rows[place] for place in order], strict=True)
        complete = all(each is self._all for each in given)
        return Batch(
            order,
            np.array(stamps, np.int64),
            np.array(list(zip(*y, strict=True)), np.float64),
            np.array(list(zip(*u, strict=True)), np.float64),
            None if complete else np.array(given, np.bool_).T,
            None if complete else np.array(wrong, np.bool_).T,
        )

    def _read(self, data: bytes) -> _Row:
        try:
            stamp, names, position, _, effort, _ = self._decode(data)
        except MessageError:
            return self._unreadable
        places = self._places.get(names) or self._find(names)
        if self._assume_zero_torque and not effort:
            effort = (0.0,) * len(position)
        count = min(len(position), len(effort))
        given = [place < count for place in places]
        if all(given):
            y = [position[place] for place in places]
            u = [effort[place] for place in places]
            return stamp, y, u, self._all, self._none
        named = [place != _ABSENT for place in places]
        if not any(named):
            return self._unreadable
        pairs = list(zip(places, given, strict=True))
        y = [position[place] if there else math.nan for place, there in pairs]
        u = [effort[place] if there else math.nan for place, there in pairs]
        return stamp, y, u, given, [a and not b for a, b in zip(named, given, strict=True)]

    def describe(self, data: bytes, joint: str) -> str:
        """Return what a message contains of a joint, for the log line of its rejection."""
        try:
            message = self._decode(data)
        except MessageError as error:
            return f"not a JointState: {error}"
        if joint not in message.names:
            # The publisher decides how many names there are, and how long.
            names = reprlib.repr(list(message.names))
            return f"expected {', '.join(self._joints)}; got names {names}"
        place, text = message.names.index(joint), f"stamp {message.stamp * 1e-9:.3f}"
        for field in ("position", "effort"):
            numbers = getattr(message, field)
            value = numbers[place] if place < len(numbers) else f"missing ({len(numbers)} in all)"
            text += f", {field} {value}"
        return text

    def _find(self, names: tuple[str, ...]) -> list[int]:
        if len(self._places) >= _MAX_KNOWN:
            self._places.clear()
        # Of a name that comes twice, the first.
        found = {name: place for place, name in reversed(list(enumerate(names)))}
        self._places[names] = places = [found.get(joint, _ABSENT) for joint in self._joints]
        return places


class _Output:
    """A publisher of JointStates of any of some joints, each with its names."""

    def __init__(
        self,
        node: Node,
        topic: str,
        names: Sequence[Sequence[str]],
        qos: QoSProfile = _RELIABLE,
    ) -> None:
        # Every QoS event is one more thing the executor gathers for each of its waits.
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        self._publisher = node.create_publisher(
            JointState, f"~/{topic}", qos, event_callbacks=quiet
        )
        self._latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        self._names = names
        self._encoders: dict[tuple[int, ...], JointStateEncoder] = {}

    @property
    def is_heard(self) -> bool:
        """Whether there may be a listener."""
        return self._latched or bool(self._publisher.get_subscription_count())

    def publish(self, stamp: int, rows: Sequence[_Motion]) -> None:
        """Send one message of all the rows' joints, if it has any and there may be a listener."""
        if not rows or not self.is_heard:
            return
        joints = tuple([row[0] for row in rows])
        encode = self._encoders.get(joints)
        if encode is None:
            if len(self._encoders) >= _MAX_KNOWN:
                self._encoders.clear()
            names = [name for joint in joints for name in self._names[joint]]
            encode = self._encoders[joints] = JointStateEncoder(names)
        positions = [value for row in rows for value in row[1]]
        velocities = [value for row in rows for value in row[2]]
        self._publisher.publish(encode(stamp, positions, velocities))


class EstimatePublisher:
    """Publishes estimates, innovations and parameters under the node's private names.

    Args:
        node: The node.
        learnt: Names of each joint's learnt parameters, by the joint's name; there are topics of
            them only if there are any.
    """

    def __init__(self, node: Node, learnt: Mapping[str, tuple[str, ...]]) -> None:
        joints = [[joint] for joint in learnt]
        sides = [topics.sides(joint) for joint in learnt]
        self._states = _Output(node, topics.STATES, sides)
        self._state_bounds = _Output(node, topics.STATE_BOUNDS, sides)
        self._disturbance = _Output(node, topics.DISTURBANCE, joints)
        self._disturbance_bound = _Output(node, topics.DISTURBANCE_BOUND, joints)
        self._innovation = _Output(node, topics.INNOVATION, joints)
        self._restarts = _Output(node, topics.RESTARTS, joints, _RESTARTS)
        own = [
            topics.parameter_names(joint, topics.CONDITIONS, alone=len(learnt) == 1)
            for joint in learnt
        ]
        self._health = _Output(node, topics.HEALTH, own)
        self._joint_count = len(joints)
        self._parameters: tuple[_Output, _Output] | None = None
        if any(learnt.values()):
            names = [
                topics.parameter_names(joint, own, alone=len(learnt) == 1)
                for joint, own in learnt.items()
            ]
            self._parameters = (
                _Output(node, topics.PARAMETERS, names),
                _Output(node, topics.PARAMETER_BOUNDS, names),
            )
        self._parameters_due = 0

    def publish(self, stamp: int, estimates: Sequence[Estimate | None]) -> bool:
        """Publish the joints' estimates at a stamp [ns]; what they lack is left out.

        Args:
            stamp: Of the messages [ns].
            estimates: One entry a joint; None if it has no estimate.

        Returns:
            Whether there was an estimate.
        """
        known = [(joint, each) for joint, each in enumerate(estimates) if each is not None]
        if not known:
            return False
        self._states.publish(stamp, [_motion(joint, each.state) for joint, each in known])
        self._state_bounds.publish(
            stamp, [_motion(joint, each.state_bound) for joint, each in known if _has_bound(each)]
        )
        disturbed = [(joint, each) for joint, each in known if each.disturbance.size]
        self._disturbance.publish(
            stamp,
            [
                (joint, each.disturbance.tolist(), each.disturbance_rate.tolist())
                for joint, each in disturbed
            ],
        )
        self._disturbance_bound.publish(
            stamp,
            [
                (joint, each.disturbance_bound.tolist(), ())
                for joint, each in disturbed
                if each.disturbance_bound.size
            ],
        )
        if self._parameters is not None and stamp >= self._parameters_due:
            valid = [(joint, each) for joint, each in known if each.parameters_valid]
            values, bounds = self._parameters
            values.publish(stamp, [(joint, each.parameters.tolist(), ()) for joint, each in valid])
            bounds.publish(
                stamp, [(joint, each.parameter_bound.tolist(), ()) for joint, each in valid]
            )
            if valid:
                self._parameters_due = stamp + topics.SLOW_PERIOD
        return True

    def publish_innovations(self, stamps: Stamps, innovations: Array) -> None:
        """Publish y − ŷ of messages, stamped as they are.

        Args:
            stamps: Of the messages [ns], shape (m,).
            innovations: Of their samples [rad], NaN of those not used, shape (k, m).
        """
        if not self._innovation.is_heard:
            return
        for stamp, values in zip(stamps.tolist(), innovations.T.tolist(), strict=True):
            self._innovation.publish(
                stamp,
                [(joint, (each,), ()) for joint, each in enumerate(values) if each == each],
            )

    def publish_health(self, stamp: int, conditions: Sequence[Condition | None]) -> None:
        """Publish what the joints' estimates are worth.

        Args:
            stamp: Of the estimates [ns].
            conditions: One entry a joint; None if it has no estimate.
        """
        self._health.publish(
            stamp,
            [(joint, each.numbers, ()) for joint, each in enumerate(conditions) if each],
        )

    def publish_restart(self, stamp: int, number: int) -> None:
        """Publish that the joints have no past from now on, for those who come later too.

        Args:
            stamp: Time on the node's clock [ns].
            number: Number of restarts up to this one, 0 at the start.
        """
        count = float(number)
        self._restarts.publish(stamp, [(joint, (count,), ()) for joint in range(self._joint_count)])

    def restart(self) -> None:
        """Let parameters be published again at once, as stamps may have gone back."""
        self._parameters_due = 0


def _has_bound(estimate: Estimate) -> bool:
    return estimate.state_bound.size > 0


def _motion(joint: int, state: Array) -> _Motion:
    """Return [q₁, q̇₁, q₂, q̇₂] as angles and velocities."""
    q1, v1, q2, v2 = state.tolist()
    return joint, (q1, q2), (v1, v2)
