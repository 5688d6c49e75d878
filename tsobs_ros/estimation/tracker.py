# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The tracker of one joint: measurements in the order of their stamps, estimates at any stamp.

Live measurements may be late, doubled, out of order, from the future or missing. An unusable one is
refused with a reason and counted. The tracker keeps a ring of states, one after each measurement.
For a late measurement it rewinds to the state before, so the estimate equals, bit for bit, the one
after arrival in order. core/history.c does this.
"""

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, Flags, Integers, non_negative, positive, unmasked
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import Estimator, Rows
from tsobs_ros.estimation.records import (
    Basis,
    Estimate,
    Hypothesis,
    Learning,
    Measurement,
    RejectReason,
    rejections,
)
from tsobs_ros.estimation.state import numbers_of
from tsobs_ros.model.prediction import Record
from tsobs_ros.series import NANOSECONDS, Stamps

_BASES, _LEARNINGS, _HYPOTHESES = tuple(Basis), tuple(Learning), tuple(Hypothesis)
"""Members by their codes; to make them from numbers would take longer."""

_MEMORY = record_type("history")

_FOUND = {
    "sensor jumps": native.JUMPED,
    "hits": native.HIT,
    "losses of track": native.MOVED,
    "wrong torques": native.WRONG_TORQUE,
}
"""Assumption of the forks that are counted, by the name of the finding."""

_LONGEST = 2**61
"""Longer times are treated as this long, so that no sum of stamps overflows [ns]."""


class Outcomes(NamedTuple):
    """The outcomes of N measurements.

    Attributes:
        codes: 0 if the measurement was used, else the code of a `RejectReason`, shape (N,).
        output_codes: The same for each output, shape (N, p).
        innovations: y − ŷ of each output, NaN if it was not used, shape (N, p).
        expected_std: Expected 1σ of each innovation, shape (N, p).
    """

    codes: Integers
    output_codes: Integers
    innovations: Array
    expected_std: Array


def _outcomes(shape: tuple[int, int]) -> Outcomes:
    codes = np.empty(shape[0], np.int64), np.empty(shape, np.int64)
    return Outcomes(*codes, np.empty(shape), np.empty(shape))


class TrackerRun(NamedTuple):
    """The results of N measurements and M ticks.

    Attributes:
        rows: Estimates, NaN where there is none, shape (M,).
        there: Whether there is an estimate, shape (M,).
        newest: Stamp of the newest measurement in use [ns], shape (M,).
        outcomes: Outcomes of the measurements.
    """

    rows: Rows
    there: Flags
    newest: Stamps
    outcomes: Outcomes


def require_steps(max_steps: int) -> None:
    """Refuse a `max_steps` for which the core has no room."""
    if not 1 <= max_steps <= native.MOST_STEPS:
        raise ModelError(f"max_steps: expected 1 to {native.MOST_STEPS}, got {max_steps}")


class Tracker:
    """Runs an estimator over measurements in the order of their stamps; see `make_tracker`.

    Args:
        estimator: The step functions.
        x_max: Half width of the certificate's domain of the first state; infinite if the domain is
            not an interval of that state, as for a T–S system.
        history: How far back a late measurement may reach [s].
        future_tolerance: How far ahead of `now` a stamp may lie [s].
        restart_after: A gap in the measurements longer than this restarts the estimator [s]; no
            estimate is given further than this from a measurement.
        max_steps: Largest number of measurements in the history, however dense their stamps.

    Attributes:
        estimator: The step functions.
        memory: Counts, limits and places in the ring, a record that core/tsobs.h describes,
            shape (1,).
        ring: States after the last measurements.

    Raises:
        ModelError: A limit is negative or not finite, or `max_steps` not within 1 and a million.
    """

    def __init__(
        self,
        estimator: Estimator,
        *,
        x_max: float = math.inf,
        history: float = 0.5,
        future_tolerance: float = 0.1,
        restart_after: float = 5.0,
        max_steps: int = 1024,
    ) -> None:
        require_steps(max_steps)
        self.estimator, model = estimator, numbers_of(estimator.model)
        room, state = np.zeros(native.tracker_room(model, max_steps)), estimator.model["initial"]
        begin, numbers = _MEMORY.itemsize // 8, (max_steps + 2) * state.itemsize // 8
        self._records = model, room
        self.memory: Record = room[:begin].view(_MEMORY)
        self.ring: Record = room[begin : begin + numbers].view(state.dtype)
        for name, seconds in (
            ("span", non_negative("history", history)),
            ("future", non_negative("future_tolerance", future_tolerance)),
            ("restart_after", positive("restart_after", restart_after)),
        ):
            self.memory[name] = round(min(seconds * NANOSECONDS, _LONGEST))
        self.memory["max_steps"] = max_steps
        self.memory["x_max"] = x_max if x_max == math.inf else positive("x_max", x_max)
        self._unused = self.memory.copy()
        self._first, self._length, self._turn = (
            self.memory[name] for name in ("first", "length", "turn")
        )
        self._stamps = self.ring["stamp"]
        shape = estimator.shape
        # Stamp, outputs and inputs of a single measurement.
        self._one = np.empty(1, np.int64), np.empty((1, shape.p)), np.empty((1, shape.m))
        fields = [estimator.row_type.fields[name] for name in estimator.row_type.names]
        self._vectors = [
            slice(place // 8, place // 8 + of.shape[0]) for of, place in fields if of.shape
        ]
        self._width = estimator.row_type.itemsize // 8
        self._scalars = slice(len(self._vectors) - len(fields), None)

    def reset(self) -> None:
        """Forget everything; afterwards the tracker is like a new one."""
        self.memory[:] = self._unused

    def forget(self) -> None:
        """Forget all measurements, but keep the counts of measurements and failures."""
        judged = self.state["judged"]
        self.memory["refused"] += judged
        self.memory["accepted"] -= judged.sum()
        self.memory["bad_outputs"] += self.state["failures"]
        for name in ("first", "length", "coasted_periods"):
            self.memory[name] = 0

    @property
    def state(self) -> Record:
        """The state after the newest measurement, or before any, shape (1,); not a copy."""
        if not self._length.item():
            return self.estimator.model["initial"]
        place = self._place()
        return self.ring[place : place + 1]

    def _place(self) -> int:
        """Return the place of the newest state in the ring."""
        place: int = (self._first.item() + self._length.item() - 1) % self._turn.item()
        return place

    @property
    def newest(self) -> int | None:
        """Stamp of the newest measurement in use [ns], None before the first."""
        return self._stamps.item(self._place()) if self._length.item() else None

    @property
    def used(self) -> int:
        """Number of measurements of which both angle and torque were used."""
        return int(self.memory["accepted"][0] - self.state["judged"].sum())

    @property
    def rejected(self) -> Counter[RejectReason]:
        """Number of the other measurements by reason; of some of them, outputs are used."""
        # The estimator itself refuses some measurements, or parts of them.
        counts = self.memory["refused"][0] + self.state["judged"][0]
        return Counter(rejections(counts))

    @property
    def rewinds(self) -> int:
        """Number of late measurements that were put in their place."""
        return int(self.memory["rewinds"][0])

    @property
    def restarts(self) -> int:
        """Number of restarts after a gap or a numerical failure."""
        return int(self.state["restarts"][0])

    @property
    def failures(self) -> int:
        """Number of numerical failures: states or outputs that were not finite."""
        return int(self.memory["bad_outputs"][0] + self.state["failures"][0])

    @property
    def events(self) -> dict[str, int]:
        """Counts of findings up to the newest measurement, by name; none without supervision."""
        if not self.estimator.supervised:
            return {}
        state, won = self.state, self.state["won"][0].tolist()
        found = {name: won[fork] for name, fork in _FOUND.items()}
        return {"outliers left out": int(state["outliers"][0]), **found}

    def reject(self, reason: RejectReason, count: int = 1) -> None:
        """Count measurements that the caller could not even read."""
        self.memory["refused"][0, reason] += count

    def offer(self, measurement: Measurement, now: int) -> Outcomes:
        """Use one measurement, which may be late by up to `history`; see `offer_many`."""
        stamp, y, u = measurement
        stamps, samples, inputs = self._one
        if not (
            type(y) is type(u) is np.ndarray
            and type(stamp) is int
            and stamp.bit_length() < 64
            and (y.shape, u.shape) == (samples.shape[1:], inputs.shape[1:])
        ):
            many = np.asanyarray(y)[np.newaxis], np.asanyarray(u)[np.newaxis]
            return self.offer_many([stamp], *many, now)
        stamps[0], samples[0], inputs[0] = stamp, y, u
        outcomes = _outcomes(samples.shape)
        native.history_offer(*self._records, stamps, samples, inputs, now, *outcomes)
        return outcomes

    def offer_many(self, stamps: ArrayLike, y: ArrayLike, u: ArrayLike, now: int) -> Outcomes:
        """Use measurements in the order of their stamps, or refuse them.

        One rewind serves all late measurements. Of measurements with the same stamp, the first is
        used.

        Args:
            stamps: Stamps of N measurements, in any order [whole ns], shape (N,).
            y: Measured outputs, NaN if missing, shape (N, p).
            u: Inputs from each measurement until the next one, shape (N, m).
            now: Time on the clock of the stamps [ns].

        Raises:
            ModelError: The arrays have other shapes, or a stamp is not an integer.
        """
        times, samples, inputs = self._checked(stamps, y, u)
        outcomes, order = _outcomes(samples.shape), None
        if len(times) > 1 and (times[1:] < times[:-1]).any():
            order = np.argsort(times, kind="stable")
            times, samples, inputs = times[order], samples[order], inputs[order]
        native.history_offer(*self._records, times, samples, inputs, now, *outcomes)
        if order is not None:
            for each in outcomes:
                each[order] = each.copy()
        return outcomes

    def follow(self, stamps: ArrayLike, y: ArrayLike, u: ArrayLike) -> Rows:
        """Use measurements one after the other, and return the estimates at their stamps.

        Other Python threads can run meanwhile.

        Arguments are as for `offer_many`, but stamps must ascend and be later than all earlier
        ones. Rows are of `Estimator.row_type`, NaN where there is no estimate, shape (N,).

        Raises:
            ModelError: The arrays have other shapes, or the stamps do not ascend.
        """
        times, samples, inputs = self._checked(stamps, y, u)
        after = self.newest or 0
        if not (np.diff(times, prepend=after) > 0).all():
            raise ModelError(f"stamps: expected them to ascend from {after} ns on")
        return self.run(times, samples, inputs, (times, times, np.arange(1, len(times) + 1))).rows

    def run(
        self,
        stamps: Stamps,
        y: Array,
        u: Array,
        ticks: Sequence[Integers],
        stale_after: float = math.inf,
    ) -> TrackerRun:
        """Offer measurements, as in `offer_many`, and estimate at M ticks, as in `follow`.

        Args:
            ticks: Stamps of the estimates and times on the clock [ns], and the number of
                measurements taken by the end of each tick.
            stale_after: Age of the newest measurement after which nothing is estimated [s].
        """
        run = _advance([self], (stamps, y, u), ticks, stale_after)
        for each, nothing in zip(run.outcomes, (0, 0, np.nan, np.nan), strict=True):
            each[ticks[2][-1] if len(run.rows) else 0 :] = nothing  # for those that no tick took
        return run

    def _checked(
        self, stamps: ArrayLike, y: ArrayLike, u: ArrayLike
    ) -> tuple[Stamps, Array, Array]:
        shape, times = self.estimator.shape, np.ascontiguousarray(stamps)
        if times.size and times.dtype.kind not in "iu":
            raise ModelError(f"stamps: expected whole ns, got numbers of type {times.dtype}")
        times = times.astype(np.int64, copy=False)
        samples, inputs = (np.ascontiguousarray(unmasked(one), np.float64) for one in (y, u))
        count = len(times)
        if samples.shape != (count, shape.p) or inputs.shape != (count, shape.m):
            raise ModelError(
                f"measurements: expected y of shape {(count, shape.p)} and u of shape "
                f"{(count, shape.m)}, got {samples.shape} and {inputs.shape}"
            )
        return times, samples, inputs

    def estimate(self, stamp: int) -> Estimate | None:
        """Return the estimate at a stamp [ns].

        It is None before the first measurement, too long after the last one, or if it is not
        finite; such a failure is counted.
        """
        row = np.empty(self._width)
        if not native.history_estimate(*self._records, stamp, row):
            return None
        basis, claimed, valid, scale, coloured, learning, hypothesis, in_domain, age = row[
            self._scalars
        ].tolist()
        # Arguments by name would take a tenth of a tick.
        return Estimate._make(
            (
                stamp, *(row[part] for part in self._vectors), _BASES[int(basis)], claimed != 0.0,
                valid != 0.0, scale, coloured, _LEARNINGS[int(learning)],
                _HYPOTHESES[int(hypothesis)], in_domain != 0.0, age,
            )
        )  # fmt: skip


def step_joints(
    trackers: Sequence[Tracker], stamps: ArrayLike, y: ArrayLike, u: ArrayLike, now: int
) -> TrackerRun:
    """Use one measurement of each of J joints, and estimate at one time, in one call of the core.

    Rows and outcomes, one per joint, are those of `Tracker.offer` and `Tracker.estimate`.

    Args:
        trackers: One per joint. The designs have equally many states, outputs, inputs and learnt
            parameters, but may have any values.
        stamps: Stamps of the measurements [ns], shape (J,).
        y: Measured outputs, NaN if missing, shape (J, p).
        u: Inputs from each measurement until the next one, shape (J, m).
        now: Time on the clock of the stamps, and of the estimates [ns].

    Raises:
        ModelError: The arrays have other shapes, or the designs other sizes.
    """
    count, shapes = len(trackers), {each.estimator.shape for each in trackers}
    if len(shapes) != 1:
        raise ModelError(f"trackers: expected one or more of the same sizes, got {shapes}")
    given = trackers[0]._checked(stamps, y, u)
    if len(given[0]) != count:
        raise ModelError(f"stamps: expected one for each of {count} joints, got {len(given[0])}")
    at, known = np.empty((2, count), np.int64)
    at.fill(now)
    known.fill(1)
    return _advance(trackers, given, (at, at, known))


def _advance(
    trackers: Sequence[Tracker],
    given: tuple[Stamps, Array, Array],
    ticks: Sequence[Integers],
    stale_after: float = math.inf,
) -> TrackerRun:
    """Advance trackers, each by an equal share of measurements (stamps, y, u) and of ticks."""
    first, outcomes = trackers[0], _outcomes(given[1].shape)
    count, limit = len(ticks[0]), int(min(stale_after * NANOSECONDS, 2 * _LONGEST))
    rows, (newest, there) = np.empty(count * first._width), np.zeros((2, count), np.int64)
    native.history_advance(
        tuple(record for each in trackers for record in each._records),
        *map(np.ascontiguousarray, given),
        *outcomes,
        *map(np.ascontiguousarray, ticks),
        *(newest, there, rows, limit),
    )
    made, exists = first.estimator.rows_of(rows), there != 0
    if np.count_nonzero(there) < count:  # takes a tenth of the time of `all`
        made[~exists] = np.nan
    return TrackerRun(made, exists, newest, outcomes)
