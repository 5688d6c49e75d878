# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""JointState topics of a bag as arrays: one row a message, in the order of recording."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import islice
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateDecoder, JointStates
from tsobs_ros.bag.reader import BagMessage, BagReader
from tsobs_ros.checks import Array, Flags
from tsobs_ros.errors import BagReadError

_STEP = 8192
_DATA, _LOG_TIME, _PUBLISH_TIME = map(itemgetter, (2, 3, 4))

Times = NDArray[np.int64]


Place = tuple[str, str]
"""Name of an entry, and which of its numbers: `position`, `velocity` or `effort`."""

Wanted = Sequence[Sequence[Place]]
"""What to read off a topic's messages: the places of each joint's numbers."""


@dataclass(frozen=True)
class JointSeries:
    """A topic's messages, n of them.

    Attributes:
        stamps: Of their headers, ns since the epoch, shape (n,).
        log_times: When they were received, ns since the epoch, shape (n,).
        publish_times: When they were published, ns since the epoch, shape (n,).
        values: NaN where a message has none, or a joint has fewer, shape (n, joints, places).
        named: Whether a message has any of a joint's entries, shape (n, joints).
        given: Whether it has a value, NaN or not, shape (n, joints, places).
        other_names: Entries that nobody wanted, a few of them at most.
    """

    stamps: Times
    log_times: Times
    publish_times: Times
    values: Array
    named: Flags
    given: Flags
    other_names: tuple[str, ...]

    @property
    def count(self) -> int:
        """The number of messages."""
        return len(self.stamps)

    def take(self, places: NDArray[Any] | slice) -> "JointSeries":
        """Return some of the messages, or all of them in another order."""
        taken = {name: getattr(self, name)[places] for name in _ARRAYS}
        return JointSeries(**taken, other_names=self.other_names)

    def of_joint(self, joint: int) -> "JointSeries":
        """Return what the messages have of one joint."""
        own = slice(joint, joint + 1)
        return replace(
            self, values=self.values[:, own], named=self.named[:, own], given=self.given[:, own]
        )

    def followed_by(self, *others: "JointSeries") -> "JointSeries":
        """Return these messages and those of others behind them."""
        all_ = (self, *others)
        joined = {name: np.concatenate([getattr(one, name) for one in all_]) for name in _ARRAYS}
        names = dict.fromkeys(name for one in all_ for name in one.other_names)
        return JointSeries(**joined, other_names=tuple(names)[:_MAX_OTHERS])


_ARRAYS = [field.name for field in fields(JointSeries) if field.name != "other_names"]
_MAX_OTHERS = 32


class _Builder:
    """Gathers one topic's messages and turns them into arrays, a block at a time."""

    def __init__(self, wanted: Wanted) -> None:
        self.waiting: list[BagMessage] = []
        self._wanted = wanted
        self._names = {name for places in wanted for name, _ in places}
        self._decoder = JointStateDecoder()
        self._blocks: list[JointSeries] = []
        self._others: dict[str, None] = {}

    def take(self) -> JointSeries:
        """Return what has been decoded since the last call."""
        first, *rest = self._blocks
        self._blocks = []
        return first.followed_by(*rest)

    def decode(self) -> None:
        """Decode the messages that wait."""
        block = _empty(len(self.waiting), self._wanted)
        block.log_times[:] = list(map(_LOG_TIME, self.waiting))
        block.publish_times[:] = list(map(_PUBLISH_TIME, self.waiting))
        # What is malformed names nobody, and so is no sample of anybody.
        groups, _ = self._decoder.decode_all(list(map(_DATA, self.waiting)))
        self.waiting.clear()
        for group in groups:
            self._place(group, block)
        self._blocks.append(replace(block, other_names=tuple(self._others)))

    def _place(self, group: JointStates, block: JointSeries) -> None:
        rows = group.places
        block.stamps[rows] = group.stamps
        for name in group.names:
            if name not in self._names and len(self._others) < _MAX_OTHERS:
                self._others[name] = None
        for joint, places in enumerate(self._wanted):
            for at, (name, field) in enumerate(places):
                if name not in group.names:
                    continue
                place, numbers = group.names.index(name), getattr(group, field)
                block.named[rows, joint] = True
                if place < numbers.shape[1]:
                    block.values[rows, joint, at] = numbers[:, place]
                    block.given[rows, joint, at] = True


class Block(NamedTuple):
    """A part of some topics.

    Attributes:
        series: By the topics' names.
        horizon: Log time from which on messages of the next block may be [ns]; messages of this
            one go on for a third of its length beyond. Infinite in the last block.
    """

    series: dict[str, JointSeries]
    horizon: float


def read_blocks(
    reader: BagReader,
    wanted: Mapping[str, Wanted],
    size: int | None = None,
    *,
    on_damage: Callable[[BagReadError], None] | None = None,
) -> Iterator[Block]:
    """Read some topics of a bag block by block.

    Args:
        reader: The bag.
        wanted: What to read of which topic.
        size: Number of messages in a block, of all topics, divisible by 4; None for one block.
        on_damage: Told of damage to the bag, up to which everything is returned; else it is raised.

    Raises:
        BagReadError: The bag has no such topic, a topic is of another type, or it is damaged.
    """
    for name in wanted:
        require_joint_states(reader, name)
    builders = {name: _Builder(each) for name, each in wanted.items()}
    messages = until_damage(reader.messages(list(wanted)), on_damage)
    add = {name: builder.waiting.append for name, builder in builders.items()}
    step = _STEP if size is None else min(_STEP, size // 4)
    while True:
        count, horizon = 0, math.inf
        while size is None or count < size:
            some = list(islice(messages, step if size is None else min(step, size - count)))
            for message in some:
                add[message[0]](message)
            for builder in builders.values():
                builder.decode()
            count += len(some)
            if size is not None and horizon == math.inf and 4 * count >= 3 * size:
                horizon = some[-1].log_time if some else math.inf
            if len(some) < step:
                break
        whole = size is None or count < size
        series = {name: builder.take() for name, builder in builders.items()}
        yield Block(series, math.inf if whole else horizon)
        if whole:
            return


def require_joint_states(reader: BagReader, topic: str) -> None:
    """Raise `BagReadError` unless the bag has the topic, with JointStates on it."""
    if topic not in reader.topics:
        has = ", ".join(reader.topics) or "none"
        raise BagReadError(f"{reader.path}: no topic {topic}; topics: {has}")
    if (type_ := reader.topics[topic].type) != JOINT_STATE:
        raise BagReadError(f"{reader.path}: {topic} is {type_}, expected {JOINT_STATE}")


def until_damage(
    messages: Iterable[BagMessage], on_damage: Callable[[BagReadError], None] | None
) -> Iterator[BagMessage]:
    """Yield messages until the bag turns out to be damaged, and tell of that."""
    try:
        yield from messages
    except BagReadError as error:
        if on_damage is None:
            raise
        on_damage(error)


def _empty(count: int, wanted: Wanted) -> JointSeries:
    shape = (count, len(wanted), max(map(len, wanted), default=0))
    return JointSeries(
        stamps=np.zeros(count, np.int64),
        log_times=np.zeros(count, np.int64),
        publish_times=np.zeros(count, np.int64),
        values=np.full(shape, np.nan),
        named=np.zeros(shape[:2], np.bool_),
        given=np.zeros(shape, np.bool_),
        other_names=(),
    )
