# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""When estimates are made, and which measurements each of them knows of.

Live, the clock decides both. Afterwards the recording tells: an estimate knows of the measurements
that had arrived by its tick.
"""

from collections import defaultdict, deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.messages.joint_series import JointSeries, Times
from tsobs_ros.estimation.records import NANOSECONDS
from tsobs_ros.replay.samples import Samples, passes

Counts = NDArray[np.intp]

_UNKNOWN = np.iinfo(np.int64).max


@dataclass(frozen=True)
class Schedule:
    """Ticks of an observer over n messages, m of them.

    Attributes:
        stamps: What the estimates are for [ns], shape (m,).
        now: The time on the observer's clock, by which stamps from the future are told [ns], (m,).
        least: How many messages the tick knows of for certain, ascending, shape (m,).
        most: How many it knows of at most, ascending, shape (m,).
        afresh: After how many messages the observer restarts before the tick, if after fewer
            than it has, at once; -1 where it goes on; shape (m,).
        log_times: Of the estimates' messages, ns since the epoch, shape (m,).
        publish_times: Of the same, shape (m,).
        at_samples: Whether there are only estimates at measurements that are in use.
    """

    stamps: Times
    now: Times
    least: Counts
    most: Counts
    afresh: Counts
    log_times: Times
    publish_times: Times
    at_samples: bool = False

    @property
    def count(self) -> int:
        """The number of ticks."""
        return len(self.stamps)


def at_samples(samples: Samples) -> Schedule:
    """Return a tick at every message, as soon as it has arrived.

    Messages in a row with the same stamp, of one joint each, have one tick together.
    """
    last = np.append(samples.stamps[1:] != samples.stamps[:-1], samples.count > 0)
    messages = np.flatnonzero(last)
    afresh = np.full(len(messages), -1)
    for begin, _ in passes(samples.stamps.tolist())[1:]:
        afresh[np.searchsorted(messages, begin)] = begin
    return Schedule(
        stamps=samples.stamps[messages],
        now=samples.arrivals[messages],
        least=messages + 1,
        most=messages + 1,
        afresh=afresh,
        log_times=samples.log_times[messages],
        publish_times=samples.publish_times[messages],
        at_samples=True,
    )


def at_rate(samples: Samples, rate: float) -> Schedule:
    """Return ticks at a fixed rate [Hz] on the clock of the recording, as a node has them."""
    arrivals = samples.arrivals
    stamps, known, afresh = [], [], []
    for begin, end in passes(samples.stamps.tolist()):
        own = np.maximum.accumulate(arrivals[begin:end])
        if not len(own):
            continue
        count = int(np.ptp(own) * rate / NANOSECONDS) + 1
        ticks = own[0] + np.round(np.arange(count) * (NANOSECONDS / rate)).astype(np.int64)
        stamps.append(ticks)
        known.append(begin + np.searchsorted(own, ticks, side="right"))
        afresh.append(np.where((np.arange(count) == 0) & (begin > 0), begin, -1))
    if not stamps:
        return at_samples(samples)
    ticks, counts = np.concatenate(stamps), np.concatenate(known)
    log_times = samples.log_times[counts - 1] + ticks - arrivals[counts - 1]
    return Schedule(ticks, ticks, counts, counts, np.concatenate(afresh), log_times, log_times)


def as_recorded(
    samples: Samples, estimates: JointSeries, innovations: JointSeries | None
) -> Schedule:
    """Return the ticks of the observer that was recorded, as far as the recording tells.

    An innovation is published when its measurement is used, and the estimate after those of its
    tick. Of a measurement without one, rejected or gated, it is only known between which two used
    ones it came; and that it had been published before the estimate.

    Args:
        samples: In the order of use.
        estimates: The recorded ones.
        innovations: The recorded ones, if there are any.
    """
    order = np.argsort(estimates.publish_times, kind="stable")
    stamps, published = estimates.stamps[order], estimates.publish_times[order]
    tick = _ticks_of_use(samples, published, innovations)
    m, n = len(stamps), samples.count
    used = np.flatnonzero(tick < m)
    least, beyond = np.zeros(m, np.intp), np.full(m + 1, n)
    np.maximum.at(least, tick[used], used + 1)
    np.minimum.at(beyond, tick[used], used)
    least = np.maximum.accumulate(least)
    # What is used at a later tick did not come before an earlier one.
    bound = np.minimum.accumulate(beyond[::-1])[::-1][1:]
    sent = np.maximum.accumulate(samples.publish_times)
    most = np.searchsorted(sent, published, side="right")
    afresh = np.full(m, -1)
    afresh[1:][np.diff(stamps) <= 0] = 0
    return Schedule(
        stamps=stamps,
        now=stamps,
        least=least,
        most=np.maximum(least, np.minimum(most, bound)),
        afresh=afresh,
        log_times=estimates.log_times[order],
        publish_times=published,
    )


def in_order_of_use(samples: Samples, innovations: JointSeries) -> Samples:
    """Return the messages in the order in which a recorded observer used them.

    Those of one publisher come in its order. Between publishers the innovations tell: what was sent
    first need not have arrived first. A message without innovation is taken to have been as long on
    its way as the others of the same joints are, which is the best that can be known.

    Args:
        samples: In the order of publishing.
        innovations: The recorded ones.
    """
    used_at = _times_of_use(samples, innovations)
    keys = np.zeros(samples.count, np.int64)
    for joints in np.unique(samples.named, axis=0):
        own = np.flatnonzero((samples.named == joints).all(axis=1))
        keys[own] = _expected(used_at[own], samples.publish_times[own])
    return samples.take(np.argsort(keys, kind="stable"))


def _expected(used_at: Times, published: Times) -> Times:
    """Return the times of use of one publisher's messages, with the unknown ones filled in."""
    known = used_at != _UNKNOWN
    if not known.any():
        return published
    usual = published + int(np.median(used_at[known] - published[known]))
    after = np.maximum.accumulate(np.where(known, used_at, 0))
    before = np.minimum.accumulate(used_at[::-1])[::-1]
    return np.asarray(np.maximum.accumulate(np.clip(usual, after, before)))


