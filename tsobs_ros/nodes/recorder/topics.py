# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics of a recorder: parameters that select them, subscriptions, and counts of losses."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial
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
from tsobs_ros.nodes.parameters import SelectingParameters, full_name
from tsobs_ros.nodes.wire import DrainedSubscription, message_class
from tsobs_ros.settings import live_setting, setting

_LATCHED, _RELIABLE = DurabilityPolicy.TRANSIENT_LOCAL, ReliabilityPolicy.RELIABLE
# A full look finds a publisher that replaced another, which the number of publishers hides.
_POLLS_PER_FULL_LOOK = 10
# Least number of messages to remember per topic, to recognise those that arrive twice.
_REMEMBERED = 5000


@dataclass(frozen=True)
class RecorderParameters(SelectingParameters):
    """The node's parameters; `config/recorder.yaml` shows them with their reasons."""

    topics: tuple[str, ...] = setting(
        (), "Topics to record; without any selection all that are not hidden"
    )
    output: str = setting("", "Folder of the bag, which must not exist; empty for a dated name")
    compression: str = setting("zstd", "Compression of the chunks", choices=("none", "lz4", "zstd"))
    max_bag_size: int = setting(
        0, "Size at which a file is followed by another; 0: never", unit="bytes", minimum=0
    )
    max_bag_duration: float = setting(
        0.0,
        "Time after which a file is followed by another; 0: never",
        unit="s",
        minimum=0.0,
        maximum=1e9,
    )
    flush_period: float = setting(
        0.5, "Age from which messages survive a kill", unit="s", minimum=0.01, maximum=10
    )
    sync_period: float = setting(
        5.0, "Age from which messages survive a power cut", unit="s", minimum=0.1, maximum=1e6
    )
    queue_depth: int = setting(
        5000, "Messages of a topic that may wait to be drained", minimum=1, maximum=5000
    )
    minimum_free_disk: int = live_setting(
        256, "Free disk space at which recording ends", unit="MiB", minimum=0
    )

    def wants(self, topic: str) -> bool:
        """Return whether to record a topic by its full name."""
        return self.takes(topic, by_default="/_" not in topic)


class LossCounter:
    """Counts the messages of a topic that a recorder has missed, by gaps in a publisher's numbers.

    The middleware gives the number of a message, but not its publisher. A gap therefore means a
    loss only while the topic has one publisher; with several, losses are unknown. The first number
    that arrives from a publisher shows how many messages it had sent before. Messages that are lost
    after the last one that arrives leave no trace.

    >>> counter = LossCounter()
    >>> counter.add([7, 8, 11], lambda: frozenset({b"plant"}))
    >>> str(counter)
    '2 lost, 6 published before'

    Attributes:
        earlier: The number of messages that publishers sent before their first one that arrived.
        lost: The number of messages known to be lost since then.
        is_exact: False once both may be too small: the topic has had several publishers at a
            time, or the middleware does not number messages.
    """

    def __init__(self) -> None:
        self.earlier = self.lost = 0
        self.is_exact = True
        # Numbers begin at 1, so no first number equals this 0.
        self._next = 0
        self._publishers: frozenset[bytes] = frozenset()
        self._gone = False

    def __str__(self) -> str:
        """Return the counts in words."""
        if self.is_exact:
            return f"{self.lost} lost, {self.earlier} published before"
        return f"at least {self.lost} lost" if self.lost else "losses unknown"

    def see(self, publishers: frozenset[bytes]) -> None:
        """Note the present publishers; the queue has been emptied since the last call."""
        self.is_exact &= len(publishers) <= 1
        gone = not publishers & self._publishers
        if gone and self._gone:
            self._next = 0  # all its messages have been counted
        self._gone = gone

    def add(
        self, numbers: Iterable[int | None], current_publishers: Callable[[], frozenset[bytes]]
    ) -> None:
        """Take in the numbers of new messages in order of arrival; None from some middlewares.

        `current_publishers` is called only if a number is not the next one.
        """
        publishers: frozenset[bytes] | None = None
        for number in numbers:
            if number == self._next:
                self._next += 1
            elif number is None:
                self.is_exact = False
            else:
                publishers = current_publishers() if publishers is None else publishers
                self._jump(number, publishers)

    def _jump(self, number: int, publishers: frozenset[bytes]) -> None:
        if self._next and len(self._publishers) == 1 and publishers <= self._publishers:
            if number < self._next:
                self.is_exact = False  # another publisher, which came and went between two looks
                return
            self.lost += number - self._next
        else:
            self.is_exact &= len(publishers) <= 1
            self.earlier += number - 1 if self.is_exact else 0
            self._publishers = publishers
        self._next = number + 1


