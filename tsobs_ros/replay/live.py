# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of estimates with those of a live run, message by message."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_series import RawMessages
from tsobs_ros.bag.message_series import MessageSeries
from tsobs_ros.series import NANOSECONDS

COMPARED = (
    topics.STATES,
    topics.STATE_BOUNDS,
    topics.DISTURBANCE,
    topics.DISTURBANCE_BOUND,
    *topics.TORQUE_TOPICS,
)
"""Topics of estimates, one message per tick."""

_STAMP = slice(4, 12)


@dataclass
class Agreement:
    """Comparison of the estimates with those of the live run.

    Attributes:
        recorded: Number of recorded estimates.
        reproduced: Number of those that are the same to the last bit, bounds included.
        first_difference: Stamp of the first that is not [ns], None if all are.
        not_recorded: Number of measurements that the live observer used but the bag lacks.
        not_received: Number of those in the bag that did not reach the live observer.
        lost_ticks: Number of ticks that the tick log lacks.
        ran_before: Whether it had run before the recording of it began.
    """

    recorded: int = 0
    reproduced: int = 0
    first_difference: int | None = None
    not_recorded: int = 0
    not_received: int = 0
    lost_ticks: int = 0
    ran_before: bool = False

    @property
    def complete(self) -> bool:
        """Whether every estimate was reproduced."""
        return self.reproduced == self.recorded

    def text(self) -> str:
        """Return one line for people, with the reason of any difference."""
        line = (
            f"live estimates: {self.reproduced:,} of {self.recorded:,} reproduced to the last bit"
        )
        if self.not_received:
            line += f", without {_count(self.not_received, 'measurement')} that did not reach it"
        if self.complete:
            return line
        reasons = []
        if self.ran_before:
            reasons.append("the live observer had run before the recording of it began")
        if self.not_recorded:
            lost = _count(self.not_recorded, "measurement")
            reasons.append(f"the live observer used {lost} that the bag lacks")
        if self.lost_ticks:
            reasons.append(f"its tick log lacks {_count(self.lost_ticks, 'tick')}")
        reasons = reasons or ["it had another design, other parameters or another version"]
        return f"{line}; {' and '.join(reasons)}"


_Message: TypeAlias = tuple[int, int, bytes]
"""Stamp and log time [ns] of a message, and its bytes."""


class LiveComparison:
    """Compares the messages of a run with the recorded ones, window by window.

    Args:
        counts: What the tick log has: counts that grow with the windows.
    """

    def __init__(self, counts: Agreement) -> None:
        self._tick_log, self._found = counts, Agreement()
        self._recorded: dict[str, list[_Message]] = {topic: [] for topic in COMPARED}
        self._made: dict[str, set[bytes]] = {topic: set() for topic in COMPARED}
        self._made_at: set[int] = set()

    def add_recorded(self, topic: str, messages: RawMessages) -> None:
        """Take in recorded messages."""
        for places, data in messages.groups:
            if data.shape[1] >= _STAMP.stop:
                times = messages.log_times[places].tolist()
                self._recorded[topic] += zip(_stamps(data), times, _rows(data), strict=True)

    def add_made(self, topic: str, messages: Iterable[MessageSeries]) -> None:
        """Take in messages of the run."""
        for one in messages:
            self._made[topic].update(_rows(one.data))
            if topic == topics.STATES:
                self._made_at.update(_stamps(one.data))

    def settle(self, horizon: float) -> None:
        """Compare what there is; recorded messages that nothing is like may wait for more.

        Args:
            horizon: Log time of the ticks to come [ns].
        """
        found, differing = self._found, set[int]()
        # An estimate counts by its states, and is the same if all messages of its stamp are.
        for topic in (*COMPARED[1:], topics.STATES):
            waiting, made = [], self._made[topic]
            for one in self._recorded[topic]:
                stamp, log_time, data = one
                same = data in made
                if not (same or stamp in self._made_at or log_time < horizon - NANOSECONDS):
                    waiting.append(one)
                    continue
                if not same:
                    differing.add(stamp)
                if topic == topics.STATES:
                    found.recorded += 1
                    found.reproduced += stamp not in differing
                    if stamp in differing:
                        first = found.first_difference
                        found.first_difference = stamp if first is None else min(first, stamp)
            self._recorded[topic] = waiting
            made.clear()
        self._made_at.clear()

    def result(self) -> Agreement:
        """Return what was counted."""
        self.settle(math.inf)
        found = self._found
        return replace(
            self._tick_log,
            recorded=found.recorded,
            reproduced=found.reproduced,
            first_difference=found.first_difference,
        )


def _rows(data: NDArray[np.uint8]) -> list[bytes]:
    """Return messages of one size one by one."""
    rows: list[bytes] = np.ascontiguousarray(data).view(f"V{data.shape[1]}")[:, 0].tolist()
    return rows


def _stamps(data: NDArray[np.uint8]) -> list[int]:
    """Return the stamps in the headers of little-endian messages [ns]."""
    parts = np.ascontiguousarray(data[:, _STAMP])
    seconds, rest = parts.view("<i4")[:, 0], parts.view("<u4")[:, 1]
    stamps: list[int] = (seconds.astype(np.int64) * NANOSECONDS + rest).tolist()
    return stamps


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' if number != 1 else ''}"
