# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a playback reads: the wanted part of a bag, pass after pass, ahead of its time."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from operator import attrgetter
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import Generic, Self, TypeVar

from tsobs_ros.bag.reader import BagMessage, BagReader

T = TypeVar("T")

# So many batches wait to be played; more would only mean more switching between threads.
_BATCHES = 8
_STOP_CHECK = 0.1
# A message, its times and its place in a batch, besides its data.
_MESSAGE_OVERHEAD = 300


class BagSource:
    """Part of a bag, with what is latched where reading begins, for `Playback`.

    Args:
        reader: The bag.
        topics: Which topics to read.
        latched: How many messages of each latched topic from before the beginning come first.
        start: The log time at which a pass begins [ns].
        end: The log time at which a pass ends; messages of that time are still read [ns].
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
        """Read from a log time to the end, which is a None, then from the start if `again`.

        What was being read is given up.

        Args:
            time: Where to begin [ns].
            again: Whether to read one pass after the other, without end.

        Returns:
            The messages in order of log time, those latched there first. Getting them may raise a
            BagReadError.
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
            yield from self._latched_at(time)
            yield from self._reader.messages(self._topics, time, self._end + 1)
            yield None
            if not again:
                return
            time = self._start

    def _latched_at(self, time: int) -> list[BagMessage]:
        found = [
            message
            for topic, depth in self._latched.items()
            for message in self._reader.last_before(time, [topic], depth)
        ]
        return sorted(found, key=attrgetter("log_time"))


class ReadAhead(Generic[T]):
    """An iterator over what a thread of its own reads ahead from another one.

    Args:
        items: What to iterate over; only the thread touches it. What it raises is raised here
            once all before it has been taken.
        size_of: The size of an item [bytes].
        limit: How much may wait to be taken [bytes]; a single item may be larger.
    """

    def __init__(self, items: Iterable[T], size_of: Callable[[T], int], limit: int) -> None:
        self._items = items
        self._size_of = size_of
        # One more batch is being filled, and one being taken.
        self._batch_limit = limit // (_BATCHES + 2)
        self._batches: Queue[list[T] | Exception | None] = Queue(_BATCHES)
        self._batch: Iterator[T] = iter(())
        self._stopping = Event()
        self._thread = Thread(target=self._run, name="read ahead", daemon=True)
        self._thread.start()

    def __iter__(self) -> Self:
        """Return the iterator itself."""
        return self

    def __next__(self) -> T:
        """Return the next item; wait for it if it has not been read yet."""
        for item in self._batch:
            return item
        batch = None if self._stopping.is_set() else self._batches.get()
        if isinstance(batch, list):
            self._batch = iter(batch)
            return next(self._batch)
        self._stopping.set()
        if batch is None:
            raise StopIteration
        raise batch

    def close(self) -> None:
        """Stop reading and wait for the thread; safe to call twice."""
        self._stopping.set()
        with suppress(Empty):
            self._batches.get_nowait()  # the thread may be waiting for room
        self._thread.join()
        self._batch = iter(())

    def _run(self) -> None:
        try:
            for batch in self._in_batches():
                if not self._put(batch):
                    return
            self._put(None)
        except Exception as error:  # of any kind: whoever waits for the next item must hear of it
            self._put(error)

    def _in_batches(self) -> Iterator[list[T]]:
        # The first batches are small, so that playing can begin soon.
        batch: list[T] = []
        size, limit = 0, min(1, self._batch_limit)
        try:
            for item in self._items:
                batch.append(item)
                size += self._size_of(item)
                if size >= limit:
                    yield batch
                    batch, size, limit = [], 0, min(4 * limit + 1, self._batch_limit)
        except Exception:
            if batch:
                yield batch
            raise
        if batch:
            yield batch

    def _put(self, batch: list[T] | Exception | None) -> bool:
        """Wait until there is room for a batch; return whether it is still wanted."""
        while not self._stopping.is_set():
            try:
                self._batches.put(batch, timeout=_STOP_CHECK)
            except Full:
                continue
            return True
        return False


def _size(message: BagMessage | None) -> int:
    return _MESSAGE_OVERHEAD + (0 if message is None else len(message.data))
