# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics a recorder subscribes to: found in the graph, with the QoS their publishers offer."""

from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from tsobs_ros.bag.definitions import MessageDefinition, find_definition
from tsobs_ros.bag.losses import LossCounter
from tsobs_ros.bag.qos import QosProfile, QosTime
from tsobs_ros.errors import BagWriteError
from tsobs_ros.nodes.draining import Drained, DrainedSubscription


class RecordedTopic:
    """One topic being recorded: its subscription and what is known about it."""

    def __init__(
        self,
        name: str,
        definition: MessageDefinition,
        offers: tuple[QosProfile, ...],
        requested: QoSProfile,
        subscription: DrainedSubscription,
    ) -> None:
        self.name = name
        self.definition = definition
        self.offers = offers
        self.requested = requested
        self.subscription = subscription
        self.losses = LossCounter()
        self.messages = 0
        self.publishers_seen = len(offers)

    def drain(self, limit: int) -> list[Drained]:
        """Take what has arrived, at most `limit` messages, and count it and what is missing."""
        drained = self._take(limit)
        self.messages += len(drained)
        return drained

    def discard(self) -> None:
        """Throw away what has arrived; nothing of it is a loss."""
        self._take(None)

    def _take(self, limit: int | None) -> list[Drained]:
        drained = self.subscription.drain(limit)
        self.losses.observe(
            [item.info.sequence for item in drained], self.subscription.publisher_count
        )
        return drained


class TopicFinder:
    """Subscribes to topics as soon as somebody publishes them.

    Args:
        node: The node that owns the subscriptions.
        names: The topics to record, relative ones in the node's namespace; empty for all that
            are not hidden.
        queue_depth: How many messages of a topic may wait to be drained.
        warn: Told once about each topic that cannot be recorded, or not all of it.
    """

    def __init__(
        self, node: Node, names: Sequence[str], queue_depth: int, warn: Callable[[str], None]
    ) -> None:
        self.recorded: dict[str, RecordedTopic] = {}
        self._node = node
        # Subscribing applies the remappings, so it must be given the name from before them.
        self._names = {str(node.resolve_topic_name(name)): name for name in names}
        self._queue_depth = queue_depth
        self._warn = warn
        self._refused: set[str] = set()

    @property
    def missing(self) -> list[str]:
        """The listed topics that nobody publishes yet, or that cannot be recorded."""
        return [
            name
            for name in self._names
            if name not in self.recorded or not self.recorded[name].subscription.publisher_count
        ]

    def poll(self) -> list[RecordedTopic]:
        """Look at the graph and return the topics that have been subscribed to by this call."""
        for topic in self.recorded.values():
            self._check_publishers(topic)
        wanted = self._names or self._visible()
        found = []
        for name in wanted:
            if name in self.recorded or name in self._refused:
                continue
            if not (offered := self._node.get_publishers_info_by_topic(name)):
                continue
            try:
                found.append(self._subscribe(name, offered))
            except BagWriteError as error:
                self._refused.add(name)
                self._warn(f"not recording {name}: {error}")
        self.recorded.update({topic.name: topic for topic in found})
        return found

    def _visible(self) -> list[str]:
        names = (name for name, _ in self._node.get_topic_names_and_types())
        return [name for name in names if "/_" not in name]

    def _subscribe(self, name: str, offered: Sequence[TopicEndpointInfo]) -> RecordedTopic:
        types = sorted({info.topic_type for info in offered})
        if len(types) > 1:
            raise BagWriteError(f"its publishers disagree about its type: {', '.join(types)}")
        definition = find_definition(types[0])
        message_class = _message_class(types[0])
        # The hash of the type as it is published; a different one here means other definitions.
        published = {str(info.topic_type_hash) for info in offered} - {definition.type_hash}
        if definition.type_hash and any(text.startswith("RIHS01_") for text in published):
            self._warn(f"{name}: a publisher's definition of {types[0]} is not the installed one")
        requested = _requested([info.qos_profile for info in offered], self._queue_depth)
        subscription = DrainedSubscription(
            self._node, message_class, self._names.get(name, name), requested, raw=True
        )
        offers = tuple(_to_bag_qos(info.qos_profile) for info in offered)
        return RecordedTopic(name, definition, offers, requested, subscription)

    def _check_publishers(self, topic: RecordedTopic) -> None:
        if (count := self._node.count_publishers(topic.name)) == topic.publishers_seen:
            return
        topic.publishers_seen = count
        for info in self._node.get_publishers_info_by_topic(topic.name):
            reason = _unheard(topic, info)
            if reason and (about := f"{topic.name} {info.endpoint_gid}") not in self._refused:
                self._refused.add(about)
                self._warn(f"not recording the {topic.name} of node {info.node_name}: {reason}")


def _requested(offered: Iterable[QoSProfile], depth: int) -> QoSProfile:
    """Ask for as much as all publishers offer: more would leave one of them out."""
    profiles = list(offered)
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _unheard(topic: RecordedTopic, info: TopicEndpointInfo) -> str:
    """Return why a publisher that came later is not heard, or nothing when it is."""
    if info.topic_type != topic.definition.type:
        return f"it is a {info.topic_type}, not a {topic.definition.type}"
    for policy, strong in (
        ("reliability", ReliabilityPolicy.RELIABLE),
        ("durability", DurabilityPolicy.TRANSIENT_LOCAL),
    ):
        offered = getattr(info.qos_profile, policy)
        if getattr(topic.requested, policy) == strong and offered != strong:
            return f"it came later and offers less {policy} than the first publishers"
    return ""


def _message_class(msgtype: str) -> type[Any]:
    package, _, name = msgtype.split("/")
    try:
        message_class: type[Any] = getattr(import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise BagWriteError(f"the Python module of {msgtype} is not installed: {error}") from error
    return message_class


def _to_bag_qos(profile: QoSProfile) -> QosProfile:
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
