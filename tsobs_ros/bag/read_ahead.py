# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The messages a playback needs, read ahead of their time in another thread."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter
from typing import Generic, Self, TypeVar

from tsobs_ros.bag.reader import BagMessage, BagReader

T = TypeVar("T")

# The memory of a message beyond its data [bytes].
_OVERHEAD = 300


class BagSource:
    """Part of a bag, with what is latched where reading starts, for `Playback`.

    Args:
        reader: The bag.
        topics: The topics to read.
        latched: How many messages of each latched topic from before the start come first.
        start: Log time at which a pass starts [ns].
        end: Log time at which a pass ends; messages of that time are still read [ns].
        read_ahead: How much to read ahead [bytes].
    """

    def __init__(
        self,
        reader: BagReader,
        topics: Collection[str],
        latched: Mapping[str, int],
        start: int,
        end: int,
        read_ahead: int,
    ) -> None:
        self._reader = reader
        self._topics = topics
        self._latched = latched
        self._start, self._end = start, end
        self._read_ahead = read_ahead
        self._ahead: ReadAhead[BagMessage | None] | None = None

    def read(self, time: int, again: bool) -> Iterator[BagMessage | None]:
        """Read from a log time to the end, and give up what was being read.

        Args:
            time: Where to start [ns].
            again: Whether to go on with pass after pass from the start, without end.

        Returns:
            The messages in order of log time, those latched there first, and None at the end of
            each pass. The iterator raises a BagReadError where the bag is damaged.
        """
        self.close()
        self._ahead = ReadAhead(self._passes(time, again), _size, self._read_ahead)
        return self._ahead

    def close(self) -> None:
        """Stop reading; safe to call twice."""
        if self._ahead is not None:
            self._ahead.close()
            self._ahead = None

    def _passes(self, time: int, again: bool) -> Iterator[BagMessage | None]:
        while True:
            latched = [
                message
                for topic, depth in self._latched.items()
                for message in self._reader.last_before(time, [topic], depth)
            ]
            yield from sorted(latched, key=attrgetter("log_time"))
            yield from self._reader.messages(self._topics, time, self._end + 1)
            yield None
            if not again:
                return
            time = self._start


class ReadAhead(Generic[T]):
    """An iterator over items of another one, which a thread reads a batch ahead.

    Args:
        items: What to iterate over; only the thread touches it. An error it raises is raised here
            once all items before it have been taken.
        size_of: The size of an item [bytes].
        limit: How much may be read and not taken [bytes]; a single item may be larger.
    """

    def __init__(self, items: Iterable[T], size_of: Callable[[T], int], limit: int) -> None:
        self._items = iter(items)
        self._size_of = size_of
        self._max_batch = limit // 2
        self._batch_size = 1  # grows: the first batches are small, so that playing can start soon
        self._error: Exception | None = None
        self._batch: Iterator[T] = iter(())
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="read ahead")
        self._closed = False
        self._next_batch = self._thread.submit(self._read_batch)

    def __iter__(self) -> Self:
        """Return the iterator itself."""
        return self

    def __next__(self) -> T:
        """Return the next item; wait for it if it has not been read yet."""
        for item in self._batch:
            return item
        if self._closed or not (batch := self._next_batch.result()):
            raise StopIteration
        self._next_batch = self._thread.submit(self._read_batch)
        self._batch = iter(batch)
        return next(self._batch)

    def close(self) -> None:
        """Stop reading and wait for the thread; safe to call twice."""
        self._closed = True
        self._thread.shutdown()
        self._batch = iter(())

    def _read_batch(self) -> list[T]:
        """Read items of a size; none at the end, and at an error those before it."""
        if self._error is not None:
            raise self._error
        batch: list[T] = []
        size = 0
        try:
            for item in self._items:
                batch.append(item)
                size += self._size_of(item)
                if size >= self._batch_size or self._closed:
                    break
        except Exception as error:
            if not batch:
                raise
            self._error = error
        self._batch_size = min(4 * self._batch_size, self._max_batch)
        return batch


def _size(message: BagMessage | None) -> int:
    return _OVERHEAD + (0 if message is None else len(message.data))
