# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's loop without its clock: measurements in, innovations and estimates out.

Live, the clock decides when estimates are made and which measurements each of them includes. Here
a `Schedule` does, made of the recording's arrival times.
"""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from itertools import islice
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.joint_series import JointSeries, Times
from tsobs_ros.checks import Array
from tsobs_ros.estimation.records import (
    NANOSECONDS,
    Estimate,
    Innovation,
    RejectReason,
    Sample,
    stamp_of,
)
from tsobs_ros.estimation.tracker import JointTrackers
from tsobs_ros.replay.source import UNKNOWN, Samples, passes, times_of_use

Counts = NDArray[np.intp]
Estimates: TypeAlias = Sequence[Estimate | None]
_Outcomes: TypeAlias = Sequence[Innovation | RejectReason | None]
_Waiting: TypeAlias = tuple[int, list[Sample]]

# Without an estimate for so many of the usual times between two, an observer was not at work.
_SILENCE = 5


class Evidence(IntEnum):
    """Evidence in a recording that its observer received a message."""

    NONE = 0
    """It has no innovation, and the observer published no estimates for a while after it."""
    POSSIBLE = 1
    """It has no innovation, as one that was gated or rejected."""
    CERTAIN = 2
    """It has an innovation, or nothing is known of an observer."""


class Choice(Enum):
    """Which of the messages without innovation were received."""

    UNUSED = auto()
    """Those that are gated or rejected, as the others would have an innovation."""
    LIKELY = auto()
    """Those with some evidence."""
    ALL = auto()
    """All; the innovations were lost."""
    NONE = auto()
    """None."""


_Choice: TypeAlias = Choice | int
"""A number: none of those before this message, and all from it on."""

# How many messages are used at most to find the first one that an observer received.
_SEARCH = 50_000


class RecordedRun(Protocol):
    """The recorded output of an observer, to compare with."""

    innovations: Array
    """Those of each message, NaN without, shape (n, J)."""

    def agrees(self, tick: int, estimates: Estimates) -> bool:
        """Return whether the estimates at a tick are those that were recorded."""


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
        evidence: Of each message, that the observer received it, shape (n,).
        at_samples: Whether there are only estimates at measurements that are in use.
    """

    stamps: Times
    now: Times
    min_known: Counts
    max_known: Counts
    reset_after: Counts
    log_times: Times
    publish_times: Times
    evidence: NDArray[np.int8]
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
        evidence=_certain(samples),
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
    evidence = _certain(samples)
    return Schedule(ticks, ticks, counts, counts, resets, log_times, log_times, evidence)


def _certain(samples: Samples) -> NDArray[np.int8]:
    return np.full(samples.count, Evidence.CERTAIN, np.int8)


def as_recorded(
    samples: Samples,
    estimates: JointSeries,
    innovations: JointSeries | None,
    restarts: JointSeries | None,
) -> Schedule:
    """Return the ticks of the observer that was recorded.

    An innovation is published when its measurement is used, and the estimate after those of its
    tick. A measurement without one, rejected or gated, came between the used ones before and after
    it, and was published before the estimate.

    Args:
        samples: In the order of use.
        estimates: The recorded ones.
        innovations: The recorded ones, if there are any.
        restarts: The recorded ones, if there are any.
    """
    order = np.argsort(estimates.publish_times, kind="stable")
    stamps, published = estimates.stamps[order], estimates.publish_times[order]
    m, n = len(stamps), samples.count
    tick, evidence = np.full(n, m), _certain(samples)
    used_at = np.full(n, UNKNOWN)
    if innovations is not None and innovations.count:
        used_at = times_of_use(samples, innovations)
        tick = np.searchsorted(published, used_at, side="left")
        evidence[used_at == UNKNOWN] = Evidence.POSSIBLE
        following = np.append(published, UNKNOWN)[np.searchsorted(published, samples.publish_times)]
        silent = following - samples.publish_times > _SILENCE * _usual_interval(published)
        evidence[(used_at == UNKNOWN) & silent & samples.usable] = Evidence.NONE
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
    for restart in () if restarts is None else np.sort(restarts.publish_times).tolist():
        following_tick = np.searchsorted(published, restart, side="left")
        if following_tick < m:
            before = np.flatnonzero(used_at < restart)
            after = np.flatnonzero((used_at >= restart) & (used_at < UNKNOWN))
            begin = int(before[-1]) + 1 if len(before) else 0
            end = int(after[0]) if len(after) else begin
            sent_before = samples.publish_times[begin:end] < restart
            reset_after[following_tick] = begin + int(sent_before.sum())
    return Schedule(
        stamps=stamps,
        now=stamps,
        min_known=known,
        max_known=np.maximum(known, np.minimum(sent, bound)),
        reset_after=reset_after,
        log_times=estimates.log_times[order],
        publish_times=published,
        evidence=evidence,
    )


