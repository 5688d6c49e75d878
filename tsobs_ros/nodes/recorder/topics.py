# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics a recorder subscribes to: found in the graph, with the QoS their publishers offer."""

import time
from collections.abc import Sequence
from enum import Enum
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.metadata import QosProfile, QosTime
from tsobs_ros.bag.recording import Received
from tsobs_ros.errors import BagWriteError, NodeError
from tsobs_ros.estimation.health import Level
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.recorder.losses import LossCounter
from tsobs_ros.nodes.recorder.parameters import RecorderParameters
from tsobs_ros.nodes.wire import DrainedSubscription, message_class

_LATCHED, _RELIABLE = DurabilityPolicy.TRANSIENT_LOCAL, ReliabilityPolicy.RELIABLE
# The number of a topic's publishers shows that one came, but not that one took another's place.
_POLLS_PER_FULL_LOOK = 10
# Messages of a topic remembered at least, to recognise those that arrive by two subscriptions.
_REMEMBERED = 5000


class RecordedTopic:
    """One topic being recorded.

    There is a subscription for each kind of QoS that is offered, so that every publisher is
    recorded with all it offers; one, if all offer the same. A subscription that asks for less also
    matches those that offer more, and what arrives twice is recorded once.

    Args:
        node: The node that owns the subscriptions.
        name: The full topic name.
        given: The name before remappings, which subscribing applies.
        publishers: Its publishers, all of one type, which are not subscribed to yet.
        depth: Messages that may wait in the queue of a subscription.

    Attributes:
        offers: What its publishers offered when it was found.

    Raises:
        BagWriteError: The type has no definition.
        NodeError: The type is not installed.
    """

    def __init__(
        self, node: Node, name: str, given: str, publishers: Sequence[TopicEndpointInfo], depth: int
    ) -> None:
        self.name = name
        self.definition = find_definition(publishers[0].topic_type)
        self.losses = LossCounter()
        self._node, self._given, self._depth = node, given, depth
        self._msg_type = message_class(self.definition.type)
        # By whether it is latched and reliable, which decides on the publishers it matches.
        self._subscriptions: dict[tuple[bool, bool], DrainedSubscription] = {}
        self._latched_publishers: set[bytes] = set()
        # Publication time, number and length: of two messages of a topic, one is never the same.
        self._recent: set[tuple[int, int | None, int]] = set()
        self._older = self._recent
        self.offers = tuple(to_bag_qos(info.qos_profile) for info in publishers)

    @property
    def matched(self) -> bool:
        """Whether a publisher is matched at the moment."""
        return any(s.publisher_count for s in self._subscriptions.values())

    def subscribe(self, publishers: Sequence[TopicEndpointInfo]) -> None:
        """Subscribe to all the publishers there are, as far as that is not done yet."""
        for info in publishers:
            offer = info.qos_profile
            kind = offer.durability == _LATCHED, offer.reliability == _RELIABLE
            if offer.durability == _LATCHED:
                self._latched_publishers.add(bytes(info.endpoint_gid))
            if kind in self._subscriptions:
                continue
            qos = QoSProfile(
                depth=self._depth,
                reliability=_RELIABLE if kind[1] else ReliabilityPolicy.BEST_EFFORT,
                durability=_LATCHED if kind[0] else DurabilityPolicy.VOLATILE,
            )
            try:
                made = DrainedSubscription(self._node, self._msg_type, self._given, qos, raw=True)
            except Exception as error:  # such as another type of the same topic in this process
                raise NodeError(f"{self.name}: cannot subscribe: {error}") from error
            # Latched ones last: when their queue is emptied, a copy has not arrived before.
            self._subscriptions = dict(sorted([*self._subscriptions.items(), (kind, made)]))
        self.losses.see(_gids(publishers))

    def drain(self, limit: int) -> list[Received]:
        """Take what has arrived for the first time, at most `limit` from each subscription.

        The log times are those of arrival by the system's clock.
        """
        taken = [(kind, s, s.drain(limit)) for kind, s in self._subscriptions.items()]
        received: list[Received] = []
        for (is_latched, _), subscription, messages in reversed(taken):
            latched = 0
            if is_latched and messages:
                latched = max(1, subscription.publisher_count, len(self._latched_publishers))
            for data, info in messages:
                source_ns, number = info["source_timestamp"], info["publication_sequence_number"]
                key = (source_ns, number, len(data))
                if len(taken) > 1 and (key in self._recent or key in self._older):
                    continue
                self._recent.add(key)
                times = info["received_timestamp"] or time.time_ns(), max(source_ns, 0)
                received.append(Received(self.name, data, *times, number, latched))
        self.losses.add(
            (message.number for message in received),
            lambda: _gids(self._node.get_publishers_info_by_topic(self.name)),
        )
        if len(self._recent) > _REMEMBERED:
            self._recent, self._older = set(), self._recent
        return received


