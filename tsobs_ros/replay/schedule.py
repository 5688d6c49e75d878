# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Ticks of an observer over recorded measurements, and the measurements that each of them includes.

Live, the clock decides both. Here they are made of the recording's arrival times, or of the output
of the observer that was recorded.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.joint_series import JointSeries, Times
from tsobs_ros.estimation.records import NANOSECONDS
from tsobs_ros.replay.passes import CERTAIN, NO_EVIDENCE, POSSIBLE, Codes
from tsobs_ros.replay.source import UNKNOWN, Samples, passes, times_of_use

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


def _certain(samples: Samples) -> Codes:
    return np.full(samples.count, CERTAIN)


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
