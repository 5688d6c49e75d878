# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics a recorder subscribes to: found in the graph, with the QoS their publishers offer."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from tsobs_ros.bag.definitions import MessageDefinition, find_definition
from tsobs_ros.bag.qos import QosProfile
from tsobs_ros.bag.recording import LossCounter
from tsobs_ros.errors import BagWriteError, NodeError
from tsobs_ros.nodes.messages import message_class
from tsobs_ros.nodes.recorder.selection import TopicSelection
from tsobs_ros.nodes.recorder.subscription import RawSubscription, Received
from tsobs_ros.nodes.recorder.types import to_bag_qos

# Counting the publishers of a topic tells that one came, but not that one took another's place.
_POLLS_PER_FULL_LOOK = 10
# Of one topic: nodes that are started again and again leave one behind each time.
_MAX_PUBLISHERS = 1000


class QosKind(NamedTuple):
    """What decides whether a subscription hears a publisher, and what it hears."""

    latched: bool
    reliable: bool

    @classmethod
    def of(cls, profile: QoSProfile) -> "QosKind":
        """Return the kind that a publisher offers."""
        return cls(
            latched=profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
            reliable=profile.reliability == ReliabilityPolicy.RELIABLE,
        )

    def request(self, depth: int) -> QoSProfile:
        """Return the profile of a subscription that asks for as much as is offered."""
        reliability, durability = ReliabilityPolicy, DurabilityPolicy
        return QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=depth,
            reliability=reliability.RELIABLE if self.reliable else reliability.BEST_EFFORT,
            durability=durability.TRANSIENT_LOCAL if self.latched else durability.VOLATILE,
        )


class RecordedTopic:
    """One topic being recorded.

    There is a subscription for each kind of QoS that a publisher offers, so that each is heard with
    all it offers. What asks for less also hears those who offer more; the copies are told by their
    publisher's number and left out.

    Attributes:
        name: The full topic name.
        definition: Its type.
        offers: What its publishers offered when it was found.
        losses: What is missing of it.
        publishers: The nodes that publish it, by their publishers' ids.
    """

    def __init__(
        self,
        name: str,
        definition: MessageDefinition,
        offers: tuple[QosProfile, ...],
        subscribe: Callable[[QosKind], RawSubscription],
    ) -> None:
        self.name = name
        self.definition = definition
        self.offers = offers
        self.losses = LossCounter()
        self.publishers: dict[bytes, str] = {}
        self._subscribe = subscribe
        self._subscriptions: dict[QosKind, RawSubscription] = {}
        self._kinds: dict[bytes, QosKind] = {}

    @property
    def matched(self) -> bool:
        """Whether a publisher is heard at the moment."""
        return any(s.publisher_count for s in self._subscriptions.values())

    def hear(self, publishers: Sequence[TopicEndpointInfo]) -> None:
        """Subscribe to those of all the publishers that are not heard yet, as they should be."""
        if len(self.publishers) > _MAX_PUBLISHERS:
            self.publishers.clear()
            self._kinds.clear()
        for info in publishers:
            kind = QosKind.of(info.qos_profile)
            publisher = bytes(info.endpoint_gid)
            self.publishers[publisher] = f"{info.node_namespace.rstrip('/')}/{info.node_name}"
            self._kinds[publisher] = kind
            self.hear_kind(kind)

    def hear_kind(self, kind: QosKind) -> None:
        """Subscribe to publishers of a kind."""
        if kind not in self._subscriptions:
            self._subscriptions[kind] = self._subscribe(kind)
            # Latched ones first: what comes twice is taken for what it is.
            self._subscriptions = dict(sorted(self._subscriptions.items(), reverse=True))

    def drain(self, limit: int) -> list[Received]:
        """Take what has arrived for the first time, at most `limit` from each subscription."""
        is_new, kinds = self.losses.is_new, self._kinds
        return [
            message
            for kind, subscription in self._subscriptions.items()
            for message in subscription.drain(limit)
            # Without numbers, only what comes by the subscription that was made for its publisher.
            if (message.number is not None or kinds.get(message.publisher, kind) == kind)
            and is_new(message.publisher, message.number)
        ]

    def latched_by(self, message: Received) -> bytes | None:
        """Return a message's publisher if what it publishes is for those too who come later."""
        kind = self._kinds.get(message.publisher)
        return message.publisher if kind is not None and kind.latched else None


