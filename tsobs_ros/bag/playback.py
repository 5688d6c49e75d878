# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Playback of a bag: a schedule that reads no clock, and messages that a thread reads ahead.

Bag time is the log time of messages; steady time is that of a clock that is never set. Both are in
ns. Every deadline is computed from the last change of pace, so that errors do not add up. Events
are returned in the order of their deadlines, however late the caller asks for them.
"""

from collections.abc import Collection, Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from operator import attrgetter
from typing import NamedTuple

from tsobs_ros.bag.reader import BagMessage, BagReader
from tsobs_ros.bag.timeline import NEVER, Ticks, Timeline

# A player that is late by more continues from there instead of catching up in one burst.
MAX_LAG = 1_000_000_000
# The shortest pass: a loop over a single message would otherwise publish it nonstop.
MIN_PASS = 10_000_000
# The memory of a message beyond its data [bytes].
_OVERHEAD = 300


class Event(NamedTuple):
    """A message, or None for a clock stamp; the steady and bag time at which it was due [ns]."""

    due: int
    time: int
    message: BagMessage | None


class Playback:
    """Returns the messages of a bag, and the clock's stamps, when they are due.

    It is paused at first, as reading the first message may take a while. The first clock stamp and
    the latched messages from before the start are due at once. `take` and `position` may block, and
    may raise the errors of reading a bag.

    Args:
        start: Bag time at which each pass starts [ns].
        end: Bag time at which a pass ends [ns].
        clock_rate: Clock stamps per second of steady time, also in a pause; 0: none.

    Attributes:
        loop: Whether to start again at the end; may be changed at any time.
        ended: Whether the end was reached without a loop.
        held_back: Total delay of the end [ns] because the caller came later than `MAX_LAG`.
    """

    def __init__(
        self,
        messages: Iterator[BagMessage | None],
        start: int,
        end: int,
        now: int,
        *,
        rate: float = 1.0,
        clock_rate: float = 0.0,
        loop: bool = False,
    ) -> None:
        self.loop = loop
        self.ended, self.held_back = False, 0
        self._start, self._end = start, end
        self._timeline = Timeline(start, rate)
        self._ticks = Ticks(clock_rate)
        self._messages = messages
        self._next: BagMessage | None = None
        self._is_read, self._began = False, now
        self._start_pass(now)

    @property
    def paused(self) -> bool:
        """Whether bag time stands still."""
        return self._timeline.paused

    def position(self, now: int) -> int:
        """Return the bag time [ns]; it never passes a message that has not been taken."""
        return min(self._timeline.at(now), self._next_time())

    def pause(self, now: int) -> None:
        """Stop bag time."""
        self._timeline.anchor(self.position(now), now)
        self._timeline.paused = True

    def resume(self, now: int) -> None:
        """Let bag time run on from where it is; events that fell due in the pause are due now."""
        if self.paused:
            self._began = max(self._began, now)
            if self._ticks.due < now:
                self._ticks.start(now)
            self._timeline.anchor(self.position(now), now)
            self._timeline.paused = False

    def set_rate(self, rate: float, now: int) -> None:
        """Let bag time run at another rate from now on."""
        self._timeline.anchor(self.position(now), now, rate)

    def take(self, now: int) -> Event | None:
        """Return the next event and move on to the one after; None if it is not due yet."""
        due = min(self._ticks.due, self._message_due())
        if due > now:
            return None
        if (lag := now - due) > MAX_LAG:
            self.held_back += 0 if self.paused else lag
            self._began += lag
            self._timeline.shift(lag)
            self._ticks.shift(lag)
            due = now
        if self._ticks.due == due:
            return Event(self._ticks.take(), min(self._timeline.at(due), self._next_time()), None)
        if (message := self._peek()) is not None:
            self._is_read = False
            return Event(due, max(message.log_time, self._start), message)
        if not self.loop:
            self._timeline.anchor(self._end, due)
            self._timeline.paused = self.ended = True
            return None
        self._is_read = False
        self._start_pass(due)
        return self.take(now)

    def wait(self, now: int) -> int:
        """Return the time until the next event is due [ns]; it is huge if no event follows."""
        return max(0, min(self._ticks.due, self._message_due()) - now)

    def _peek(self) -> BagMessage | None:
        """Return the next message, None at the end of a pass."""
        if not self._is_read:
            self._next = next(self._messages, None)
            self._is_read = True
        return self._next

    def _next_time(self) -> int:
        message = self._peek()
        return self._end if message is None else max(message.log_time, self._start)

    def _message_due(self) -> int:
        """Return when the next message, or else the end of the pass, is due."""
        if self.ended:
            return NEVER
        message = self._peek()
        if message is not None and message.log_time < self._start:
            return self._began
        due = self._timeline.due(self._end if message is None else message.log_time)
        return max(due, self._began + MIN_PASS) if message is None and self.loop else due

    def _start_pass(self, now: int) -> None:
        self.ended, self._began = False, now
        self._timeline.anchor(self._start, now)
        self._ticks.start(now)


def read_passes(
    reader: BagReader,
    topics: Collection[str],
    latched: Mapping[str, int],
    start: int,
    end: int,
    read_ahead: int,
) -> Generator[BagMessage | None]:
    """Read endless passes through a part of a bag; a thread reads ahead, a batch at a time.

    A pass has the last messages of each latched topic before `start` [ns], as many as `latched`
    states, then those up to `end` [ns], and None. One message may exceed `read_ahead` [bytes].

    Raises:
        BagReadError: The bag is damaged there.
    """

    def passes() -> Iterator[BagMessage | None]:
        each = (reader.last_before(start, [name], n) for name, n in latched.items())
        front = sorted(chain.from_iterable(each), key=attrgetter("log_time"))
        while True:
            yield from front
            yield from reader.messages(topics, start, end + 1)
            yield None

    batches = _batches(passes(), read_ahead // 2)
    with ThreadPoolExecutor(1, thread_name_prefix="read ahead") as thread:
        following = thread.submit(next, batches)
        while True:
            batch = following.result()
            following = thread.submit(next, batches)
            yield from batch


def _batches(
    messages: Iterator[BagMessage | None], max_size: int
) -> Iterator[list[BagMessage | None]]:
    """Yield messages in batches of about `max_size` [bytes], each from one pass."""
    batch: list[BagMessage | None] = []
    size = 0
    try:
        for message in messages:
            batch.append(message)
            size += _OVERHEAD + (0 if message is None else len(message.data))
            if message is None or size >= max_size:
                yield batch
                batch, size = [], 0
    except Exception:
        yield batch  # messages before the error are still played
        raise
