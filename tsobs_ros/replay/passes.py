# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One tracker over ticks and samples, in compiled code that lets other threads of Python run.

Each tick uses the samples that it includes, in the order of their stamps, and estimates. If an
observer was recorded, its output decides which samples it received:

* those with a recorded innovation;
* of the others, those with which the estimate is the recorded one: alternatives are tried;
* none from before a restart, which shows in an innovation that only an observer without a past has.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled, compiled_nogil
from tsobs_ros.estimation.history import EXTRA, USED, estimate_at, newest_stamp, offer, slot_of
from tsobs_ros.estimation.tracker import Tracker

Times = NDArray[np.int64]
Codes = NDArray[np.int64]

NO_EVIDENCE, POSSIBLE, CERTAIN = 0, 1, 2
"""Evidence of a sample's reception: neither an innovation nor estimates for a while after it; no
innovation, as of one that was gated or rejected; an innovation, or no observer was recorded."""

LEFT_OUT, NOT_TAKEN = -1, -2
"""Outcomes besides the codes of `history.REASONS`: the recorded observer did not receive it; no
tick has taken it yet."""

# Which samples without certain evidence were received, as alternatives in the order of trial: those
# that are gated or rejected, as the others would have an innovation; those with some evidence; all;
# none; a number from 0 on: all from this one on, in the order of arrival. The likely one is last.
_UNUSED, _LIKELY, _ALL, _NONE, _LAST = -5, -4, -3, -2, -1

# How many samples are offered at most to find the first one that was received.
_SEARCH = 200_000

_TAKEN, _OFFERED, _BEGAN_ANEW = range(3)
_UNKNOWN, _UNRECORDED = -1, -2


class Track(NamedTuple):
    """The records of a tracker."""

    model: Any
    memory: Any
    ring: Any


class Samples(NamedTuple):
    """Measurements, n of them, in the order in which ticks use them.

    Attributes:
        stamps: [ns], shape (n,).
        arrivals: Arrival times on the clock of the stamps [ns], shape (n,).
        y: Outputs, shape (n, p).
        u: Inputs from each measurement until the next one, shape (n, m).
        evidence: Of reception, shape (n,).
        innovations: Recorded ones, NaN without, shape (n,).
        arrived: Place of each in the order of arrival, shape (n,).
        places: Inverse of `arrived`, shape (n,).
    """

    stamps: Times
    arrivals: Times
    y: Array
    u: Array
    evidence: Codes
    innovations: Array
    arrived: Codes
    places: Codes


class Ticks(NamedTuple):
    """A schedule's ticks, m of them, with numbers of the samples that `Samples` has.

    Attributes:
        states: Recorded estimates, NaN without, shape (m, 4); (0, 4) if no observer was recorded.
    """

    stamps: Times
    now: Times
    min_known: Codes
    max_known: Codes
    reset_after: Codes
    states: Array


class Results(NamedTuple):
    """Everything that comes out.

    Attributes:
        outcomes: Codes of the samples, shape (n,).
        innovations: y − ŷ of those that are used, shape (n, p).
        expected_std: 1σ expected of each, shape (n, p).
        ticks_of_use: Tick that took a sample, shape (n,).
        newest: Stamp of the newest sample in use at a tick [ns], shape (m,).
        there: 1 if there is an estimate at a tick, shape (m,).
        counts: Samples taken for certain, and at all; whether the first recorded innovation is that
            of a tracker without a past, -1 before it, -2 if nothing was recorded; and the same
            before an alternative, shape (2, 3).
    """

    outcomes: Codes
    innovations: Array
    expected_std: Array
    ticks_of_use: Codes
    newest: Times
    there: Codes
    counts: Codes


