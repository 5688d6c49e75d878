# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Players in the test's graph, and a node that listens to them."""

from collections.abc import Callable
from typing import Any

import pytest
from player.bags import START
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from staging import start, to_nanoseconds
from std_msgs.msg import String
from std_srvs.srv import Trigger

from tsobs_ros.nodes.player import Player


class Listener:
    """A node that subscribes and keeps what it receives.

    Attributes:
        heard: Topic and text of every String, in order of arrival.
        sent: When each was published.
        clock: What /clock said, in ms after the bags' start.
    """

    def __init__(self, ros: Any) -> None:
        self._ros = ros
        self.node = ros.node("listener")
        self.heard: list[tuple[str, str]] = []
        self.sent: list[int] = []
        self.clock: list[float] = []

    def listen(self, *topics: str, qos: QoSProfile | int = 1000) -> None:
        """Subscribe to topics of Strings."""
        for topic in topics:
            self.node.create_subscription(String, topic, self._hear(topic), qos)

    def listen_to_clock(self) -> None:
        """Subscribe to /clock."""

        def hear(message: Clock) -> None:
            self.clock.append((to_nanoseconds(message.clock) - START) * 1e-6)

        self.node.create_subscription(Clock, "/clock", hear, 1000)

    def texts(self, topic: str = "/a") -> list[str]:
        """Return what was said on a topic."""
        return [text for name, text in self.heard if name == topic]

    def hear_out(self, player: Player) -> None:
        """Listen until a player has ended and all that it published has been heard."""
        self._ros.spin_until(
            lambda: player.finished and len(self.heard) >= player.messages, what="the end"
        )

    def _hear(self, topic: str) -> Callable[[String, Any], None]:
        def hear(message: String, info: Any) -> None:
            self.heard.append((topic, message.data))
            self.sent.append(info["source_timestamp"])

        return hear


@pytest.fixture
def listener(ros: Any) -> Listener:
    """Give a node that listens where it is told to."""
    return Listener(ros)


@pytest.fixture
def play(ros: Any) -> Callable[..., Player]:
    """Give what starts players in the test's graph."""
    return lambda path, **parameters: start(ros, "player", **{"bag": str(path), **parameters})


@pytest.fixture
def call(manage: Any) -> Callable[[str], Any]:
    """Give what calls one of the player's services and returns the answer."""
    return lambda name: manage("/player").call(Trigger, name)
