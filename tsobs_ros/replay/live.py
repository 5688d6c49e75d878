# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of estimates with those of a live run, message by message."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_series import RawMessages, Times
from tsobs_ros.bag.message_series import MessageSeries
from tsobs_ros.checks import Flags
from tsobs_ros.replay.windows import LiveCounts
from tsobs_ros.series import NANOSECONDS

COMPARED = (
    topics.STATES,
    topics.STATE_BOUNDS,
    topics.DISTURBANCE,
    topics.DISTURBANCE_BOUND,
    *topics.TORQUE_TOPICS,
)
"""Topics of estimates, one message a tick."""

_STAMP_END = 12


class Agreement(NamedTuple):
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

    recorded: int
    reproduced: int
    first_difference: int | None
    not_recorded: int
    not_received: int
    lost_ticks: int
    ran_before: bool

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


class LiveComparison:
    """Compares the messages of a run with the recorded ones, window by window.

    Args:
        counts: What the tick log tells.
    """

    def __init__(self, counts: LiveCounts) -> None:
        self._tick_log = counts
        self._recorded: dict[str, list[_Group]] = {topic: [] for topic in COMPARED}
        self._made: dict[str, list[_Group]] = {topic: [] for topic in COMPARED}
        self._count, self._same = 0, 0
        self._first: int | None = None

    def add_recorded(self, topic: str, messages: RawMessages) -> None:
        """Take in recorded messages."""
        self._recorded[topic] += [
            _Group(_stamps(data), messages.log_times[places], data)
            for places, data in messages.groups
            if data.shape[1] >= _STAMP_END
        ]

    def add_made(self, topic: str, messages: Iterable[MessageSeries]) -> None:
        """Take in messages of the run."""
        self._made[topic] += [_Group(_stamps(m.data), m.log_times, m.data) for m in messages]

    def settle(self, horizon: float) -> None:
        """Compare what there is; recorded messages that nothing is like may wait for more.

        Args:
            horizon: Log time of the ticks to come [ns].
        """
        made_at = _joined([group.stamps for group in self._made[topics.STATES]])
        differing = []
        for topic in COMPARED[1:]:
            for one, same in self._settled(topic, made_at, horizon):
                differing.append(one.stamps[~same])
        others = _joined(differing)
        for one, same in self._settled(topics.STATES, made_at, horizon):
            same &= ~np.isin(one.stamps, others)
            self._count += len(same)
            self._same += int(same.sum())
            if not same.all():
                first = int(one.stamps[~same].min())
                self._first = first if self._first is None else min(first, self._first)
        self._made = {topic: [] for topic in COMPARED}

    def _settled(
        self, topic: str, made_at: Times, horizon: float
    ) -> "Iterator[tuple[_Group, Flags]]":
        """Yield the recorded messages that need not wait, and whether they are the same."""
        waiting = []
        for one in self._recorded[topic]:
            same = np.zeros(len(one.stamps), np.bool_)
            for made in self._made[topic]:
                same |= _is_in(one, made)
            due = same | np.isin(one.stamps, made_at) | (one.log_times < horizon - NANOSECONDS)
            yield one.take(due), same[due]
            if not due.all():
                waiting.append(one.take(~due))
        self._recorded[topic] = waiting

    def result(self) -> Agreement:
        """Return what was counted."""
        self.settle(math.inf)
        known = self._tick_log
        return Agreement(
            self._count, self._same, self._first,
            known.not_recorded, known.not_received, known.lost_ticks, known.ran_before,
        )  # fmt: skip


class _Group(NamedTuple):
    """Messages of one size: stamps and log times [ns], and bytes."""

    stamps: Times
    log_times: Times
    data: NDArray[np.uint8]

    def take(self, chosen: Flags) -> "_Group":
        return _Group(self.stamps[chosen], self.log_times[chosen], self.data[chosen])


def _is_in(wanted: _Group, there: _Group) -> Flags:
    """Return which messages are among others, to the last bit."""
    if wanted.data.shape[1] != there.data.shape[1] or not len(there.stamps):
        return np.zeros(len(wanted.stamps), np.bool_)
    order = np.argsort(there.stamps, kind="stable")
    ascending, found = there.stamps[order], np.zeros(len(wanted.stamps), np.bool_)
    # If the clock went back, a stamp may be there twice.
    for side, shift in (("left", 0), ("right", -1)):
        at = np.searchsorted(ascending, wanted.stamps, side=side) + shift  # type: ignore[call-overload]
        found |= (there.data[order[at.clip(0, len(order) - 1)]] == wanted.data).all(axis=1)
    return found


def _joined(stamps: Sequence[Times]) -> Times:
    return np.concatenate([np.zeros(0, np.int64), *stamps])


def _stamps(data: NDArray[np.uint8]) -> Times:
    """Return the stamps in the headers of little-endian messages [ns], shape (n,)."""
    parts = np.ascontiguousarray(data[:, 4:_STAMP_END])
    seconds, rest = parts.view("<i4")[:, 0], parts.view("<u4")[:, 1]
    return np.asarray(seconds.astype(np.int64) * NANOSECONDS + rest)


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' if number != 1 else ''}"
