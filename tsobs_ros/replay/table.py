# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates and innovations of a replay as arrays, and whether they are those of a live run."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tsobs_ros.bag.messages import estimate_topics as topics
from tsobs_ros.bag.messages.joint_series import Flags, JointSeries, Times
from tsobs_ros.checks import Array
from tsobs_ros.estimation.records import Estimate, Innovation
from tsobs_ros.replay.samples import Samples
from tsobs_ros.replay.schedule import Schedule, match
from tsobs_ros.replay.source import Live

_STATES, _STATE_BOUNDS = slice(0, 4), slice(4, 8)
_DISTURBANCE, _DISTURBANCE_RATE, _DISTURBANCE_BOUND = slice(8, 9), slice(9, 10), slice(10, 11)
_COLUMNS = 11


class EstimateTable:
    """What was estimated at m ticks, of J joints, from n messages.

    Args:
        ticks: How many there are.
        messages: How many there are.
        joints: How many there are.

    Attributes:
        done: Whether there is an estimate of anything, shape (m,).
        innovations: y − ŷ of the measurements that were used, else NaN [rad], shape (n, J).
    """

    def __init__(self, ticks: int, messages: int, joints: int) -> None:
        self._values = np.full((ticks, joints, _COLUMNS), np.nan)
        self.done = np.zeros(ticks, np.bool_)
        self.innovations = np.full((messages, joints), np.nan)

    @property
    def states(self) -> Array:
        """Estimated [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (m, J, 4)."""
        return self._values[..., _STATES]

    @property
    def state_bounds(self) -> Array:
        """1σ bound of each, NaN without one, shape (m, J, 4)."""
        return self._values[..., _STATE_BOUNDS]

    @property
    def disturbances(self) -> Array:
        """Estimated disturbance and its rate (rad, rad/s), NaN without one, shape (m, J, 2)."""
        return self._values[..., _DISTURBANCE.start : _DISTURBANCE_RATE.stop]

    @property
    def disturbance_bounds(self) -> Array:
        """1σ bound of the disturbance [rad], NaN without one, shape (m, J, 1)."""
        return self._values[..., _DISTURBANCE_BOUND]

    def add(self, ticks: Sequence[int], estimates: Sequence[Sequence[Estimate | None]]) -> None:
        """Keep the estimates of some ticks."""
        self.done[list(ticks)] = True
        for joint in range(self._values.shape[1]):
            known = [(tick, each[joint]) for tick, each in zip(ticks, estimates, strict=True)]
            rows = [tick for tick, one in known if one is not None]
            own = [one for _, one in known if one is not None]
            for columns, arrays in (
                (_STATES, [one.state for one in own]),
                (_STATE_BOUNDS, [one.state_bound for one in own]),
                (_DISTURBANCE, [one.disturbance for one in own]),
                (_DISTURBANCE_RATE, [one.disturbance_rate for one in own]),
                (_DISTURBANCE_BOUND, [one.disturbance_bound for one in own]),
            ):
                self._fill(rows, joint, columns, arrays)

    def _fill(self, rows: list[int], joint: int, columns: slice, arrays: list[Array]) -> None:
        width = columns.stop - columns.start
        there = [len(array) == width for array in arrays]
        if not all(there):
            rows = [row for row, is_there in zip(rows, there, strict=True) if is_there]
            arrays = [array for array in arrays if len(array) == width]
        if rows:
            self._values[rows, joint, columns] = np.concatenate(arrays).reshape(-1, width)

    def add_innovations(self, message: int, outcomes: Sequence[object]) -> None:
        """Keep the innovations of a message."""
        for joint, one in enumerate(outcomes):
            if isinstance(one, Innovation):
                self.innovations[message, joint] = one.value[0]


