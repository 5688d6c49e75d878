# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Reading a message's CDR bytes step by step, with every step inside their bounds."""

import re
import struct
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeAlias

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
_SIZES: Mapping[str, int] = {"bool": 1, "byte": 1, "char": 1, "float32": 4, "float64": 8} | {
    f"{sign}int{bits}": bits // 8 for sign in ("", "u") for bits in (8, 16, 32, 64)
}

_Walk: TypeAlias = Callable[[bytes, int, str], int]
"""Returns where a value ends that begins at a place; the text is the byte order."""


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


class _Field(NamedTuple):
    type: str
    is_array: bool
    size: int
    """The number of elements of a fixed array; 0 for a sequence."""


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
        self._walks: dict[str, _Walk] = {}
        try:
            self._walk = self._struct(_short(type), ())
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
            end = self._walk(data, HEADER, "big" if order == ">" else "little")
        except RecursionError as error:
            raise MessageError("nested too deep") from error
        if end > len(data):
            raise MessageError(f"its values need {end} bytes, but it has {len(data)}")
        if len(data) - end >= 4:
            raise MessageError(f"{len(data) - end} bytes follow its last value")

    def _struct(self, name: str, within: tuple[str, ...]) -> _Walk:
        if known := self._walks.get(name):
            return known
        if name in within:
            raise ValueError(f"{name} contains itself")
        if name not in self._texts:
            raise ValueError(f"{name} is used, but not defined")
        package = name.partition("/")[0]
        walks = []
        for field in _fields(name, self._texts[name]):
            if field.type in ("wstring", "wchar"):
                raise UnknownLayoutError(f"{name} has a {field.type}")
            if element := _SIZES.get(field.type):
                walks.append(_primitive(field, element))
            elif field.type == "string":
                walks.append(_many(field, _string))
            else:
                full = field.type if "/" in field.type else f"{package}/{field.type}"
                walks.append(_many(field, self._struct(_short(full), (*within, name))))
        # A struct without fields has one byte, as C has no empty ones.
        parts = tuple(walks) or (_primitive(_Field("uint8", False, 1), 1),)

        def walk(data: bytes, place: int, order: str) -> int:
            for part in parts:
                place = part(data, place, order)
                if place > len(data):  # a definition can ask for 2^60 parts in 60 lines
                    break
            return place

        # A definition of three hundred structs, each of one other, must not take as many steps.
        self._walks[name] = walk if len(parts) > 1 else parts[0]
        return self._walks[name]


def _short(name: str) -> str:
    """Return `package/Type`, as definitions write it."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}"


def _fields(name: str, text: str) -> list[_Field]:
    fields = []
    for line in map(str.strip, text.splitlines()):
        if not line or line.startswith("#"):
            continue
        match = _FIELD.match(line)
        if match is None or match["size"] == "0":
            raise ValueError(f"{name}: '{line[:60]}' is not a field")
        if not match["constant"]:
            size = int(match["size"]) if match["size"] and "<=" not in match["array"] else 0
            fields.append(_Field(match["type"], bool(match["array"]), size))
    return fields


def _primitive(field: _Field, element: int) -> _Walk:
    if field.is_array and not field.size:

        def walk_sequence(data: bytes, place: int, order: str) -> int:
            count, place = _count(data, place, order)
            if count:
                place += -(place - HEADER) % element + count * element
            return place

        return walk_sequence

    size = element * (field.size or 1)

    def walk(_data: bytes, place: int, _order: str) -> int:
        return place + -(place - HEADER) % element + size

    return walk


def _many(field: _Field, walk: _Walk) -> _Walk:
    if not field.is_array or field.size == 1:
        return walk

    def walk_all(data: bytes, place: int, order: str) -> int:
        count = field.size
        if not count:
            count, place = _count(data, place, order)
        for _ in range(count):
            place = walk(data, place, order)
            if place > len(data):  # a hostile count must not keep us busy
                break
        return place

    return walk_all


def _string(data: bytes, place: int, order: str) -> int:
    size, place = _count(data, place, order)
    if size and place + size <= len(data) and data[place + size - 1]:
        raise MessageError(f"the text at byte {place} does not end in a zero byte")
    return place + size


def _count(data: bytes, place: int, order: str) -> tuple[int, int]:
    start = place + -(place - HEADER) % 4
    if start + 4 > len(data):
        return 0, start + 4
    return int.from_bytes(data[start : start + 4], order), start + 4  # type: ignore[arg-type]
