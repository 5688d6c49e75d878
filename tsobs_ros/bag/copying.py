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


def add_topics(reader: BagReader, writer: BagWriter, topics: Collection[str]) -> None:
    """Register topics of a bag in a new one, with the numbers they have in the first file."""
    each = [one for summary in reader.summaries for one in summary.channels.values()]
    for name in topics:
        topic, channel = reader.topics[name], next(one for one in each if one.topic == name)
        writer.add_topic(
            name,
            topic.type,
            topic.qos_profiles,
            definition=topic.definition,
            ids=(channel.id, channel.schema_id),
        )


def copy_chunks(reader: BagReader, writer: BagWriter, topics: Collection[str]) -> None:
    """Copy what the chunks of a bag have of some topics, in the order of its files.

    Raises:
        BagReadError: A chunk is damaged; those in front of it are copied.
    """
    for summary in reader.summaries:
        wanted = {id_: one.topic for id_, one in summary.channels.items() if one.topic in topics}
        for span in sorted(summary.spans, key=lambda span: span.offset):
            if span.channels is None or span.channels & wanted.keys():
                writer.copy(*reader.read(span), wanted)