class Pass:
    """A tracker on its way over samples and ticks.

    Args:
        tracker: The tracker.
        stamps: Of n samples in the order of arrival [ns], shape (n,).
        y: Outputs, shape (n, p).
        u: Inputs from each sample until the next one, shape (n, m).
        ticks: The ticks.
        arrivals: Arrival times on the clock of the stamps [ns], shape (n,).
        evidence: Of reception, shape (n,); certain if None.
        innovations: Recorded ones, NaN without, shape (n,).
        stale_after: Age of the newest sample after which nothing is estimated [ns].

    Attributes:
        samples: The samples, in the order in which ticks use them.
        results: What has come out of them.
    """

    def __init__(
        self,
        tracker: Tracker,
        stamps: Times,
        y: Array,
        u: Array,
        ticks: Ticks,
        *,
        arrivals: Times | None = None,
        evidence: Codes | None = None,
        innovations: Array | None = None,
        stale_after: int = 2**62,
    ) -> None:
        n, m = len(stamps), len(ticks.stamps)
        bounds = np.unique(np.concatenate([ticks.min_known, ticks.reset_after]))
        ticks_of_use = np.searchsorted(bounds, np.arange(n), side="right")
        arrived = np.lexsort((stamps, ticks_of_use))
        places = np.empty(n, np.int64)
        places[arrived] = np.arange(n)
        self.samples = Samples(
            stamps[arrived],
            (stamps if arrivals is None else arrivals)[arrived],
            np.ascontiguousarray(y[arrived]),
            np.ascontiguousarray(u[arrived]),
            np.full(n, CERTAIN) if evidence is None else evidence[arrived].astype(np.int64),
            np.full(n, np.nan) if innovations is None else innovations[arrived],
            arrived,
            places,
        )
        began = _UNRECORDED if innovations is None else _UNKNOWN
        self.results = Results(
            np.full(n, NOT_TAKEN),
            np.full((n, y.shape[1]), np.nan),
            np.full((n, y.shape[1]), np.nan),
            np.full(n, -1),
            np.zeros(m, np.int64),
            np.zeros(m, np.int64),
            np.array([[0, 0, began]] * 2),
        )
        self._tracker, self._ticks, self._stale_after = tracker, ticks, stale_after
        estimator, options = tracker.estimator, tracker.options
        alternatives = [Tracker(estimator, options) for _ in range(2 * (innovations is not None))]
        own, first, second = (alternatives and [tracker, *alternatives]) or [tracker] * 3
        self._tracks = (_track(own), _track(first), _track(second))

    @property
    def taken(self) -> int:
        """The number of samples that have been taken."""
        return int(self.results.counts[0, _OFFERED])

    @property
    def began_anew(self) -> bool | None:
        """Whether the first recorded innovation is that of a tracker without a past."""
        code = int(self.results.counts[0, _BEGAN_ANEW])
        return None if code < 0 else bool(code)

    def advance(self, begin: int, end: int) -> Array:
        """Make the ticks from one up to another, and return a row of estimates for each.

        A row is as `history.estimate_at` writes it, where `results.there` is 1.
        """
        rows = np.empty((end - begin, self._tracker.estimator.row_width + EXTRA))
        advance(
            self._tracks,
            self.samples,
            self._ticks,
            self.results,
            rows,
            begin,
            end,
            self._stale_after,
        )
        return rows


def _track(tracker: Tracker) -> Track:
    return Track(tracker.estimator.model, tracker.memory, tracker.ring)