class TopicFinder:
    """Subscribes to topics as soon as somebody publishes them.

    Args:
        node: The node that owns the subscriptions.
        selection: What to record.
        remapped: The listed topics' names from before remapping, by their full names:
            subscribing applies the remappings again.
        queue_depth: How many messages of a topic may wait to be drained.
        include_unpublished: Whether to subscribe to topics that nobody publishes.
        warn: Told once about each topic that cannot be recorded, or not all of it.

    Attributes:
        recorded: The topics that have been found, by name.
    """

    def __init__(
        self,
        node: Node,
        selection: TopicSelection,
        remapped: Mapping[str, str],
        queue_depth: int,
        include_unpublished: bool,
        warn: Callable[[str], None],
    ) -> None:
        self.recorded: dict[str, RecordedTopic] = {}
        self._node = node
        self._selection = selection
        self._remapped = remapped
        self._queue_depth = queue_depth
        self._include_unpublished = include_unpublished
        self._warn = warn
        # With which types a topic was tried, and what has been said: neither is repeated.
        self._tried: dict[str, Sequence[str]] = {}
        self._warnings: set[str] = set()
        self._publisher_counts: dict[str, int] = {}
        self._polls = 0

    @property
    def missing(self) -> list[str]:
        """The listed topics that nobody publishes yet, or that cannot be recorded."""
        return [
            name
            for name in self._selection.listed
            if name not in self.recorded or not self.recorded[name].matched
        ]

    def poll(self) -> list[RecordedTopic]:
        """Look at the graph and return the topics that have been subscribed to by this call."""
        self._polls += 1
        full_look = self._polls % _POLLS_PER_FULL_LOOK == 0
        for topic in self.recorded.values():
            count = self._node.count_publishers(topic.name)
            if full_look or count != self._publisher_counts.get(topic.name):
                self._publisher_counts[topic.name] = count
                self._look_at(topic)
        found = []
        for name, types in self._wanted().items():
            try:
                if (new := self._found(name, types)) is not None:
                    found.append(new)
            except (BagWriteError, NodeError) as error:
                self._warn(f"not recording {name}: {error}")
        self.recorded.update({topic.name: topic for topic in found})
        return found

    def _wanted(self) -> dict[str, Sequence[str]]:
        """Return the topics yet to be found, and their types as far as those are known."""
        selection = self._selection
        wanted: dict[str, Sequence[str]] = dict.fromkeys(selection.listed, ())
        if selection.has_patterns or self._include_unpublished:
            for name, types in self._node.get_topic_names_and_types():
                if name in wanted or selection.wants(name, types):
                    wanted[name] = types
        return {name: types for name, types in wanted.items() if name not in self.recorded}

    def _found(self, name: str, types: Sequence[str]) -> RecordedTopic | None:
        """Subscribe to a topic, unless it must wait for a publisher."""
        publishers = self._node.get_publishers_info_by_topic(name)
        if publishers:
            types = sorted({info.topic_type for info in publishers})
        elif not (self._include_unpublished and types):
            return None
        if not self._selection.wants(name, types) or self._tried.get(name) == types:
            return None
        self._tried[name] = types
        if len(types) > 1:
            raise BagWriteError(f"its publishers disagree about its type: {', '.join(types)}")
        definition = find_definition(types[0])
        msg_type = message_class(types[0])
        topic = RecordedTopic(
            name,
            definition,
            tuple(to_bag_qos(info.qos_profile) for info in publishers),
            lambda kind: RawSubscription(
                self._node,
                msg_type,
                self._remapped.get(name, name),
                kind.request(self._queue_depth),
            ),
        )
        self._check_definition(definition, name, publishers)
        topic.hear(publishers)
        if not publishers:
            topic.hear_kind(QosKind(latched=False, reliable=True))
        return topic

    def _look_at(self, topic: RecordedTopic) -> None:
        """Hear publishers that came later."""
        fitting = []
        for info in self._node.get_publishers_info_by_topic(topic.name):
            if info.topic_type == topic.definition.type:
                fitting.append(info)
            else:
                self._warn_once(
                    f"not recording the {topic.name} of node {info.node_name}: it is a "
                    f"{info.topic_type}, not a {topic.definition.type}"
                )
        try:
            topic.hear(fitting)
        except NodeError as error:
            self._warn_once(f"not recording all of {topic.name}: {error}")

    def _check_definition(
        self, definition: MessageDefinition, name: str, publishers: Iterable[TopicEndpointInfo]
    ) -> None:
        published = {str(info.topic_type_hash) for info in publishers} - {definition.type_hash}
        if definition.type_hash and any(text.startswith("RIHS01_") for text in published):
            self._warn(
                f"{name}: a publisher's definition of {definition.type} is not the installed one"
            )

    def _warn_once(self, message: str) -> None:
        if message not in self._warnings:
            self._warnings.add(message)
            self._warn(message)
