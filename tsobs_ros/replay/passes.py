# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One tracker over ticks and samples; other threads of Python can run meanwhile.

Each tick uses the samples that it includes, in the order of their stamps, and estimates. If an
observer was recorded, its output decides which samples it received:

* those with a recorded innovation;
* of the others, those with which the estimate is the recorded one: alternatives are tried;
* none from before a restart, which shows in an innovation that only an observer without a past has.

Ticks with nothing to decide, which are most, are made by core/history.c.
"""

from enum import Enum, auto
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array
from tsobs_ros.estimation.history import (
    CORRECTING,
    USED,
)
from tsobs_ros.estimation.tracker import Tracker

Times = NDArray[np.int64]
Codes = NDArray[np.int64]

NO_EVIDENCE, POSSIBLE, CERTAIN = 0, 1, 2
"""Evidence of a sample's reception: neither an innovation nor estimates for a while after it; no
innovation, as of one that was gated or rejected; an innovation, or no observer was recorded."""

LEFT_OUT, NOT_TAKEN = -1, -2
"""Outcomes besides the codes of `history.REASONS`: the recorded observer did not receive it; no
tick has taken it yet."""

# How many samples are offered at most to find the first one that was received.
_SEARCH = 20_000

_TAKEN, _OFFERED = range(2)
_ALL = slice(None)


class _Choice(Enum):
    """Which samples without certain evidence were received, in the order of trial."""

    UNUSED = auto()
    """Those that are gated or rejected, as the others would have an innovation."""
    LIKELY = auto()
    """Those with some evidence."""
    ALL = auto()
    """All; the innovations were lost."""
    NONE = auto()
    """None."""


_From: TypeAlias = _Choice | int
"""A number: all from this one on, in the order of arrival."""


class Samples(NamedTuple):
    """Measurements, n of them, in the order in which ticks use them.

    Attributes:
        stamps: [ns], shape (n,).
        arrivals: Arrival times on the clock of the stamps [ns], shape (n,).
        y: Outputs, shape (n, p).
        u: Inputs from each measurement until the next one, shape (n, m).
        evidence: Of reception, shape (n,).
        innovations: Recorded ones, NaN without, shape (n, p).
        begins: 1 if the recorded innovations are those of a zero estimate, from which all
            estimators start, shape (n,).
        arrived: Place of each in the order of arrival, shape (n,).
        places: Inverse of `arrived`, shape (n,).
    """

    stamps: Times
    arrivals: Times
    y: Array
    u: Array
    evidence: Codes
    innovations: Array
    begins: Codes
    arrived: Codes
    places: Codes


class Ticks(NamedTuple):
    """A schedule's ticks, m of them, with numbers of the samples that `Samples` has.

    Attributes:
        estimates: Recorded states and their bounds, NaN without, shape (m, 2 plant); none if no
            observer was recorded. What was received last may show in the bounds alone.
    """

    stamps: Times
    now: Times
    min_known: Codes
    max_known: Codes
    reset_after: Codes
    estimates: Array


class Results(NamedTuple):
    """Everything that comes out.

    Attributes:
        outcomes: Codes of the samples, shape (n,).
        output_codes: Codes of each output, shape (n, p).
        innovations: y − ŷ of those that are used, shape (n, p).
        expected_std: 1σ expected of each, shape (n, p).
        ticks_of_use: Tick that took a sample, shape (n,).
        newest: Stamp of the newest sample in use at a tick [ns], shape (m,).
        there: 1 if there is an estimate at a tick, shape (m,).
        counts: Numbers of samples taken for certain, and at all, shape (2,).
    """

    outcomes: Codes
    output_codes: Codes
    innovations: Array
    expected_std: Array
    ticks_of_use: Codes
    newest: Times
    there: Codes
    counts: Codes

    def used_innovations(self, places: NDArray[np.intp] | Codes | slice = _ALL) -> Array:
        """Return the innovations of some samples, NaN of outputs that were not used, (i, p)."""
        return np.where(self.output_codes[places] == USED, self.innovations[places], np.nan)


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
        innovations: Recorded ones, NaN without, shape (n, p).
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
        arrived = np.arange(n)
        if (np.diff(stamps) < 0).any():
            bounds = np.sort(np.concatenate([ticks.min_known, ticks.reset_after]))
            arrived = np.lexsort((stamps, np.searchsorted(bounds, arrived, side="right")))
        places = np.empty(n, np.int64)
        places[arrived] = np.arange(n)
        wanted = np.full(y.shape, np.nan) if innovations is None else innovations[arrived]
        samples = np.ascontiguousarray(y[arrived])
        recorded = np.isfinite(wanted)
        begins = recorded.any(axis=1) & (~recorded | (samples == wanted)).all(axis=1)
        self.samples = Samples(
            stamps[arrived],
            (stamps if arrivals is None else arrivals)[arrived],
            samples,
            np.ascontiguousarray(u[arrived]),
            np.full(n, CERTAIN) if evidence is None else evidence[arrived],
            wanted,
            begins.astype(np.int64),
            arrived,
            places,
        )
        self.results = Results(
            np.full(n, NOT_TAKEN),
            np.full(y.shape, NOT_TAKEN),
            np.full(y.shape, np.nan),
            np.full(y.shape, np.nan),
            np.full(n, -1),
            np.zeros(m, np.int64),
            np.zeros(m, np.int64),
            np.zeros(2, np.int64),
        )
        self._ticks, self._stale_after = ticks, stale_after
        self._plain_until = self._ends_of_plain_ticks()
        others = 2 * (innovations is not None)
        self._tracker = tracker
        # To try alternatives with.
        self._spare = [Tracker(tracker.estimator, tracker.options) for _ in range(others)]

    def _ends_of_plain_ticks(self) -> NDArray[np.intp]:
        """Return for each tick the next one with anything to decide, shape (m,)."""
        ticks, known = self._ticks, self._ticks.min_known
        open_ = (self.samples.evidence != CERTAIN) | (self.samples.begins != 0)
        opened = np.concatenate([[0], np.cumsum(open_)])[known]
        undecided = (ticks.reset_after >= 0) | (ticks.max_known > known)
        undecided |= np.diff(opened, prepend=0) > 0
        ends = np.where(undecided, np.arange(len(known)), len(known))
        return np.asarray(np.minimum.accumulate(ends[::-1])[::-1])

    @property
    def taken(self) -> int:
        """The number of samples that have been taken."""
        return int(self.results.counts[_OFFERED])

    @property
    def began_without_past(self) -> bool | None:
        """Whether the first recorded innovation is that of a tracker without a past.

        None if there is none, or no tick has taken its sample.
        """
        recorded = np.flatnonzero(np.isfinite(self.samples.innovations).any(axis=1))
        if not len(recorded) or self.results.outcomes[recorded[0]] == NOT_TAKEN:
            return None
        return self._has_recorded_innovation(int(recorded[0]))

    def new_rows(self, count: int) -> Array:
        """Return room for as many estimates."""
        return self._tracker.estimator.new_rows(count)

    def advance(self, begin: int, end: int, rows: Array) -> None:
        """Make the ticks from one up to another.

        Args:
            begin: The first tick.
            end: The tick after the last.
            rows: Estimates as `History.estimate_at` writes them, written where `results.there` is
                1 and else undefined, shape (end − begin, width).
        """
        tick, counts = begin, self.results.counts
        while tick < end:
            plain = int(self._plain_until[tick])
            # A tick before has taken more, or less, than the schedule says.
            if counts[_TAKEN] != counts[_OFFERED] or counts[_TAKEN] > self._ticks.min_known[tick]:
                plain = tick
            plain = min(plain, end)
            if plain > tick:
                self._make_plain(tick, plain, rows[tick - begin :])
            else:
                self._make(tick, rows[tick - begin])
            tick = max(plain, tick + 1)

    def use(self, tick: int, end: int) -> None:
        """Use the samples up to one in the order of arrival, without a tick.

        Args:
            tick: The tick before which they are used.
            end: The sample after the last.
        """
        for place in self.samples.places[self.taken : end].tolist():
            self._use(place, tick, int(self.samples.arrivals[place]), _Choice.LIKELY)
        self.results.counts[:] = np.maximum(self.results.counts, end)

    def _make_plain(self, begin: int, end: int, rows: Array) -> None:
        """Make ticks with nothing to decide."""
        samples, results, ticks = self.samples, self.results, self._ticks
        known, taken = ticks.min_known[begin:end], int(results.counts[_TAKEN])
        own, made = slice(taken, int(known[-1])), slice(begin, end)
        self._tracker.history.advance(
            samples.stamps[own], samples.y[own], samples.u[own],
            results.outcomes[own], results.output_codes[own],
            results.innovations[own], results.expected_std[own],
            ticks.stamps[made], ticks.now[made], known - taken,
            results.newest[made], results.there[made], rows, self._stale_after,
        )  # fmt: skip
        results.ticks_of_use[own] = np.repeat(np.arange(begin, end), np.diff(known, prepend=taken))
        results.counts[:] = known[-1]

    def _make(self, tick: int, row: Array) -> None:
        """Make a tick with something to decide."""
        ticks, counts = self._ticks, self.results.counts
        now, known, most, reset_after = (
            int(column[tick])
            for column in (ticks.now, ticks.min_known, ticks.max_known, ticks.reset_after)
        )
        if reset_after >= 0:
            self._take(reset_after, tick, now, _Choice.UNUSED)
            self._tracker.history.forget()
        begin, before = self.taken, counts.copy()
        uncertain = [
            arrived
            for arrived in range(begin, known)
            if self.samples.evidence[self.samples.places[arrived]] != CERTAIN
        ]
        starts = uncertain[1 : 1 + _SEARCH // max(1, known - begin)]
        choices = (
            [*_Choice, *starts, _Choice.LIKELY] if self._spare and uncertain else [_Choice.LIKELY]
        )
        if len(choices) > 1:
            _copy(self._tracker, self._spare[0])
        for number, choice in enumerate(choices):
            if number:
                _copy(self._spare[0], self._tracker)
                counts[:] = before
            self._take(known, tick, now, choice)
            self._estimate(tick, row)
            if self._agrees(tick, row):
                break
        while self.taken < most and not self._agrees(tick, row):
            place = int(self.samples.places[self.taken])
            counts[_OFFERED] += 1
            self._use(place, tick, now, _Choice.LIKELY)
            if self._spare or self.taken == most:
                self._estimate(tick, row)

    def _agrees(self, tick: int, row: Array) -> bool:
        """Return whether the estimate is the recorded one."""
        if not len(self._ticks.estimates):
            return False
        recorded = self._ticks.estimates[tick]
        if not self.results.there[tick]:
            return bool(np.isnan(recorded).all())
        same, bounds = row[: len(recorded)] == recorded, slice(len(recorded) // 2, None)
        same[bounds] |= np.isnan(recorded[bounds])
        return bool(same.all())

    def _take(self, end: int, tick: int, now: int, choice: _From) -> None:
        """Use the samples up to one that have not been used yet, in the order of their stamps."""
        counts, offered = self.results.counts, self.taken
        for place in range(int(counts[_TAKEN]), end):
            if self.samples.arrived[place] >= offered:
                self._use(place, tick, now, choice)
        counts[:] = np.maximum(counts, end)

    def _use(self, place: int, tick: int, now: int, choice: _From) -> None:
        """Use a sample if it was received."""
        samples, results, tracker = self.samples, self.results, self._tracker
        certain = samples.evidence[place] == CERTAIN
        results.ticks_of_use[place] = tick
        if not (certain or self._is_received(place, choice)):
            self._leave_out(place)
            return
        undone = choice is _Choice.UNUSED and not certain and bool(self._spare)
        if undone or samples.begins[place]:
            _copy(tracker, self._spare[1])
        self._offer(tracker, place, now)
        if undone and results.outcomes[place] in CORRECTING:
            _copy(self._spare[1], tracker)
            self._leave_out(place)
        if samples.begins[place] and not self._has_recorded_innovation(place):
            _copy(self._spare[1], tracker)
            tracker.history.forget()
            self._offer(tracker, place, now)

    def _leave_out(self, place: int) -> None:
        self.results.outcomes[place] = self.results.output_codes[place] = LEFT_OUT

    def _is_received(self, place: int, choice: _From) -> bool:
        if isinstance(choice, int):
            return bool(self.samples.arrived[place] >= choice)
        if choice in (_Choice.ALL, _Choice.NONE):
            return choice is _Choice.ALL
        return bool(self.samples.evidence[place] == POSSIBLE)

    def _has_recorded_innovation(self, place: int) -> bool:
        own = self.results.used_innovations(slice(place, place + 1))[0]
        return np.array_equal(own, self.samples.innovations[place], equal_nan=True)

    def _offer(self, tracker: Tracker, place: int, now: int) -> None:
        own, samples, results = slice(place, place + 1), self.samples, self.results
        tracker.history.offer(
            samples.stamps[own],
            samples.y[own],
            samples.u[own],
            now,
            results.outcomes[own],
            results.output_codes[own],
            results.innovations[own],
            results.expected_std[own],
        )

    def _estimate(self, tick: int, row: Array) -> None:
        tracker, stamp = self._tracker, int(self._ticks.stamps[tick])
        newest = tracker.newest or 0
        self.results.newest[tick] = newest
        self.results.there[tick] = (
            newest > 0
            and stamp - newest <= self._stale_after
            and tracker.history.estimate_at(stamp, row)
        )


def _copy(source: Tracker, target: Tracker) -> None:
    source.history.copy_to(target.history)
