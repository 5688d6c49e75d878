# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates and innovations of a replay as arrays, and their comparison with a live run's."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_series import JointSeries, Times
from tsobs_ros.checks import Array, Flags
from tsobs_ros.estimation.estimator import Rows
from tsobs_ros.estimation.records import HEALTH
from tsobs_ros.estimation.state import Shape
from tsobs_ros.replay.schedule import Schedule
from tsobs_ros.replay.source import Live, Samples, match, places_of_innovations


class EstimateTable:
    """Estimates of J joints at m ticks, from n messages; what a joint lacks is NaN.

    Args:
        ticks: m.
        messages: n.
        shapes: Sizes of each joint's estimator.

    Attributes:
        done: Whether there is an estimate of any joint, shape (m,).
        innovations: y − ŷ of the outputs that were used, else NaN, shape (n, J, p).
        times_of_use: Log and publish time of the tick at which a message was used [ns]; -1 if it
            was not used, or after the last tick, shape (n, 2).
        left_out: Whether a message was not used as the recorded observer had not received it,
            shape (n,).
        states: Of the plant, in an arm [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), NaN without an estimate,
            shape (m, J, plant).
        state_bounds: 1σ bound of each, NaN without one, shape (m, J, plant).
        disturbances: Disturbance of each output and then its rate, NaN without, shape (m, J, 2p).
        disturbance_bounds: 1σ bound of each disturbance, NaN without, shape (m, J, p).
        torques: Torque disturbances [N m], NaN without, shape (m, J, t).
        torque_bounds: 1σ bound of each, shape (m, J, t).
        parameters: Learnt parameters, NaN without, shape (m, J, k).
        parameter_bounds: 1σ of each, shape (m, J, k).
        conditions: What an estimate's numbers are worth by its fields' names, NaN without one,
            each of shape (m, J).
    """

    def __init__(self, ticks: int, messages: int, shapes: Sequence[Shape]) -> None:
        def nothing(width: int) -> Array:
            return np.full((ticks, len(shapes), width), np.nan)

        self._shapes = shapes
        sizes = zip(*((shape.plant, shape.p, shape.t, shape.k) for shape in shapes), strict=True)
        plant, p, t, k = map(max, sizes)
        self.states, self.state_bounds = nothing(plant), nothing(plant)
        self.disturbances, self.disturbance_bounds = nothing(2 * p), nothing(p)
        self.torques, self.torque_bounds = nothing(t), nothing(t)
        self.parameters, self.parameter_bounds = nothing(k), nothing(k)
        names = (*HEALTH, "parameters_valid", "in_domain")
        self.conditions = {name: nothing(1)[..., 0] for name in names}
        self.done = np.zeros(ticks, np.bool_)
        self.innovations = np.full((messages, len(shapes), p), np.nan)
        self.times_of_use = np.full((messages, 2), -1)
        self.left_out = np.zeros(messages, np.bool_)

    @property
    def of_topics(self) -> dict[str, Array]:
        """The estimates by the topics that they are published on."""
        return {
            topics.STATES: self.states,
            topics.STATE_BOUNDS: self.state_bounds,
            topics.DISTURBANCE: self.disturbances,
            topics.DISTURBANCE_BOUND: self.disturbance_bounds,
            topics.TORQUE_DISTURBANCE: self.torques,
            topics.TORQUE_DISTURBANCE_BOUND: self.torque_bounds,
        }

    def take_over(self, other: "EstimateTable", begin: int) -> None:
        """Enter what another table has of the messages that are this one's first.

        Args:
            other: The other table.
            begin: The first of those messages there.
        """
        count = len(other.left_out) - begin
        self.innovations[:count] = other.innovations[begin:]
        self.times_of_use[:count] = other.times_of_use[begin:]
        self.left_out[:count] = other.left_out[begin:]

    def add(self, joint: int, ticks: slice, rows: Rows, there: Flags) -> None:
        """Enter the estimates of a joint at some ticks.

        Args:
            joint: Index of the joint.
            ticks: m of them.
            rows: Of `Estimator.row_type`, shape (m,).
            there: Whether a row is an estimate, shape (m,).
        """
        p = self._shapes[joint].p
        for name, array in (
            ("state", self.states),
            ("state_bound", self.state_bounds),
            ("disturbance", self.disturbances),
            ("disturbance_rate", self.disturbances[..., p:]),
            ("disturbance_bound", self.disturbance_bounds),
            ("torque_disturbance", self.torques),
            ("torque_disturbance_bound", self.torque_bounds),
            ("parameters", self.parameters),
            ("parameter_bound", self.parameter_bounds),
        ):
            numbers = rows[name]
            width = numbers.shape[1]
            array[ticks, joint, :width] = np.where(there[:, np.newaxis], numbers, np.nan)
        for name, column in self.conditions.items():
            column[ticks, joint] = np.where(there, rows[name], np.nan)

    def health(self, ticks: slice) -> Array:
        """Return the fields of `HEALTH` at n ticks, NaN without an estimate, shape (n, J, 7)."""
        return np.stack([self.conditions[name][ticks] for name in HEALTH], axis=-1)