def _usual_interval(times: Times) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else 0.0


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
        left_out: Whether a message was not used as the recorded observer had not received it,
            shape (n,).
        began_anew: Whether the first recorded innovation is that of an observer without a past;
            None without any.
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
        self.left_out = np.zeros(samples.count, np.bool_)
        self.began_anew: bool | None = None
        self._before_reset = Counter[str]()
        self._trackers = trackers
        self._samples, self._schedule = samples, schedule
        self._certain = (schedule.evidence == Evidence.CERTAIN).tolist()
        self._possible = (schedule.evidence == Evidence.POSSIBLE).tolist()
        self._stale_after = stale_after * NANOSECONDS
        self._recorded: RecordedRun | None = None

    @property
    def rewinds(self) -> int:
        return self._before_reset["rewinds"] + sum(t.rewinds for t in self._trackers.trackers)

    @property
    def failures(self) -> int:
        return self._before_reset["failures"] + sum(t.failures for t in self._trackers.trackers)

    def run(self, recorded: RecordedRun | None = None) -> Iterator[Used | Estimated | Reset]:
        """Yield the events in order.

        Args:
            recorded: Of the messages that a tick may include, as many are used as it takes to agree
                with the recorded estimates; all of them if None.
        """
        schedule = self._schedule
        self._recorded = recorded
        waiting = enumerate(self._samples.of_each_joint())
        offered, last = 0, 0
        names = ("stamps", "now", "min_known", "max_known", "reset_after")
        ticks = zip(*(getattr(schedule, name).tolist() for name in names), strict=True)
        for tick, (stamp, now, known, most, reset_after) in enumerate(ticks):
            if reset_after >= 0:
                before = list(islice(waiting, max(0, reset_after - offered)))
                yield from self._counted(self._offer_all(tick, before, now, Choice.UNUSED))
                offered = max(offered, reset_after)
                self._reset()
                last = 0
                yield Reset(tick)
            included = list(islice(waiting, max(0, known - offered)))
            offered = max(offered, known)
            if recorded is None or stamp <= last or self._are_certain(included):
                yield from self._counted(self._offer_all(tick, included, now))
                if stamp <= last or (schedule.at_samples and not self._is_newest(stamp)):
                    continue
                estimates = self._estimate(stamp)
            else:
                used, estimates = self._decide(recorded, tick, included, stamp, now)
                yield from self._counted(used)
            while offered < most and not (recorded and recorded.agrees(tick, estimates)):
                yield from self._counted(self._offer_all(tick, [next(waiting)], now))
                offered += 1
                if recorded or offered == most:
                    estimates = self._estimate(stamp)
            if estimates.count(None) < len(estimates):
                last = stamp
                yield Estimated(tick, estimates)
        for message, sample in waiting:
            now = int(self._samples.arrivals[message])
            yield from self._counted(self._offer_all(schedule.count, [(message, sample)], now))

    def _are_certain(self, messages: list[_Waiting]) -> bool:
        return all(self._certain[message] for message, _ in messages)

    def _decide(
        self, recorded: RecordedRun, tick: int, messages: list[_Waiting], stamp: int, now: int
    ) -> tuple[list[Used], list[Estimate | None]]:
        """Use the messages that were received, of which the recorded estimates decide."""
        trackers, earlier = self._trackers, self._before_reset
        uncertain = [message for message, _ in messages if not self._certain[message]]
        starts = uncertain[1 : 1 + _SEARCH // len(messages)]
        for choice in (*Choice, *starts, Choice.LIKELY):
            self._trackers, self._before_reset = trackers.copy(), earlier.copy()
            used = self._offer_all(tick, messages, now, choice)
            estimates = self._estimate(stamp)
            if recorded.agrees(tick, estimates):
                break
        return used, estimates

    def _offer_all(
        self, tick: int, messages: list[_Waiting], now: int, choice: _Choice = Choice.LIKELY
    ) -> list[Used]:
        """Use messages in the order of their stamps, as a tick of the node."""
        messages = sorted(messages, key=lambda one: stamp_of(one[1]))
        return [
            Used(tick, message, self._outcomes(message, sample, now, choice))
            for message, sample in messages
        ]

    def _outcomes(self, message: int, sample: list[Sample], now: int, choice: _Choice) -> _Outcomes:
        """Use a message; return no outcomes if it is left out."""
        if self._certain[message]:
            outcomes = self._offer(self._trackers, sample, now)
            return self._as_recorded(message, sample, now, outcomes)
        if isinstance(choice, int):
            received = message >= choice
        elif choice in (Choice.ALL, Choice.NONE):
            received = choice is Choice.ALL
        else:
            received = self._possible[message]
        if not received:
            return ()
        trackers = self._trackers.copy() if choice is Choice.UNUSED else self._trackers
        outcomes = self._offer(trackers, sample, now)
        if choice is Choice.UNUSED and any(isinstance(one, Innovation) for one in outcomes):
            return ()
        self._trackers = trackers
        return outcomes

    def _as_recorded(
        self, message: int, sample: list[Sample], now: int, outcomes: _Outcomes
    ) -> _Outcomes:
        """Return the outcomes, those of an observer without a past if those were recorded."""
        if self._recorded is None:
            return outcomes
        wanted = self._recorded.innovations[message].tolist()
        if not (same := _are(outcomes, wanted)):
            anew = self._trackers.copy()
            anew.reset()
            others = self._offer(anew, sample, now)
            if same := _are(others, wanted):
                self._remember_counts()
                self._trackers, outcomes = anew, others
        if self.began_anew is None:
            self.began_anew = same
        return outcomes

    @staticmethod
    def _offer(trackers: JointTrackers, sample: list[Sample], now: int) -> _Outcomes:
        given = [None if isinstance(one, RejectReason) else one for one in sample]
        outcomes = trackers.offer(given, now)
        pairs = zip(sample, outcomes, strict=True)
        return [one if isinstance(one, RejectReason) else outcome for one, outcome in pairs]

    def _counted(self, used: list[Used]) -> Iterator[Used]:
        for one in used:
            for outcome in one.outcomes:
                if isinstance(outcome, Innovation):
                    self.used += 1
                elif outcome is not None:
                    self.rejected[outcome] += 1
            if one.outcomes:
                yield one
            else:
                self.left_out[one.message] = True

    def _estimate(self, stamp: int) -> list[Estimate | None]:
        # As the node, which publishes nothing of a joint without recent measurements.
        fresh = [self._is_fresh(tracker.newest, stamp) for tracker in self._trackers.trackers]
        return self._trackers.estimate(stamp, fresh)

    def _is_fresh(self, newest: int | None, stamp: int) -> bool:
        return newest is not None and stamp - newest <= self._stale_after

    def _is_newest(self, stamp: int) -> bool:
        return stamp in [tracker.newest for tracker in self._trackers.trackers]

    def _reset(self) -> None:
        self._remember_counts()
        self._trackers.reset()

    def _remember_counts(self) -> None:
        for tracker in self._trackers.trackers:
            self._before_reset.update(rewinds=tracker.rewinds, failures=tracker.failures)


def _are(outcomes: _Outcomes, innovations: Sequence[float]) -> bool:
    """Return whether those of a message are the recorded ones, NaN without one."""
    values = [one.value[0] if isinstance(one, Innovation) else math.nan for one in outcomes]
    return all(
        value == wanted or wanted != wanted
        for value, wanted in zip(values, innovations, strict=True)
    )
