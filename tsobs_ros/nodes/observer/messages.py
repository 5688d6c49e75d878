# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's output: estimates, innovations and ticks, on the same topics as a replay's."""

from collections.abc import Iterable, Mapping, Sequence

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Int64MultiArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import encode_tick
from tsobs_ros.design.signals import Signals
from tsobs_ros.estimation.records import Estimate
from tsobs_ros.nodes.wire import QUIET, JointStatePublisher
from tsobs_ros.replay.places import ESTIMATES, parts_of, places_of

_RESTARTS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class EstimatePublisher:
    """Publishes estimates, innovations and ticks under the node's private names.

    Topics of torque disturbances and learnt parameters exist only if a joint has any. The topic of
    ticks is reliable, as after a lost message nobody could tell what the estimates include.
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
        self._slow_since = -topics.SLOW_PERIOD

    def publish(self, stamp: int, estimates: Mapping[int, Estimate]) -> bool:
        """Publish estimates at a stamp [ns], by index of the joint; return whether health was due.

        Quantities that an estimate lacks are left out. If there are measurements or new estimates,
        their tick is published first; a held estimate, of an earlier time, is not new.
        """
        fresh = {joint: each for joint, each in estimates.items() if each.stamp == stamp}
        if self._taken or fresh:
            self._tick += 1
            if self._ticks.get_subscription_count():
                self._ticks.publish(encode_tick(stamp, self._tick, bool(fresh), self._taken))
            self._taken.clear()
        # The stamps may have gone back.
        is_due = bool(fresh) and not 0 <= stamp - self._slow_since < topics.SLOW_PERIOD
        if is_due:
            self._slow_since = stamp
            health = {joint: each.health for joint, each in fresh.items()}
            self._outputs[topics.HEALTH].publish(stamp, health)
        valid = {joint: each for joint, each in fresh.items() if each.parameters_valid}
        for topic, output in self._outputs.items():
            if topic in topics.PARAMETER_TOPICS:
                if is_due:
                    output.publish(stamp, _rows(topic, valid))
            elif topic != topics.HEALTH and output.publisher.get_subscription_count():
                output.publish(stamp, _rows(topic, estimates))
        return is_due

    def publish_innovations(
        self, stamps: Sequence[int], innovations: Iterable[Sequence[float]]
    ) -> None:
        """Publish y − ŷ of N messages under the stamps of these messages [ns].

        Each has the outputs of all joints in turn, NaN if not used.
        """
        if self._innovation.publisher.get_subscription_count():
            for stamp, values in zip(stamps, innovations, strict=True):
                rows = {place: (each,) for place, each in enumerate(values) if each == each}
                self._innovation.publish(stamp, rows)

    def publish_restart(self, stamp: int, number: int) -> None:
        """Publish the number of restarts at a stamp [ns]; the numbers of ticks begin at 1 again."""
        self._tick, self._taken = 0, []
        self._restarts.publish(stamp, dict.fromkeys(range(self._count), (float(number),)))

    def take(self, messages: Iterable[bytes]) -> None:
        """Note the measurement messages that the next tick includes."""
        self._taken += messages


def _rows(topic: str, estimates: Mapping[int, Estimate]) -> dict[int, list[float]]:
    """Return a topic's numbers by index of the joint, without joints that have none."""
    rows = {}
    for joint, each in estimates.items():
        row = [number for field in ESTIMATES[topic] for number in getattr(each, field).tolist()]
        if row:
            rows[joint] = row
    return rows
