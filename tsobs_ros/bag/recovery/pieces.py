# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a scan of a damaged MCAP file finds."""

from typing import Any, NamedTuple, TypeAlias


class Content(NamedTuple):
    """Whole records that hold messages: those of a chunk, or one message outside of any."""

    records: bytes


class Found(NamedTuple):
    """A record of another kind: as `mcap` reads it; None for kinds of no interest."""

    record: Any


class MessageCount(NamedTuple):
    """How many messages of one channel the chunk before has, as its index states."""

    messages: int


class Damage(NamedTuple):
    """Bytes that are lost.

    Attributes:
        offset: Where they begin.
        size: How many they are.
        reason: Why.
        unchecked: What a chunk whose checksum fails yields all the same, if that was asked for;
            some of it is wrong.
    """

    offset: int
    size: int
    reason: str
    unchecked: bytes = b""


Piece: TypeAlias = Content | Found | MessageCount | Damage
