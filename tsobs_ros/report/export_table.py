# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One topic of a bag as a table: its columns, found in a first pass, and its rows."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from tsobs_ros.bag.messages.joint_states import JOINT_STATE, JointStateDecoder
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.errors import BagReadError, MessageError
from tsobs_ros.report.export_flatten import Cell, flatten, flatten_joint_state

_TIMES = (("time", "s"), ("log_time", "ns"), ("publish_time", "ns"))


@dataclass
class Column:
    """A column.

    Attributes:
        name: Its name, without unit.
        unit: Its unit, empty for none.
        kind: The type of its values.
        item: The type of what is in them, where they are lists.
        largest: The largest of its values, where they are whole numbers.
    """

    name: str
    unit: str
    kind: type = float
    item: type = float
    largest: int = 0

    def see(self, value: Any) -> None:
        """Take in one of the values."""
        self.kind = type(value)
        if self.kind is int:
            self.largest = max(self.largest, value)
        elif self.kind is list and value:
            self.item = type(value[0])


class Table:
    """A topic as a table.

    The first columns are `time`, in seconds since the bag's first message, and the times at which
    the message was received and published. They are followed by the message's own, in the order
    in which they first appear.

    Args:
        reader: The bag.
        topic: The topic.

    Attributes:
        topic: The topic.
        columns: Its columns.
        count: How many rows there are.
        damage: Where reading ended early, if it did.

    Raises:
        BagReadError: The topic's messages cannot be decoded at all: their definition is malformed
            or not in `ros2msg`, or `mcap-ros2-support` is not installed.
    """

    def __init__(self, reader: BagReader, topic: str) -> None:
        self.topic = topic
        self.damage: BagReadError | None = None
        self.count = 0
        self._reader = reader
        self._whole: set[str] = set()
        self.columns = self._survey()

    def rows(self) -> Iterator[list[Any]]:
        """Yield the rows; None where a message has nothing for a column."""
        places = {column.name: place for place, column in enumerate(self.columns)}
        start = self._reader.start_time or 0
        for log_time, publish_time, cells in self._messages():
            row: list[Any] = [None] * len(places)
            row[:3] = (log_time - start) / 1e9, log_time, publish_time
            for column, _, value in cells:
                row[places[column]] = value
            yield row

    def _survey(self) -> list[Column]:
        """Read all messages once to find the columns."""
        found = {name: Column(name, unit) for name, unit in _TIMES}
        for log_time, publish_time, cells in self._messages():
            self.count += 1
            found["log_time"].see(log_time)
            found["publish_time"].see(publish_time)
            for name, unit, value in cells:
                found.setdefault(name, Column(name, unit)).see(value)
                if isinstance(value, list):
                    self._whole.add(name)
        # What was an array of several columns before it became too long is one column throughout.
        split = tuple(f"{name}[" for name in self._whole)
        return (
            [column for name, column in found.items() if not name.startswith(split)]
            if split
            else list(found.values())
        )

    def _messages(self) -> Iterator[tuple[int, int, Iterator[Cell]]]:
        # Outside of the `try`: without a decoder nothing is damaged, and there are no rows to keep.
        messages = self._decoded()
        try:
            yield from messages
        except BagReadError as error:
            self.damage = error

    def _decoded(self) -> Iterator[tuple[int, int, Iterator[Cell]]]:
        if self._reader.topics[self.topic].type == JOINT_STATE:
            return self._joint_states()
        messages = self._reader.decoded([self.topic])  # without a decoder it fails here
        return (
            (message.log_time, message.publish_time, flatten(message.message, self._whole))
            for message in messages
        )

    def _joint_states(self) -> Iterator[tuple[int, int, Iterator[Cell]]]:
        decode = JointStateDecoder()
        for raw in self._reader.messages([self.topic]):
            try:
                state = decode(raw.data)
            except MessageError as error:
                raise BagReadError(
                    f"{self._reader.path}: the message of {self.topic} at {raw.log_time} ns is "
                    f"not a {JOINT_STATE}: {error}"
                ) from error
            yield raw.log_time, raw.publish_time, flatten_joint_state(state)
