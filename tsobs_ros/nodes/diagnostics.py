# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Statuses from the core as diagnostic_msgs on /diagnostics."""

from collections.abc import Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from tsobs_ros.estimation.health import Status


class DiagnosticsPublisher:
    """Publishes one DiagnosticStatus a concern, named "<node>: <concern>"."""

    def __init__(self, node: Node, hardware_id: str) -> None:
        self._node = node
        self._hardware_id = hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def publish(self, statuses: Sequence[Status]) -> None:
        """Publish the statuses, stamped with the node's time."""
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=bytes([status.level]),
                name=f"{self._node.get_fully_qualified_name().lstrip('/')}: {status.name}",
                message=status.message,
                hardware_id=self._hardware_id,
                values=[KeyValue(key=key, value=value) for key, value in status.values.items()],
            )
            for status in statuses
        ]
        self._publisher.publish(message)
