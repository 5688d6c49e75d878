# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates, innovations and the tick log as messages; the topics are those of a replay."""

import math
from collections.abc import Iterable, Mapping, Sequence

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Int64MultiArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_states import JointStateEncoder
from tsobs_ros.bag.tick_log import encode_tick
from tsobs_ros.checks import Array
from tsobs_ros.design.signals import Place, Signals, positions
from tsobs_ros.estimation.records import Estimate
from tsobs_ros.nodes.observer.input import Numbers, Pick, Stamps, picker
from tsobs_ros.replay.places import ESTIMATES, FIELDS, places_of

_RELIABLE, _TICKS = QoSProfile(depth=10), QoSProfile(depth=100)
_RESTARTS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Every QoS event is one more thing the executor gathers for each of its waits.
_QUIET = PublisherEventCallbacks(use_default_callbacks=False)
_MAX_LAYOUTS = 256


class _Output:
    """A publisher of JointStates of any of some parts, such as joints.

    Args:
        node: The node.
        topic: Below the node's name.
        parts: The places of each part's numbers.
        qos: Of the topic.
    """

    def __init__(
        self, node: Node, topic: str, parts: Sequence[Sequence[Place]], qos: QoSProfile = _RELIABLE
    ) -> None:
        self._publisher = node.create_publisher(
            JointState, f"~/{topic}", qos, event_callbacks=_QUIET
        )
        self._latched, self._parts = qos is _RESTARTS, parts
        self._layouts: dict[tuple[tuple[int, int], ...], tuple[JointStateEncoder, list[Pick]]] = {}

    @property
    def is_heard(self) -> bool:
        """Whether there may be a listener."""
        return self._latched or bool(self._publisher.get_subscription_count())

    def publish(self, stamp: int, rows: Mapping[int, Numbers]) -> None:
        """Send a message of the numbers of some parts, by their index, unless there are none."""
        if rows:
            key = tuple([(part, len(row)) for part, row in rows.items()])
            encode, picks = self._layouts.get(key) or self._find(key)
            numbers = [*(number for row in rows.values() for number in row), math.nan]
            self._publisher.publish(encode(stamp, *[pick(numbers) for pick in picks]))

    def _find(self, key: tuple[tuple[int, int], ...]) -> tuple[JointStateEncoder, list[Pick]]:
        """Return what makes messages of so many numbers of parts.

        A field has a number for each name, or none.
        """
        names: list[str] = []
        columns: dict[str, dict[int, int]] = {field: {} for field in FIELDS}
        column = 0
        for part, length in key:
            begin = len(names)
            for name, field in self._parts[part][:length]:
                if name not in names[begin:]:
                    names.append(name)
                columns[field][names.index(name, begin)] = column
                column += 1
        picks = [
            picker([own.get(entry, -1) for entry in range(len(names))] if own else [])
            for own in columns.values()
        ]
        if len(self._layouts) >= _MAX_LAYOUTS:
            self._layouts.clear()
        layout = self._layouts[key] = JointStateEncoder(names), picks
        return layout


class EstimatePublisher:
    """Publishes estimates and innovations under the node's private names.

    There are topics of torque disturbances and of learnt parameters only if there are any.

    Args:
        node: The node.
        joints: Places of each joint's signals, by the joint's name.
        learnt: Names of the learnt parameters of each joint.
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
            topic: _Output(node, topic, [one[topic] for one in each])
            for topic in ESTIMATES
            if any(one[topic] for one in each)
        }
        outputs = [[place] for one in each for place in one[topics.INNOVATION]]
        self._innovation = _Output(node, topics.INNOVATION, outputs)
        self._restarts = _Output(
            node, topics.RESTARTS, [positions([joint]) for joint in joints], _RESTARTS
        )
        self._count = len(joints)
        self._slow_since = dict.fromkeys((topics.PARAMETERS, topics.HEALTH), -topics.SLOW_PERIOD)

    def publish(self, stamp: int, estimates: Sequence[Estimate | None]) -> bool:
        """Publish the joints' estimates; what they lack is left out.

        Args:
            stamp: Of the messages [ns].
            estimates: One entry a joint; None if it has no estimate.

        Returns:
            Whether there was an estimate.
        """
        known = {joint: each for joint, each in enumerate(estimates) if each is not None}
        valid = {joint: each for joint, each in known.items() if each.parameters_valid}
        is_due = bool(valid) and self._is_due(topics.PARAMETERS, stamp)
        for topic, output in self._outputs.items():
            if topic in topics.PARAMETER_TOPICS:
                if is_due:
                    output.publish(stamp, _rows(topic, valid))
            elif topic != topics.HEALTH and output.is_heard:
                output.publish(stamp, _rows(topic, known))
        return bool(known)

    def publish_health(self, stamp: int, estimates: Sequence[Estimate | None]) -> bool:
        """Publish what the joints' estimates are worth, if that is due; return whether it is.

        Args:
            stamp: Of the estimates [ns].
            estimates: One entry a joint; None if it has none.
        """
        known = {joint: each for joint, each in enumerate(estimates) if each is not None}
        if not known or not self._is_due(topics.HEALTH, stamp):
            return False
        self._outputs[topics.HEALTH].publish(
            stamp, {joint: each.health for joint, each in known.items()}
        )
        return True

    def publish_innovations(self, stamps: Stamps, innovations: Array) -> None:
        """Publish y − ŷ of messages, stamped as they are.

        Args:
            stamps: Of the messages [ns], shape (N,).
            innovations: Of the outputs of all joints, one after the other, NaN of those that are
                not used, shape (N, outputs).
        """
        if self._innovation.is_heard:
            for stamp, values in zip(stamps.tolist(), innovations.tolist(), strict=True):
                rows = {place: (each,) for place, each in enumerate(values) if each == each}
                self._innovation.publish(stamp, rows)

    def publish_restart(self, stamp: int, number: int) -> None:
        """Publish that the joints have no past from now on, for those who come later too.

        Args:
            stamp: Time on the node's clock [ns].
            number: Number of restarts up to this one, 0 at the start.
        """
        self._restarts.publish(stamp, dict.fromkeys(range(self._count), (float(number),)))

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


class TickLog:
    """Publishes a message for each tick with measurements or estimates; see `bag.tick_log`.

    It is reliable, as a lost message would leave it open what the estimates include.
    """

    def __init__(self, node: Node) -> None:
        self._publisher = node.create_publisher(
            Int64MultiArray, f"~/{topics.TICKS}", _TICKS, event_callbacks=_QUIET
        )
        self.restart()

    def restart(self) -> None:
        """Count ticks from 1 again: the estimates have no past."""
        self._number = 0
        self._taken: list[bytes] = []

    def take(self, messages: Iterable[bytes]) -> None:
        """Note the measurement messages that the next tick includes."""
        self._taken += messages

    def publish(self, stamp: int, *, estimated: bool) -> None:
        """Publish a tick, before its estimates, unless nothing happened.

        Args:
            stamp: Time on the node's clock [ns].
            estimated: Whether there are estimates.
        """
        if not (self._taken or estimated):
            return
        self._number += 1
        if self._publisher.get_subscription_count():
            self._publisher.publish(encode_tick(stamp, self._number, estimated, self._taken))
        self._taken.clear()