class Agreement(NamedTuple):
    """Comparison of the estimates with those of the live run.

    Attributes:
        recorded: Number of recorded estimates.
        reproduced: Number of those that are the same to the last bit, bounds included.
        first_difference: Stamp of the first that is not [ns], None if all are.
        not_recorded: Number of measurements that the live observer used but the bag lacks.
        not_received: Number of those in the bag that were used here but not live.
        before_first: Number of those left out as they came before the live observer's first.
        in_between: Number of those left out as they did not reach it later.
        after_last: Number of those left out as they came after its last.
        ran_before: Whether it had used measurements from before the recording; None if no
            innovations show what it used.
    """

    recorded: int
    reproduced: int
    first_difference: int | None
    not_recorded: int
    not_received: int
    before_first: int
    in_between: int
    after_last: int
    ran_before: bool | None

    @property
    def complete(self) -> bool:
        """Whether every estimate was reproduced."""
        return self.reproduced == self.recorded

    def text(self) -> str:
        """Return one line for people, with the reason of any difference."""
        line = (
            f"live estimates: {self.reproduced:,} of {self.recorded:,} reproduced to the last bit"
        )
        without = [
            f"{_measurements(count)} {which}"
            for count, which in (
                (self.before_first, "from before the live observer's first"),
                (self.in_between, "that did not reach it"),
                (self.after_last, "from after its last"),
            )
            if count
        ]
        line += f", without {' and '.join(without)}" if without else ""
        if self.complete:
            return line
        reasons = []
        if self.ran_before:
            reasons.append("the live observer had run before the recording of it began")
        if self.not_recorded:
            lost = _measurements(self.not_recorded)
            reasons.append(f"the live observer used {lost} that the bag lacks")
        if self.not_received:
            unused = _measurements(self.not_received)
            reasons.append(f"the live observer did not receive or use {unused} of the bag")
        if not reasons:
            reasons.append("it had another design, other parameters or another version")
            if self.ran_before is None:
                reasons[-1] += ", or used other measurements, which only innovations would show"
        return f"{line}; {' and '.join(reasons)}"


class Recorded:
    """The estimates of a live run, by the ticks of a schedule made of them.

    Args:
        live: The recorded topics.
        schedule: The ticks.
        samples: The measurements.

    Attributes:
        states: Those at the ticks, NaN without, shape (m, J, plant).
        state_bounds: Their bounds, NaN without, shape (m, J, plant).
        innovations: Those of each message, NaN without, shape (n, J, p).
        unmatched: Places of the recorded innovations that no message has.
    """

    def __init__(self, live: Live, schedule: Schedule, samples: Samples) -> None:
        self._live = live
        self._schedule = schedule
        self.states = _by_tick(live.states, schedule)
        self.state_bounds = np.full_like(self.states, np.nan)
        if topics.STATE_BOUNDS in live.others:
            self.state_bounds = _by_tick(live.others[topics.STATE_BOUNDS], schedule)
        own = live.others.get(topics.INNOVATION)
        self.innovations = np.full(samples.y.shape, np.nan)
        self.unmatched = np.zeros(0, np.intp)
        if own is not None:
            places = places_of_innovations(samples, own)
            self.innovations[places >= 0] = own.values[places[places >= 0]]
            self.unmatched = np.setdiff1d(np.arange(own.count), places)

    def same(self, table: EstimateTable, ticks: slice) -> Flags:
        """Return whether the estimates at some ticks are the same to the last bit."""
        same: Flags = np.ones(len(self.states[ticks]), np.bool_)
        for topic, values in table.of_topics.items():
            if topic == topics.STATES:
                same &= _same(values[ticks], self.states[ticks])
            elif topic in self._live.others:
                recorded = _by_tick(self._live.others[topic], self._schedule)[ticks]
                # A single message that is missing was lost, not different.
                lost = np.isnan(recorded).all(axis=(1, 2))
                same &= lost | _same(values[ticks], recorded)
        return same