@compiled_nogil
def advance(
    tracks: tuple[Track, Track, Track],
    samples: Samples,
    ticks: Ticks,
    results: Results,
    rows: Array,
    begin: int,
    end: int,
    stale_after: int,
) -> None:
    """Make the ticks from one up to another; after the last, use what is left of the samples.

    Args:
        tracks: The tracker, and two like it to try alternatives with.
        samples: The samples.
        ticks: The ticks.
        results: Written at the ticks and their samples.
        rows: The estimates, written from the first row on; see `history.estimate_at`.
        begin: The first tick.
        end: The tick after the last.
        stale_after: Age of the newest sample after which nothing is estimated [ns].
    """
    counts, is_recorded = results.counts[0], len(ticks.states) > 0
    for tick in range(begin, end):
        now, reset_after = ticks.now[tick], ticks.reset_after[tick]
        if reset_after >= 0:
            _take(tracks, samples, results, reset_after, tick, now, _UNUSED)
            _restart(tracks[0])
        row = rows[tick - begin]
        known, most = ticks.min_known[tick], ticks.max_known[tick]
        if is_recorded and not _are_certain(samples, results, known):
            _decide(tracks, samples, ticks, results, row, tick, stale_after)
        else:
            _take(tracks, samples, results, known, tick, now, _LIKELY)
            _estimate(tracks[0], ticks, results, row, tick, stale_after)
        while counts[_OFFERED] < most and not _agrees(ticks, results, row, tick):
            place = samples.places[counts[_OFFERED]]
            counts[_OFFERED] += 1
            _use(tracks, samples, results, place, tick, now, _LIKELY)
            if is_recorded or counts[_OFFERED] == most:
                _estimate(tracks[0], ticks, results, row, tick, stale_after)
    if end == len(ticks.stamps):
        for arrived in range(counts[_OFFERED], len(samples.stamps)):
            place = samples.places[arrived]
            _use(tracks, samples, results, place, end, samples.arrivals[place], _LIKELY)
        counts[_OFFERED] = len(samples.stamps)


@compiled
def _are_certain(samples: Samples, results: Results, end: int) -> bool:
    for place in range(results.counts[0, _TAKEN], end):
        taken = samples.arrived[place] < results.counts[0, _OFFERED]
        if not taken and samples.evidence[place] != CERTAIN:
            return False
    return True


@compiled
def _decide(
    tracks: tuple[Track, Track, Track],
    samples: Samples,
    ticks: Ticks,
    results: Results,
    row: Array,
    tick: int,
    stale_after: int,
) -> None:
    """Use the samples with which the estimate is the recorded one, and estimate."""
    counts, end, now = results.counts, ticks.min_known[tick], ticks.now[tick]
    begin = counts[0, _OFFERED]
    tries, choice = _SEARCH // (end - begin), _UNUSED
    _copy_track(tracks[0], tracks[1])
    counts[1] = counts[0]
    while True:
        _take(tracks, samples, results, end, tick, now, choice)
        _estimate(tracks[0], ticks, results, row, tick, stale_after)
        if choice == _LAST or _agrees(ticks, results, row, tick):
            return
        tries -= choice >= 0
        choice = _following(samples, choice, begin, end if tries > 0 else begin)
        _copy_track(tracks[1], tracks[0])
        counts[0] = counts[1]


@compiled
def _following(samples: Samples, choice: int, begin: int, end: int) -> int:
    """Return the alternative to try after another."""
    if choice < _NONE:
        return choice + 1
    # To begin with the first one is to use all.
    is_first = choice == _NONE
    for arrived in range(max(begin, choice + 1), end):
        if samples.evidence[samples.places[arrived]] != CERTAIN:
            if not is_first:
                return arrived
            is_first = False
    return _LAST


@compiled
def _agrees(ticks: Ticks, results: Results, row: Array, tick: int) -> bool:
    """Return whether the estimate is the recorded one."""
    if len(ticks.states) == 0:
        return False
    there = results.there[tick] != 0
    for i in range(4):
        recorded = ticks.states[tick, i]
        if there != (recorded == recorded) or (there and row[i] != recorded):
            return False
    return True


@compiled
def _take(
    tracks: tuple[Track, Track, Track],
    samples: Samples,
    results: Results,
    end: int,
    tick: int,
    now: int,
    choice: int,
) -> None:
    """Use the samples up to one that have not been used yet, in the order of their stamps."""
    counts, place = results.counts[0], results.counts[0, _TAKEN]
    # One by one as long as there may be something to decide, and the others as a batch.
    offered, certain = counts[_OFFERED], _are_certain(samples, results, end)
    checked = counts[_BEGAN_ANEW] == _UNRECORDED
    while place < end and not (certain and checked and offered <= counts[_TAKEN]):
        if samples.arrived[place] >= offered:
            _use(tracks, samples, results, place, tick, now, choice)
            wanted = samples.innovations[place]
            checked = checked or wanted == wanted
        place += 1
    if place < end:
        _offer(tracks[0], samples, results, place, end, tick, now)
    counts[_TAKEN] = max(counts[_TAKEN], end)
    counts[_OFFERED] = max(offered, end)


