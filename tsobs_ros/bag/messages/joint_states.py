# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/JointState to and from the bytes on the wire, without ROS.

The messages of a topic nearly always have the same names and lengths: only the stamp and the
numbers change. Encoder and decoder keep the rest as a template, so that a message costs about a
microsecond, a tenth of what a ROS message object costs; and many at once cost less still.
"""

import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.messages.cdr import HEADER, CdrReader
from tsobs_ros.bag.messages.joint_state_template import (
    CONSTANT,
    NANOSECONDS,
    JointState,
    JointStates,
    Template,
)
from tsobs_ros.checks import Array
from tsobs_ros.errors import MessageError

__all__ = [
    "JOINT_STATE",
    "JointState",
    "JointStateDecoder",
    "JointStateEncoder",
    "JointStates",
]

JOINT_STATE = "sensor_msgs/msg/JointState"

_SECONDS = 2**31
_NO_VALUES = np.zeros((1, 0))
_HEADER = b"\x00\x01\x00\x00"
# rclpy.serialize_message() reserves the alignment of empty arrays, and leaves what was there.
_LARGEST_TAIL = 16
_MOST_TEMPLATES = 64


class JointStateEncoder:
    """Writes messages of the same joints, as rclpy puts them on the wire.

    Args:
        names: The joints.
        frame_id: Of the header.
    """

    def __init__(self, names: Sequence[str], frame_id: str = "") -> None:
        self._names, self._frame_id = tuple(names), frame_id
        self._templates: dict[tuple[int, int, int], Template] = {}

    def __call__(
        self,
        stamp: int,
        position: Sequence[float] = (),
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
    ) -> bytes:
        """Return a message in little-endian CDR.

        Args:
            stamp: Of its header, ns since the epoch.
            position: Of each joint [rad or m], or empty.
            velocity: Of each joint [rad/s or m/s], or empty.
            effort: Of each joint [N m or N], or empty.

        Raises:
            MessageError: The stamp does not fit into a message, or a value is not a number.
        """
        lengths = (len(position), len(velocity), len(effort))
        template = self._templates.get(lengths) or self._template(lengths)
        try:
            return template.pack(stamp, position, velocity, effort)
        except struct.error as error:
            raise MessageError(f"stamp {stamp} ns, {lengths} numbers: {error}") from error

    def encode_all(
        self,
        stamps: NDArray[np.int64],
        position: Array = _NO_VALUES,
        velocity: Array = _NO_VALUES,
        effort: Array = _NO_VALUES,
    ) -> list[bytes]:
        """Return m messages, each as if encoded on its own.

        Args:
            stamps: Of the headers, ns since the epoch, shape (m,).
            position: Shape (m, joints), or (m, 0) or (1, 0) for none.
            velocity: As `position`.
            effort: As `position`.

        Raises:
            MessageError: A stamp does not fit into a message.
        """
        seconds = stamps // NANOSECONDS
        wrong = (seconds < -_SECONDS) | (seconds >= _SECONDS)
        if wrong.any():
            raise MessageError(f"stamp {stamps[wrong][0]} ns: its seconds do not fit into 32 bits")
        lengths = (position.shape[1], velocity.shape[1], effort.shape[1])
        template = self._templates.get(lengths) or self._template(lengths)
        return template.pack_all(stamps, position, velocity, effort)

    def _template(self, lengths: tuple[int, int, int]) -> Template:
        constant = _constant(self._frame_id, self._names, lengths[0])
        template = Template(_HEADER, constant, lengths, "<", self._names, self._frame_id)
        self._templates[lengths] = template
        return template


class JointStateDecoder:
    """Reads messages, most quickly such as it has read before."""

    def __init__(self) -> None:
        self._templates: dict[int, Template] = {}

    def __call__(self, data: bytes) -> JointState:
        """Return the message in CDR bytes of either byte order.

        Raises:
            MessageError: The bytes are not a JointState; the text says which field, where in the
                message, and what came.
        """
        template = self._templates.get(len(data))
        message = None if template is None else template.unpack(data)
        if message is None:
            message, template = _parse(data)
            if len(self._templates) >= _MOST_TEMPLATES:
                self._templates.clear()
            self._templates[len(data)] = template
        return message

    def decode_all(
        self, messages: Sequence[bytes]
    ) -> tuple[list[JointStates], dict[int, MessageError]]:
        """Decode many messages at once.

        Returns:
            The messages, those of the same names and lengths together; and by its place each
            that is none, with the reason.
        """
        found: list[JointStates] = []
        malformed: dict[int, MessageError] = {}
        sizes = np.fromiter(map(len, messages), np.intp, len(messages))
        for size in np.unique(sizes).tolist():
            places = np.flatnonzero(sizes == size)
            while len(places):
                first = int(places[0])
                try:
                    self(messages[first])
                except MessageError as error:
                    malformed[first] = error
                    places = places[1:]
                    continue
                data = b"".join([messages[place] for place in places.tolist()])
                found.append(self._templates[size].unpack_all(places, data, size))
                places = np.setdiff1d(places, found[-1].places, assume_unique=True)
        return found, malformed


def _constant(frame_id: str, names: tuple[str, ...], positions: int) -> bytes:
    """Return the bytes between the stamp and the positions."""
    body = bytearray(8)

    def count(number: int) -> None:
        body.extend(bytes(-len(body) % 4) + struct.pack("<I", number))

    def text(string: str) -> None:
        raw = string.encode() + b"\0"
        count(len(raw))
        body.extend(raw)

    text(frame_id)
    count(len(names))
    for name in names:
        text(name)
    count(positions)
    if positions:
        body.extend(bytes(-len(body) % 8))
    return bytes(body[8:])


def _parse(data: bytes) -> tuple[JointState, Template]:
    """Read a message field by field; return it and what others like it have in common."""
    reader = CdrReader(data)
    at = reader.place
    reader.skip(8, "header.stamp")
    sec, nanosec = struct.unpack_from(f"{reader.order}iI", data, at)
    frame_id = reader.text("header.frame_id")
    names = tuple(reader.text("name") for _ in range(reader.count("name", 4)))
    position = reader.doubles("position")
    begin = reader.place - 8 * len(position)
    velocity, effort = reader.doubles("velocity"), reader.doubles("effort")
    if reader.left > _LARGEST_TAIL:
        raise MessageError(f"{reader.left} bytes are left at {reader.place}, after the effort")
    stamp = sec * NANOSECONDS + nanosec
    message = JointState(stamp, names, position, velocity, effort, frame_id)
    lengths = (len(position), len(velocity), len(effort))
    # Padding may hold anything, but is usually the same in the next message.
    constant = bytes(data[CONSTANT:begin])
    header = bytes(data[:HEADER])
    return message, Template(header, constant, lengths, reader.order, names, frame_id)
