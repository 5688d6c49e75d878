# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a damaged MCAP file still tells about its topics and itself."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Header, Metadata, Schema, Statistics

from tsobs_ros.bag.mcap.records import FRAME, RecordError, parse
from tsobs_ros.bag.metadata import BagMetadata
from tsobs_ros.bag.recovery.pieces import Content, Found, Piece
from tsobs_ros.bag.recovery.scan import Scan


class Survey:
    """What one pass over a file finds out.

    Attributes:
        path: The file.
        size: How much of it was read, bytes.
        profile: The profile its header states; None if the header is lost.
        library: The library that wrote it, as its header states.
        schemas: Its schemas by id.
        channels: Its channels by id.
        statistics: What it states about itself at its end; None if that is lost.
        metadata: The bag's metadata in its newest record of that; None if there is none.
        is_finished: Whether its end was found.
    """

    def __init__(self, path: Path, size: int) -> None:
        self.path = path
        self.size = size
        self.profile: str | None = None
        self.library = ""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.statistics: Statistics | None = None
        self.metadata: BagMetadata | None = None
        self.is_finished = False

    def take(self, piece: Piece) -> None:
        """Learn from a piece of the file."""
        if isinstance(piece, Content):
            self._take_records(piece.records)
        elif isinstance(piece, Found):
            self._take_record(piece.record)

    def _take_records(self, records: bytes) -> None:
        at = 0
        while at < len(records):
            opcode, size = FRAME.unpack_from(records, at)
            body, at = at + FRAME.size, at + FRAME.size + size
            if opcode != Opcode.MESSAGE:
                with suppress(RecordError):
                    self._take_record(parse(opcode, records[body:at]))

    def _take_record(self, record: object) -> None:
        # Of two records with one id the first is kept: chunks, which have checksums, come first.
        match record:
            case Header():
                self.profile, self.library = record.profile, record.library
            case Schema():
                self.schemas.setdefault(record.id, record)
            case Channel():
                self.channels.setdefault(record.id, record)
            case Statistics() if record.message_count == sum(
                record.channel_message_counts.values()
            ):
                self.statistics = record
            case Footer():
                self.is_finished = True
            case Metadata(name="rosbag2"):
                with suppress(ValueError):
                    text = record.metadata.get("serialized_metadata", "")
                    self.metadata = BagMetadata.from_yaml(text)


def survey(path: Path, progress: Callable[[int], object] = lambda _: None) -> Survey:
    """Return what a file tells; it is read once, from its beginning to its end.

    Args:
        path: The file.
        progress: Called with the number of bytes that were got through since the last call.

    Raises:
        OSError: It cannot be read.
    """
    with path.open("rb") as stream:
        found = Survey(path, stream.seek(0, 2))
        for piece in Scan(stream, found.size, progress).pieces():
            found.take(piece)
    return found
