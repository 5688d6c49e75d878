# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS messages: stamps as integers, diagnostics of the core's statuses, classes by their names."""

import re
from collections.abc import Mapping, Sequence
from functools import reduce
from importlib import import_module
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from tsobs_ros.bag.definitions import share_folders
from tsobs_ros.errors import NodeError
from tsobs_ros.estimation.health import Status
from tsobs_ros.series import NANOSECONDS

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Of what stays valid until the next message."""

Statuses = tuple[Sequence[Status], Mapping[str, Sequence[Status]]]
"""Statuses of a node, and of parts of its hardware by their names."""

_NAME = re.compile(r"([A-Za-z]\w*)/(msg|srv|action)/([A-Za-z]\w*)", flags=re.ASCII)
# Places of the classes that a service or an action sends, within its own class.
_NESTED = {
    "srv": {"_Event": "Event"},
    "action": {
        "_SendGoal_Event": "Impl.SendGoalService.Event",
        "_GetResult_Event": "Impl.GetResultService.Event",
        "_FeedbackMessage": "Impl.FeedbackMessage",
    },
}


def set_stamp(stamp: Any, nanoseconds: int) -> None:
    """Write nanoseconds since the epoch into a builtin_interfaces Time in place."""
    stamp.sec, stamp.nanosec = divmod(nanoseconds, NANOSECONDS)


def diagnostic_array(
    node: Node, hardware_id: str, statuses: Sequence[Status], parts: Mapping[str, Sequence[Status]]
) -> DiagnosticArray:
    """Return a message of one DiagnosticStatus per concern, stamped with the node's time.

    Args:
        node: The node.
        hardware_id: The hardware that its statuses are about.
        statuses: Of the node, named "<node>: <concern>".
        parts: Of parts of the hardware by their names, such as joints: "<node>: <part>: <concern>"
            with the part as hardware id.
    """
    message = DiagnosticArray()
    message.header.stamp = node.get_clock().now().to_msg()
    prefix = f"{node.get_fully_qualified_name().lstrip('/')}: "
    message.status = [_status(prefix, hardware_id, status) for status in statuses]
    for part, own in parts.items():
        message.status += [_status(f"{prefix}{part}: ", part, status) for status in own]
    return message


def _status(prefix: str, hardware_id: str, status: Status) -> DiagnosticStatus:
    return DiagnosticStatus(
        level=bytes([status.level]),
        name=prefix + status.name,
        message=status.message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=value) for key, value in status.values.items()],
    )


def message_class(name: str) -> type[Any]:
    """Return the class of a message type.

    Args:
        name: The type, `package/msg/Type`, or one that belongs to a service or an action, such as
            `package/srv/Type_Event`.

    Raises:
        NodeError: The name is not one of a type, or the type is not installed.
    """
    if (match := _NAME.fullmatch(name)) is None:
        raise NodeError(f"'{name}' is not a message type: expected package/msg/Type")
    package, kind, type_name = match.groups()
    # Names come from bags and networks, and importing runs code: of interface packages only.
    if not any((folder / package / kind).is_dir() for folder in share_folders()):
        raise NodeError(f"{name} is not installed")
    path = type_name
    for suffix, nested in _NESTED.get(kind, {}).items():
        if type_name.endswith(suffix):
            path = f"{type_name.removesuffix(suffix)}.{nested}"
            break
    try:
        module: Any = import_module(f"{package}.{kind}")
        found: type[Any] = reduce(getattr, path.split("."), module)
    except (ImportError, AttributeError) as error:
        raise NodeError(f"the Python module of {name} is not installed: {error}") from error
    return found
