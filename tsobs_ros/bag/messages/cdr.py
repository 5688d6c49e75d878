# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Reading a message's CDR bytes step by step, with every step inside their bounds."""

import struct

from tsobs_ros.errors import MessageError

HEADER = 4
"""Bytes before the body, from whose end alignment counts."""

ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}
"""Byte order, as `struct` writes it, by the first half of the header."""


class CdrReader:
    """A place in a message, which moves on as values are read.

    Args:
        data: The message with its header.

    Attributes:
        order: The byte order, as `struct` writes it.
        place: The next byte to read, counted from the beginning of the header.

    Raises:
        MessageError: The header is missing, or announces another encoding than plain CDR.
    """

    def __init__(self, data: bytes) -> None:
        if len(data) < HEADER:
            raise MessageError(f"{len(data)} bytes are too few for a CDR header")
        order = ORDERS.get(bytes(data[:2]))
        if order is None:
            raise MessageError(f"encoding 0x{bytes(data[:2]).hex()} is not plain CDR")
        self._data = data
        self.order = order
        self.place = HEADER

    @property
    def left(self) -> int:
        """How many bytes there still are."""
        return len(self._data) - self.place

    def skip(self, size: int, what: str) -> None:
        """Move on by so many bytes, which there must be."""
        if size > self.left:
            raise MessageError(
                f"{what}: expected {size} bytes at {self.place}, but the message ends after "
                f"{self.left}"
            )
        self.place += size

    def count(self, what: str, least_size: int) -> int:
        """Read how many elements of at least so many bytes follow."""
        self._align(4)
        at = self.place
        self.skip(4, what)
        count = int(struct.unpack_from(f"{self.order}I", self._data, at)[0])
        if count * least_size > self.left:
            raise MessageError(
                f"{what}: {count} elements at {self.place} do not fit into the {self.left} bytes "
                "left"
            )
        return count

    def text(self, what: str) -> str:
        """Read a string."""
        size = self.count(what, 1)
        at = self.place
        self.skip(size, what)
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
        if not count:
            return ()
        self._align(8)
        at = self.place
        self.skip(8 * count, what)
        return struct.unpack_from(f"{self.order}{count}d", self._data, at)

    def _align(self, size: int) -> None:
        self.place += -(self.place - HEADER) % size
