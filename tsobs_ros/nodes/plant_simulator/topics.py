# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The plant simulator's topics: torque commands in; the measurement, the truth and the time out."""

import math
from collections.abc import Sequence
from itertools import islice
from operator import attrgetter
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import Float64MultiArray

from tsobs_ros.bag.estimate_topics import TRUE_DISTURBANCE, TRUE_STATES, TRUE_TORQUE, sides
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.design.signals import Place, positions
from tsobs_ros.estimation.health import Level
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.plant_simulator.parameters import PlantSimulatorParameters
from tsobs_ros.nodes.wire import QUIET, DrainedSubscription, JointStatePublisher, set_stamp
from tsobs_ros.simulation.plant import Trajectories

_ACKNOWLEDGE_TIMEOUT = 1.0


class TorqueCommands:
    """The torque commands of a node, each of which holds for some time.

    A command has a number for each arm, and for each input of a T–S system, in the joints' order.

    Attributes:
        subscription: That of the topic.
        rejected: Number of commands that were not so many finite numbers.
    """

    def __init__(self, node: ManagedNode[PlantSimulatorParameters]) -> None:
        self.rejected = 0
        self._counts = [each.input_count for each in node.parameters.scenarios().values()]
        self._node = node
        self.subscription = DrainedSubscription(
            node, Float64MultiArray, "joint_torque_command", QoSProfile(depth=10)
        )
        self.forget()

    def forget(self) -> None:
        """Let no command hold."""
        self._torques: list[list[float]] = []
        self._end = 0.0

    def take(self, sample: int) -> None:
        """Take what has arrived, to hold from a sample on."""
        given = self._node.parameters
        for message, _ in self.subscription.drain():
            if len(message.data) != sum(self._counts) or not all(map(math.isfinite, message.data)):
                self.rejected += 1
                if self._node.may_log("commands"):
                    self._node.log(
                        Level.WARN,
                        f"rejected {self.rejected} torque commands so far: expected "
                        f"{sum(self._counts)} finite numbers, got {list(message.data)[:4]}",
                    )
                continue
            numbers = iter(message.data)
            self._torques = []
            for request, count in zip(given.requests.values(), self._counts, strict=True):
                limit = given.torque_limit if isinstance(request, ArmRequest) else math.inf
                own = islice(numbers, count)
                self._torques.append([min(max(each, -limit), limit) for each in own])
            self._end = math.inf
            if given.command_timeout > 0.0:
                self._end = sample + max(1, round(given.command_timeout * given.sample_rate))

    def at(self, sample: int) -> list[list[float]] | list[None]:
        """Return each joint's inputs commanded at a sample, None without a command."""
        return self._torques if sample < self._end else [None] * len(self._counts)


class SamplePublisher:
    """Publishes samples as messages, each of all joints."""

    def __init__(self, node: Node, parameters: PlantSimulatorParameters) -> None:
        requests = parameters.requests
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
        self._clock = ClockMessage()
        self._to_clock: Any = None
        if parameters.publish_clock:
            self._to_clock = node.create_publisher(
                ClockMessage, "/clock", 10, event_callbacks=QUIET
            )

    @property
    def subscribers(self) -> int:
        """Number of matched subscriptions of the measurements."""
        return int(self._measurements.publisher.get_subscription_count())

    def __call__(self, stamp: int, samples: Sequence[Trajectories]) -> None:
        """Publish the time [ns], the truth and, unless they were lost, the measurements."""
        if self._to_clock is not None:
            set_stamp(self._clock.clock, stamp)
            self._to_clock.publish(self._clock)
        for truth, publisher in self._truths:
            publisher.publish(stamp, {k: truth(each).tolist() for k, each in enumerate(samples)})
        measured = {
            place: [*each.torques.tolist(), *each.measurements.tolist()]
            for place, each in enumerate(samples)
            if not np.isnan(each.measurements).all()
        }
        self._measurements.publish(stamp, measured)

    def wait_for_acknowledgement(self) -> None:
        """Wait at most a second until subscribers have the truth that was published."""
        for _, truth in self._truths:
            truth.publisher.wait_for_all_acked(Duration(seconds=_ACKNOWLEDGE_TIMEOUT))
