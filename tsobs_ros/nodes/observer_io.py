# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""JointState messages in, estimates out: the observer node's only knowledge of messages."""

from typing import Any

import numpy as np
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from tsobs_ros.estimation.records import Estimate, Innovation, Measurement, RejectReason
from tsobs_ros.nodes.stamps import to_nanoseconds, to_stamp

MEASUREMENT_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Sensor data, with room for a second of samples: the queue is only emptied once a tick."""

_RELIABLE = 10


def to_measurement(
    message: JointState, joint: str, assume_zero_torque: bool
) -> Measurement | RejectReason:
    """Return the joint's sample in a message, or why there is none.

    Args:
        message: Any JointState; the joint may be one of several.
        joint: Name of the joint.
        assume_zero_torque: Whether a message without effort means torque 0.
    """
    try:
        index = message.name.index(joint)
        angle = message.position[index]
        torque = message.effort[index] if message.effort or not assume_zero_torque else 0.0
    except (ValueError, IndexError):
        return RejectReason.WRONG_JOINT
    stamp = to_nanoseconds(message.header.stamp)
    return Measurement(stamp, np.array([angle]), np.array([torque]))


class EstimatePublisher:
    """Publishes estimates and innovations under the node's private names.

    The messages are filled again and again: building new ones costs as much as publishing them.
    """

    def __init__(self, node: Node, joint: str) -> None:
        def publisher(topic: str) -> Any:
            # Every QoS event is one more thing the executor gathers for each of its waits.
            quiet = PublisherEventCallbacks(use_default_callbacks=False)
            return node.create_publisher(JointState, topic, _RELIABLE, event_callbacks=quiet)

        link_and_motor = [f"{joint}_link", f"{joint}_motor"]
        self._states = JointState(name=link_and_motor)
        self._bounds = JointState(name=link_and_motor)
        self._disturbance = JointState(name=[joint])
        self._disturbance_bound = JointState(name=[joint])
        self._innovation = JointState(name=[joint])
        self._outputs = [
            (publisher("~/joint_states"), self._states),
            (publisher("~/error_bound"), self._bounds),
            (publisher("~/disturbance"), self._disturbance),
            (publisher("~/disturbance_bound"), self._disturbance_bound),
        ]
        self._innovation_publisher = publisher("~/innovation")

    def publish(self, estimate: Estimate) -> None:
        """Publish one estimate on all topics, with the same stamp."""
        q1, v1, q2, v2 = estimate.state.tolist()
        self._states.position, self._states.velocity = [q1, q2], [v1, v2]
        q1, v1, q2, v2 = estimate.state_bound.tolist()
        self._bounds.position, self._bounds.velocity = [q1, q2], [v1, v2]
        self._disturbance.position = estimate.disturbance.tolist()
        self._disturbance.velocity = estimate.disturbance_rate.tolist()
        self._disturbance_bound.position = estimate.disturbance_bound.tolist()
        stamp = to_stamp(estimate.stamp)
        for publisher, message in self._outputs:
            message.header.stamp = stamp
            publisher.publish(message)

    def publish_innovation(self, innovation: Innovation) -> None:
        """Publish y − ŷ, stamped as its measurement."""
        self._innovation.header.stamp = to_stamp(innovation.stamp)
        self._innovation.position = innovation.value.tolist()
        self._innovation_publisher.publish(self._innovation)
