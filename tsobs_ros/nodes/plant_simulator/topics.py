# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The plant simulator's topics: torque commands in; the measurement, the truth and the time out."""

import math
from collections.abc import Sequence
from operator import attrgetter
from typing import Any

import numpy as np
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray

from tsobs_ros.bag.estimate_topics import TRUE_DISTURBANCE, TRUE_STATES, TRUE_TORQUE, sides
from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.design.signals import Place, positions
from tsobs_ros.estimation.health import Level
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.plant_simulator.parameters import PlantSimulatorParameters
from tsobs_ros.nodes.wire import (
    QUIET,
    DrainedSubscription,
    JointStatePublisher,
    clock_message,
    wait_until_taken,
)
from tsobs_ros.simulation.plant import Scenario, Trajectories

_ACKNOWLEDGE_TIMEOUT = 1.0


class TorqueCommands:
    """The torque commands of a node, each of which holds for some time.

    A command has a number for each arm, and for each input of a T–S system, in the joints' order.
    """

    def __init__(self, node: ManagedNode[PlantSimulatorParameters]) -> None:
        plants = node.parameters.scenarios.values()
        self._counts = [each.input_count for each in plants]
        self._is_arm = np.repeat([isinstance(each, Scenario) for each in plants], self._counts)
        self._node, self._rejected = node, 0
        self.subscription = DrainedSubscription(
            node, Float64MultiArray, "joint_torque_command", QoSProfile(depth=10)
        )
        self.forget()

    def forget(self) -> None:
        """Let no command hold."""
        self._torques: list[Array] = []
        self._end = 0.0

    def take(self, sample: int) -> None:
        """Take what has arrived, to hold from a sample on."""
        given, count = self._node.parameters, len(self._is_arm)
        for message, _ in self.subscription.drain():
            torques = np.array(message.data)
            if len(torques) != count or not np.isfinite(torques).all():
                self._rejected += 1
                if self._node.may_log("commands"):
                    self._node.log(
                        Level.WARN,
                        f"rejected {self._rejected} torque commands so far: expected {count} "
                        f"finite numbers, got {torques[:4].tolist()}",
                    )
                continue
            limits = np.where(self._is_arm, given.torque_limit, math.inf)
            limited = np.clip(torques, -limits, limits)
            self._torques = np.split(limited, np.cumsum(self._counts)[:-1])
            held = max(1, round(given.command_timeout * given.sample_rate))
            self._end = sample + (held if given.command_timeout > 0.0 else math.inf)

    def at(self, sample: int) -> list[Array] | list[None]:
        """Return each joint's inputs commanded at a sample, None without a command."""
        return self._torques if sample < self._end else [None] * len(self._counts)


class SamplePublisher:
    """Publishes samples as messages, each of all joints."""

    def __init__(self, node: ManagedNode[PlantSimulatorParameters]) -> None:
        requests = node.parameters.requests
        joints = [
            request.signals(joint, alone=len(requests) == 1) for joint, request in requests.items()
        ]
        # Outputs last: of an output that is an input too, a lost value shall be NaN. A reliable
        # publisher suits all usual subscribers; only this one is asked about mismatches.
        self._measurements = JointStatePublisher(
            node,
            "joint_measurements",
            [(*each.inputs, *each.outputs) for each in joints],
            qos_profile_sensor_data,
            events=None,
        )
        truths: dict[str, tuple[str, Sequence[Sequence[Place]]]] = {
            TRUE_STATES: ("physical", [each.states for each in joints]),
            TRUE_DISTURBANCE: ("disturbances", [positions(each.disturbances) for each in joints]),
            TRUE_TORQUE: (
                "torque_disturbances",
                [
                    # The motor's first, as in the truth of a sample.
                    [Place(name, "effort") for name in reversed(sides(joint))]
                    if isinstance(each, ArmRequest)
                    else []
                    for joint, each in requests.items()
                ],
            ),
        }
        self._truths = [
            (attrgetter(of), JointStatePublisher(node, topic, parts))
            for topic, (of, parts) in truths.items()
            if any(parts)
        ]
        # The last truth reaches its subscribers.
        publishers = [truth.publisher for _, truth in self._truths]
        node.at_cleanup(wait_until_taken, publishers, _ACKNOWLEDGE_TIMEOUT)
        self._clock: Any = None
        if node.parameters.publish_clock:
            self._clock = node.create_publisher(Clock, "/clock", 10, event_callbacks=QUIET)

    @property
    def subscribers(self) -> int:
        """Number of matched subscriptions of the measurements."""
        return int(self._measurements.publisher.get_subscription_count())

    def __call__(self, stamp: int, samples: Sequence[Trajectories]) -> None:
        """Publish the time [ns], the truth and, unless they were lost, the measurements."""
        if self._clock is not None:
            self._clock.publish(clock_message(stamp))
        for truth, publisher in self._truths:
            publisher.publish(stamp, {k: truth(each).tolist() for k, each in enumerate(samples)})
        measured = {
            place: [*each.torques.tolist(), *each.measurements.tolist()]
            for place, each in enumerate(samples)
            if not np.isnan(each.measurements).all()
        }
        self._measurements.publish(stamp, measured)
