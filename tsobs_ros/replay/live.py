# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The output of the observer that ran during a recording, and the comparison with it."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import MessageSeries, decode_ticks
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.reader import BagReader, RawMessages
from tsobs_ros.checks import Integers
from tsobs_ros.errors import BagReadError, MessageError
from tsobs_ros.series import NANOSECONDS, Spool

COMPARED = (
    topics.STATES,
    topics.STATE_BOUNDS,
    topics.DISTURBANCE,
    topics.DISTURBANCE_BOUND,
    *topics.TORQUE_TOPICS,
)
"""Topics of estimates, one message per tick."""

_BLOCK = 2**13
_STAMP = slice(4, 12)
_HEAD = ("stamps", "numbers", "estimated")
_TICK = np.dtype([(name, np.int64) for name in ("log_times", "publish_times", *_HEAD, "counts")])
_MESSAGE = np.dtype([("stamps", np.int64), ("digests", np.int64), ("counts", np.bool_)])


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

    def text(self) -> str:
        """Return one line for people, with the reason of any difference."""
        line = (
            f"live estimates: {self.reproduced:,} of {self.recorded:,} reproduced to the last bit"
        )
        if self.not_received:
            line += f", without {self.not_received:,} measurements that did not reach it"
        if self.reproduced == self.recorded:
            return line
        reasons = (
            (self.ran_before, "the live observer had run before the recording of it began"),
            (
                self.not_recorded,
                f"the live observer used {self.not_recorded:,} measurements that the bag lacks",
            ),
            (self.lost_ticks, f"its tick log lacks {self.lost_ticks:,} ticks"),
        )
        known = " and ".join(text for there, text in reasons if there)
        return f"{line}; {known or 'it had another design, other parameters or another version'}"


class LiveRun:
    """What the observer that ran during a recording sent.

    Args:
        reader: The bag.
        names: Full names of its topics by those of `estimate_topics`; that of ticks is there.
        measured: Checksums of the measurements in the bag, shape (n,).
        on_damage: Called with damage to the bag, up to which all is read.

    Attributes:
        ticks: Its ticks in the order of recording; `counts` has the numbers of their measurements.
        used: Places of their measurements in the bag, in the order of use.
        restarts: Its messages of restarts.
    """

    def __init__(
        self,
        reader: BagReader,
        names: Mapping[str, str],
        measured: Integers,
        on_damage: Callable[[BagReadError], None],
    ) -> None:
        ticks, checksums = Spool(_TICK), Spool(np.dtype(np.int64))
        self._estimates = Spool(_MESSAGE)
        self.restarts: list[MessageSeries] = []
        for block in reader.blocks(names.values(), _BLOCK, on_damage=on_damage):
            for topic, name in names.items():
                messages = block[name]
                if topic == topics.TICKS:
                    _add_ticks(messages, ticks, checksums)
                    continue
                for at, data in messages.groups:
                    if topic == topics.RESTARTS:
                        times = messages.log_times[at], messages.publish_times[at]
                        self.restarts.append(MessageSeries(name, JOINT_STATE, *times, data))
                    elif data.shape[1] >= _STAMP.stop:
                        self._estimates.add(_digested(topic, data))
        self.ticks, wanted = ticks.read(), checksums.read()
        places = _match(wanted, measured)
        there = places >= 0
        self.used = places[there]
        # The numbers of ticks count from 1 after each restart.
        numbers = self.ticks.numbers
        steps = np.diff(numbers)
        lost = np.where(steps > 0, steps - 1, np.maximum(numbers[1:] - 1, 0))
        self._agreement = Agreement(
            not_recorded=int((~there).sum()),
            not_received=len(measured) - len(self.used),
            lost_ticks=int(lost.sum()),
            ran_before=bool((numbers[:1] > 1).any()),
        )
        before = np.append(0, np.cumsum(there))[np.append(0, np.cumsum(self.ticks.counts))]
        self.ticks.counts = np.diff(before)

    def compare(self, made: Integers) -> Agreement:
        """Return the comparison with other messages, whose digests are given."""
        recorded = self._estimates.read()
        # An estimate counts by its states, and is the same if all messages of its stamp are.
        differing = recorded.stamps[~np.isin(recorded.digests, made)]
        stamps = recorded.stamps[recorded.counts]
        wrong = stamps[np.isin(stamps, differing)]
        return replace(
            self._agreement,
            recorded=len(stamps),
            reproduced=len(stamps) - len(wrong),
            first_difference=int(wrong.min()) if len(wrong) else None,
        )


def digests(topic: str, data: NDArray[np.uint8]) -> Integers:
    """Return a number for each message of a topic, the same of equal ones in this process only.

    Args:
        topic: One of `COMPARED`.
        data: Messages of one size, shape (n, size).
    """
    rows = np.ascontiguousarray(data).view(f"V{data.shape[1]}")[:, 0].tolist()
    return np.fromiter((hash((topic, row)) for row in rows), np.int64, len(rows))


def _digested(topic: str, data: NDArray[np.uint8]) -> NDArray[Any]:
    """Return the stamps in the headers of little-endian messages [ns], and their digests."""
    parts = np.ascontiguousarray(data[:, _STAMP])
    found = np.zeros(len(data), _MESSAGE)
    found["stamps"] = parts.view("<i4")[:, 0].astype(np.int64) * NANOSECONDS
    found["stamps"] += parts.view("<u4")[:, 1]
    found["digests"], found["counts"] = digests(topic, data), topic == topics.STATES
    return found


def _add_ticks(messages: RawMessages, ticks: Spool, checksums: Spool) -> None:
    """Add messages to ticks and their checksums; those that are none of a tick log are lost."""
    known = dict[int, Integers]()
    for at, data in messages.groups:
        with suppress(MessageError):
            known |= zip(at.tolist(), decode_ticks(data), strict=True)
    places = sorted(known)
    rows = [known[place] for place in places]
    found = np.zeros(len(rows), _TICK)
    found["log_times"] = messages.log_times[places]
    found["publish_times"] = messages.publish_times[places]
    found["counts"] = [len(row) - len(_HEAD) for row in rows]
    for number, name in enumerate(_HEAD):
        found[name] = [row[number] for row in rows]
    ticks.add(found)
    for row in rows:
        checksums.add(row[len(_HEAD) :])


def _match(wanted: Integers, there: Integers) -> NDArray[np.intp]:
    """Return the place of each wanted checksum, -1 for none, and no place twice, shape (n,)."""
    if len(wanted) <= len(there) and (wanted == there[: len(wanted)]).all():
        return np.arange(len(wanted))
    # The first with the first of those that are equal, and so on.
    keys, known = (each << 31 | _occurrences(each) for each in (wanted, there))
    order = np.argsort(known)
    found = order[np.searchsorted(known, keys, sorter=order).clip(max=len(known) - 1)]
    return np.where(known[found] == keys, found, -1)


def _occurrences(numbers: Integers) -> NDArray[np.intp]:
    """Return how many numbers in front of each are equal to it, shape (n,)."""
    order = np.argsort(numbers, kind="stable")
    found = np.empty(len(numbers), np.intp)
    found[order] = np.arange(len(numbers)) - np.searchsorted(numbers[order], numbers[order])
    return found
