# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The plant simulator's topics: torque commands in; the measurement, the truth and the time out."""

import math
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from tsobs_ros.bag.estimate_topics import sides
from tsobs_ros.nodes.draining import DrainedSubscription
from tsobs_ros.nodes.messages import set_stamp
from tsobs_ros.nodes.plant_simulator.parameters import PlantSimulatorParameters
from tsobs_ros.simulation.plant import Sample

_ACKNOWLEDGE_TIMEOUT = 1.0
_WARN_EVERY = 5.0


class TorqueCommands:
    """The torque commands of a node, each of which holds for some time.

    Attributes:
        parameters: Of commands from the next one on; may be exchanged.
        rejected: Number of commands that were not one finite number.
    """

    def __init__(self, node: Node, parameters: PlantSimulatorParameters) -> None:
        self.parameters = parameters
        self.rejected = 0
        self._node = node
        self._subscription = DrainedSubscription(
            node, Float64MultiArray, "joint_torque_command", QoSProfile(depth=10)
        )
        self.forget()

    def forget(self) -> None:
        """Let no command hold."""
        self._torque = self._end = 0.0

    def discard(self) -> None:
        """Throw away what has arrived."""
        self._subscription.drain()

    def take(self, sample: int) -> None:
        """Take what has arrived, to hold from a sample on."""
        for message, _ in self._subscription.drain():
            values = message.data
            if len(values) != 1 or not math.isfinite(values[0]):
                self.rejected += 1
                self._node.get_logger().warning(
                    f"rejected {self.rejected} torque commands so far: expected one finite "
                    f"number, got {list(values)[:4]}",
                    throttle_duration_sec=_WARN_EVERY,
                )
                continue
            given = self.parameters
            self._torque = min(max(values[0], -given.torque_limit), given.torque_limit)
            held = math.inf
            if given.command_timeout > 0.0:
                held = max(1, round(given.command_timeout * given.rate))
            self._end = sample + held

    def at(self, sample: int) -> float | None:
        """Return the torque commanded at a sample [N m], None without a command."""
        return self._torque if sample < self._end else None


class SamplePublisher:
    """Publishes samples as messages, which are made once and overwritten."""

    def __init__(self, node: Node, parameters: PlantSimulatorParameters) -> None:
        joint = parameters.joint
        self._measurement = JointState(name=[joint], position=[0.0], effort=[0.0])
        self._states = JointState(name=[*sides(joint)], position=[0.0] * 2, velocity=[0.0] * 2)
        self._disturbance = JointState(name=[joint], position=[0.0])
        self._clock = ClockMessage()
        self._to_measurements = node.create_publisher(
            JointState, "joint_measurements", qos_profile_sensor_data
        )
        # Executors look at every event of every publisher at every wake-up. A reliable publisher
        # suits all usual subscribers, so only the best-effort one is asked about mismatches.
        silent = PublisherEventCallbacks(use_default_callbacks=False)
        options = {"qos_profile": QoSProfile(depth=10), "event_callbacks": silent}
        self._to_states = node.create_publisher(JointState, "ground_truth/joint_states", **options)
        self._to_disturbance = node.create_publisher(
            JointState, "ground_truth/disturbance", **options
        )
        self._to_clock: Any = None
        if parameters.publish_clock:
            self._to_clock = node.create_publisher(ClockMessage, "/clock", **options)

    @property
    def subscribers(self) -> int:
        """Number of matched subscriptions of the measurements."""
        return int(self._to_measurements.get_subscription_count())

    def __call__(self, stamp: int, sample: Sample) -> None:
        """Publish the time, the truth and, unless it was lost, the measurement of a sample."""
        if self._to_clock is not None:
            set_stamp(self._clock.clock, stamp)
            self._to_clock.publish(self._clock)
        for message in (self._measurement, self._states, self._disturbance):
            set_stamp(message.header.stamp, stamp)
        states = self._states
        states.position[0], states.velocity[0], states.position[1], states.velocity[1] = (
            sample.physical.tolist()
        )
        self._to_states.publish(states)
        self._disturbance.position[0] = sample.disturbance.item()
        self._to_disturbance.publish(self._disturbance)
        if not sample.lost:
            self._measurement.position[0] = sample.measurement.item()
            self._measurement.effort[0] = sample.torque.item()
            self._to_measurements.publish(self._measurement)

    def wait_for_acknowledgement(self) -> None:
        """Wait at most a second until subscribers have the truth that was published."""
        for publisher in (self._to_states, self._to_disturbance):
            publisher.wait_for_all_acked(Duration(seconds=_ACKNOWLEDGE_TIMEOUT))