class RecordedTopic:
    """One topic being recorded.

    There is one subscription for each kind of QoS that publishers offer, so that every publisher is
    recorded with all that it offers. A subscription that asks for less also matches publishers that
    offer more; a message that arrives twice is recorded once.

    Args:
        given: The name before remapping; subscribing applies the remappings.
        publishers: Its publishers, all of one type; `subscribe` subscribes to them.
        depth: Largest number of messages in the queue of a subscription.

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
        # By whether they are latched and reliable, which decides on the publishers they match.
        self._subscriptions: dict[tuple[bool, bool], DrainedSubscription] = {}
        self._latched_publishers: set[bytes] = set()
        # Publication time, number and length; no two messages of a topic have all three in common.
        self._recent: set[tuple[int, int | None, int]] = set()
        self._older = self._recent
        self.offers = tuple(_to_bag(info.qos_profile) for info in publishers)

    @property
    def matched(self) -> bool:
        """Whether a publisher is matched at the moment."""
        return any(s.subscription.get_publisher_count() for s in self._subscriptions.values())

    def subscribe(self, publishers: Sequence[TopicEndpointInfo]) -> None:
        """Subscribe once for each kind of QoS that the present publishers offer."""
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
            # Latched ones are drained last, to have a copy of each message from the others.
            self._subscriptions = dict(sorted([*self._subscriptions.items(), (kind, made)]))
        self.losses.see(_gids(publishers))

    def drain(self, limit: int) -> list[Received]:
        """Take new messages without repetitions, at most `limit` from each subscription.

        The log times are the times of arrival on the system clock.
        """
        taken = [(kind, s, s.drain(limit)) for kind, s in self._subscriptions.items()]
        received: list[Received] = []
        for (is_latched, _), made, messages in reversed(taken):
            latched = 0
            if is_latched and messages:
                matched = made.subscription.get_publisher_count()
                latched = max(1, matched, len(self._latched_publishers))
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
    """Subscribes to topics as soon as they have a publisher; `recorded` has these, by name.

    It warns once about each topic that cannot be recorded, or only in part.
    """

    def __init__(self, node: ManagedNode[RecorderParameters]) -> None:
        self.recorded: dict[str, RecordedTopic] = {}
        self._node = node
        self._selection = node.parameters.resolved(partial(full_name, node))
        self._listed = list(filter(self._selection.wants, self._selection.topics))
        # Names before remapping, by full name; subscribing applies the remappings.
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
        """Look at the ROS graph and return the topics that this call has subscribed to."""
        self._polls += 1
        graph = (name for name, _ in self._node.get_topic_names_and_types())
        before = set(self.recorded)
        for name in dict.fromkeys([*self._listed, *filter(self._selection.wants, graph)]):
            count = self._node.count_publishers(name)
            if count != self._publisher_counts.get(name) or not self._polls % _POLLS_PER_FULL_LOOK:
                self._publisher_counts[name] = count
                try:
                    self._look_at(name, self._node.get_publishers_info_by_topic(name))
                except (BagWriteError, NodeError) as error:
                    self._warn(f"not recording {name}: {error}")
        return [topic for name, topic in self.recorded.items() if name not in before]

    def _look_at(self, name: str, publishers: Sequence[TopicEndpointInfo]) -> None:
        """Subscribe to the new publishers of a topic, which may itself be new."""
        topic = self.recorded.get(name)
        if topic is None:
            types = sorted({info.topic_type for info in publishers})
            if not types:
                return
            if len(types) > 1:
                raise BagWriteError(f"its publishers disagree about its type: {', '.join(types)}")
            given, depth = self._given.get(name, name), self._selection.queue_depth
            topic = RecordedTopic(self._node, name, given, publishers, depth)
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

    def _warn(self, text: str) -> None:
        if text not in self._warnings:
            self._warnings.add(text)
            self._node.log(Level.WARN, text)


def _to_bag(value: Any) -> Any:
    """Return a QoS profile, or a part of one, in the form that bags use."""
    if isinstance(value, QoSProfile):
        names = QosProfile.__struct_fields__
        return QosProfile(**{name: _to_bag(getattr(value, name)) for name in names})
    if isinstance(value, Duration):
        return QosTime(*divmod(value.nanoseconds, 10**9))
    return value.name.lower() if isinstance(value, Enum) else value


def _gids(publishers: Sequence[TopicEndpointInfo]) -> frozenset[bytes]:
    return frozenset(bytes(info.endpoint_gid) for info in publishers)
