# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Reads all that an observer publishes and holds it to what must always be true."""

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from faults.arm import Arm
from tsobs_ros.nodes.draining import DrainedSubscription
from tsobs_ros.nodes.messages import to_nanoseconds

ESTIMATES = ("joint_states", "error_bound", "disturbance", "disturbance_bound")
OUTPUTS = (*ESTIMATES, "innovation")
SIGMAS = 4.0
"""How many of its bounds an error may be."""


class Watcher:
    """Reads an observer's topics.

    Attributes:
        broken: What should never have happened, in words.
        count: Messages on each topic.
        newest: The newest message on each topic.
        keep: Called with topic and message, for tests that compare them.

    Args:
        node: Whose subscriptions they are.
        prefix: The observer's full name.
        keep: See the attribute.
    """

    def __init__(
        self, node: Node, prefix: str, keep: Callable[[str, JointState], None] | None = None
    ) -> None:
        self._subscriptions = {
            topic: DrainedSubscription(
                node, JointState, f"{prefix}/{topic}", QoSProfile(depth=5000)
            )
            for topic in OUTPUTS
        }
        self.keep = keep
        self.broken: list[str] = []
        self.count: Counter[str] = Counter()
        self.newest: dict[str, JointState] = {}
        self._stamps: dict[str, int] = {}

    @property
    def matched(self) -> bool:
        """Whether all topics have a publisher."""
        return all(each.publisher_count for each in self._subscriptions.values())

    def close(self) -> None:
        """Stop reading."""
        for subscription in self._subscriptions.values():
            subscription.destroy()

    def time_began_anew(self) -> None:
        """Allow stamps to restart, as the clock went back."""
        self.read()
        self._stamps.clear()

    def read(self) -> None:
        """Take what has been published."""
        for topic, subscription in self._subscriptions.items():
            for message, _ in subscription.drain():
                self._check(topic, message)
                self.count[topic] += 1
                self.newest[topic] = message
                if self.keep is not None:
                    self.keep(topic, message)

    def stamp(self, topic: str = "joint_states") -> int | None:
        """Return the newest stamp on a topic [ns]."""
        return self._stamps.get(topic)

    def sigmas(self, arm: Arm) -> float:
        """Return the largest error of the newest estimate, in its bounds."""
        state, bound = self.newest["joint_states"], self.newest["error_bound"]
        q1, v1, q2, v2 = arm.truth(to_nanoseconds(state.header.stamp))
        error = np.abs([*state.position, *state.velocity] - np.array([q1, q2, v1, v2]))
        return float((error / [*bound.position, *bound.velocity]).max())

    def _check(self, topic: str, message: Any) -> None:
        stamp = to_nanoseconds(message.header.stamp)
        numbers = (*message.position, *message.velocity, *message.effort)
        if not all(map(math.isfinite, numbers)):
            self.broken.append(f"{topic} at {stamp}: {numbers}")
        # Innovations bear the stamps of measurements, which may be late.
        if topic in ESTIMATES:
            before = self._stamps.get(topic)
            if before is not None and stamp <= before:
                self.broken.append(f"{topic}: {stamp} after {before}")
            self._stamps[topic] = stamp
