# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's loop without its clock: measurements in, innovations and estimates out."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple, TypeAlias

from tsobs_ros.estimation.joints import JointTrackers
from tsobs_ros.estimation.records import (
    NANOSECONDS,
    Estimate,
    Innovation,
    Measurement,
    RejectReason,
    Sample,
    stamp_of,
)
from tsobs_ros.replay.samples import Samples
from tsobs_ros.replay.schedule import Schedule

Estimates: TypeAlias = Sequence[Estimate | None]
Agrees: TypeAlias = Callable[[int, Estimates], bool]
"""Whether the estimates at a tick are those that were recorded."""


class Used(NamedTuple):
    """What became of a message.

    Attributes:
        tick: At which it was used; as many as there are ticks after the last one.
        message: Which one it is, in the order of the samples.
        outcomes: One entry a joint; None where there was nothing for it.
    """

    tick: int
    message: int
    outcomes: Sequence[Innovation | RejectReason | None]


class Estimated(NamedTuple):
    """The estimates of a tick.

    Attributes:
        tick: Which one.
        estimates: One entry a joint, None where there is nothing to say; at least one says more.
    """

    tick: int
    estimates: Estimates


class Afresh(NamedTuple):
    """The observer has restarted before a tick."""

    tick: int


class Replay:
    """Runs an observer over samples.

    Args:
        trackers: Of the samples' joints.
        samples: What to run over.
        schedule: When to estimate.
        stale_after: Age of a joint's newest measurement after which it is not estimated [s].

    Attributes:
        used: Number of measurements that were used, of all joints.
        rejected: Number of those that were not, by reason.
        rewinds: Number of late ones put in their place.
        failures: Number of states or outputs that were not finite.
    """

    def __init__(
        self,
        trackers: JointTrackers,
        samples: Samples,
        schedule: Schedule,
        stale_after: float = 5.0,
    ) -> None:
        self.used = 0
        self.rejected: Counter[RejectReason] = Counter()
        self._finished = Counter[str]()
        self._trackers = trackers
        self._samples, self._schedule = samples, schedule
        self._stale_after = stale_after * NANOSECONDS

    @property
    def rewinds(self) -> int:
        """Number of late measurements put in their place."""
        return self._finished["rewinds"] + sum(t.rewinds for t in self._trackers.trackers)

    @property
    def failures(self) -> int:
        """Number of states or outputs that were not finite."""
        return self._finished["failures"] + sum(t.failures for t in self._trackers.trackers)

    def run(self, agrees: Agrees | None = None) -> Iterator[Used | Estimated | Afresh]:
        """Yield what happens, in order.

        Args:
            agrees: Of the messages that a tick may or may not know of, as many are used as it
                takes to agree with what was recorded; all of them if None.
        """
        schedule = self._schedule
        waiting = enumerate(self._samples.of_each_joint())
        offered, last = 0, 0
        columns = (schedule.stamps, schedule.now, schedule.least, schedule.most, schedule.afresh)
        ticks = zip(*(column.tolist() for column in columns), strict=True)
        for tick, (stamp, now, least, most, afresh) in enumerate(ticks):
            if afresh >= 0:
                yield from self._offer_next(tick, waiting, afresh - offered, now)
                offered = max(offered, afresh)
                self._begin_afresh()
                last = 0
                yield Afresh(tick)
            yield from self._offer_next(tick, waiting, least - offered, now)
            offered = max(offered, least)
            if stamp <= last or (schedule.at_samples and not self._is_newest(stamp)):
                continue
            estimates = self._estimate(stamp)
            while offered < most and not (agrees and agrees(tick, estimates)):
                yield self._offer(tick, *next(waiting), now)
                offered += 1
                if agrees or offered == most:
                    estimates = self._estimate(stamp)
            if estimates.count(None) < len(estimates):
                last = stamp
                yield Estimated(tick, estimates)
        for message, sample in waiting:
            now = int(self._samples.arrivals[message])
            yield self._offer(schedule.count, message, sample, now)

    def _offer_next(
        self, tick: int, waiting: Iterator[tuple[int, list[Sample]]], count: int, now: int
    ) -> Iterator[Used]:
        """Use the next `count` messages, as the node uses what a tick finds: by their stamps."""
        found = sorted(islice(waiting, max(0, count)), key=lambda message: stamp_of(message[1]))
        for message, sample in found:
            yield self._offer(tick, message, sample, now)

    def _offer(self, tick: int, message: int, sample: list[Sample], now: int) -> Used:
        """Use a message."""
        given: list[Measurement | None] = []
        for joint, one in enumerate(sample):
            if isinstance(one, RejectReason):
                self._trackers.trackers[joint].reject(one)
                self.rejected[one] += 1
                one = None
            given.append(one)
        outcomes = self._trackers.offer(given, now)
        for outcome in outcomes:
            if isinstance(outcome, Innovation):
                self.used += 1
            elif outcome is not None:
                self.rejected[outcome] += 1
        return Used(tick, message, outcomes)

    def _estimate(self, stamp: int) -> list[Estimate | None]:
        # As the node, which says nothing of a joint without news of it.
        fresh = [self._is_fresh(tracker.newest, stamp) for tracker in self._trackers.trackers]
        return self._trackers.estimate(stamp, fresh)

    def _is_fresh(self, newest: int | None, stamp: int) -> bool:
        return newest is not None and stamp - newest <= self._stale_after

    def _is_newest(self, stamp: int) -> bool:
        return stamp in [tracker.newest for tracker in self._trackers.trackers]

    def _begin_afresh(self) -> None:
        for tracker in self._trackers.trackers:
            self._finished.update(rewinds=tracker.rewinds, failures=tracker.failures)
        self._trackers.reset()
