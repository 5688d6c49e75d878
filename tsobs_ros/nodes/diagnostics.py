# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Statuses from the core as diagnostic_msgs on /diagnostics."""

from collections.abc import Mapping, Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from tsobs_ros.estimation.health import Status


class DiagnosticsPublisher:
    """Publishes one DiagnosticStatus a concern, named "<node>: <concern>".

    Args:
        node: The node.
        hardware_id: What its statuses are about.
    """

    def __init__(self, node: Node, hardware_id: str) -> None:
        self._node = node
        self._hardware_id = hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def publish(
        self, statuses: Sequence[Status], parts: Mapping[str, Sequence[Status]] | None = None
    ) -> None:
        """Publish statuses, stamped with the node's time.

        Args:
            statuses: Of the node.
            parts: Of parts of the hardware by their names, such as joints; published as
                "<node>: <part>: <concern>" with the part as hardware id.
        """
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        prefix = f"{self._node.get_fully_qualified_name().lstrip('/')}: "
        message.status = [_message(prefix, self._hardware_id, status) for status in statuses]
        for part, own in (parts or {}).items():
            message.status += [_message(f"{prefix}{part}: ", part, status) for status in own]
        self._publisher.publish(message)


def _message(prefix: str, hardware_id: str, status: Status) -> DiagnosticStatus:
    return DiagnosticStatus(
        level=bytes([status.level]),
        name=prefix + status.name,
        message=status.message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=value) for key, value in status.values.items()],
    )
