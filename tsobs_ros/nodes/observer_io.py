# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""JointState messages in, estimates out: the observer node's only knowledge of messages."""

from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from tsobs_ros.estimation.records import Estimate, Innovation, Measurement, RejectReason
from tsobs_ros.nodes.stamps import to_nanoseconds, to_stamp

MEASUREMENT_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Sensor data, with room for a second of samples: the queue is only emptied once a tick."""

_RELIABLE = 10

_PARAMETER_PERIOD = 100_000_000
"""Parameters change slowly: published ten times a second [ns]."""


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


class _Output:
    """A publisher with the one message that it sends again and again.

    Building new messages costs as much as publishing them.
    """

    def __init__(self, node: Node, topic: str, names: Sequence[str]) -> None:
        # Every QoS event is one more thing the executor gathers for each of its waits.
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        self._publisher = node.create_publisher(JointState, topic, _RELIABLE, event_callbacks=quiet)
        self._message = JointState(name=list(names))

    def publish(
        self, stamp: Time, position: Sequence[float], velocity: Sequence[float] = ()
    ) -> None:
        """Send positions and, where there are any, velocities."""
        self._message.header.stamp = stamp
        self._message.position = position
        self._message.velocity = velocity
        self._publisher.publish(self._message)


class EstimatePublisher:
    """Publishes estimates, innovations and parameters under the node's private names.

    Args:
        node: The node.
        joint: Name of the joint.
        parameters: Names of the parameters that are learnt; their topics exist only if there
            are any.
    """

    def __init__(self, node: Node, joint: str, parameters: Sequence[str] = ()) -> None:
        sides = [f"{joint}_link", f"{joint}_motor"]
        self._states = _Output(node, "~/joint_states", sides)
        self._state_bounds = _Output(node, "~/error_bound", sides)
        self._disturbance = _Output(node, "~/disturbance", [joint])
        self._disturbance_bound = _Output(node, "~/disturbance_bound", [joint])
        self._innovation = _Output(node, "~/innovation", [joint])
        self._parameters, self._parameter_bounds = (
            _Output(node, topic, parameters) if parameters else None
            for topic in ("~/parameters_estimate", "~/parameters_bound")
        )
        self._parameters_due = 0

    def publish(self, estimate: Estimate) -> None:
        """Publish one estimate, all of it with the same stamp; what it lacks is left out."""
        stamp = to_stamp(estimate.stamp)
        q1, v1, q2, v2 = estimate.state.tolist()
        self._states.publish(stamp, [q1, q2], [v1, v2])
        if estimate.state_bound.size:
            q1, v1, q2, v2 = estimate.state_bound.tolist()
            self._state_bounds.publish(stamp, [q1, q2], [v1, v2])
        if estimate.disturbance.size:
            rate = estimate.disturbance_rate.tolist()
            self._disturbance.publish(stamp, estimate.disturbance.tolist(), rate)
        if estimate.disturbance_bound.size:
            self._disturbance_bound.publish(stamp, estimate.disturbance_bound.tolist())
        if estimate.parameters_valid and estimate.stamp >= self._parameters_due:
            self._publish_parameters(stamp, estimate)

    def publish_innovation(self, innovation: Innovation) -> None:
        """Publish y − ŷ, stamped as its measurement."""
        self._innovation.publish(to_stamp(innovation.stamp), innovation.value.tolist())

    def restart(self) -> None:
        """Forget when parameters were last published, as stamps may have gone back."""
        self._parameters_due = 0

    def _publish_parameters(self, stamp: Time, estimate: Estimate) -> None:
        if self._parameters is not None and self._parameter_bounds is not None:
            self._parameters.publish(stamp, estimate.parameters.tolist())
            self._parameter_bounds.publish(stamp, estimate.parameter_bound.tolist())
            self._parameters_due = estimate.stamp + _PARAMETER_PERIOD
