# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of many spans in order of log time, with no more spans in memory than overlap."""

from bisect import bisect_left
from collections.abc import Callable, Collection, Iterable, Iterator
from itertools import chain, pairwise
from operator import attrgetter
from typing import TypeAlias

from tsobs_ros.bag.mcap.index import Span
from tsobs_ros.bag.mcap.messages import LOG_TIME, BagMessage

Load: TypeAlias = Callable[[Span], list[BagMessage]]
"""Gives those messages of a span that are wanted, in order of log time."""


class _Run:
    """A span's messages, of which those before `position` have been given away."""

    __slots__ = ("messages", "place", "position")

    def __init__(self, span: Span, messages: list[BagMessage]) -> None:
        self.place = (span.rank, span.frame.start)
        self.messages = messages
        self.position = 0

    def take_before(self, time: int | None) -> list[BagMessage]:
        """Give away what comes before a log time; everything without one."""
        first, size = self.position, len(self.messages)
        last = size if time is None else bisect_left(self.messages, time, first, key=LOG_TIME)
        self.position = last
        return self.messages if (first, last) == (0, size) else self.messages[first:last]

    @property
    def is_empty(self) -> bool:
        """Whether all has been given away."""
        return self.position == len(self.messages)


def in_log_order(spans: Iterable[Span], load: Load) -> Iterator[BagMessage]:
    """Yield the messages of spans in order of log time; equal ones in order of recording.

    Args:
        spans: In any order; each is loaded when its first message may be due.
        load: Gives a span's messages.
    """
    ordered = sorted(spans, key=lambda span: (span.start, span.rank, span.frame.start))
    runs: list[_Run] = []
    for span, following in pairwise(chain[Span | None](ordered, (None,))):
        assert span is not None
        runs.append(_Run(span, load(span)))
        runs.sort(key=attrgetter("place"))
        due = [run.take_before(following.start if following else None) for run in runs]
        # Sorting is stable, and cheap for what is in order already.
        yield from due[0] if len(due) == 1 else sorted(chain.from_iterable(due), key=LOG_TIME)
        runs = [run for run in runs if not run.is_empty]


def last_of_each(
    spans: Iterable[Span],
    load: Load,
    topics_of: Callable[[Span], Collection[str]],
    depth: int,
) -> list[BagMessage]:
    """Return the last messages of each topic, in order of log time.

    Args:
        spans: Where to look; each is loaded only if it can matter.
        load: Gives a span's messages.
        topics_of: Gives the topics that a span may have messages of.
        depth: How many messages of a topic at most.
    """
    last: dict[str, list[BagMessage]] = {}

    def matters(span: Span, topic: str) -> bool:
        known = last.get(topic, [])
        return len(known) < depth or known[0].log_time < span.end

    for span in sorted(spans, key=lambda span: (span.end, span.rank, span.frame.start))[::-1]:
        if any(matters(span, topic) for topic in topics_of(span)):
            earlier: dict[str, list[BagMessage]] = {}
            for message in load(span):
                earlier.setdefault(message.topic, []).append(message)
            for topic, messages in earlier.items():
                both = sorted(messages[-depth:] + last.get(topic, []), key=LOG_TIME)
                last[topic] = both[-depth:]
    return sorted(chain.from_iterable(last.values()), key=LOG_TIME)
