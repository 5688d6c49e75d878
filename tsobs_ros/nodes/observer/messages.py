# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the observer publishes: estimates, innovations and ticks, on topics as those of a replay."""

from collections.abc import Iterable, Mapping, Sequence

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Int64MultiArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import encode_tick
from tsobs_ros.checks import Array
from tsobs_ros.design.signals import Signals
from tsobs_ros.estimation.records import Estimate
from tsobs_ros.nodes.wire import QUIET, JointStatePublisher
from tsobs_ros.replay.places import ESTIMATES, parts_of, places_of
from tsobs_ros.series import Stamps

_RESTARTS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


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
        self._slow_since = -topics.SLOW_PERIOD

    def publish(self, stamp: int, estimates: Mapping[int, Estimate]) -> bool:
        """Publish estimates of joints, by index, at a stamp [ns]; what they lack is left out.

        A tick with measurements or estimates is published before. One that is held, of an earlier
        time, is none. Return whether health was due.
        """
        fresh = {joint: each for joint, each in estimates.items() if each.stamp == stamp}
        if self._taken or fresh:
            self._tick += 1
            if self._ticks.get_subscription_count():
                self._ticks.publish(encode_tick(stamp, self._tick, bool(fresh), self._taken))
            self._taken.clear()
        # Stamps may have gone back.
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

    def publish_innovations(self, stamps: Stamps, innovations: Array) -> None:
        """Publish y − ŷ of N messages, stamped as they are [ns].

        They are of all joints' outputs in turn, NaN of those not used, shape (N, outputs).
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


def _rows(topic: str, estimates: Mapping[int, Estimate]) -> dict[int, list[float]]:
    """Return a topic's numbers of those joints that have any."""
    rows = {}
    for joint, each in estimates.items():
        row = [number for field in ESTIMATES[topic] for number in getattr(each, field).tolist()]
        if row:
            rows[joint] = row
    return rows
