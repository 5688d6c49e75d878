# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics a player publishes, with their recorded QoS."""

from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from msgspec.structs import replace
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)

from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.metadata import QosProfile, QosTime, TopicInfo
from tsobs_ros.errors import BagWriteError, NodeError
from tsobs_ros.estimation.health import Level
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.messages import message_class

# The depth of ROS's default profile, for a publisher of unknown depth.
_USUAL_DEPTH = 10
_FOREVER = 2**63 - 1


def played_topics(
    node: ManagedNode[Any], topics: Iterable[TopicInfo], queue_depth: int
) -> dict[str, Publisher]:
    """Return publishers for topics of a bag, by their names in the bag.

    Those that cannot be published are left out.

    Args:
        node: The node that owns the publishers, and warns of each topic that is left out.
        topics: What to publish.
        queue_depth: How many messages a volatile publisher keeps for slow subscribers.
    """
    publishers = {}
    for topic in topics:
        try:
            qos = offered_qos(topic.qos_profiles, queue_depth)
            publishers[topic.name] = _publisher(node, topic, qos)
        except NodeError as error:
            node.log(Level.WARN, f"not playing {topic.name}: {error}")
    return publishers


def offered_qos(profiles: tuple[QosProfile, ...], queue_depth: int) -> QoSProfile:
    """Return the profile to offer on a topic: the recorded one if all its publishers agree.

    If they do not, or nothing was recorded, it is reliable and volatile, as for rosbag2. The depth
    matters to late subscribers of latched topics: there it is the sum of the publishers' depths, as
    one publisher now stands for all of them.

    Args:
        profiles: What the recorded publishers offered.
        queue_depth: How many messages a volatile publisher keeps for slow subscribers.
    """
    # Not policies that a subscription is matched by, and often unknown from discovery.
    alike = {replace(profile, history="unknown", depth=0) for profile in profiles}
    profile = alike.pop() if len(alike) == 1 else QosProfile()
    latched = profile.durability == "transient_local"
    kept = sum(p.depth or _USUAL_DEPTH for p in profiles if p.history != "keep_all")
    keeps_all = any(p.history == "keep_all" for p in profiles)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=kept if latched and not keeps_all else queue_depth,
        reliability=_policy(ReliabilityPolicy, profile.reliability, "reliable"),
        durability=_policy(DurabilityPolicy, profile.durability, "volatile"),
        deadline=_duration(profile.deadline),
        lifespan=_duration(profile.lifespan),
        liveliness=_policy(LivelinessPolicy, profile.liveliness, "automatic"),
        liveliness_lease_duration=_duration(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )


def _publisher(node: Node, topic: TopicInfo, qos: QoSProfile) -> Publisher:
    """Return a publisher, unless subscribers would decode its bytes as something else."""
    with suppress(BagWriteError):  # no message of its own file, such as a service's event
        installed = find_definition(topic.type).type_hash
        if topic.type_hash and installed and topic.type_hash != installed:
            raise NodeError(
                f"it was recorded with another definition of {topic.type} than the installed one"
            )
    type_ = message_class(topic.type)
    try:
        return node.create_publisher(type_, topic.name, qos)
    except Exception as error:  # rclpy's errors on names, types and profiles are of many kinds
        raise NodeError(f"it cannot be published: {error}") from error


def _policy(policies: Any, name: str, default: str) -> Any:
    """Return a policy by name; the default for a name such as `unknown`."""
    known = {"best_effort", "transient_local", "manual_by_topic"}
    return policies[(name if name in known else default).upper()]


def _duration(time: QosTime) -> Duration:
    return Duration(nanoseconds=min(time.sec * 10**9 + time.nsec, _FOREVER))
