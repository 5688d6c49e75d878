# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A subscription that gives bytes off the wire, and tells of each message who published it.

rclpy tells of a message which number its publisher gave it, but not which publisher that was, and
without that a gap in the numbers means nothing as soon as a topic has two. The rcl below does tell:
`rcl_take_serialized_message` fills a `rmw_message_info_t` that rclpy drops half of. It is public,
the same in all of Jazzy, in every middleware, and already loaded; so it is called here directly, in
the way rclpy does and at the same cost.
"""

import ctypes
from functools import cache
from typing import Any, NamedTuple

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile

from tsobs_ros.errors import NodeError
from tsobs_ros.nodes.draining import DrainedGroup

_RCL_RET_OK = 0
_RCL_RET_SUBSCRIPTION_TAKE_FAILED = 401
_NO_NUMBER = 2**64 - 1
_GID_SIZE = 16


class _Allocator(ctypes.Structure):
    """C's rcutils_allocator_t."""

    _fields_ = tuple(
        (name, ctypes.c_void_p)
        for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state")
    )


class _Bytes(ctypes.Structure):
    """C's rcutils_uint8_array_t, which is also rmw_serialized_message_t."""

    _fields_ = (
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", _Allocator),
    )


class _Info(ctypes.Structure):
    """C's rmw_message_info_t, with room behind it in case it grows."""

    _fields_ = (
        ("source_timestamp", ctypes.c_int64),
        ("received_timestamp", ctypes.c_int64),
        ("publication_sequence_number", ctypes.c_uint64),
        ("reception_sequence_number", ctypes.c_uint64),
        ("implementation", ctypes.c_char_p),
        ("publisher", ctypes.c_ubyte * _GID_SIZE),
        ("from_intra_process", ctypes.c_bool),
        ("room", ctypes.c_ubyte * 256),
    )


class Received(NamedTuple):
    """One message as it came off the wire.

    Attributes:
        data: The message in CDR.
        source_ns: When it was published, on the publisher's system clock, ns since the epoch.
        received_ns: When it arrived here, on this machine's system clock, ns since the epoch.
        publisher: Who published it: the `endpoint_gid` that the graph tells.
        number: Its publisher's count of messages, from 1; None where the RMW does not tell.
    """

    data: bytes
    source_ns: int
    received_ns: int
    publisher: bytes
    number: int | None


class Rcl:
    """The functions of rcl that are needed, and the memory they work on.

    Args:
        rcl: The library's file.
        rcutils: The file of the library below it.

    Raises:
        NodeError: A library cannot be loaded, or is not the one of Jazzy.
    """

    def __init__(self, rcl: str = "librcl.so", rcutils: str = "librcutils.so") -> None:
        # Not CDLL: rcl does not wait here, and giving up the GIL would cost more than the call.
        try:
            upper, lower = ctypes.PyDLL(rcl), ctypes.PyDLL(rcutils)
            self.take = upper.rcl_take_serialized_message
            self.reset_error = lower.rcutils_reset_error
            default_allocator = lower.rcutils_get_default_allocator
        except (OSError, AttributeError) as error:
            raise NodeError(
                f"recording needs {rcl} and {rcutils}, which rclpy loads in ROS 2 Jazzy on Linux: "
                f"{error}"
            ) from error
        self.take.argtypes = [ctypes.c_void_p] * 4
        default_allocator.restype = _Allocator
        self.bytes = _Bytes(allocator=default_allocator())
        self.info = _Info()


@cache
def loaded_rcl() -> Rcl:
    """Return what all subscriptions share: one buffer, as large as the largest message.

    Raises:
        NodeError: It cannot be loaded.
    """
    return Rcl()


class RawSubscription:
    """A subscription that waits, in its queue, for `drain`; no executor waits for it.

    Args:
        node: The node that owns the subscription.
        msg_type: The message class.
        topic: The topic name; relative names are resolved and remapped by the node.
        qos: The requested QoS profile, whose depth covers the longest time between drains.

    Raises:
        NodeError: The middleware refuses the subscription, or rcl cannot be loaded.
    """

    def __init__(self, node: Node, msg_type: type[Any], topic: str, qos: QoSProfile) -> None:
        self._node = node
        self._rcl = loaded_rcl()
        # No QoS events: see DrainedSubscription, which does the same for messages.
        try:
            self._subscription = node.create_subscription(
                msg_type,
                topic,
                _never_called,
                qos,
                callback_group=DrainedGroup(),
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
                raw=True,
            )
        except rclpy_implementation.RCLError as error:
            # Such as another type of the same topic in this process.
            raise NodeError(f"{topic}: cannot subscribe: {error}") from error

    @property
    def publisher_count(self) -> int:
        """The number of publishers this subscription is matched with at the moment."""
        return int(self._subscription.get_publisher_count())

    def drain(self, limit: int) -> list[Received]:
        """Take what is in the queue, oldest first, at most `limit` messages.

        Raises:
            NodeError: The middleware failed.
            InvalidHandle: The subscription or its node has been destroyed.
        """
        rcl = self._rcl
        take, message, info = rcl.take, rcl.bytes, rcl.info
        message_at, info_at = ctypes.addressof(message), ctypes.addressof(info)
        publisher_at = info_at + _Info.publisher.offset
        read = ctypes.string_at
        handle = self._subscription.handle
        received = []
        with handle:
            subscription_at = handle.pointer
            result = _RCL_RET_OK
            for _ in range(limit):
                result = take(subscription_at, message_at, info_at, None)
                if result != _RCL_RET_OK:
                    break
                number = info.publication_sequence_number
                received.append(
                    Received(
                        read(message.buffer, message.length),
                        info.source_timestamp,
                        info.received_timestamp,
                        read(publisher_at, _GID_SIZE),
                        None if number == _NO_NUMBER else number,
                    )
                )
        if result not in (_RCL_RET_OK, _RCL_RET_SUBSCRIPTION_TAKE_FAILED):
            rcl.reset_error()
            topic = self._subscription.topic_name
            raise NodeError(f"{topic}: taking a message failed with rcl's error {result}")
        return received

    def destroy(self) -> None:
        """Destroy the subscription with what is left in its queue; safe to call twice."""
        self._node.destroy_subscription(self._subscription)


def _never_called(message: object) -> None:
    """Stand in for the callback that rclpy asks for: the group keeps executors from calling it."""
