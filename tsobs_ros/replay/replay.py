# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's loop without its clock: measurements in, innovations and estimates out.

Live, the clock decides when estimates are made and which measurements each of them includes. Here
a `Schedule` does, made of the recording's arrival times.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.joint_series import JointSeries, Times
from tsobs_ros.estimation.records import (
    NANOSECONDS,
    Estimate,
    Innovation,
    Measurement,
    RejectReason,
    Sample,
    stamp_of,
)
from tsobs_ros.estimation.tracker import JointTrackers
from tsobs_ros.replay.source import Samples, passes, times_of_use

Counts = NDArray[np.intp]
Estimates: TypeAlias = Sequence[Estimate | None]
Agrees: TypeAlias = Callable[[int, Estimates], bool]
"""Whether the estimates at a tick are those that were recorded."""


@dataclass(frozen=True)
class Schedule:
    """Ticks of an observer over n messages, m of them.

    Attributes:
        stamps: Instants of the estimates [ns], shape (m,).
        now: Time on the observer's clock, to recognise stamps from the future [ns], shape (m,).
        min_known: Number of messages that the tick includes for certain, ascending, shape (m,).
        max_known: Number of messages that it includes at most, ascending, shape (m,).
        reset_after: Number of messages after which the observer is reset before the tick, at once
            if it has used more; -1 for no reset; shape (m,).
        log_times: Of the estimates' messages, ns since the epoch, shape (m,).
        publish_times: Of the same, shape (m,).
        at_samples: Whether there are only estimates at measurements that are in use.
    """

    stamps: Times
    now: Times
    min_known: Counts
    max_known: Counts
    reset_after: Counts
    log_times: Times
    publish_times: Times
    at_samples: bool = False

    @property
    def count(self) -> int:
        """The number of ticks."""
        return len(self.stamps)


def at_samples(samples: Samples) -> Schedule:
    """Return a tick at every message, as soon as it has arrived.

    Messages in a row with the same stamp, of one joint each, share a tick.
    """
    last = np.append(samples.stamps[1:] != samples.stamps[:-1], samples.count > 0)
    messages = np.flatnonzero(last)
    reset_after = np.full(len(messages), -1)
    for begin, _ in passes(samples.stamps.tolist())[1:]:
        reset_after[np.searchsorted(messages, begin)] = begin
    return Schedule(
        stamps=samples.stamps[messages],
        now=samples.arrivals[messages],
        min_known=messages + 1,
        max_known=messages + 1,
        reset_after=reset_after,
        log_times=samples.log_times[messages],
        publish_times=samples.publish_times[messages],
        at_samples=True,
    )


def at_rate(samples: Samples, rate: float) -> Schedule:
    """Return ticks at a fixed rate [Hz] on the clock of the recording, as a node has them."""
    arrivals = samples.arrivals
    stamps, known, reset_after = [], [], []
    for begin, end in passes(samples.stamps.tolist()):
        own = np.maximum.accumulate(arrivals[begin:end])
        if not len(own):
            continue
        count = int(np.ptp(own) * rate / NANOSECONDS) + 1
        ticks = own[0] + np.round(np.arange(count) * (NANOSECONDS / rate)).astype(np.int64)
        stamps.append(ticks)
        known.append(begin + np.searchsorted(own, ticks, side="right"))
        reset_after.append(np.where((np.arange(count) == 0) & (begin > 0), begin, -1))
    if not stamps:
        return at_samples(samples)
    ticks, counts = np.concatenate(stamps), np.concatenate(known)
    log_times = samples.log_times[counts - 1] + ticks - arrivals[counts - 1]
    resets = np.concatenate(reset_after)
    return Schedule(ticks, ticks, counts, counts, resets, log_times, log_times)


