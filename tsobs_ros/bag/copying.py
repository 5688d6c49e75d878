# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Copying recorded topics from bag to bag, chunk by chunk.

A chunk states no place in its file, so one of which everything is wanted is copied as it is. Of
another one the records of the wanted messages are picked out, and compressed anew. No message is
taken apart either way.
"""

from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mcap.records import Channel, Chunk, McapRecord, Schema

from tsobs_ros.bag.container import (
    MESSAGE,
    RECORD,
    RECOVER_HINT,
    RecordError,
    Span,
    chunk_records,
    read_chunk,
)
from tsobs_ros.bag.damaged_file import parse_record
from tsobs_ros.bag.file_writer import Records
from tsobs_ros.bag.message_rows import Integers, split_fields
from tsobs_ros.bag.reader import MAX_MESSAGES, TOO_MANY_MESSAGES, BagReader
from tsobs_ros.errors import BagReadError
from tsobs_ros.files import open_regular

if TYPE_CHECKING:
    from tsobs_ros.bag.writer import BagWriter

# More than a file of a robot has topics and types.
_MAX_DESCRIPTIONS = 10_000
_CHANNEL_AT = RECORD.size
_NO_CHANNEL = -1


class RecordedChunk(NamedTuple):
    """A chunk of a file.

    Attributes:
        record: Its record in the file.
        chunk: The same.
        messages: All messages in it.
        publish_times: Of these [ns], shape (n,).
    """

    record: bytes
    chunk: Chunk
    messages: Records
    publish_times: Integers

    def can_stay(
        self, ids: Mapping[int, int], channels: Mapping[int, Channel], schemas: Mapping[int, Schema]
    ) -> bool:
        """Return whether a file may have the chunk as it is.

        Args:
            ids: The file's channel of each channel that is wanted.
            channels: The file's.
            schemas: The file's.
        """
        times, chunk = self.messages.log_times, self.chunk
        if not chunk.uncompressed_crc or not len(times):
            return False
        if any(ids.get(id_) != id_ for id_ in np.unique(self.messages.channels).tolist()):
            return False
        if (chunk.message_start_time, chunk.message_end_time) != (times.min(), times.max()):
            return False
        for count, one in enumerate(self._descriptions()):
            match one:
                case Channel():
                    known: McapRecord | None = channels.get(one.id)
                case Schema():
                    known = schemas.get(one.id)
                case _:
                    known = None
            if one != known or count > _MAX_DESCRIPTIONS:
                return False
        return True

    def _descriptions(self) -> Iterator[McapRecord | None]:
        """Yield the records between the messages, None for one that cannot be read."""
        data, begins, ends = self.messages.data, self.messages.begins, self.messages.ends
        gaps = np.flatnonzero(np.append(begins, len(data)) != np.append(0, ends))
        for gap in gaps.tolist():
            at = int(ends[gap - 1]) if gap else 0
            end = int(begins[gap]) if gap < len(begins) else len(data)
            while at < end:
                _, length = RECORD.unpack_from(data.data, at)
                record = data[at : at + RECORD.size + length].tobytes()
                try:
                    yield parse_record(record)
                except RecordError:
                    yield None
                at += len(record)

    def pick(self, ids: Mapping[int, int]) -> Records:
        """Return the messages of the channels that are wanted, with the channels of another file.

        Args:
            ids: The channel there of each of them.
        """
        data, channels, log_times, begins, ends = self.messages
        new = np.full(2**16, _NO_CHANNEL)
        new[list(ids)] = list(ids.values())
        chosen = np.flatnonzero(new[channels] != _NO_CHANNEL)
        channels, begins, ends = new[channels[chosen]], begins[chosen], ends[chosen]
        edges = np.zeros(len(data) + 1, np.int8)
        edges[begins] += 1
        edges[ends] -= 1
        picked = data[np.cumsum(edges[:-1], dtype=np.int8).view(np.bool_)]
        ends = np.cumsum(ends - begins)
        begins = np.append(0, ends[:-1])[: len(ends)]
        for byte in range(2):
            picked[begins + _CHANNEL_AT + byte] = channels >> 8 * byte & 255
        return Records(picked, channels, log_times[chosen], begins, ends)


def read_recorded(reader: BagReader, span: Span) -> RecordedChunk:
    """Read a chunk of a bag.

    Raises:
        BagReadError: It is damaged, or has a message of an unknown channel.
    """
    path = reader.files[span.rank]
    try:
        with open_regular(path) as stream:
            record, chunk = read_chunk(stream, span)
        data = chunk_records(chunk)
        found = split_fields(data)
        if found is None:
            raise RecordError("its content is not whole records")
        if found.shape[1] > MAX_MESSAGES:
            raise RecordError(TOO_MANY_MESSAGES)
        channels, log_times, publish_times, begins, sizes = found
        known = reader.summaries[span.rank].channels
        if unknown := sorted(set(np.unique(channels).tolist()) - known.keys()):
            text = f"a message is of channel {unknown[0]}, which is not described"
            raise RecordError(text)
        if len(log_times):
            span.check(int(log_times.min()), int(log_times.max()))
    except (OSError, RecordError) as error:
        text = f"the file is damaged: at byte {span.offset}: {error}; {RECOVER_HINT}"
        raise BagReadError(f"{path}: {text}") from error
    each = Records(
        np.frombuffer(data, np.uint8), channels, log_times, begins - MESSAGE.size, begins + sizes
    )
    return RecordedChunk(record, chunk, each, publish_times)


class ChunkCopy:
    """The chunks of a bag that have messages of some topics, copied in the order of its files.

    Args:
        reader: The bag.
        topics: Their names.
    """

    def __init__(self, reader: BagReader, topics: Collection[str]) -> None:
        self._reader = reader
        self._topics = [
            {id_: one.topic for id_, one in summary.channels.items() if one.topic in topics}
            for summary in reader.summaries
        ]
        spans = [
            span
            for summary, wanted in zip(reader.summaries, self._topics, strict=True)
            for span in sorted(summary.spans, key=lambda span: span.offset)
            if span.channels is None or span.channels & wanted.keys()
        ]
        self.spans = spans
        # The smallest log time of a chunk and of those behind it.
        starts = np.array([span.start for span in spans], np.uint64)
        self._starts = np.minimum.accumulate(starts[::-1])[::-1].tolist()
        self._next = 0

    def ids(self, topic: str) -> tuple[int, int]:
        """Return the channel and the schema of a topic in the first file that has it."""
        each = (one for summary in self._reader.summaries for one in summary.channels.values())
        channel = next(one for one in each if one.topic == topic)
        return channel.id, channel.schema_id

    def is_sound(self, checked: str) -> bool:
        """Return whether all messages are in chunks that can be read.

        Args:
            checked: A topic all of whose messages could be read.
        """
        for span in self.spans:
            channels = self._reader.summaries[span.rank].channels
            known = {id_ for id_, channel in channels.items() if channel.topic == checked}
            if not span.is_chunk:
                return False
            if span.channels is None or not span.channels & known:
                try:
                    read_recorded(self._reader, span)
                except BagReadError:
                    return False
        return True

    def up_to(self, horizon: float, writer: "BagWriter") -> None:
        """Copy the chunks that have messages before a log time [ns], and those in front of them.

        Args:
            horizon: The log time [ns].
            writer: The bag to copy to, which has the topics.

        Raises:
            BagReadError: A chunk is damaged.
            BagWriteError: The bag cannot be written.
        """
        while self._next < len(self.spans) and self._starts[self._next] < horizon:
            span = self.spans[self._next]
            self._next += 1
            writer.copy(read_recorded(self._reader, span), self._topics[span.rank])
