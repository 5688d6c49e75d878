# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The newest messages of an observer, of its sensors and of the truth, for live views."""

import math
import time
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.validate_full_topic_name import validate_full_topic_name
from sensor_msgs.msg import JointState as JointStateMessage
from std_msgs.msg import String

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_states import JointState, JointStateDecoder
from tsobs_ros.design.file import parse_design
from tsobs_ros.design.published import read_record
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.design.signals import Signals, signals
from tsobs_ros.errors import MessageError, TsobsError
from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.nodes.messages import LATCHED
from tsobs_ros.nodes.wire import DrainedSubscription
from tsobs_ros.series import NANOSECONDS

MEASUREMENTS = "measurements"
"""The key of the sensors' messages: `joint_measurements` until the observer publishes its topic."""

_RATE_WINDOW = 3 * NANOSECONDS
_MAX_READS = 1000


class ObserverFeed:
    """Subscribes to an observer's topics and keeps the newest message of each.

    Args:
        node: The node that subscribes.
        observer: The observer's name, relative to the node's namespace or full.
        wanted: Topics of JointStates, those of `estimate_topics` below the observer's name, and of
            `TRUTH`.
        depth: Messages that a topic keeps between two reads; only kept ones count in rates.

    Attributes:
        name: The observer's full name.
        latest: The newest message of each topic, by the name in `wanted`, and of `MEASUREMENTS`.
        arrived: When it was read, on the monotonic clock [s].
        statuses: The observer's newest diagnostics, by name without the observer's.
        requests: What each joint's design was made for, by its name; empty without a record.
        problem: Why the record cannot be used; empty if it can.
    """

    def __init__(self, node: Node, observer: str, wanted: Iterable[str], depth: int = 1) -> None:
        self._node = node
        self._qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._decode = JointStateDecoder()
        self.name = node.resolve_topic_name(observer)
        self.latest: dict[str, JointState] = {}
        self.arrived: dict[str, float] = {}
        # Of each read: when its newest message was received [ns], and how many there were so far.
        self._received: dict[str, deque[tuple[int, int]]] = {}
        self.statuses: dict[str, Status] = {}
        self.requests: dict[str, ArmRequest | TSRequest] = {}
        self.problem = ""
        self._prefix = f"{self.name.lstrip('/')}: "
        self._topics = {
            key: self._subscribe(key if key in topics.TRUTH else f"{observer}/{key}")
            for key in wanted
        }
        self._topics[MEASUREMENTS] = self._subscribe("joint_measurements")
        node.create_subscription(String, f"{observer}/{topics.DESIGN}", self._take_record, LATCHED)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._take_statuses, 10)

    def read(self) -> None:
        """Take what has arrived since the last time."""
        for key, subscription in self._topics.items():
            taken = subscription.drain()
            if taken:
                past = self._received.setdefault(key, deque([(0, 0)], _MAX_READS))
                past.append((taken[-1][1]["received_timestamp"], past[-1][1] + len(taken)))
                self.arrived[key] = time.monotonic()
                with suppress(MessageError):
                    self.latest[key] = self._decode(taken[-1][0])

    def values(self, field: str, topic: str, max_age: float = math.inf) -> dict[str, float]:
        """Return the numbers in the newest message of a topic, by name; none if it is too old.

        Args:
            field: Which of its fields.
            topic: One of those wanted, or `MEASUREMENTS`.
            max_age: Time since it was read [s].
        """
        message = self.latest.get(topic)
        if message is None or time.monotonic() - self.arrived[topic] >= max_age:
            return {}
        return dict(zip(message.names, getattr(message, field), strict=False))

    def rates(self) -> dict[str, float]:
        """Return the messages a second of each topic that had any, over the last seconds."""
        began = time.time_ns() - _RATE_WINDOW
        found = {}
        for key, past in self._received.items():
            recent = [each for each in past if each[0] > began] or [past[-1]]
            (first, before), (last, count) = recent[0], recent[-1]
            found[key] = NANOSECONDS * (count - before) / (last - first) if last > first else 0.0
        return found

    def status_of(self, joint: str, concern: str) -> list[Status]:
        """Return the newest statuses of a joint whose names begin with a concern."""
        return [
            status
            for name, status in self.statuses.items()
            if name.removeprefix(f"{joint}: ").startswith(concern)
        ]

    def places(self, joint: str) -> Signals:
        """Return the places of a joint's signals in messages."""
        return signals(self.requests[joint], joint, alone=len(self.requests) == 1)

    def _subscribe(self, topic: str) -> DrainedSubscription:
        return DrainedSubscription(self._node, JointStateMessage, topic, self._qos, raw=True)

    def _take_record(self, message: Any) -> None:
        """Take over what the observer runs, which is new after each of its starts."""
        self.problem = ""
        try:
            record = read_record(message.data)
            validate_full_topic_name(record.measurements)
            self.requests = {
                joint: parse_design(each.file, each.text).request
                for each in record.designs
                for joint in each.joints
            }
        except (TsobsError, InvalidTopicNameException) as error:
            self.problem = f"{self.name}/{topics.DESIGN}: {error}"
            return
        if self._topics[MEASUREMENTS].topic != record.measurements:
            self._topics[MEASUREMENTS].destroy()
            self._topics[MEASUREMENTS] = self._subscribe(record.measurements)

    def _take_statuses(self, array: DiagnosticArray) -> None:
        found = {
            each.name.removeprefix(self._prefix): Status(
                each.name.removeprefix(self._prefix),
                Level(each.level[0]) if each.level[0] in set(Level) else Level.STALE,
                each.message,
                {item.key: item.value for item in each.values},
            )
            for each in array.status
            if each.name.startswith(self._prefix)
        }
        # An array has all of the node's statuses, so that those of an earlier design go.
        self.statuses = found or self.statuses
