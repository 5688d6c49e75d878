# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates and innovations of a replay as arrays, and their comparison with a live run's."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_series import Flags, JointSeries, Times
from tsobs_ros.checks import Array
from tsobs_ros.estimation.records import Estimate, Innovation
from tsobs_ros.replay.replay import Schedule
from tsobs_ros.replay.source import Live, Samples, match

_COLUMNS = {
    "state": slice(0, 4),
    "state_bound": slice(4, 8),
    "disturbance": slice(8, 9),
    "disturbance_rate": slice(9, 10),
    "disturbance_bound": slice(10, 11),
}
_COUNT = 11


class EstimateTable:
    """Estimates of J joints at m ticks, from n messages.

    Args:
        ticks: m.
        messages: n.
        joints: J.
        parameters: k, the largest number of parameters that a joint learns.

    Attributes:
        done: Whether there is an estimate of any joint, shape (m,).
        innovations: y − ŷ of the measurements that were used, else NaN [rad], shape (n, J).
        states: [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), NaN without an estimate, shape (m, J, 4).
        state_bounds: 1σ bound of each, NaN without one, shape (m, J, 4).
        disturbances: Disturbance and its rate (rad, rad/s), NaN without, shape (m, J, 2).
        disturbance_bounds: 1σ bound of the disturbance [rad], NaN without, shape (m, J, 1).
        parameters: Learnt parameters, NaN without, shape (m, J, k).
        parameter_bounds: 1σ of each, shape (m, J, k).
        flags: Whether an estimate is certified, its parameters are valid, and it is in the
            certificate's domain, shape (m, J, 3).
    """

    def __init__(self, ticks: int, messages: int, joints: int, parameters: int = 0) -> None:
        self._values = np.full((ticks, joints, _COUNT), np.nan)
        self.states = self._values[..., _COLUMNS["state"]]
        self.state_bounds = self._values[..., _COLUMNS["state_bound"]]
        self.disturbances = self._values[..., 8:10]
        self.disturbance_bounds = self._values[..., _COLUMNS["disturbance_bound"]]
        self.parameters = np.full((ticks, joints, parameters), np.nan)
        self.parameter_bounds = self.parameters.copy()
        self.flags = np.zeros((ticks, joints, 3), np.bool_)
        self.done = np.zeros(ticks, np.bool_)
        self.innovations = np.full((messages, joints), np.nan)

    def add(self, ticks: Sequence[int], estimates: Sequence[Sequence[Estimate | None]]) -> None:
        """Enter the estimates of some ticks."""
        self.done[list(ticks)] = True
        for joint in range(self._values.shape[1]):
            known = [(tick, each[joint]) for tick, each in zip(ticks, estimates, strict=True)]
            rows = [tick for tick, one in known if one is not None]
            own = [one for _, one in known if one is not None]
            if not own:
                continue
            # A joint has one observer, so either all estimates have a quantity or none.
            for name, columns in _COLUMNS.items():
                arrays = [getattr(one, name) for one in own]
                if len(arrays[0]):
                    numbers = np.concatenate(arrays).reshape(len(rows), -1)
                    self._values[rows, joint, columns] = numbers
            self.flags[rows, joint] = [
                (one.certified, one.parameters_valid, one.in_domain) for one in own
            ]
            if count := len(own[0].parameters):
                self.parameters[rows, joint, :count] = [one.parameters for one in own]
                self.parameter_bounds[rows, joint, :count] = [one.parameter_bound for one in own]

    def add_innovations(self, message: int, outcomes: Sequence[object]) -> None:
        """Enter the innovations of a message."""
        for joint, one in enumerate(outcomes):
            if isinstance(one, Innovation):
                self.innovations[message, joint] = one.value[0]


class Agreement(NamedTuple):
    """Comparison of the estimates with those of the live run.

    Attributes:
        recorded: Number of recorded estimates.
        reproduced: Number of those that are the same to the last bit, bounds included.
        first_difference: Stamp of the first that is not [ns], None if all are.
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
        """Return one line for people, with the reason of any difference."""
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
        live: The recorded topics.
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
        not_recorded, not_received = self._lost(table, samples)
        return Agreement(
            recorded=len(same),
            reproduced=int(same.sum()),
            first_difference=int(self._stamps[different[0]]) if len(different) else None,
            not_recorded=not_recorded,
            not_received=not_received,
        )

    def _lost(self, table: EstimateTable, samples: Samples) -> tuple[int, int]:
        innovations = self._live.others.get(topics.INNOVATION)
        if innovations is None or not innovations.count:
            return 0, 0
        order = np.argsort(innovations.publish_times, kind="stable")
        places = match(samples.stamps, innovations.stamps[order])
        used_here = ~np.isnan(table.innovations).all(axis=1)
        # Innovations after the recording's last one may just not have been recorded.
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
    """Return for each tick whether all bits are the same, or both sides have no number."""
    bits = np.ascontiguousarray(ours).view(np.int64) == np.ascontiguousarray(theirs).view(np.int64)
    return np.asarray((bits | (np.isnan(ours) & np.isnan(theirs))).all(axis=(1, 2)))
