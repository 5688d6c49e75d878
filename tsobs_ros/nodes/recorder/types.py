# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""rclpy's QoS profiles in the form a bag has them."""

from rclpy.duration import Duration
from rclpy.qos import QoSProfile

from tsobs_ros.bag.qos import QosProfile, QosTime


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
