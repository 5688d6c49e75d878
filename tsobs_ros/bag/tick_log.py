# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The tick log of an observer: for each tick the messages that came in, so that a replay is a loop.

A message is a std_msgs/Int64MultiArray of one tick: its time on the observer's clock [ns], which is
the stamp of its estimates, the number of ticks since the restart, from 1, whether there were
estimates, and the CRC-32 of each measurement message taken, in the order of taking. A tick with
neither estimates nor measurements is left out, and not counted.
"""

import struct
from collections.abc import Iterable
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.errors import MessageError

TICK_LOG = "std_msgs/msg/Int64MultiArray"
"""Type of the messages."""

DEFINITION = """\
std_msgs/MultiArrayLayout  layout
int64[]                    data
{line}
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
{line}
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
""".format(line="=" * 80)
"""Definition of the type, for bags that are written without ROS."""

_LABEL = b"stamp [ns], tick since the restart, estimated, CRC-32 of each measurement\0"
_LABEL += bytes(-len(_LABEL) % 4)
# Header of CDR, one dimension with label, size and stride, no offset, number of values; values are
# aligned to 8 behind the header.
_FRONT = struct.Struct(f"<4sII{len(_LABEL)}sIIII")
_BEGIN = _FRONT.size + -(_FRONT.size - 4) % 8
_FIXED = 3


def encode_tick(stamp: int, number: int, estimated: bool, messages: Iterable[bytes]) -> bytes:
    """Return the message of a tick.

    Args:
        stamp: Time on the observer's clock [ns].
        number: Of the tick since the restart, from 1.
        estimated: Whether there are estimates.
        messages: Measurement messages that it took.
    """
    values = [stamp, number, estimated, *map(crc32, messages)]
    count = len(values)
    front = _FRONT.pack(b"\0\1\0\0", 1, len(_LABEL), _LABEL, count, count, 0, count)
    return struct.pack(f"<{_BEGIN}s{count}q", front, *values)


def encode_ticks(values: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return messages of ticks with as many measurements each.

    Args:
        values: Stamp, number, whether estimated and checksums, a row each, shape (n, 3 + count).

    Returns:
        Their bytes, shape (n, size).
    """
    front = encode_tick(0, 0, False, [b""] * (values.shape[1] - _FIXED))[:_BEGIN]
    fronts = np.tile(np.frombuffer(front, np.uint8), (len(values), 1))
    return np.hstack([fronts, values.astype("<i8").view(np.uint8)])


def decode_ticks(messages: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the values of messages of one size.

    Args:
        messages: Their bytes, shape (n, size).

    Returns:
        A row each: stamp, number, whether estimated, checksums; shape (n, 3 + count).

    Raises:
        MessageError: They are none of a tick log.
    """
    count = (messages.shape[1] - _BEGIN) // 8
    expected = encode_tick(0, 0, False, [b""] * (count - _FIXED))[:_BEGIN]
    if count < _FIXED or (messages[:, :_BEGIN] != np.frombuffer(expected, np.uint8)).any():
        raise MessageError("expected messages of a tick log, got others of their type")
    return np.ascontiguousarray(messages[:, _BEGIN:]).view("<i8").astype(np.int64, copy=False)
