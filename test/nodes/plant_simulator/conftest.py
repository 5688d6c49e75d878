# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A listener to a simulator under test: starts it, collects what it publishes, talks to it."""

from typing import Any, NamedTuple

import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from staging import call, start, to_nanoseconds
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from tsobs_ros.nodes.plant_simulator import PlantSimulatorNode
from tsobs_ros.nodes.plant_simulator.parameters import PlantSimulatorParameters
from tsobs_ros.simulation.plant import Plant

RATE = 50.0
"""Samples a second [Hz]: even a busy machine takes in so many messages."""
BEST_EFFORT = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=5000)


class Received(NamedTuple):
    stamp: int
    message: Any


class Listener:
    """Collects what the simulator publishes and talks to it."""

    def __init__(self, ros: Any) -> None:
        self.ros = ros
        self.node = ros.node("listener")
        self.clock: list[int] = []
        self.measurements = self._kept("joint_measurements", BEST_EFFORT)
        self.states = self._kept("ground_truth/joint_states")
        self.disturbances = self._kept("ground_truth/disturbance")
        self.torques = self._kept("ground_truth/torque_disturbance")
        self.commands = self.node.create_publisher(Float64MultiArray, "joint_torque_command", 10)

    def listen_to_clock(self) -> None:
        self.node.create_subscription(
            Clock, "/clock", lambda m: self.clock.append(to_nanoseconds(m.clock)), RELIABLE
        )

    def start(self, **overrides: Any) -> PlantSimulatorNode:
        """Start a simulator which waits for this listener."""
        given = {"wait_for_subscribers": 1, "rate": RATE, **overrides}
        node: PlantSimulatorNode = start(self.ros, "plant_simulator", **given)
        return node

    def wait_for(self, kept: list[Any], more: int) -> None:
        wanted = len(kept) + more
        self.ros.spin_until(lambda: len(kept) >= wanted, 20.0, f"the arrival of {more} messages")

    def command(self, *values: float) -> None:
        self.ros.spin_until(self.commands.get_subscription_count, what="matching")
        self.commands.publish(Float64MultiArray(data=list(values)))

    def reset(self) -> Any:
        return call(self.ros, self.node, Trigger, "plant_simulator/reset")

    @staticmethod
    def core(count: int, of: str = "measurements", seed: int = 0, **changes: Any) -> list[float]:
        """Return the angles that a simulator publishes; the true ones are `of="physical"`."""
        (scenario,) = PlantSimulatorParameters(**{"rate": RATE, **changes}).scenarios.values()
        angles: list[float] = getattr(Plant(scenario, seed).run(count), of)[:, 0].tolist()
        return angles

    @staticmethod
    def places(received: list[Received], angles: list[float]) -> list[int]:
        """Find what was received bit for bit among the angles of the core."""
        index = {angle: place for place, angle in enumerate(angles)}
        return [index[item.message.position[0]] for item in received]

    def _kept(self, topic: str, qos: QoSProfile = RELIABLE) -> list[Received]:
        """Subscribe, and return the list of what will arrive."""
        kept: list[Received] = []

        def keep(message: JointState) -> None:
            kept.append(Received(to_nanoseconds(message.header.stamp), message))

        self.node.create_subscription(JointState, topic, keep, qos)
        return kept


@pytest.fixture
def listener(ros: Any) -> Listener:
    """Give a listener that is there from the beginning."""
    return Listener(ros)
