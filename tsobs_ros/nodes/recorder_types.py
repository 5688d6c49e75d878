# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""rclpy's message classes and QoS profiles as names and values of a bag."""

from functools import reduce
from importlib import import_module
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import QoSProfile

from tsobs_ros.bag.qos import QosProfile, QosTime
from tsobs_ros.errors import BagWriteError

# Where the class of what a service or an action sends is, within that of the service or action.
_NESTED = {
    "srv": {"_Event": "Event"},
    "action": {
        "_SendGoal_Event": "Impl.SendGoalService.Event",
        "_GetResult_Event": "Impl.GetResultService.Event",
        "_FeedbackMessage": "Impl.FeedbackMessage",
    },
}


def message_class(msgtype: str) -> type[Any]:
    """Return the Python class of a message type.

    Args:
        msgtype: The type, `package/msg/Type`, or one that a service or an action brings along.

    Raises:
        BagWriteError: Its Python module is not installed.
    """
    package, kind, name = msgtype.split("/")
    path = name
    for suffix, nested in _NESTED.get(kind, {}).items():
        if name.endswith(suffix):
            path = f"{name.removesuffix(suffix)}.{nested}"
            break
    try:
        module: Any = import_module(f"{package}.{kind}")
        found: type[Any] = reduce(getattr, path.split("."), module)
    except (ImportError, AttributeError) as error:
        raise BagWriteError(f"the Python module of {msgtype} is not installed: {error}") from error
    return found


def to_bag_qos(profile: QoSProfile) -> QosProfile:
    """Return a profile that a publisher offers in the form a bag has it."""
    return QosProfile(
        history=profile.history.name.lower(),
        depth=profile.depth,
        reliability=profile.reliability.name.lower(),
        durability=profile.durability.name.lower(),
        deadline=_to_bag_time(profile.deadline),
        lifespan=_to_bag_time(profile.lifespan),
        liveliness=profile.liveliness.name.lower(),
        liveliness_lease_duration=_to_bag_time(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )


def _to_bag_time(duration: Duration) -> QosTime:
    return QosTime(*divmod(duration.nanoseconds, 10**9))
