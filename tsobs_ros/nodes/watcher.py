# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The data of live views: the newest messages of an observer, and of the truth.

`ObserverFeed` keeps them for any node; `Watcher` is the node of `tsobs watch`.
"""

import math
import os
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from itertools import chain
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState as JointStateMessage

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_states import JointState, JointStateDecoder
from tsobs_ros.errors import MessageError, NodeError
from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.nodes.parameters import full_name
from tsobs_ros.nodes.runtime import Ticker
from tsobs_ros.nodes.wire import DrainedSubscription
from tsobs_ros.replay.places import FIELDS

_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
_PERIOD = 0.25  # time between two views [s]
_COLUMNS = ("value", "bound", "truth")
_TABLES = {
    "estimate": (topics.STATES, topics.STATE_BOUNDS, topics.TRUE_STATES),
    "sensor disturbance": (topics.DISTURBANCE, topics.DISTURBANCE_BOUND, topics.TRUE_DISTURBANCE),
    "innovation": (topics.INNOVATION,),
    "torque disturbance": (*topics.TORQUE_TOPICS, topics.TRUE_TORQUE),
    "learnt change": topics.PARAMETER_TOPICS,
}
"""The topics of each table's columns."""


class View(NamedTuple):
    """The data on an observer at an instant.

    Attributes:
        observer: Its full name.
        age: Time since its last estimate [s]; NaN if there was none.
        tables: The `value`, and its 1σ `bound` and the `truth` if they are known, by title, name of
            the entry and field of the message.
        statuses: Its diagnostics by name.
    """

    observer: str
    age: float
    tables: dict[str, dict[str, dict[str, dict[str, float]]]]
    statuses: Mapping[str, Status]


class ObserverFeed:
    """Subscribes to an observer's topics and keeps the newest message of each.

    Args:
        observer: The observer's name, relative to the node's namespace or full.
        wanted: Topics of JointStates in `estimate_topics`: of `TRUTH`, or below the observer's
            name.

    Attributes:
        name: The observer's full name.
        latest: The newest message of each topic, by the name in `wanted`.
        arrived: When each of these was read, on the monotonic clock [s].
        statuses: The observer's newest diagnostics, by their names without the observer's name.
    """

    def __init__(self, node: Node, observer: str, wanted: Iterable[str]) -> None:
        self._decode = JointStateDecoder()
        self.name = full_name(node, "observer", observer)
        self.latest: dict[str, JointState] = {}
        self.arrived: dict[str, float] = {}
        self.statuses: dict[str, Status] = {}
        self._prefix = f"{self.name.lstrip('/')}: "
        names = {key: key if key in topics.TRUTH else f"{observer}/{key}" for key in wanted}
        self._topics = {
            key: DrainedSubscription(node, JointStateMessage, topic, _QOS, raw=True)
            for key, topic in names.items()
        }
        node.create_subscription(DiagnosticArray, "/diagnostics", self._take_statuses, 10)

    def read(self) -> None:
        """Take the messages that have arrived since the last call."""
        for key, subscription in self._topics.items():
            taken = subscription.drain()
            if taken:
                self.arrived[key] = time.monotonic()
                with suppress(MessageError):
                    self.latest[key] = self._decode(taken[-1][0])

    def values(self, field: str, topic: str, max_age: float = math.inf) -> dict[str, float]:
        """Return a field of a topic's newest message by entry; none if older than `max_age` [s]."""
        message = self.latest.get(topic)
        if message is None or time.monotonic() - self.arrived[topic] >= max_age:
            return {}
        return dict(zip(message.names, getattr(message, field), strict=False))

    def _take_statuses(self, array: DiagnosticArray) -> None:
        found = {}
        for each in array.status:
            if (name := each.name.removeprefix(self._prefix)) != each.name:
                level = Level(each.level[0]) if each.level[0] in set(Level) else Level.STALE
                values = {item.key: item.value for item in each.values}
                found[name] = Status(name, level, each.message, values)
        # An array has all statuses of the node, so those of an earlier design disappear.
        self.statuses = found or self.statuses


class Watcher(Node):
    """Shows an observer, given by its full name, until `show` returns false.

    Raises:
        NodeError: The observer's name is not the name of a node.
    """

    def __init__(self, observer: str, show: Callable[[View], bool], **node_kwargs: Any) -> None:
        namespace, _, name = observer.rpartition("/")
        if not name:
            raise NodeError(f"'{observer}' is not the name of an observer")
        # There are no parameters to set, and rclpy fails on requests with an unknown type.
        super().__init__(
            f"tsobs_watch_{os.getpid()}",
            namespace=namespace,
            start_parameter_services=False,
            **node_kwargs,
        )
        self.finished = False
        self._show = show
        self._feed = ObserverFeed(self, name, chain.from_iterable(_TABLES.values()))
        self.ticker = Ticker(self, _PERIOD, self._tick)

    def _tick(self) -> None:
        self._feed.read()
        self.finished = not self._show(self._view())

    def _view(self) -> View:
        feed, tables = self._feed, {}
        for title, sources in _TABLES.items():
            rows: dict[str, dict[str, dict[str, float]]] = {}
            for field in FIELDS:
                columns = [feed.values(field, topic) for topic in sources]
                for name in columns[0]:
                    known = zip(_COLUMNS, columns, strict=False)
                    numbers = {what: each[name] for what, each in known if name in each}
                    rows.setdefault(name, {})[field] = numbers
            tables[title] = rows
        age = time.monotonic() - feed.arrived.get(topics.STATES, math.nan)
        return View(feed.name, age, tables, feed.statuses)
