# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Ticks of an observer over recorded measurements, and the measurements that each of them includes.

Live, the clock decides both. Here they are made of the recording's arrival times, or of the output
of the observer that was recorded.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.joint_series import JointSeries, Times
from tsobs_ros.replay.passes import CERTAIN, NO_EVIDENCE, POSSIBLE, Codes
from tsobs_ros.replay.source import UNKNOWN, Samples, times_of_use
from tsobs_ros.series import NANOSECONDS

Counts = NDArray[np.intp]

# Without an estimate for so many of the usual times between two, an observer was not at work.
_SILENCE = 5
_LONG_SILENCE = NANOSECONDS


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
        evidence: Of each message's reception, see `passes`, shape (n,).
        at_samples: Whether there are only estimates at measurements that are in use.
    """

    stamps: Times
    now: Times
    min_known: Counts
    max_known: Counts
    reset_after: Counts
    log_times: Times
    publish_times: Times
    evidence: Codes
    at_samples: bool = False

    @property
    def count(self) -> int:
        """The number of ticks."""
        return len(self.stamps)


class Past(NamedTuple):
    """What came before the samples of a schedule.

    Attributes:
        stamp: Of the last tick [ns]; none if None.
        first: Stamp of the first tick since time restarted [ns].
        ticks: Number of ticks since then.
        arrival: Latest arrival of a sample since then [ns].
        delay: Log time of the last sample after its arrival on the clock of the stamps [ns].
    """

    stamp: int | None = None
    first: int = 0
    ticks: int = 0
    arrival: int = 0
    delay: int = 0

    def after(self, schedule: Schedule, ticks: int, samples: Samples, dropped: int) -> "Past":
        """Return what comes before the rest of the samples.

        Args:
            schedule: Of the samples.
            ticks: Number of its ticks that were made.
            samples: The samples.
            dropped: Number of those that the rest is without.
        """
        past = self
        if dropped:
            delay = int(samples.log_times[dropped - 1] - samples.arrivals[dropped - 1])
            begins = [begin for begin, _ in samples.passes if begin < dropped]
            latest = int(samples.arrivals[begins[-1] : dropped].max())
            if len(begins) == 1:
                latest = max(latest, self.arrival)
            past = past._replace(arrival=latest, delay=delay)
        if ticks:
            resets = np.flatnonzero(schedule.reset_after[:ticks] >= 0)
            begin = int(resets[-1]) if len(resets) else 0
            first, before = int(schedule.stamps[begin]), 0
            if not len(resets) and self.stamp is not None:
                first, before = self.first, self.ticks
            past = past._replace(
                stamp=int(schedule.stamps[ticks - 1]), first=first, ticks=before + ticks - begin
            )
        return past


_NO_PAST = Past()


def at_samples(samples: Samples) -> Schedule:
    """Return a tick at every message, as soon as it has arrived.

    Messages in a row with the same stamp, of one joint each, share a tick.
    """
    last = np.append(samples.stamps[1:] != samples.stamps[:-1], samples.count > 0)
    messages = np.flatnonzero(last)
    reset_after = np.full(len(messages), -1)
    for begin, _ in samples.passes[1:]:
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


def at_rate(
    samples: Samples, rate: float, past: Past = _NO_PAST, max_ticks: int | None = None
) -> Schedule:
    """Return ticks at a fixed rate [Hz] on the clock of the recording, as a node has them.

    Args:
        samples: In the order of use.
        rate: Ticks a second [Hz].
        past: What came before.
        max_ticks: The largest number of ticks; the rest is left out.
    """
    arrivals, left = samples.arrivals, max_ticks
    stamps, known, reset_after = [], [], []
    for place, (begin, end) in enumerate(samples.passes):
        goes_on = place == 0 and past.stamp is not None
        own = np.maximum.accumulate(arrivals[begin:end])
        if goes_on:
            own = np.maximum(own, past.arrival)
        if not len(own) or left == 0:
            continue
        first, made = (past.first, past.ticks) if goes_on else (int(own[0]), 0)
        count = max(made, int((own[-1] - first) * rate / NANOSECONDS) + 1)
        if left is not None:
            count = min(count, made + left)
            left -= count - made
        ticks = first + np.round(np.arange(made, count) * (NANOSECONDS / rate)).astype(np.int64)
        stamps.append(ticks)
        known.append(begin + np.searchsorted(own, ticks, side="right"))
        reset_after.append(np.where((np.arange(made, count) == 0) & (place > 0), begin, -1))
    if not stamps:
        return at_samples(samples)
    ticks, counts = np.concatenate(stamps), np.concatenate(known)
    delays = np.append(samples.log_times - arrivals, past.delay)
    log_times = delays[counts - 1] + ticks
    resets = np.concatenate(reset_after)
    evidence = _certain(samples)
    return Schedule(ticks, ticks, counts, counts, resets, log_times, log_times, evidence)


def _certain(samples: Samples) -> Codes:
    return np.full(samples.count, CERTAIN)


def as_recorded(
    samples: Samples,
    estimates: JointSeries,
    innovations: JointSeries | None,
    restarts: JointSeries | None,
    past: Past = _NO_PAST,
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
        past: What came before.
    """
    order = np.argsort(estimates.publish_times, kind="stable")
    stamps, published = estimates.stamps[order], estimates.publish_times[order]
    since = np.diff(stamps, prepend=stamps[:1] - 1 if past.stamp is None else past.stamp)
    m, n = len(stamps), samples.count
    tick, evidence = np.full(n, m), _certain(samples)
    used_at = np.full(n, UNKNOWN)
    if innovations is not None and innovations.count:
        used_at = times_of_use(samples, innovations)
        tick = np.searchsorted(published, used_at, side="left")
        evidence[used_at == UNKNOWN] = POSSIBLE
        following = np.searchsorted(published, samples.publish_times)
        waited = np.append(published, UNKNOWN)[following] - samples.publish_times
        silent = waited > _SILENCE * _usual_interval(published)
        # Simulated time goes on unevenly: a short silence is one on the clock of the stamps too.
        waited_there = np.append(stamps, UNKNOWN)[following] - samples.stamps
        silent &= (
            (waited > _LONG_SILENCE)
            | (waited_there > _SILENCE * _usual_interval(stamps))
            | (waited_there < 0)
        )
        evidence[(used_at == UNKNOWN) & silent & samples.usable] = NO_EVIDENCE
    used = np.flatnonzero(tick < m)
    known, beyond = np.zeros(m, np.intp), np.full(m + 1, n)
    np.maximum.at(known, tick[used], used + 1)
    np.minimum.at(beyond, tick[used], used)
    known = np.maximum.accumulate(known)
    # A measurement used at a later tick did not come before an earlier one.
    bound = np.minimum.accumulate(beyond[::-1])[::-1][1:]
    sent = np.searchsorted(np.maximum.accumulate(samples.publish_times), published, side="right")
    reset_after = np.full(m, -1)
    reset_after[since <= 0] = 0
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
