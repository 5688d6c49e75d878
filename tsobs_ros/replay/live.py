# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The output of the observer that ran during a recording, and the comparison with it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import MessageSeries, decode_ticks
from tsobs_ros.bag.joint_series import RawMessages, read_blocks
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.errors import BagReadError, MessageError
from tsobs_ros.series import NANOSECONDS, Spool, Stamps

COMPARED = (
    topics.STATES,
    topics.STATE_BOUNDS,
    topics.DISTURBANCE,
    topics.DISTURBANCE_BOUND,
    *topics.TORQUE_TOPICS,
)
"""Topics of estimates, one message per tick."""

_BLOCK = 2**15
_STAMP = slice(4, 12)
_TICK_NUMBERS = ("log_times", "publish_times", "stamps", "numbers", "estimated", "counts")
_TICK = np.dtype([(name, np.int64) for name in _TICK_NUMBERS])
_MESSAGE = np.dtype([("stamps", np.int64), ("digests", np.int64)])


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


class LiveRun:
    """What the observer that ran during a recording sent.

    Args:
        reader: The bag.
        names: Full names of its topics by those of `estimate_topics`; that of ticks is there.
        measured: Checksums of the measurements in the bag, shape (n,).
        on_damage: Called with damage to the bag, up to which all is read.

    Attributes:
        ticks: Its ticks in the order of sending; `counts` has the numbers of their measurements.
        used: Places of their measurements in the bag, in the order of use.
        restarts: Its messages of restarts.
    """

    def __init__(
        self,
        reader: BagReader,
        names: Mapping[str, str],
        measured: NDArray[np.int64],
        on_damage: Callable[[BagReadError], None],
    ) -> None:
        ticks, checksums = Spool(_TICK), Spool(np.dtype(np.int64))
        self._estimates = {topic: Spool(_MESSAGE) for topic in COMPARED}
        self.restarts: list[MessageSeries] = []
        raw = list(names.values())
        for block in read_blocks(reader, {}, _BLOCK, raw=raw, on_damage=on_damage):
            for topic, name in names.items():
                messages = block.raw[name]
                if topic == topics.TICKS:
                    _add_ticks(messages, ticks, checksums)
                elif topic == topics.RESTARTS:
                    for at, data in messages.groups:
                        times = messages.log_times[at], messages.publish_times[at]
                        self.restarts.append(MessageSeries(name, JOINT_STATE, *times, data))
                else:
                    for _, data in messages.groups:
                        self._estimates[topic].add(_digested(data))
        self.ticks, wanted = _in_order_of_sending(ticks.read(), checksums.read())
        places = _match(wanted, measured)
        there = places >= 0
        self.used = places[there]
        self._counts = _counts_of(self.ticks.numbers)
        self._counts.not_recorded = int((~there).sum())
        self._counts.not_received = len(measured) - len(self.used)
        before = np.append(0, np.cumsum(there))[np.append(0, np.cumsum(self.ticks.counts))]
        self.ticks.counts = np.diff(before)

    def compare(self, made: Mapping[str, NDArray[np.int64]]) -> Agreement:
        """Return the comparison with other messages.

        Args:
            made: Their digests by the topics of `COMPARED`.
        """
        recorded = {topic: spool.read() for topic, spool in self._estimates.items()}
        # An estimate counts by its states, and is the same if all messages of its stamp are.
        differing = [
            own.stamps[~np.isin(own.digests, made[topic])] for topic, own in recorded.items()
        ]
        stamps = recorded[topics.STATES].stamps
        wrong = stamps[np.isin(stamps, np.concatenate(differing))]
        return replace(
            self._counts,
            recorded=len(stamps),
            reproduced=len(stamps) - len(wrong),
            first_difference=int(wrong.min()) if len(wrong) else None,
        )


def digests(data: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return a number for each message, the same of equal ones in this process only, shape (n,).

    Args:
        data: Messages of one size, shape (n, size).
    """
    rows = np.ascontiguousarray(data).view(f"V{data.shape[1]}")[:, 0].tolist()
    return np.fromiter(map(hash, rows), np.int64, len(rows))


def _digested(data: NDArray[np.uint8]) -> NDArray[Any]:
    """Return the stamps in the headers of little-endian messages [ns], and their digests."""
    if data.shape[1] < _STAMP.stop:
        return np.zeros(0, _MESSAGE)
    parts = np.ascontiguousarray(data[:, _STAMP])
    found = np.zeros(len(data), _MESSAGE)
    found["stamps"] = parts.view("<i4")[:, 0].astype(np.int64) * NANOSECONDS
    found["stamps"] += parts.view("<u4")[:, 1]
    found["digests"] = digests(data)
    return found


def _add_ticks(messages: RawMessages, ticks: Spool, checksums: Spool) -> None:
    """Add messages to ticks and their checksums; those that are none of a tick log are lost."""
    known = []
    for places, data in messages.groups:
        try:
            known.append((places, decode_ticks(data)))
        except MessageError:
            continue
    found, there = np.zeros(len(messages.log_times), _TICK), np.zeros(len(messages.log_times), bool)
    found["log_times"], found["publish_times"] = messages.log_times, messages.publish_times
    for places, values in known:
        there[places], found["counts"][places] = True, values.shape[1] - 3
        for name, column in zip(_TICK_NUMBERS[2:5], values.T[:3], strict=True):
            found[name][places] = column
    ends = np.cumsum(found["counts"])
    taken = np.zeros(int(ends[-1]) if len(ends) else 0, np.int64)
    for places, values in known:
        begins = (ends - found["counts"])[places, np.newaxis]
        taken[begins + np.arange(values.shape[1] - 3)] = values[:, 3:]
    ticks.add(found[there])
    checksums.add(taken)


def _in_order_of_sending(ticks: Any, checksums: Stamps) -> tuple[Any, Stamps]:
    """Return ticks by their publish times, and their checksums."""
    order = np.argsort(ticks.publish_times, kind="stable")
    begins = np.cumsum(ticks.counts) - ticks.counts
    ticks = ticks[order]
    shift = begins[order] - (np.cumsum(ticks.counts) - ticks.counts)
    return ticks, checksums[np.repeat(shift, ticks.counts) + np.arange(len(checksums))]


def _counts_of(numbers: NDArray[np.int64]) -> Agreement:
    """Return what the numbers of ticks, which count from 1 after each restart, show of a log."""
    steps = np.diff(numbers)
    lost = np.where(steps > 0, steps - 1, np.maximum(numbers[1:] - 1, 0))
    return Agreement(lost_ticks=int(lost.sum()), ran_before=bool((numbers[:1] > 1).any()))


def _match(wanted: NDArray[np.int64], there: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return the place of each wanted checksum, -1 for none, and no place twice, shape (n,)."""
    if len(wanted) <= len(there) and (wanted == there[: len(wanted)]).all():
        return np.arange(len(wanted))
    # The first with the first of those that are equal, and so on.
    keys, known = (each << 31 | _occurrences(each) for each in (wanted, there))
    order = np.argsort(known)
    found = order[np.searchsorted(known, keys, sorter=order).clip(max=len(known) - 1)]
    return np.where(known[found] == keys, found, -1)


def _occurrences(numbers: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return how many numbers in front of each are equal to it, shape (n,)."""
    order = np.argsort(numbers, kind="stable")
    found = np.empty(len(numbers), np.intp)
    found[order] = np.arange(len(numbers)) - np.searchsorted(numbers[order], numbers[order])
    return found


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' if number != 1 else ''}"
