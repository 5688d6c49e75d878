# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""JointState topics of a bag as arrays: one row a message, in the order of recording."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, pairwise
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.container import ROW, Rows, pieces
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateDecoder
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.checks import Array, Flags
from tsobs_ros.errors import BagReadError

Read = TypeVar("Read")

Times = NDArray[np.int64]

Place = tuple[str, str]
"""Name of an entry, and which of its numbers: `position`, `velocity` or `effort`."""

Wanted = Sequence[Sequence[Place]]
"""What to read off a topic's messages: the places of each joint's numbers."""


class RawMessages(NamedTuple):
    """A topic's messages as bytes, n of them.

    Attributes:
        log_times: When they were received, ns since the epoch, shape (n,).
        publish_times: When they were published, ns since the epoch, shape (n,).
        groups: Those of the same size, their places and their bytes, shapes (k,) and (k, size).
    """

    log_times: Times
    publish_times: Times
    groups: list[tuple[NDArray[np.intp], NDArray[np.uint8]]]


class JointSeries(NamedTuple):
    """A topic's messages, n of them.

    Attributes:
        stamps: Of their headers, ns since the epoch, shape (n,).
        log_times: When they were received, ns since the epoch, shape (n,).
        publish_times: When they were published, ns since the epoch, shape (n,).
        values: NaN where a message has none, or a joint has fewer, shape (n, joints, places).
        named: Whether a message has any of a joint's entries, shape (n, joints).
    """

    stamps: Times
    log_times: Times
    publish_times: Times
    values: Array
    named: Flags


class JointReader:
    """Reads numbers of joints off a topic's messages."""

    def __init__(self, wanted: Wanted) -> None:
        self._wanted = wanted
        self._decoder = JointStateDecoder()

    def __call__(self, raw: RawMessages) -> JointSeries:
        """Return messages as numbers; those that are malformed have none."""
        count = len(raw.log_times)
        shape = (count, len(self._wanted), max(map(len, self._wanted), default=0))
        stamps, values = np.zeros(count, np.int64), np.full(shape, np.nan)
        named = np.zeros(shape[:2], np.bool_)
        for group in chain.from_iterable(self._decoder.decode_rows(*one) for one in raw.groups):
            rows = group.places
            stamps[rows] = group.stamps
            for joint, places in enumerate(self._wanted):
                for at, (name, field) in enumerate(places):
                    if name not in group.names:
                        continue
                    place, numbers = group.names.index(name), getattr(group, field)
                    named[rows, joint] = True
                    if place < numbers.shape[1]:
                        values[rows, joint, at] = numbers[:, place]
        return JointSeries(stamps, raw.log_times, raw.publish_times, values, named)


def read_blocks(
    reader: BagReader,
    topics: Iterable[str],
    size: int | None = None,
    *,
    on_damage: Callable[[BagReadError], None] | None = None,
) -> Iterator[dict[str, RawMessages]]:
    """Read some topics of a bag in blocks of at least `size` messages, or in one block.

    `on_damage` is called with damage to the bag, up to which all is returned.

    Raises:
        BagReadError: The bag has no such topic, or it is damaged and that is not noted.
    """
    names = list(topics)
    found, records = [np.zeros(0, ROW)], dict[int, bytes]()

    def block() -> dict[str, RawMessages]:
        rows = np.concatenate(found)
        each = enumerate(names)
        return {name: _raw(rows[rows["channel"] == place], records) for place, name in each}

    for rows, new in until_damage(reader.rows(names), on_damage):
        found.append(rows)
        records |= new
        if size is not None and sum(map(len, found)) >= size:
            yield block()
            found, records = [rows[:0]], {}
    yield block()


def require_joint_states(reader: BagReader, topic: str) -> None:
    """Raise `BagReadError` unless the bag has the topic, with JointStates on it."""
    reader.require([topic])
    if (type_ := reader.topics[topic].type) != JOINT_STATE:
        raise BagReadError(f"{reader.path}: {topic} is {type_}, expected {JOINT_STATE}")


def until_damage(
    messages: Iterable[Read], on_damage: Callable[[BagReadError], None] | None
) -> Iterator[Read]:
    """Yield messages up to damage to the bag, and call with that."""
    try:
        yield from messages
    except BagReadError as error:
        if on_damage is None:
            raise
        on_damage(error)


def _raw(rows: Rows, records: Mapping[int, bytes]) -> RawMessages:
    groups = []
    for size in np.unique(rows["size"]).tolist():
        places = np.flatnonzero(rows["size"] == size)
        groups.append((places, _gather(rows[places], records, size)))
    return RawMessages(rows["log_time"].copy(), rows["publish_time"].copy(), groups)


def _gather(rows: Rows, records: Mapping[int, bytes], size: int) -> NDArray[np.uint8]:
    """Return the bytes of messages of one size, shape (n, size)."""
    gathered = np.empty((len(rows), size), np.uint8)
    edges = np.flatnonzero(np.diff(rows["chunk"], prepend=-1, append=-1))
    for begin, end in pairwise(edges.tolist() if size else ()):
        data = np.frombuffer(records[int(rows["chunk"][begin])], np.uint8)
        own = pieces(data, size)[rows["begin"][begin:end]]
        gathered[begin:end] = own.view(np.uint8).reshape(-1, size)
    return gathered
