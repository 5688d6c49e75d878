# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's loop without its clock: measurements in, innovations and estimates out."""

import math
import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tsobs_ros.bag.joint_series import Times
from tsobs_ros.checks import Array, Flags
from tsobs_ros.estimation.history import GATED, NON_FINITE, REASONS, USED
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.replay.passes import LEFT_OUT, Codes, Pass, Ticks
from tsobs_ros.replay.schedule import Schedule
from tsobs_ros.replay.source import Samples
from tsobs_ros.replay.table import EstimateTable, Recorded
from tsobs_ros.series import NANOSECONDS


class Replay:
    """An observer that runs over samples, each joint on its own.

    Args:
        trackers: Of the samples' joints.
        stale_after: Age of a joint's newest measurement after which it is not estimated [s].

    Attributes:
        rejected: Number of measurements not used, by reason.
        outputs: Of each joint, for each of its outputs, how often it was gated and how often it
            was missing, shape (p, 2).
        taken: Number of the first samples that all joints have taken.
    """

    _samples: Samples
    _schedule: Schedule
    _table: EstimateTable

    def __init__(self, trackers: Sequence[Tracker], stale_after: float = 5.0) -> None:
        self._trackers = tuple(trackers)
        self._stale_after = stale_after
        self.rejected: Counter[RejectReason] = Counter()
        self.outputs = [np.zeros((one.estimator.shape.p, 2), np.int64) for one in trackers]
        self._joints: list[_Joint] = []
        self._used, self._last, self._done, self.taken = 0, 0, 0, 0

    def enter(
        self,
        samples: Samples,
        schedule: Schedule,
        table: EstimateTable,
        recorded: Recorded | None = None,
        dropped: int = 0,
    ) -> None:
        """Go on with other samples, of which the first are the last of those until now.

        Args:
            samples: The measurements.
            schedule: Their ticks, without those that were made.
            table: Where the results are entered.
            recorded: Recorded output of an observer. As many of the messages that a tick may
                include are used as it takes to agree with it; all of them if None.
            dropped: Number of samples until now that are not among the others; all were taken.
        """
        skipped = [0] * len(self._trackers)
        if self._joints:
            ahead = slice(self.taken, self._samples.count)
            for joint, each in enumerate(self._joints):
                self._count(joint, *each.enter(self._table, joint, ahead))
            self._used += _count_used(self._table.innovations[:dropped])
            table.take_over(self._table, dropped)
            skipped = [each.used_since(dropped) for each in self._joints]
        self._samples, self._schedule, self._table = samples, schedule, table
        self._joints = [
            _Joint(tracker, joint, samples, schedule, recorded, self._stale_after, skip)
            for joint, (tracker, skip) in enumerate(zip(self._trackers, skipped, strict=True))
        ]
        self._done, self.taken = 0, self.taken - dropped

    @property
    def used(self) -> int:
        """Number of measurements used, of all joints."""
        return self._used + _count_used(self._table.innovations)

    @property
    def reached(self) -> int:
        """Number of the first messages among which are all that were used."""
        return max(joint.reached for joint in self._joints)

    @property
    def began_without_past(self) -> bool | None:
        """Whether the first recorded innovation of these samples is of an observer without past.

        None without any.
        """
        found = (joint.began_without_past for joint in self._joints)
        return next((one for one in found if one is not None), None)

    @property
    def rewinds(self) -> int:
        """Number of late measurements put in their place."""
        return sum(tracker.rewinds for tracker in self._trackers)

    @property
    def failures(self) -> int:
        """Number of states or outputs that were not finite."""
        return sum(tracker.failures for tracker in self._trackers)

    def advance(self, end: int) -> slice:
        """Make the ticks up to one.

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
            self._table.add(joint, ticks, self._trackers[joint].estimator.as_rows(own), there)
        return self._enter()

    def use(self, end: int) -> slice:
        """Use the messages up to one without a tick.

        Returns:
            The messages that were taken.
        """
        for joint in self._joints:
            joint.use(self._done, end)
        return self._enter()

    def _enter(self) -> slice:
        """Enter the results of the messages that all joints have taken, and return them."""
        taken = slice(self.taken, min(joint.next_message for joint in self._joints))
        self.taken = taken.stop
        for joint, each in enumerate(self._joints):
            self._count(joint, *each.enter(self._table, joint, taken))
        # What cannot be read is refused, whenever that is; what names nobody is for all.
        named, complete = self._samples.named[taken], self._samples.complete[taken]
        unread = int((named & ~complete).sum())
        unread += len(self._joints) * int((~named.any(axis=1)).sum())
        if unread:
            self.rejected[RejectReason.WRONG_JOINT] += unread
        return taken

    def _count(self, joint: int, rejected: Counter[RejectReason], outputs: Codes) -> None:
        self.rejected += rejected
        self.outputs[joint] += outputs

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


def _count_used(innovations: Array) -> int:
    return int(np.isfinite(innovations).any(axis=2).sum())


class _Joint:
    """One joint's tracker on its way over the joint's samples.

    Args:
        tracker: The tracker.
        joint: Index of the joint.
        samples: The measurements of all joints.
        schedule: The ticks.
        recorded: Recorded output of an observer.
        stale_after: Age of the newest measurement after which nothing is estimated [s].
        skipped: Number of its first measurements that it has used already.
    """

    def __init__(
        self,
        tracker: Tracker,
        joint: int,
        samples: Samples,
        schedule: Schedule,
        recorded: Recorded | None,
        stale_after: float,
        skipped: int,
    ) -> None:
        mask = samples.named[:, joint] & samples.complete[:, joint]
        self._skipped = np.flatnonzero(mask)[:skipped]
        mask[self._skipped] = False
        self._schedule = schedule
        self._messages = np.flatnonzero(mask)
        self._count = np.concatenate([[0], np.cumsum(mask)])
        own, shape = self._messages, tracker.estimator.shape
        outputs = slice(shape.p)
        estimates = np.zeros((0, 2 * shape.plant))
        if recorded is not None:
            both = recorded.states[:, joint], recorded.state_bounds[:, joint]
            estimates = np.hstack([each[:, : shape.plant] for each in both])
        resets = schedule.reset_after
        ticks = Ticks(
            schedule.stamps,
            schedule.now,
            self._count[schedule.min_known],
            self._count[schedule.max_known],
            np.where(resets >= 0, self._count[resets], -1),
            estimates,
        )
        self._pass = Pass(
            tracker,
            samples.stamps[own],
            samples.y[own, joint, outputs],
            samples.u[own, joint, : shape.m],
            ticks,
            arrivals=samples.arrivals[own],
            evidence=schedule.evidence[own],
            innovations=None if recorded is None else recorded.innovations[own, joint, outputs],
            stale_after=2**62 if math.isinf(stale_after) else int(stale_after * NANOSECONDS),
        )

    def advance(self, begin: int, end: int) -> Array:
        rows = self._pass.new_rows(end - begin)
        self._pass.advance(begin, end, rows)
        return rows

    def use(self, tick: int, end: int) -> None:
        self._pass.use(tick, int(self._count[end]))

    @property
    def reached(self) -> int:
        """The message after the last that was used."""
        used = np.append(self._skipped, self._messages[: self._pass.taken])
        return int(used.max(initial=-1)) + 1

    def used_since(self, message: int) -> int:
        """Return the number of its measurements that it has used from a message on."""
        used = np.append(self._skipped, self._messages[: self._pass.taken])
        return int((used >= message).sum())

    @property
    def began_without_past(self) -> bool | None:
        return self._pass.began_without_past

    def there(self, ticks: slice) -> Flags:
        return np.asarray(self._pass.results.there[ticks] != 0)

    def newest(self, ticks: slice) -> Times:
        return self._pass.results.newest[ticks]

    @property
    def next_message(self) -> int:
        """The first message that may be used yet; the number of messages if there is none."""
        taken = self._pass.taken
        return int(self._messages[taken]) if taken < len(self._messages) else len(self._count) - 1

    def enter(
        self, table: EstimateTable, joint: int, taken: slice
    ) -> tuple[Counter[RejectReason], Codes]:
        """Enter the outcomes of some messages, and return their counts.

        Returns:
            Of those rejected by reason; of each output that was gated, and that was missing.
        """
        own = slice(self._count[taken.start], self._count[taken.stop])
        messages, places = self._messages[own], self._pass.samples.places[own]
        results = self._pass.results
        outcomes = results.outcomes[places]
        innovations = results.used_innovations(places)
        table.innovations[messages, joint, : innovations.shape[1]] = innovations
        ticks = results.ticks_of_use[places]
        known = (ticks >= 0) & (ticks < self._schedule.count)
        times = [self._schedule.log_times, self._schedule.publish_times]
        of_use = np.stack([each[ticks[known]] for each in times], axis=-1)
        messages_of_use = messages[known]
        table.times_of_use[messages_of_use] = np.maximum(
            table.times_of_use[messages_of_use], of_use
        )
        table.left_out[messages[outcomes == LEFT_OUT]] = True
        counts = np.bincount(outcomes[outcomes > USED], minlength=len(REASONS)).tolist()
        rejected = {r: n for r, n in zip(REASONS, counts, strict=True) if r is not None and n}
        codes = results.output_codes[places]
        outputs = [(codes == code).sum(axis=0) for code in (GATED, NON_FINITE)]
        return Counter(rejected), np.stack(outputs, axis=1)
