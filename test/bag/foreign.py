# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files as other recorders write them: by the library `mcap`, with any content and settings."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from tsobs_ros.bag.container import MAGIC, RECORD

STRING = "std_msgs/msg/String"
SCHEMA = (STRING, "ros2msg", b"string data\n")
CHANNEL = ("/a", "cdr", 1, {})


class Entry(NamedTuple):
    """A message of a bag."""

    topic: str
    data: bytes
    log_time: int
    publish_time: int


def cdr(text: str) -> bytes:
    """Return a message of the type `STRING`."""
    return b"\0\1\0\0" + (len(text) + 1).to_bytes(4, "little") + text.encode() + b"\0"


def places(data: bytes, opcode: Opcode) -> list[tuple[int, int]]:
    """Return where the records of a kind start and end."""
    found, at = [], len(MAGIC)
    while at < len(data) - len(MAGIC):
        kind, length = RECORD.unpack_from(data, at)
        if kind == opcode:
            found.append((at, at + RECORD.size + length))
        at += RECORD.size + length
    return found


Call = tuple[int, int, bytes, int]
"""Channel, log time, data and publish time of a message."""


def write_mcap(
    path: Path,
    messages: Iterable[Call] = (),
    *,
    profile: str = "ros2",
    schemas: Iterable[tuple[str, str, bytes]] = (SCHEMA,),
    channels: Iterable[tuple[str, str, int, dict[str, str]]] = (CHANNEL,),
    compression: CompressionType = CompressionType.NONE,
    attachment: bool = False,
    **options: Any,
) -> Path:
    """Write a file, whose schemas and channels have the numbers 1, 2 …"""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, **options)
        writer.start(profile=profile)
        for schema in schemas:
            writer.register_schema(*schema)
        for channel in channels:
            writer.register_channel(*channel)
        if attachment:
            writer.add_attachment(1, 1, "a", "b", b"c")
        for message in messages:
            writer.add_message(*message)
        writer.finish()
    return path
