# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""CDR messages as bytes on the wire, without ROS: strings, ticks, and arrays of messages.

An observer's tick log has one std_msgs/Int64MultiArray per tick, so that a replay is a plain loop.
Each message has the tick's time on the observer's clock [ns], which is also the stamp of its
estimates; the number of the tick since the restart, counted from 1; whether there were estimates;
and the CRC-32 of each measurement message taken, in the order in which they were taken. A tick
with neither estimates nor measurements is neither logged nor counted.
"""

import struct
from collections.abc import Iterable
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.errors import MessageError
from tsobs_ros.series import NANOSECONDS

HEADER = 4
"""Size of the header in bytes; alignment counts from its end."""

LITTLE = b"\x00\x01\x00\x00"
"""The header of every message: plain little-endian CDR, which all middlewares send."""


class CdrReader:
    """A read position in a message; each read checks the message's bounds and moves on.

    `place` is the offset of the next byte to read, counted from the beginning of the header.

    Raises:
        MessageError: The header is missing, or announces another encoding.
    """

    def __init__(self, data: bytes) -> None:
        if len(data) < HEADER or data[:2] != LITTLE[:2]:
            found = bytes(data[:HEADER]).hex()
            raise MessageError(
                f"{len(data)} bytes, encoding 0x{found}: not plain little-endian CDR"
            )
        self._data = data
        self.place = HEADER

    @property
    def left(self) -> int:
        """The number of bytes that are not read yet."""
        return len(self._data) - self.place

    def skip(self, size: int, what: str) -> int:
        """Skip `size` bytes, all of which must exist; return the offset of the first."""
        if size > self.left:
            raise MessageError(
                f"{what}: expected {size} bytes at {self.place}, but the message ends after "
                f"{self.left}"
            )
        self.place += size
        return self.place - size

    def stamp(self, what: str) -> int:
        """Read a time [ns]."""
        seconds, nanoseconds = self._unpack("iI", 4, 8, what)
        return int(seconds) * NANOSECONDS + int(nanoseconds)

    def count(self, what: str, least_size: int) -> int:
        """Read the number of elements that follow, each of at least `least_size` bytes."""
        count = int(self._unpack("I", 4, 4, what)[0])
        if count * least_size > self.left:
            raise MessageError(
                f"{what}: {count} elements at {self.place} do not fit into the {self.left} bytes "
                "left"
            )
        return count

    def text(self, what: str) -> str:
        """Read a string."""
        size = self.count(what, 1)
        at = self.skip(size, what)
        raw = bytes(self._data[at : self.place])
        if raw and raw[-1]:
            raise MessageError(f"{what}: the text at {at} does not end in a zero byte")
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError as error:
            raise MessageError(f"{what}: the text at {at} is not UTF-8: {error}") from error

    def doubles(self, what: str) -> tuple[float, ...]:
        """Read a sequence of float64."""
        count = self.count(what, 0)
        return self._unpack(f"{count}d", 8, 8 * count, what) if count else ()

    def _unpack(self, kinds: str, alignment: int, size: int, what: str) -> tuple[Any, ...]:
        self.place += -(self.place - HEADER) % alignment
        return struct.unpack_from(f"<{kinds}", self._data, self.skip(size, what))


def encode_text(text: str) -> bytes:
    """Return the message of a std_msgs/String."""
    raw = text.encode() + b"\0"
    return struct.pack(f"<4sI{len(raw)}s", LITTLE, len(raw), raw)


class MessageSeries(NamedTuple):
    """A topic's messages of one size, n of them.

    Times are in ns since the epoch, shape (n,); `data` is in CDR, shape (n, size).
    """

    topic: str
    type: str
    log_times: NDArray[np.int64]
    publish_times: NDArray[np.int64]
    data: NDArray[np.uint8]


TICK_LOG = "std_msgs/msg/Int64MultiArray"
"""Type of the tick log's messages."""

_LABEL = b"stamp [ns], tick since the restart, estimated, CRC-32 of each measurement\0"
_LABEL += bytes(-len(_LABEL) % 4)
# CDR header, one dimension with label, size and stride, an offset of 0, and the number of values.
# The values are aligned to 8 bytes, counted from the end of the CDR header.
_FRONT = struct.Struct(f"<4sII{len(_LABEL)}sIIII")
_BEGIN = _FRONT.size + -(_FRONT.size - HEADER) % 8
_FIXED = 3


def _tick_front(count: int) -> bytes:
    return _FRONT.pack(LITTLE, 1, len(_LABEL), _LABEL, count, count, 0, count).ljust(_BEGIN, b"\0")


def encode_tick(stamp: int, number: int, estimated: bool, messages: Iterable[bytes]) -> bytes:
    """Return the message of a tick, with the measurement messages that it took."""
    values = [stamp, number, estimated, *map(crc32, messages)]
    return _tick_front(len(values)) + struct.pack(f"<{len(values)}q", *values)


def encode_ticks(values: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return messages as bytes, shape (n, size), from values as `decode_ticks` returns them."""
    front = np.frombuffer(_tick_front(values.shape[1]), np.uint8)
    return np.hstack([np.tile(front, (len(values), 1)), values.astype("<i8").view(np.uint8)])


def decode_ticks(messages: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the values of messages of one size, given as bytes of shape (n, size).

    Each row has the stamp, number, whether estimated, and the checksums; shape (n, 3 + count).

    Raises:
        MessageError: The messages are not those of a tick log.
    """
    count, rest = divmod(messages.shape[1] - _BEGIN, 8)
    front = np.frombuffer(_tick_front(max(0, count)), np.uint8)
    if count < _FIXED or rest or (messages[:, :_BEGIN] != front).any():
        raise MessageError("expected messages of a tick log, got others of their type")
    return np.ascontiguousarray(messages[:, _BEGIN:]).view("<i8").astype(np.int64, copy=False)
