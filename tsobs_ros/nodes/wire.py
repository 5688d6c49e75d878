# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Topics that cost less than rclpy's: queues emptied in bulk, JointStates as bytes; message types.

An rclpy executor rebuilds its wait set and makes a task for every callback, which costs five to
ten times as much as the message itself. A node that needs its messages only by the next tick
therefore keeps the subscription out of the wait set, and empties the queue from its tick. Stamps
are unaffected: the middleware sets them when a message arrives.

rclpy has no other call for this than `take_message` of the subscription's public `handle`, which
its own `wait_for_message` uses; no other file calls it.
"""

import math
import re
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from tsobs_ros.bag.definitions import share_folders
from tsobs_ros.design.signals import Place
from tsobs_ros.errors import NodeError
from tsobs_ros.replay.places import Layouts

Taken = list[tuple[Any, Mapping[str, Any]]]
"""Messages, each with its info."""

QUIET = PublisherEventCallbacks(use_default_callbacks=False)
"""No QoS events: an executor would gather each of them again before every wait."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""For messages that stay valid until the next one."""

_FEW = 32
_NAME = re.compile(r"([A-Za-z]\w*)/(msg|srv|action)/([A-Za-z]\w*)", flags=re.ASCII)


class _DrainedGroup(CallbackGroup):
    """A callback group that keeps its entities out of every executor's wait set."""

    def can_execute(self, entity: object) -> bool:
        return False


class DrainedSubscription:
    """A subscription whose messages wait in its queue for `drain`, as CDR bytes if `raw`.

    The queue is that of the QoS profile: with `keep last`, the middleware drops the oldest messages
    beyond `depth` between two drains. An executor, or `look`, calls `on_arrival` as soon as there
    are messages, to drain them. `subscription` is rclpy's.
    """

    def __init__(
        self,
        node: Node,
        msg_type: type[Any],
        topic: str,
        qos: QoSProfile,
        *,
        raw: bool = False,
        on_arrival: Callable[[], None] | None = None,
    ) -> None:
        self._on_arrival = on_arrival
        # Messages that an executor has taken already; an inactive observer leaves them here.
        self._first: deque[tuple[Any, Mapping[str, Any]]] = deque(maxlen=qos.depth or None)
        # No QoS events either: Fast DDS waits for them on the reader's one status condition, which
        # unread data keeps raised, so that the executor would spin until the next drain.
        self.subscription = node.create_subscription(
            msg_type,
            topic,
            self._arrived,
            qos,
            callback_group=None if on_arrival else _DrainedGroup(),
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            raw=raw,
        )

    def drain(self, limit: int | None = None, until: float = math.inf) -> Taken:
        """Take the messages in the queue, oldest first.

        Args:
            limit: Largest number of messages to take; None empties the queue.
            until: Time on the monotonic clock after which the rest stays in the queue [s]; a few
                messages are taken in any case.

        Returns:
            Each message, or its CDR bytes if the subscription is raw, and its info as rclpy gives
            it: among others `source_timestamp` and `received_timestamp` [ns since the epoch], and
            `publication_sequence_number`, its publisher's count from 1, None if the RMW has none.

        Raises:
            InvalidHandle: The subscription or its node has been destroyed.
        """
        count = sys.maxsize if limit is None else limit
        taken = list(self._first)
        self._first.clear()
        own = self.subscription
        with own.handle:
            while len(taken) < count:
                message = own.handle.take_message(own.msg_type, own.raw)
                if message is None:
                    break
                taken.append(message)
                if len(taken) % _FEW == 0 and time.monotonic() >= until:
                    break
        return taken

    def discard(self) -> None:
        """Discard the messages in the queue, at most as many as fit in it."""
        self._first.clear()
        self.drain(self._first.maxlen)

    def look(self) -> None:
        """Call back if a message has arrived, unless an earlier one still waits for `drain`."""
        for message, info in () if self._first else self.drain(1):
            self._arrived(message, info)

    def _arrived(self, message: Any, info: Any) -> None:
        """Keep the message that an executor has taken, and call back."""
        assert self._on_arrival is not None
        self._first.append((message, info))
        self._on_arrival()


class JointStatePublisher:
    """Publishes JointStates that hold any of the given parts, such as joints; see `Layouts`."""

    def __init__(
        self,
        node: Node,
        topic: str,
        parts: Sequence[Sequence[Place]],
        qos: QoSProfile | int = 10,
        events: PublisherEventCallbacks | None = QUIET,
    ) -> None:
        self.publisher = node.create_publisher(JointState, topic, qos, event_callbacks=events)
        self._layouts = Layouts(parts)

    def publish(self, stamp: int, rows: Mapping[int, Sequence[float]]) -> None:
        """Send the given numbers of some parts, by index, as one message; none without parts."""
        if rows:
            layout = self._layouts.of(tuple([(part, len(row)) for part, row in rows.items()]))
            numbers = [number for row in rows.values() for number in row]
            self.publisher.publish(layout.encode_one(stamp, numbers))


def clock_message(time_ns: int) -> Clock:
    """Return the message of a time [ns] on /clock."""
    return Clock(clock=Time(nanoseconds=time_ns).to_msg())


def wait_until_taken(publishers: Iterable[Publisher], seconds: float) -> None:
    """Wait until reliable subscribers have all messages, or too much time has passed [s]."""
    end = time.monotonic() + seconds
    for each in publishers:
        each.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))


def message_class(name: str) -> type[Any]:
    """Return the class of a type, such as `package/msg/Type` or `package/srv/Type_Event`.

    Raises:
        NodeError: The name is not one of a type, or the type is not installed.
    """
    if (match := _NAME.fullmatch(name)) is None:
        raise NodeError(f"'{name}' is not a message type: expected package/msg/Type")
    package, kind, type_name = match.groups()
    # Names come from bags and networks, and importing runs code: import interfaces only.
    if not any((folder / package / kind).is_dir() for folder in share_folders()):
        raise NodeError(f"{name} is not installed")
    try:
        module: Any = import_module(f"{package}.{kind}")
        # The module of a service or an action has the classes of all its messages.
        where = getattr(module, type_name.partition("_")[0]).__module__
        found: type[Any] = getattr(sys.modules[where], type_name)
    except (ImportError, AttributeError) as error:
        raise NodeError(f"the Python module of {name} is not installed: {error}") from error
    return found