@compiled
def _use(
    tracks: tuple[Track, Track, Track],
    samples: Samples,
    results: Results,
    place: int,
    tick: int,
    now: int,
    choice: int,
) -> None:
    """Use a sample if it was received."""
    certain = samples.evidence[place] == CERTAIN
    if not (certain or _is_received(samples, place, choice)):
        results.outcomes[place] = LEFT_OUT
        return
    undone = choice == _UNUSED and not certain
    if undone:
        _copy_track(tracks[0], tracks[2])
    _offer(tracks[0], samples, results, place, place + 1, tick, now)
    wanted = samples.innovations[place]
    if undone and results.outcomes[place] == USED:
        _copy_track(tracks[2], tracks[0])
        results.outcomes[place] = LEFT_OUT
    elif wanted == wanted:
        is_same = _innovation(results, place) == wanted
        if not is_same:
            # If not of a tracker without a past, the sample must be used once more as before.
            _copy_track(tracks[0], tracks[2])
            _restart(tracks[2])
            outcome, innovation, std = (
                results.outcomes[place],
                results.innovations[place, 0],
                results.expected_std[place, 0],
            )
            _offer(tracks[2], samples, results, place, place + 1, tick, now)
            is_same = _innovation(results, place) == wanted
            if is_same:
                _copy_track(tracks[2], tracks[0])
            else:
                results.outcomes[place] = outcome
                results.innovations[place, 0] = innovation
                results.expected_std[place, 0] = std
        if results.counts[0, _BEGAN_ANEW] < 0:
            results.counts[0, _BEGAN_ANEW] = is_same


@compiled
def _is_received(samples: Samples, place: int, choice: int) -> bool:
    if choice >= 0:
        later: bool = samples.arrived[place] >= choice
        return later
    if choice in (_ALL, _NONE):
        return choice == _ALL
    possible: bool = samples.evidence[place] == POSSIBLE
    return possible


@compiled
def _innovation(results: Results, place: int) -> float:
    return results.innovations[place, 0] if results.outcomes[place] == USED else math.nan


@compiled
def _offer(
    track: Track,
    samples: Samples,
    results: Results,
    begin: int,
    end: int,
    tick: int,
    now: int,
) -> None:
    offer(
        track.model,
        track.memory,
        track.ring,
        samples.stamps[begin:end],
        samples.y[begin:end],
        samples.u[begin:end],
        now,
        results.outcomes[begin:end],
        results.innovations[begin:end],
        results.expected_std[begin:end],
    )
    results.ticks_of_use[begin:end] = tick


@compiled
def _estimate(
    track: Track, ticks: Ticks, results: Results, row: Array, tick: int, stale_after: int
) -> None:
    """Estimate, as the node does, which publishes nothing without recent measurements."""
    newest, stamp = newest_stamp(track.memory[0], track.ring), ticks.stamps[tick]
    results.newest[tick] = newest
    results.there[tick] = (
        newest > 0
        and stamp - newest <= stale_after
        and estimate_at(track.model, track.memory, track.ring, stamp, row)
    )


@compiled
def _restart(track: Track) -> None:
    """Forget the measurements, but not the counts."""
    memory = track.memory[0]
    if memory.size > 0:
        memory.bad_outputs += track.ring[slot_of(memory, track.ring, memory.size - 1)].failures
    memory.first, memory.size, memory.has_base, memory.coasted_periods = 0, 0, 0, 0


@compiled
def _copy_track(source: Track, target: Track) -> None:
    target.memory[0] = source.memory[0]
    memory, ring, last = source.memory[0], source.ring, len(source.ring) - 1
    for place in range(memory.size):
        target.ring[slot_of(memory, ring, place)] = ring[slot_of(memory, ring, place)]
    target.ring[last - 1] = ring[last - 1]
