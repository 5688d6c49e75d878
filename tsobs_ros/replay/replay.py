# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's loop without its clock: measurements in, innovations and estimates out."""

import math
from collections import Counter
from collections.abc import Sequence
from enum import Enum, auto
from itertools import islice
from typing import TypeAlias

from tsobs_ros.estimation.records import (
    NANOSECONDS,
    Estimate,
    Innovation,
    RejectReason,
    Sample,
    stamp_of,
)
from tsobs_ros.estimation.tracker import JointTrackers
from tsobs_ros.replay.schedule import Evidence, Schedule
from tsobs_ros.replay.source import Samples
from tsobs_ros.replay.table import EstimateTable, Recorded

Estimates: TypeAlias = Sequence[Estimate | None]
_Outcomes: TypeAlias = Sequence[Innovation | RejectReason | None]
_Waiting: TypeAlias = tuple[int, list[Sample]]
_Used: TypeAlias = tuple[int, _Outcomes]


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


class Replay:
    """An observer that runs over samples.

    Args:
        trackers: Of the samples' joints.
        samples: The measurements.
        schedule: The ticks.
        table: Where the results are entered.
        recorded: Recorded output of an observer. As many of the messages that a tick may include
            are used as it takes to agree with it; all of them if None.
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
        table: EstimateTable,
        recorded: Recorded | None = None,
        stale_after: float = 5.0,
    ) -> None:
        self.used = 0
        self.rejected: Counter[RejectReason] = Counter()
        self._before_reset = Counter[str]()
        self._trackers = trackers
        self._samples, self._schedule, self._table = samples, schedule, table
        self._recorded = recorded
        self._certain = (schedule.evidence == Evidence.CERTAIN).tolist()
        self._possible = (schedule.evidence == Evidence.POSSIBLE).tolist()
        self._stale_after = stale_after * NANOSECONDS
        self._waiting = enumerate(samples.of_each_joint())
        self._offered, self._done, self._last = 0, 0, 0

    @property
    def rewinds(self) -> int:
        return self._before_reset["rewinds"] + sum(t.rewinds for t in self._trackers.trackers)

    @property
    def failures(self) -> int:
        return self._before_reset["failures"] + sum(t.failures for t in self._trackers.trackers)

    def advance(self, end: int) -> slice:
        """Make the ticks up to one; after the last, use what is left of the messages.

        Returns:
            The messages that were taken.
        """
        begin, schedule = self._offered, self._schedule
        columns = (schedule.stamps, schedule.now, schedule.min_known, schedule.max_known)
        own = slice(self._done, end)
        rows = zip(
            *(column[own].tolist() for column in (*columns, schedule.reset_after)), strict=True
        )
        ticks: list[int] = []
        found: list[Estimates] = []
        for tick, row in enumerate(rows, self._done):
            estimates = self._tick(tick, *row)
            if estimates.count(None) < len(estimates):
                self._last = row[0]
                ticks.append(tick)
                found.append(estimates)
        self._table.add(ticks, found)
        self._done = end
        if end == schedule.count:
            for message, sample in self._waiting:
                now = int(self._samples.arrivals[message])
                self._enter(end, self._offer_all([(message, sample)], now))
                self._offered = message + 1
        return slice(begin, self._offered)

    def _tick(
        self, tick: int, stamp: int, now: int, known: int, most: int, reset_after: int
    ) -> list[Estimate | None]:
        """Return the estimates of a tick."""
        recorded = self._recorded
        if reset_after >= 0:
            self._enter(tick, self._offer_all(self._next(reset_after), now, Choice.UNUSED))
            self._reset()
            self._last = 0
        included = self._next(known)
        if recorded is None or stamp <= self._last or self._are_certain(included):
            self._enter(tick, self._offer_all(included, now))
            if stamp <= self._last or (self._schedule.at_samples and not self._is_newest(stamp)):
                return []
            estimates = self._estimate(stamp)
        else:
            used, estimates = self._decide(recorded, tick, included, stamp, now)
            self._enter(tick, used)
        while self._offered < most and not (recorded and recorded.agrees(tick, estimates)):
            self._enter(tick, self._offer_all(self._next(self._offered + 1), now))
            if recorded or self._offered == most:
                estimates = self._estimate(stamp)
        return estimates

    def _next(self, end: int) -> list[_Waiting]:
        """Return the messages up to one that have not been taken yet."""
        taken = list(islice(self._waiting, max(0, end - self._offered)))
        self._offered += len(taken)
        return taken

    def _are_certain(self, messages: list[_Waiting]) -> bool:
        return all(self._certain[message] for message, _ in messages)

    def _decide(
        self, recorded: Recorded, tick: int, messages: list[_Waiting], stamp: int, now: int
    ) -> tuple[list[_Used], list[Estimate | None]]:
        """Use the messages that were received, of which the recorded estimates decide."""
        trackers, earlier = self._trackers, self._before_reset
        uncertain = [message for message, _ in messages if not self._certain[message]]
        starts = uncertain[1 : 1 + _SEARCH // len(messages)]
        for choice in (*Choice, *starts, Choice.LIKELY):
            self._trackers, self._before_reset = trackers.copy(), earlier.copy()
            used = self._offer_all(messages, now, choice)
            estimates = self._estimate(stamp)
            if recorded.agrees(tick, estimates):
                break
        return used, estimates

    def _offer_all(
        self, messages: list[_Waiting], now: int, choice: _Choice = Choice.LIKELY
    ) -> list[_Used]:
        """Use messages in the order of their stamps, as a tick of the node."""
        messages = sorted(messages, key=lambda one: stamp_of(one[1]))
        return [
            (message, self._outcomes(message, sample, now, choice)) for message, sample in messages
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
        if self._table.began_anew is None:
            self._table.began_anew = same
        return outcomes

    @staticmethod
    def _offer(trackers: JointTrackers, sample: list[Sample], now: int) -> _Outcomes:
        given = [None if isinstance(one, RejectReason) else one for one in sample]
        outcomes = trackers.offer(given, now)
        pairs = zip(sample, outcomes, strict=True)
        return [one if isinstance(one, RejectReason) else outcome for one, outcome in pairs]

    def _enter(self, tick: int, used: list[_Used]) -> None:
        for message, outcomes in used:
            for outcome in outcomes:
                if isinstance(outcome, Innovation):
                    self.used += 1
                elif outcome is not None:
                    self.rejected[outcome] += 1
            if outcomes:
                self._table.add_innovations(tick, message, outcomes)
            else:
                self._table.left_out[message] = True

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
