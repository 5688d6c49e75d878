# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The publishers that a script asks for."""

from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from faults.script import Event, Sender

_DEPTH = 5000
SENSOR_QOS = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
_LATCHING_QOS = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Senders:
    """Publishers on one topic, each made when it is first needed.

    Args:
        node: Whose publishers they are.
        topic: The topic of the measurements.
        matched: Waits until a publisher has the given number of subscriptions.
    """

    def __init__(self, node: Node, topic: str, matched: Callable[[Any], None]) -> None:
        self._node, self._topic, self._matched = node, topic, matched
        self._publishers: dict[Sender, Any] = {}
        self._stranger: Node | None = None

    def send(self, event: Event) -> None:
        """Publish an event's message."""
        # Bytes go out by the good sensor's publisher: that one is trusted by everybody.
        sender = Sender.SENSOR if event.sender is Sender.RAW else event.sender
        self.publisher(sender).publish(event.message)

    def publisher(self, sender: Sender) -> Any:
        """Return the sender's publisher, matched if it can be."""
        if sender not in self._publishers:
            self._publishers[sender] = self._made(sender)
        return self._publishers[sender]

    def close(self) -> None:
        """Release what is not the node's own."""
        if self._stranger is not None:
            self._stranger.destroy_node()
            self._stranger.context.shutdown()
            self._stranger = None

    def _made(self, sender: Sender) -> Any:
        if sender is Sender.OTHER_TYPE:
            return self._strangers_publisher()
        qos = _LATCHING_QOS if sender is Sender.LATCHING else SENSOR_QOS
        publisher = self._node.create_publisher(JointState, self._topic, qos)
        self._matched(publisher)
        return publisher

    def _strangers_publisher(self) -> Any:
        """Return one of a context of its own: within a context a topic has one type."""
        context = rclpy.Context()
        rclpy.init(args=[], context=context, domain_id=self._node.context.get_domain_id())
        self._stranger = Node("stranger", context=context)
        topic = self._node.resolve_topic_name(self._topic)
        return self._stranger.create_publisher(Float64MultiArray, topic, SENSOR_QOS)