def as_recorded(
    samples: Samples, estimates: JointSeries, innovations: JointSeries | None
) -> Schedule:
    """Return the ticks of the observer that was recorded.

    An innovation is published when its measurement is used, and the estimate after those of its
    tick. A measurement without one, rejected or gated, came between the used ones before and after
    it, and was published before the estimate.

    Args:
        samples: In the order of use.
        estimates: The recorded ones.
        innovations: The recorded ones, if there are any.
    """
    order = np.argsort(estimates.publish_times, kind="stable")
    stamps, published = estimates.stamps[order], estimates.publish_times[order]
    m, n = len(stamps), samples.count
    tick = np.full(n, m)
    if innovations is not None:
        tick = np.searchsorted(published, times_of_use(samples, innovations), side="left")
    used = np.flatnonzero(tick < m)
    known, beyond = np.zeros(m, np.intp), np.full(m + 1, n)
    np.maximum.at(known, tick[used], used + 1)
    np.minimum.at(beyond, tick[used], used)
    known = np.maximum.accumulate(known)
    # A measurement used at a later tick did not come before an earlier one.
    bound = np.minimum.accumulate(beyond[::-1])[::-1][1:]
    sent = np.searchsorted(np.maximum.accumulate(samples.publish_times), published, side="right")
    reset_after = np.full(m, -1)
    reset_after[1:][np.diff(stamps) <= 0] = 0
    return Schedule(
        stamps=stamps,
        now=stamps,
        min_known=known,
        max_known=np.maximum(known, np.minimum(sent, bound)),
        reset_after=reset_after,
        log_times=estimates.log_times[order],
        publish_times=published,
    )


class Used(NamedTuple):
    """The outcome of a message.

    Attributes:
        tick: Tick at which it was used; the number of ticks for those after the last one.
        message: Its place in the samples.
        outcomes: One entry a joint; None for a joint that it does not name.
    """

    tick: int
    message: int
    outcomes: Sequence[Innovation | RejectReason | None]


class Estimated(NamedTuple):
    """The estimates of a tick, at least one of them.

    Attributes:
        tick: Its place in the schedule.
        estimates: One entry a joint, None without an estimate.
    """

    tick: int
    estimates: Estimates


class Reset(NamedTuple):
    """A reset of the observer before a tick."""

    tick: int


class Replay:
    """An observer that runs over samples.

    Args:
        trackers: Of the samples' joints.
        samples: The measurements.
        schedule: The ticks.
        stale_after: Age of a joint's newest measurement after which it is not estimated [s].

    Attributes:
        used: Number of measurements used, of all joints.
        rejected: Number of measurements not used, by reason.
        rewinds: Number of late measurements put in their place.
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
        self._before_reset = Counter[str]()
        self._trackers = trackers
        self._samples, self._schedule = samples, schedule
        self._stale_after = stale_after * NANOSECONDS

    @property
    def rewinds(self) -> int:
        return self._before_reset["rewinds"] + sum(t.rewinds for t in self._trackers.trackers)

    @property
    def failures(self) -> int:
        return self._before_reset["failures"] + sum(t.failures for t in self._trackers.trackers)

    def run(self, agrees: Agrees | None = None) -> Iterator[Used | Estimated | Reset]:
        """Yield the events in order.

        Args:
            agrees: Of the messages that a tick may include, as many are used as it takes to agree
                with the recorded estimates; all of them if None.
        """
        schedule = self._schedule
        waiting = enumerate(self._samples.of_each_joint())
        offered, last = 0, 0
        names = ("stamps", "now", "min_known", "max_known", "reset_after")
        ticks = zip(*(getattr(schedule, name).tolist() for name in names), strict=True)
        for tick, (stamp, now, known, most, reset_after) in enumerate(ticks):
            if reset_after >= 0:
                yield from self._offer_next(tick, waiting, reset_after - offered, now)
                offered = max(offered, reset_after)
                self._reset()
                last = 0
                yield Reset(tick)
            yield from self._offer_next(tick, waiting, known - offered, now)
            offered = max(offered, known)
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
        """Use the next `count` messages in the order of their stamps, as a tick of the node."""
        found = sorted(islice(waiting, max(0, count)), key=lambda message: stamp_of(message[1]))
        for message, sample in found:
            yield self._offer(tick, message, sample, now)

    def _offer(self, tick: int, message: int, sample: list[Sample], now: int) -> Used:
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
        # As the node, which publishes nothing of a joint without recent measurements.
        fresh = [self._is_fresh(tracker.newest, stamp) for tracker in self._trackers.trackers]
        return self._trackers.estimate(stamp, fresh)

    def _is_fresh(self, newest: int | None, stamp: int) -> bool:
        return newest is not None and stamp - newest <= self._stale_after

    def _is_newest(self, stamp: int) -> bool:
        return stamp in [tracker.newest for tracker in self._trackers.trackers]

    def _reset(self) -> None:
        for tracker in self._trackers.trackers:
            self._before_reset.update(rewinds=tracker.rewinds, failures=tracker.failures)
        self._trackers.reset()