def _ticks_of_use(
    samples: Samples, published: Times, innovations: JointSeries | None
) -> NDArray[np.intp]:
    """Return the first tick after each measurement's innovation; past the last one if unknown."""
    if innovations is None:
        return np.full(samples.count, len(published))
    return np.searchsorted(published, _times_of_use(samples, innovations), side="left")


def _times_of_use(samples: Samples, innovations: JointSeries) -> Times:
    """Return when each measurement's innovation was published, ns since the epoch."""
    used_at = np.full(samples.count, _UNKNOWN)
    order = np.argsort(innovations.publish_times, kind="stable")
    # Of messages with the same stamp, each of another joint, every one has its own innovation.
    for joints in np.unique(samples.named, axis=0):
        own = np.flatnonzero((samples.named == joints).all(axis=1))
        theirs = order[innovations.named[order][:, joints].any(axis=1)]
        places = match(samples.stamps[own], innovations.stamps[theirs])
        found = places >= 0
        used_at[own[found]] = innovations.publish_times[theirs[places[found]]]
    return used_at


def match(wanted: Times, there: Times) -> NDArray[np.intp]:
    """Return where each stamp is found, -1 if nowhere, and no place twice, shape of `wanted`.

    Stamps come again where time restarted: the first is matched with the first.
    """
    places: dict[int, deque[int]] = defaultdict(deque)
    for place, stamp in enumerate(there.tolist()):
        places[stamp].append(place)
    none = deque([-1])
    return np.array(
        [(places.get(stamp) or none.copy()).popleft() for stamp in wanted.tolist()], dtype=np.intp
    )
