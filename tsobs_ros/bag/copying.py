# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Copying recorded topics from bag to bag, chunk by chunk.

A chunk states no place in its file, so one of which everything is wanted is copied as it is. Of
another one the records of the wanted messages are picked out, and compressed again. No message is
taken apart either way.
"""

from collections.abc import Collection

from tsobs_ros.bag.reader import BagReader
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.errors import BagReadError


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
        self.spans = [
            span
            for summary, wanted in zip(reader.summaries, self._topics, strict=True)
            for span in sorted(summary.spans, key=lambda span: span.offset)
            if span.channels is None or span.channels & wanted.keys()
        ]

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
                    self._reader.read(span)
                except BagReadError:
                    return False
        return True

    def copy(self, writer: BagWriter) -> None:
        """Copy the chunks.

        Args:
            writer: The bag to copy to, which has the topics.
        """
        for span in self.spans:
            writer.copy(*self._reader.read(span), self._topics[span.rank])
