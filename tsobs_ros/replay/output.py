# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A new bag of estimates: the recorded topics that belong with them, copied, and what is made.

Recorded chunks are copied as they are. Where that cannot be, messages are copied one by one.
"""

from collections.abc import Iterable, Iterator
from operator import itemgetter

from tsobs_ros.bag.copying import ChunkCopy
from tsobs_ros.bag.message_series import Message, MessageSeries
from tsobs_ros.bag.reader import BagMessage
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.errors import BagReadError
from tsobs_ros.replay.source import Source

_log_time = itemgetter(3)


class EstimateBag:
    """Writes recorded messages and new ones, of equal log times the recorded ones first.

    Args:
        source: The recording.
        writer: The new bag, without topics.
        estimates_only: Leave out what is recorded.

    Raises:
        BagWriteError: The bag cannot be written.
    """

    def __init__(self, source: Source, writer: BagWriter, *, estimates_only: bool) -> None:
        self._source, self._writer = source, writer
        self._waiting: list[MessageSeries] = []
        self._chunks: ChunkCopy | None = None
        self._recorded: Iterator[BagMessage] = iter(())
        self._next: BagMessage | None = None
        if estimates_only:
            return
        self._chunks = source.chunks()
        if self._chunks is None:
            self._recorded = source.messages()
            self._next = next(self._recorded, None)
        for one in source.topics:
            ids = None if self._chunks is None else self._chunks.ids(one.name)
            writer.add_topic(
                one.name, one.type, one.qos_profiles, definition=one.definition, ids=ids
            )

    def write(self, made: Iterable[MessageSeries], horizon: float) -> None:
        """Write all messages before a log time, of a chunk those behind it too.

        Args:
            made: New messages; those from then on are written later.
            horizon: The log time [ns]; no new message will come before it.

        Raises:
            BagWriteError: The bag cannot be written.
        """
        known = [*self._waiting, *made]
        due = [one.take(one.log_times < horizon) for one in known]
        rest = (one.take(one.log_times >= horizon) for one in known)
        self._waiting = [one for one in rest if len(one.log_times)]
        if recorded := self._messages(horizon):
            new = (message for one in due for message in one.messages())
            self._writer.write_all(sorted([*recorded, *new], key=_log_time))
            return
        if self._chunks is not None:
            try:
                self._chunks.up_to(horizon, self._writer)
            except BagReadError as error:
                self._source.damage, self._chunks = error, None
        self._writer.write_series(due)

    def _messages(self, horizon: float) -> list[Message]:
        found: list[Message] = []
        while self._next is not None and self._next.log_time < horizon:
            found.append(self._next)
            self._next = next(self._recorded, None)
        return found
