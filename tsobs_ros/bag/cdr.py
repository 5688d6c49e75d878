# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Reading a message's CDR bytes step by step, with every step inside their bounds."""

import re
import struct
from collections.abc import Mapping
from typing import Literal, TypeAlias

from tsobs_ros.errors import MessageError

HEADER = 4
"""Bytes before the body, from whose end alignment counts."""

ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}
"""Byte order, as `struct` writes it, by the first half of the header."""

_SEPARATOR = re.compile(r"^={80}\n", re.MULTILINE)
_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?:<=)?(?P<size>\d*)\])?\s+"
    r"[A-Za-z]\w*\s*(?P<constant>=)?",
    re.ASCII,
)
SIZES: Mapping[str, int] = {"bool": 1, "byte": 1, "char": 1, "float32": 4, "float64": 8} | {
    f"{sign}int{bits}": bits // 8 for sign in ("", "u") for bits in (8, 16, 32, 64)
}
"""Bytes of each primitive type but strings."""


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


def encode_text(text: str) -> bytes:
    """Return the message of a std_msgs/String."""
    raw = text.encode() + b"\0"
    return struct.pack(f"<4sI{len(raw)}s", b"\x00\x01\x00\x00", len(raw), raw)


class UnknownLayoutError(ValueError):
    """A definition that is well formed, but whose messages cannot be measured."""


_Fields: TypeAlias = "list[tuple[int | _Fields | None, int]]"
"""Size of a primitive, a type, or None for a string; and the number of them, 0 for a sequence."""


class MessageLayout:
    """The layout of a type's messages.

    Args:
        type: The type, `package/msg/Type`.
        text: Its definition with all it depends on, in `ros2msg`.

    Raises:
        UnknownLayoutError: The type has wide strings, which middlewares encode differently.
        ValueError: The definition is malformed, or a type it uses is missing.
    """

    def __init__(self, type: str, text: str) -> None:
        root, *others = _SEPARATOR.split(text)
        self._texts = {_short(type): root}
        for other in others:
            head, _, body = other.partition("\n")
            if not head.startswith("MSG: "):
                raise ValueError(f"'{head[:60]}' is not 'MSG: package/Type'")
            self._texts.setdefault(_short(head[5:].strip()), body)
        self._types: dict[str, _Fields] = {}
        try:
            self._fields = self._fields_of(_short(type), ())
        except RecursionError as error:
            raise ValueError(f"{type} is nested too deep") from error

    def check(self, data: bytes) -> None:
        """Check that a message has the length its values give it, but for padding to 4 bytes.

        Raises:
            MessageError: It is too short or too long, or not plain CDR.
        """
        order = ORDERS.get(data[:2])
        if order is None or len(data) < HEADER:
            raise MessageError(f"{len(data)} bytes that do not begin with the header of plain CDR")
        try:
            end = _walk(self._fields, data, HEADER, "big" if order == ">" else "little")
        except RecursionError as error:
            raise MessageError("nested too deep") from error
        if end > len(data):
            raise MessageError(f"its values need {end} bytes, but it has {len(data)}")
        if len(data) - end >= 4:
            raise MessageError(f"{len(data) - end} bytes follow its last value")

    def _fields_of(self, name: str, within: tuple[str, ...]) -> _Fields:
        if known := self._types.get(name):
            return known
        if name in within or name not in self._texts:
            reason = "contains itself" if name in within else "is used, but not defined"
            raise ValueError(f"{name} {reason}")
        found: _Fields = []
        for line in map(str.strip, self._texts[name].splitlines()):
            if not line or line.startswith("#"):
                continue
            match = _FIELD.match(line)
            if match is None or match["size"] == "0":
                raise ValueError(f"{name}: '{line[:60]}' is not a field")
            if match["constant"]:
                continue
            kind, array = match["type"], match["array"]
            count = 0 if array else 1
            if array and match["size"] and "<=" not in array:
                count = int(match["size"])
            if kind in ("wstring", "wchar"):
                raise UnknownLayoutError(f"{name} has a {kind}")
            if kind == "string" or kind in SIZES:
                found.append((SIZES.get(kind), count))
                continue
            full = kind if "/" in kind else f"{name.partition('/')[0]}/{kind}"
            inner = self._fields_of(_short(full), (*within, name))
            # A definition of three hundred types, each of one other, must not take as many steps.
            found.append(inner[0] if count == len(inner) == 1 else (inner, count))
        # A struct without fields has one byte, as C has no empty ones.
        self._types[name] = found or [(1, 1)]
        return self._types[name]


def _short(name: str) -> str:
    """Return `package/Type`, as definitions write it."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}"


def _walk(fields: _Fields, data: bytes, place: int, order: Literal["big", "little"]) -> int:
    """Return where values end that begin at a place; beyond the message it gives up."""
    size = len(data)
    for kind, number in fields:
        count = number
        if not number:
            place += -(place - HEADER) % 4 + 4
            count = int.from_bytes(data[place - 4 : place], order) if place <= size else 0
        if type(kind) is int:
            if count:
                place += -(place - HEADER) % kind + count * kind
        else:
            for _ in range(count):
                if isinstance(kind, list):
                    place = _walk(kind, data, place, order)
                else:
                    place += -(place - HEADER) % 4 + 4
                    if place <= size and (text := int.from_bytes(data[place - 4 : place], order)):
                        place += text
                        if place <= size and data[place - 1]:
                            raise MessageError(
                                f"the text up to byte {place} has no zero at its end"
                            )
                if place > size:  # a hostile count must not keep us busy
                    break
        if place > size:  # a definition can ask for 2^60 parts in 60 lines
            break
    return place