class TopicFinder:
    """Subscribes to topics as soon as they have a publisher, for a node.

    It warns once of each topic that cannot be recorded, or not all of it.

    Attributes:
        recorded: The topics that have been found, by name.
    """

    def __init__(self, node: ManagedNode[RecorderParameters]) -> None:
        self.recorded: dict[str, RecordedTopic] = {}
        self._node = node
        self._selection = node.parameters.resolved(node.resolve_topic_name)
        self._listed = list(filter(self._selection.wants, self._selection.topics))
        # Full names and those before remappings, which subscribing applies.
        self._given = dict(zip(self._selection.topics, node.parameters.topics, strict=True))
        self._warnings: set[str] = set()
        self._publisher_counts: dict[str, int] = {}
        self._polls = 0

    @property
    def missing(self) -> list[str]:
        """The listed topics that have no publisher yet, or that cannot be recorded."""
        recorded = self.recorded
        return [name for name in self._listed if name not in recorded or not recorded[name].matched]

    def poll(self) -> list[RecordedTopic]:
        """Look at the graph and return the topics that have been subscribed to by this call."""
        self._polls += 1
        graph = (name for name, _ in self._node.get_topic_names_and_types())
        found = []
        for name in dict.fromkeys([*self._listed, *filter(self._selection.wants, graph)]):
            count = self._node.count_publishers(name)
            if (
                count == self._publisher_counts.get(name)
                and self._polls % _POLLS_PER_FULL_LOOK != 0
            ):
                continue
            self._publisher_counts[name] = count
            try:
                if self._look_at(name, self._node.get_publishers_info_by_topic(name)):
                    found.append(self.recorded[name])
            except (BagWriteError, NodeError) as error:
                self._warn(f"not recording {name}: {error}")
        return found

    def _look_at(self, name: str, publishers: Sequence[TopicEndpointInfo]) -> bool:
        """Subscribe to publishers that are new; return whether the topic is."""
        topic = self.recorded.get(name)
        is_new = topic is None and bool(publishers)
        if is_new:
            types = sorted({info.topic_type for info in publishers})
            if len(types) > 1:
                raise BagWriteError(f"its publishers disagree about its type: {', '.join(types)}")
            given, depth = self._given.get(name, name), self._selection.queue_depth
            topic = RecordedTopic(self._node, name, given, publishers, depth)
        if topic is None:
            return False
        own = topic.definition
        for info in publishers:
            if info.topic_type != own.type:
                self._warn(
                    f"not recording the {name} of node {info.node_name}: it is a "
                    f"{info.topic_type}, not a {own.type}"
                )
            elif own.type_hash and str(info.topic_type_hash) not in (own.type_hash, "INVALID"):
                self._warn(
                    f"{name}: a publisher's definition of {own.type} is not the installed one"
                )
        topic.subscribe([info for info in publishers if info.topic_type == own.type])
        self.recorded[name] = topic
        return is_new

    def _warn(self, text: str) -> None:
        if text not in self._warnings:
            self._warnings.add(text)
            self._node.log(Level.WARN, text)


def to_bag_qos(profile: QoSProfile) -> QosProfile:
    """Return a profile that a publisher offers in the form a bag has it."""
    names = QosProfile.__struct_fields__
    return QosProfile(**{name: _to_bag(getattr(profile, name)) for name in names})


def _to_bag(value: Any) -> Any:
    if isinstance(value, Duration):
        return QosTime(*divmod(value.nanoseconds, 10**9))
    return value.name.lower() if isinstance(value, Enum) else value


def _gids(publishers: Sequence[TopicEndpointInfo]) -> frozenset[bytes]:
    return frozenset(bytes(info.endpoint_gid) for info in publishers)
