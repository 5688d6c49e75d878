# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's tick log: which measurement messages each of its estimates includes."""

from collections.abc import Iterable

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Int64MultiArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.tick_log import encode_tick

_QOS = QoSProfile(depth=100)
"""Reliable: a lost message would leave it open what the estimates include."""


class TickLog:
    """Publishes a message for each tick with measurements or estimates; see `bag.tick_log`."""

    def __init__(self, node: Node) -> None:
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        self._publisher = node.create_publisher(
            Int64MultiArray, f"~/{topics.TICKS}", _QOS, event_callbacks=quiet
        )
        self.restart()

    def restart(self) -> None:
        """Count ticks from 1 again: the estimates have no past."""
        self._number = 0
        self._taken: list[bytes] = []

    def take(self, messages: Iterable[bytes]) -> None:
        """Note the measurement messages that the next tick includes."""
        self._taken += messages

    def publish(self, stamp: int, *, estimated: bool) -> None:
        """Publish a tick, before its estimates, unless nothing happened.

        Args:
            stamp: Time on the node's clock [ns].
            estimated: Whether there are estimates.
        """
        if not (self._taken or estimated):
            return
        self._number += 1
        if self._publisher.get_subscription_count():
            self._publisher.publish(encode_tick(stamp, self._number, estimated, self._taken))
        self._taken.clear()
