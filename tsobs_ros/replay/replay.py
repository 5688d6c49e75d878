# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's loop without its clock: measurements in, innovations and estimates out."""

import math
import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tsobs_ros.bag.joint_series import Flags, Times
from tsobs_ros.checks import Array
from tsobs_ros.estimation.history import CORRECTING, REASONS, USED
from tsobs_ros.estimation.records import NANOSECONDS, RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.replay.passes import LEFT_OUT, Pass, Ticks
from tsobs_ros.replay.schedule import Schedule
from tsobs_ros.replay.source import Samples
from tsobs_ros.replay.table import EstimateTable, Recorded

_NOTHING = np.zeros((0, 8))


class Replay:
    """An observer that runs over samples, each joint on its own.

    Args:
        trackers: Of the samples' joints.
        samples: The measurements.
        schedule: The ticks.
        table: Where the results are entered.
        recorded: Recorded output of an observer. As many of the messages that a tick may include
            are used as it takes to agree with it; all of them if None.
        stale_after: Age of a joint's newest measurement after which it is not estimated [s].

    Attributes:
        rejected: Number of measurements not used, by reason.
    """

    def __init__(
        self,
        trackers: Sequence[Tracker],
        samples: Samples,
        schedule: Schedule,
        table: EstimateTable,
        recorded: Recorded | None = None,
        stale_after: float = 5.0,
    ) -> None:
        self._trackers = tuple(trackers)
        self._schedule, self._table = schedule, table
        self._joints = [
            _Joint(tracker, joint, samples, schedule, recorded, stale_after)
            for joint, tracker in enumerate(trackers)
        ]
        # What cannot be read is refused, whenever that is; what names nobody is for all.
        unread = (samples.named & ~samples.complete).sum() + len(trackers) * (
            ~samples.named.any(axis=1)
        ).sum()
        self.rejected = Counter({RejectReason.WRONG_JOINT: int(unread)} if unread else {})
        self._taken, self._done, self._last = 0, 0, 0

    @property
    def used(self) -> int:
        """Number of measurements used, of all joints."""
        return int(np.isfinite(self._table.innovations).sum())

    @property
    def rewinds(self) -> int:
        """Number of late measurements put in their place."""
        return sum(tracker.rewinds for tracker in self._trackers)

    @property
    def failures(self) -> int:
        """Number of states or outputs that were not finite."""
        return sum(tracker.failures for tracker in self._trackers)

    def advance(self, end: int) -> slice:
        """Make the ticks up to one; after the last, use what is left of the messages.

        Returns:
            The messages that were taken.
        """
        begin, self._done = self._done, end
        workers = min(len(self._joints), os.cpu_count() or 1)
        if workers > 1:
            with ThreadPoolExecutor(workers) as pool:
                rows = list(pool.map(lambda joint: joint.advance(begin, end), self._joints))
        else:
            rows = [joint.advance(begin, end) for joint in self._joints]
        ticks = slice(begin, end)
        published = self._published(ticks)
        for joint, own in enumerate(rows):
            there = published & self._joints[joint].there(ticks)
            self._table.add(joint, ticks, own, there, self._trackers[joint].estimator.row_parts)
        taken = slice(self._taken, min(joint.next_message for joint in self._joints))
        self._taken = taken.stop
        for joint, each in enumerate(self._joints):
            self.rejected += each.enter(self._table, joint, taken)
        return taken

    def _published(self, ticks: slice) -> Flags:
        """Return the ticks at which a node would publish estimates; stamps rise to a restart."""
        schedule = self._schedule
        stamps, resets = schedule.stamps[ticks], schedule.reset_after[ticks] >= 0
        there: Flags = np.any([joint.there(ticks) for joint in self._joints], axis=0)
        if schedule.at_samples:
            there &= np.any([joint.newest(ticks) == stamps for joint in self._joints], axis=0)
        for part in np.split(np.arange(len(stamps)), np.flatnonzero(resets)):
            if len(part) and resets[part[0]]:
                self._last = 0
            before = np.maximum.accumulate(
                np.append(self._last, np.where(there[part], stamps[part], 0))
            )
            there[part] &= stamps[part] > before[:-1]
            self._last = int(before[-1])
        self._table.done[ticks] = there
        return there


class _Joint:
    """One joint's tracker on its way over the joint's samples.

    Args:
        tracker: The tracker.
        joint: Index of the joint.
        samples: The measurements of all joints.
        schedule: The ticks.
        recorded: Recorded output of an observer.
        stale_after: Age of the newest measurement after which nothing is estimated [s].
    """

    def __init__(
        self,
        tracker: Tracker,
        joint: int,
        samples: Samples,
        schedule: Schedule,
        recorded: Recorded | None,
        stale_after: float,
    ) -> None:
        mask = samples.named[:, joint] & samples.complete[:, joint]
        self._messages = np.flatnonzero(mask)
        self._count = np.concatenate([[0], np.cumsum(mask)])
        own, column = self._messages, slice(joint, joint + 1)
        resets = schedule.reset_after
        ticks = Ticks(
            schedule.stamps,
            schedule.now,
            self._count[schedule.min_known],
            self._count[schedule.max_known],
            np.where(resets >= 0, self._count[resets], -1),
            _NOTHING if recorded is None else np.ascontiguousarray(recorded.estimates[:, joint]),
        )
        self._pass = Pass(
            tracker,
            samples.stamps[own],
            samples.y[own, column],
            samples.u[own, column],
            ticks,
            arrivals=samples.arrivals[own],
            evidence=schedule.evidence[own],
            innovations=None if recorded is None else recorded.innovations[own, joint],
            stale_after=2**62 if math.isinf(stale_after) else int(stale_after * NANOSECONDS),
        )

    def advance(self, begin: int, end: int) -> Array:
        rows = self._pass.new_rows(end - begin)
        self._pass.advance(begin, end, rows)
        return rows

    def there(self, ticks: slice) -> Flags:
        return np.asarray(self._pass.results.there[ticks] != 0)

    def newest(self, ticks: slice) -> Times:
        return self._pass.results.newest[ticks]

    @property
    def next_message(self) -> int:
        """The first message that may be used yet; the number of messages if there is none."""
        taken = self._pass.taken
        return int(self._messages[taken]) if taken < len(self._messages) else len(self._count) - 1

    def enter(self, table: EstimateTable, joint: int, taken: slice) -> Counter[RejectReason]:
        """Enter the outcomes of some messages, and return the counts of those rejected."""
        own = slice(self._count[taken.start], self._count[taken.stop])
        messages, places = self._messages[own], self._pass.samples.places[own]
        results = self._pass.results
        outcomes = results.outcomes[places]
        used = np.isin(outcomes, CORRECTING)
        table.innovations[messages[used], joint] = results.innovations[places[used], 0]
        np.maximum.at(table.ticks_of_use, messages, results.ticks_of_use[places])
        table.left_out[messages[outcomes == LEFT_OUT]] = True
        if table.began_without_past is None:
            table.began_without_past = self._pass.began_without_past
        counts = np.bincount(outcomes[outcomes > USED], minlength=len(REASONS)).tolist()
        return Counter({r: n for r, n in zip(REASONS, counts, strict=True) if r is not None and n})