class AgreementCount:
    """Counts in how far estimates agree with those of the live run."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(Agreement._fields, 0)
        self._first: int | None = None
        self._past: bool | None = None
        self._any_received = False
        # Since the last recorded innovation; the live observer may have been on its way to them.
        self._used_since, self._left_out_since = 0, 0

    def add_ticks(self, stamps: Times, same: Flags) -> None:
        """Count estimates.

        Args:
            stamps: Of the ticks [ns], shape (m,).
            same: Whether they are the same as the recorded ones, shape (m,).
        """
        self._counts["recorded"] += len(same)
        self._counts["reproduced"] += int(same.sum())
        if self._first is None and not same.all():
            self._first = int(stamps[int(same.argmin())])

    def add_messages(self, innovations: Array, table: EstimateTable, messages: slice) -> None:
        """Count messages, in the order of their use.

        Args:
            innovations: The recorded ones, NaN without, shape (n, J, p).
            table: The replay's.
            messages: Those to count.
        """
        received = np.asarray(np.isfinite(innovations[messages]).any(axis=(1, 2)))
        used = ~np.isnan(table.innovations[messages]).all(axis=(1, 2)) & ~received
        left_out = table.left_out[messages]
        if received.any():
            end = len(received) - int(received[::-1].argmax())
            begin = 0 if self._any_received else int(received.argmax())
            self._counts["before_first"] += int(left_out[:begin].sum())
            self._counts["in_between"] += int(left_out[begin:end].sum())
            self._counts["not_received"] += int(used[:end].sum()) + self._used_since
            if self._any_received:
                self._counts["in_between"] += self._left_out_since
            else:
                self._counts["before_first"] += self._left_out_since
            self._used_since, self._left_out_since = 0, 0
            used, left_out, self._any_received = used[end:], left_out[end:], True
        self._used_since += int(used.sum())
        self._left_out_since += int(left_out.sum())

    def add_not_recorded(self, count: int) -> None:
        """Count innovations of measurements that the bag lacks."""
        self._counts["not_recorded"] += count

    def began(self, without_past: bool | None) -> None:
        """Note whether the first recorded innovation is that of an observer without a past."""
        if self._past is None and without_past is not None:
            self._past = not without_past

    def result(self) -> Agreement:
        """Return what was counted."""
        last = "after_last" if self._any_received else "in_between"
        counts: dict[str, Any] = {**self._counts, "first_difference": self._first}
        counts[last] += self._left_out_since
        return Agreement(**(counts | {"ran_before": self._past}))


def _measurements(count: int) -> str:
    return f"{count:,} measurement{'s' if count != 1 else ''}"


def _by_tick(series: JointSeries, schedule: Schedule) -> Array:
    """Return a topic's values at the ticks' stamps, NaN where it has none."""
    places = match(schedule, series)
    values = np.full((schedule.count, *series.values.shape[1:]), np.nan)
    values[places >= 0] = series.values[places[places >= 0]]
    return values


def _same(ours: Array, theirs: Array) -> Flags:
    """Return for each tick whether all bits are the same, or both sides have no number."""
    if ours.shape != theirs.shape:  # of an observer with other states
        return np.zeros(len(ours), np.bool_)
    bits = np.ascontiguousarray(ours).view(np.int64) == np.ascontiguousarray(theirs).view(np.int64)
    return np.asarray((bits | (np.isnan(ours) & np.isnan(theirs))).all(axis=(1, 2)))
