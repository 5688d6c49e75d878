# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The longest time between two messages of a topic, from the indexes of a bag's files alone."""

from collections.abc import Sequence
from itertools import chain, groupby
from operator import attrgetter
from typing import IO

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from tsobs_ros.bag.mcap.index import FileIndex
from tsobs_ros.bag.mcap.records import INDEX_ENTRY, INDEX_HEAD, RecordError, read_body, read_frame
from tsobs_ros.errors import BagReadError


class _Gap:
    """The largest gap so far; the times that later chunks may still fall between are kept."""

    def __init__(self) -> None:
        self.largest = 0
        self._open: NDArray[np.uint64] = np.empty(0, np.uint64)

    def add(self, times: NDArray[np.uint64], start: int) -> None:
        """Take a chunk's times, in any order; no later chunk begins before this one's start."""
        self._open = np.sort(np.concatenate((self._open, times)))
        settled = int(np.searchsorted(self._open, np.uint64(start), side="right"))
        self._measure(max(1, settled))

    def finish(self) -> int:
        """Return the largest gap of all."""
        self._measure(self._open.size)
        return self.largest

    def _measure(self, end: int) -> None:
        if end > 1:
            self.largest = max(self.largest, int(np.diff(self._open[:end]).max()))
        self._open = self._open[end - 1 :]


def largest_gaps(indexes: Sequence[FileIndex]) -> dict[str, int]:
    """Return the longest time between two messages of each topic, ns; 0 where there is only one.

    Topics of files without message indexes are left out.

    Args:
        indexes: The indexes of the bag's files.

    Raises:
        BagReadError: An index is damaged.
    """
    gaps: dict[str, _Gap] = {}
    unknown: set[str] = set()
    topics_of = [{id_: channel.topic for id_, channel in i.channels.items()} for i in indexes]
    spans = sorted(chain.from_iterable(i.spans for i in indexes), key=attrgetter("start"))
    # Files seldom overlap, so each is opened about once, and only one is open at a time.
    for rank, group in groupby(spans, key=attrgetter("rank")):
        path, topics = indexes[rank].path, topics_of[rank]
        try:
            with path.open("rb") as stream:
                size = stream.seek(0, 2)
                for span in group:
                    if not span.indexes:
                        unknown.update(topics.values())
                    for channel, offset in span.indexes.items():
                        times = _read_times(stream, offset, size)
                        if channel in topics and times.size:
                            gaps.setdefault(topics[channel], _Gap()).add(times, span.start)
        except (OSError, RecordError) as error:
            raise BagReadError(f"{path}: {error}") from error
    return {topic: gap.finish() for topic, gap in gaps.items() if topic not in unknown}


def _read_times(stream: IO[bytes], offset: int, size: int) -> NDArray[np.uint64]:
    """Return the log times in a message index, in its order.

    Raises:
        RecordError: There is no message index.
    """
    frame = read_frame(stream, offset, size)
    body = read_body(stream, frame)
    if frame.opcode != Opcode.MESSAGE_INDEX or (len(body) - INDEX_HEAD.size) % INDEX_ENTRY.size:
        raise RecordError(f"the index states a message index at byte {offset}, but there is none")
    return np.frombuffer(body, "<u8", offset=INDEX_HEAD.size)[::2]
