# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of a bag as rows of numbers, for topics of millions of messages.

A message is its place in the records of a chunk until its bytes are wanted. Chunks are split by the
compiled core, some hundred times as fast as message by message.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.container import MESSAGE, RECOVER_HINT, RecordError, split_messages
from tsobs_ros.bag.reader import (
    MAX_HELD,
    MAX_MESSAGES,
    OBJECT_SIZE,
    OVERLAPPING,
    TOO_MANY_MESSAGES,
    BagReader,
)
from tsobs_ros.core import native
from tsobs_ros.errors import BagReadError

Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]

_FIELDS = 5


class Rows(NamedTuple):
    """Messages in order.

    Attributes:
        topics: Number of the topic of each, shape (n,).
        log_times: [ns], shape (n,).
        publish_times: [ns], shape (n,).
        chunks: Key of the records that each is in, shape (n,).
        begins: First byte of its data there, shape (n,).
        sizes: Size of its data, shape (n,).
    """

    topics: Integers
    log_times: Integers
    publish_times: Integers
    chunks: Integers
    begins: Integers
    sizes: Integers

    @classmethod
    def none(cls) -> "Rows":
        """Return no messages."""
        return cls(*(np.zeros(0, np.int64) for _ in cls._fields))

    def take(self, places: NDArray[Any] | slice) -> "Rows":
        """Return some of the messages, or all of them in another order."""
        return Rows(*(column[places] for column in self))

    def followed_by(self, others: Sequence["Rows"]) -> "Rows":
        """Return these messages and others behind them."""
        return Rows(*(np.concatenate(columns) for columns in zip(self, *others, strict=True)))


def read_rows(
    reader: BagReader, topics: Sequence[str]
) -> Iterator[tuple[Rows, Mapping[int, Bytes]]]:
    """Yield the messages of some topics as `BagReader.messages` does, as rows.

    Args:
        reader: The bag.
        topics: Their names; rows have their places in it.

    Yields:
        Some of the messages, and the records that they are in by their keys.

    Raises:
        BagReadError: As for `BagReader.messages`.
    """
    number = {name: place for place, name in enumerate(topics)}
    known = [
        {id_: number.get(channel.topic, -1) for id_, channel in summary.channels.items()}
        for summary in reader.summaries
    ]
    waiting, records = Rows.none(), dict[int, Bytes]()
    for key, (span, horizon, data, is_checked) in enumerate(reader.records(topics)):
        rows = split_rows(data, key, known[span.rank])
        try:
            if rows is None or len(data) > MAX_MESSAGES * MESSAGE.size:
                _check(data, known[span.rank])
            assert rows is not None
            if len(rows.sizes):
                span.check(int(rows.log_times.min()), int(rows.log_times.max()))
        except RecordError as error:
            path = reader.files[span.rank]
            raise BagReadError(f"{path}: the file is damaged: {error}; {RECOVER_HINT}") from error
        reader.unchecked += 0 if is_checked else len(rows.sizes)
        records[key] = np.frombuffer(data, np.uint8)
        # Parts that begin at once are in the order of files and places, as messages are.
        waiting = waiting.followed_by([rows])
        waiting = waiting.take(np.argsort(waiting.log_times, kind="stable"))
        due = int(np.searchsorted(waiting.log_times, horizon))
        yield waiting.take(slice(due)), records
        waiting = waiting.take(slice(due, None))
        if int(waiting.sizes.sum()) + OBJECT_SIZE * len(waiting.sizes) > MAX_HELD:
            raise BagReadError(OVERLAPPING)
        records = {one: records[one] for one in np.unique(waiting.chunks).tolist()}


def _check(data: bytes, channels: Mapping[int, int]) -> None:
    """Raise `RecordError` if something is wrong with records, with the reason."""
    for count, (channel, *_) in enumerate(split_messages(data), 1):
        if channel not in channels:
            raise RecordError(f"a message is of channel {channel}, which is not described")
        if count > MAX_MESSAGES:
            raise RecordError(TOO_MANY_MESSAGES)


def split_rows(records: bytes, key: int, topics: Mapping[int, int]) -> Rows | None:
    """Return the messages in a run of records that are of some channels, in their order.

    Args:
        records: Whole records, one after the other, as in a decompressed chunk.
        key: Key of the records.
        topics: Number of the topic of each channel, −1 of those to leave out.

    Returns:
        The messages; None if a record is cut off, malformed or of an unknown channel.
    """
    found = split_fields(records)
    if found is None:
        return None
    channels = np.unique(found[0])
    numbers = np.array([topics.get(channel, -2) for channel in channels.tolist()], np.int64)
    if (numbers == -2).any():
        return None
    of_topic = numbers[np.searchsorted(channels, found[0])] if found.size else found[0]
    wanted = of_topic >= 0
    log_times, publish_times, begins, sizes = found[1:, wanted]
    chunks = np.full(len(log_times), key, np.int64)
    return Rows(of_topic[wanted], log_times, publish_times, chunks, begins, sizes)


def split_fields(records: bytes) -> Integers | None:
    """Return channel, log time, publish time, first byte and size of each message, shape (5, n).

    Args:
        records: As for `split_rows`.

    Returns:
        The fields; None if a record is cut off or malformed.
    """
    # Memory that nothing is written to costs nothing.
    found = np.empty((_FIELDS, len(records) // MESSAGE.size), np.int64)
    count = native.messages_split(records, found)
    return None if count < 0 else found[:, :count]


def gather(rows: Rows, records: Mapping[int, Bytes], size: int) -> Bytes:
    """Return the bytes of messages of one size, shape (n, size)."""
    gathered = np.empty((len(rows.sizes), size), np.uint8)
    edges = np.flatnonzero(np.diff(rows.chunks)) + 1
    for places in np.split(np.arange(len(gathered)), edges):
        if len(places) and size:
            own = slice(int(places[0]), int(places[-1]) + 1)
            data = records[int(rows.chunks[own.start])]
            gathered[own] = pieces(data, size)[rows.begins[own]].view(np.uint8).reshape(-1, size)
    return gathered


def pieces(data: Bytes, size: int) -> NDArray[np.void]:
    """Return the `size` bytes that begin at each place of some data, which are not copied."""
    return np.ndarray((len(data) - size + 1,), f"V{size}", data, 0, (1,))


def by_size(rows: Rows) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield the sizes of messages, and the places of those that have it."""
    for size in np.unique(rows.sizes).tolist():
        yield size, np.flatnonzero(rows.sizes == size)