class Agreement(NamedTuple):
    """How the estimates compare with those of the live run.

    Attributes:
        recorded: Number of recorded estimates.
        reproduced: Number of those that came out the same to the last bit, bounds included.
        first_difference: Stamp of the first that did not [ns], None if all did.
        not_recorded: Number of measurements that the live observer used but the bag lacks.
        not_received: Number of those in the bag that were used here but not live.
    """

    recorded: int
    reproduced: int
    first_difference: int | None
    not_recorded: int
    not_received: int

    @property
    def complete(self) -> bool:
        """Whether every estimate was reproduced."""
        return self.reproduced == self.recorded

    def text(self) -> str:
        """Return it for people to read, with the reason of any difference."""
        line = (
            f"live estimates: {self.reproduced:,} of {self.recorded:,} reproduced to the last bit"
        )
        if self.complete:
            return line
        reasons = []
        if self.not_recorded:
            lost = _measurements(self.not_recorded)
            reasons.append(f"the live observer used {lost} that the bag lacks")
        if self.not_received:
            unused = _measurements(self.not_received)
            reasons.append(f"the live observer did not receive or use {unused} of the bag")
        if not reasons:
            reasons.append(
                "it had another design, other parameters or another version, was reset, or ran "
                "before the recording began"
            )
        return f"{line}; {' and '.join(reasons)}"


class Recorded:
    """The estimates of a live run, by the ticks of a schedule made of them.

    Args:
        live: What was recorded.
        schedule: The ticks.
    """

    def __init__(self, live: Live, schedule: Schedule) -> None:
        self._live = live
        self._stamps = schedule.stamps
        joints = live.states.values.shape[1] // 2
        self._states = _by_tick(live.states, schedule.stamps).reshape(-1, joints, 4)
        self._rows = self._states.tolist()

    def agrees(self, tick: int, estimates: Sequence[Estimate | None]) -> bool:
        """Return whether a tick's states are those of the live run."""
        return all(
            row[0] != row[0] if one is None else one.state.tolist() == row
            for row, one in zip(self._rows[tick], estimates, strict=True)
        )

    def compare(self, table: EstimateTable, samples: Samples) -> Agreement:
        """Compare a whole replay."""
        same = _same(table.states, self._states)
        for topic, values in (
            (topics.STATE_BOUNDS, table.state_bounds),
            (topics.DISTURBANCE, table.disturbances),
            (topics.DISTURBANCE_BOUND, table.disturbance_bounds),
        ):
            if topic in self._live.others:
                recorded = _by_tick(self._live.others[topic], self._stamps)
                recorded = recorded.reshape(*values.shape[:2], -1)[..., : values.shape[2]]
                # A single message that is missing was lost, not different.
                lost = np.isnan(recorded).all(axis=(1, 2))
                same &= lost | _same(values, recorded)
        different = np.flatnonzero(~same)
        unrecorded, unreceived = self._lost(table, samples)
        return Agreement(
            recorded=len(same),
            reproduced=int(same.sum()),
            first_difference=int(self._stamps[different[0]]) if len(different) else None,
            not_recorded=unrecorded,
            not_received=unreceived,
        )

    def _lost(self, table: EstimateTable, samples: Samples) -> tuple[int, int]:
        innovations = self._live.others.get(topics.INNOVATION)
        if innovations is None or not innovations.count:
            return 0, 0
        order = np.argsort(innovations.publish_times, kind="stable")
        places = match(samples.stamps, innovations.stamps[order])
        used_here = ~np.isnan(table.innovations).all(axis=1)
        # What came after the recording's last innovation may just not have been recorded.
        last = innovations.publish_times.max()
        unreceived = used_here & (places < 0) & (samples.publish_times < last)
        return innovations.count - int((places >= 0).sum()), int(unreceived.sum())


def _measurements(count: int) -> str:
    return f"{count:,} measurement{'s' if count != 1 else ''}"


def _by_tick(series: JointSeries, stamps: Times) -> Array:
    """Return a topic's values at the ticks' stamps, NaN where it has none."""
    order = np.argsort(series.publish_times, kind="stable")
    places = match(stamps, series.stamps[order])
    values = np.full((len(stamps), *series.values.shape[1:]), np.nan)
    values[places >= 0] = series.values[order][places[places >= 0]]
    return values


def _same(ours: Array, theirs: Array) -> Flags:
    """Return for each tick whether all bits are the same, or nothing is said on either side."""
    bits = np.ascontiguousarray(ours).view(np.int64) == np.ascontiguousarray(theirs).view(np.int64)
    return np.asarray((bits | (np.isnan(ours) & np.isnan(theirs))).all(axis=(1, 2)))
