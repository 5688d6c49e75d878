# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The tracker of one joint: measurements in the order of their stamps, estimates at any stamp.

Live, measurements are late, doubled, out of order, from the future or missing. What cannot be used
is refused with a reason and counted. A late measurement is put in its place by rewinding a ring of
states, one after each measurement, to the state before it, so the estimate equals, bit for bit, the
one that arrival in order would have given. One rewind serves all that come together: the cost is
one pass over the ring. core/history.c does it.
"""

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsobs_ros.checks import Array, check_each, non_negative, positive
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import Estimator, Rows
from tsobs_ros.estimation.records import (
    REASONS,
    Basis,
    Estimate,
    Hypothesis,
    Innovation,
    Learning,
    Measurement,
    RejectReason,
)
from tsobs_ros.estimation.state import State, copy_records, numbers_of
from tsobs_ros.model.prediction import Record
from tsobs_ros.series import NANOSECONDS

_BASES, _LEARNINGS, _HYPOTHESES = tuple(Basis), tuple(Learning), tuple(Hypothesis)
"""By their codes: to make them from numbers would take longer."""

_MEMORY = record_type("history")

_SPARE = 2
"""States at the end of a ring: one in a gap, and one that is read."""

_LONGEST = 2**61
"""Longest time that is told from a longer one, so that no sum of stamps overflows [ns]."""


@dataclass(frozen=True)
class TrackerOptions:
    """Limits of a tracker.

    Attributes:
        x_max: Half width of the certificate's domain of the first state; infinite if the domain is
            no interval of it, as a T–S system's.
        history: How far back a late measurement may reach [s].
        future_tolerance: How far ahead of `now` a stamp may lie [s].
        restart_after: A gap in the measurements longer than this restarts the estimator [s]; no
            estimate is given further than this from a measurement.
        max_steps: Largest number of measurements in the history, however dense their stamps.
    """

    x_max: float = math.inf
    history: float = 0.5
    future_tolerance: float = 0.1
    restart_after: float = 5.0
    max_steps: int = 1024

    def __post_init__(self) -> None:
        if self.x_max != math.inf:
            positive("x_max", self.x_max)
        check_each(positive, self, "restart_after", "max_steps")
        check_each(non_negative, self, "history", "future_tolerance")


class Outcomes(NamedTuple):
    """The outcomes of N measurements.

    Attributes:
        codes: 0 of those used, else the place of the reason in `records.REASONS`, shape (N,).
        output_codes: The same of each output, shape (N, p).
        innovations: y − ŷ of those used, NaN if missing, shape (N, p).
        expected_std: 1σ expected of each, shape (N, p).
    """

    codes: NDArray[np.int64]
    output_codes: NDArray[np.int64]
    innovations: Array
    expected_std: Array


class Tracker:
    """Runs an estimator over measurements in the order of their stamps.

    Attributes:
        estimator: The step functions.
        options: Limits.
        memory: Counts, limits and places in the ring, a record that core/history.h describes,
            shape (1,).
        ring: States after the last measurements.
    """

    def __init__(self, estimator: Estimator, options: TrackerOptions) -> None:
        self.estimator = estimator
        self.options = options
        self.memory: Record = np.zeros(1, _MEMORY)
        slots = options.max_steps + 2 + _SPARE
        self.ring: Record = np.zeros(slots, estimator.new_states(0).dtype)
        model = numbers_of(estimator.model)
        scratch = np.zeros(native.history_scratch_size(model, slots))
        self._records = model, numbers_of(self.memory), numbers_of(self.ring), scratch
        shape = estimator.shape
        self._one = (
            np.zeros(1, np.int64),
            np.zeros((1, shape.p)),
            np.zeros((1, shape.m)),
            np.zeros(1, np.int64),
            np.zeros((1, shape.p), np.int64),
        )
        fields = [estimator.row_type.fields[name] for name in estimator.row_type.names]
        self._vectors = [
            slice(place // 8, place // 8 + of.shape[0]) for of, place in fields if of.shape
        ]
        self._width = estimator.row_type.itemsize // 8
        self._scalars = slice(len(self._vectors) - len(fields), None)
        self.reset()

    def reset(self) -> None:
        """Forget everything; afterwards the tracker is as a new one."""
        self.memory[:] = np.zeros(1, self.memory.dtype)
        options, memory = self.options, self.memory[0]
        for name, seconds in (
            ("span", options.history),
            ("future", options.future_tolerance),
            ("restart_after", options.restart_after),
        ):
            memory[name] = round(min(seconds * NANOSECONDS, _LONGEST))
        memory["max_steps"], memory["x_max"] = options.max_steps, options.x_max

    def forget(self) -> None:
        """Forget all measurements, but not the counts."""
        if (last := self._last) is not None:
            self.memory["bad_outputs"] += last["failures"]
        for name in ("first", "length", "has_base", "coasted_periods"):
            self.memory[name] = 0

    @property
    def _place(self) -> int:
        """Where the newest state is in the ring, if there is one."""
        memory = self.memory[0]
        return int((memory["first"] + memory["length"] - 1) % (len(self.ring) - _SPARE))

    @property
    def _last(self) -> Any:
        """The newest state, None before the first."""
        return self.ring[self._place] if self.memory["length"][0] else None

    @property
    def newest(self) -> int | None:
        """Stamp of the newest measurement in use [ns], None before the first."""
        last = self._last
        return None if last is None else int(last["stamp"])

    @property
    def state(self) -> State | None:
        """The state after the newest measurement, None before the first."""
        if self._last is None:
            return None
        newest = self.ring[self._place : self._place + 1]
        return State(copy_records(newest), self.estimator.shape)

    @property
    def used(self) -> int:
        """Number of measurements that were used, angle and torque."""
        return int(self.memory["accepted"][0]) - sum(self._judged)

    @property
    def rejected(self) -> Counter[RejectReason]:
        """Number of measurements not used, by reason."""
        refused = self.memory["refused"][0].tolist()
        pairs = zip(REASONS, refused, self._judged, strict=True)
        return Counter({reason: n + own for reason, n, own in pairs if reason and n + own})

    @property
    def rewinds(self) -> int:
        """Number of late measurements put in their place."""
        return int(self.memory["rewinds"][0])

    @property
    def forgotten(self) -> int:
        """Number of measurements that left the history early because it was full.

        Those that are older yet are then too old.
        """
        return int(self.memory["forgotten"][0])

    @property
    def restarts(self) -> int:
        """Number of restarts after a gap or a numerical failure."""
        last = self._last
        return 0 if last is None else int(last["restarts"])

    @property
    def failures(self) -> int:
        """Number of numerical failures: states or outputs that were not finite."""
        last = self._last
        inner = 0 if last is None else int(last["failures"])
        return int(self.memory["bad_outputs"][0]) + inner

    @property
    def events(self) -> dict[str, int]:
        """The estimator's counts up to the newest measurement, by name."""
        state = self.state
        return {} if state is None else self.estimator.events(state)

    @property
    def output_counts(self) -> tuple[dict[str, int], ...]:
        """Numbers of samples of each output that were gated, and that were missing."""
        last = self._last
        if last is None:
            return ({"gated": 0, "missing": 0},) * self.estimator.shape.p
        sensors = last["sensors"][: self.estimator.shape.p]
        return tuple(
            {"gated": int(each["gated"]), "missing": int(each["missing"])} for each in sensors
        )

    def reject(self, reason: RejectReason, count: int = 1) -> None:
        """Count measurements that the caller could not even read."""
        self.memory["refused"][0, REASONS.index(reason)] += count

    def offer(self, measurement: Measurement, now: int) -> Innovation | RejectReason:
        """Use a measurement, or refuse it.

        Args:
            measurement: May be late by up to the history.
            now: Time on the clock of the stamps [ns].

        Returns:
            Its innovation, or the reason of its rejection, which has been counted.
        """
        stamp, y, u = measurement
        stamps, sample, inputs, codes, output_codes = self._one
        if np.shape(y) != sample.shape[1:] or np.shape(u) != inputs.shape[1:]:
            self._prepared([stamp], [y], [u])  # names what is wrong
        # Arrays that are kept: making them would take longer than the estimator does.
        stamps[0], sample[0], inputs[0], codes[0] = stamp, y, u, 0
        innovation, expected_std = np.empty(sample.shape), np.empty(sample.shape)
        self.offer_into(stamps, sample, inputs, now, codes, output_codes, innovation, expected_std)
        reason = REASONS[codes.item()]
        return reason or Innovation(stamp, innovation[0], expected_std[0])

    def offer_many(self, stamps: ArrayLike, y: ArrayLike, u: ArrayLike, now: int) -> Outcomes:
        """Use measurements in the order of their stamps, or refuse them.

        However many are late, one rewind serves them all. Of those with the same stamp, the first
        is used.

        Args:
            stamps: Of N measurements, in any order [ns], shape (N,).
            y: Measured outputs, NaN of one that is missing, shape (N, p).
            u: Inputs from each measurement until the next one, shape (N, m).
            now: Time on the clock of the stamps [ns].

        Raises:
            ModelError: The arrays have other shapes.
        """
        times, samples, inputs = self._prepared(stamps, y, u)
        count, p = samples.shape
        outcomes = Outcomes(
            np.zeros(count, np.int64),
            np.zeros((count, p), np.int64),
            np.empty((count, p)),
            np.empty((count, p)),
        )
        ascending = count < 2 or bool((times[1:] >= times[:-1]).all())
        if not ascending:
            order = np.argsort(times, kind="stable")
            times, samples, inputs = times[order], samples[order], inputs[order]
        self.offer_into(times, samples, inputs, now, *outcomes)
        if not ascending:
            for each in outcomes:
                each[order] = each.copy()
        return outcomes

    def follow(self, stamps: ArrayLike, y: ArrayLike, u: ArrayLike) -> Rows:
        """Use measurements one after the other, and return the estimates at their stamps.

        Other threads of Python can run meanwhile.

        Args:
            stamps: Of N measurements, ascending, later than any before [ns], shape (N,).
            y: Measured outputs, NaN if lost, shape (N, p).
            u: Inputs from each measurement until the next one, shape (N, m).

        Returns:
            Rows of `Estimator.row_type`, NaN where there is no estimate, shape (N,).

        Raises:
            ModelError: The arrays have other shapes, or the stamps do not ascend.
        """
        times, samples, inputs = self._prepared(stamps, y, u)
        after = self.newest or 0
        if not (np.diff(times, prepend=after) > 0).all():
            raise ModelError(f"stamps: expected them to ascend from {after} ns on")
        count, rows = len(times), self.estimator.new_rows(len(times))
        codes, innovations = np.empty(samples.shape, np.int64), np.empty((2, *samples.shape))
        outcomes, newest, there = np.empty((3, count), np.int64)
        self.advance(
            times, samples, inputs, outcomes, codes, *innovations,
            times, times, np.arange(1, count + 1), newest, there, rows, 2 * _LONGEST,
        )  # fmt: skip
        rows[there == 0] = np.nan
        return self.estimator.as_rows(rows)

    def offer_into(self, *arguments: Any) -> None:
        """Use arrays of measurements as they are, or refuse them, and write what becomes of them.

        Args:
            arguments: Stamps, in any order [ns], shape (N,), y, shape (N, p), u, shape (N, m), the
                time on the clock of the stamps [ns], and the arrays of `Outcomes`.

        Raises:
            ValueError: An array is too short.
        """
        native.history_offer(*self._records, *arguments)

    def advance(self, *arguments: Any) -> None:
        """Offer measurements, and estimate at ticks, without other threads waiting.

        See `advance` of core/history.h.

        Args:
            arguments: As of `offer_into` but for the time; of the ticks stamps and times on the
                clock [ns], numbers of samples before each, newest stamps in use, whether there are
                estimates, and rows; and the age of the newest sample from which on there are none
                [ns].
        """
        native.history_advance(*self._records, *arguments)

    def _prepared(
        self, stamps: ArrayLike, y: ArrayLike, u: ArrayLike
    ) -> tuple[NDArray[np.int64], Array, Array]:
        shape, times = self.estimator.shape, np.array(stamps, np.int64)
        samples, inputs = np.array(y, np.float64), np.array(u, np.float64)
        count = len(times)
        if samples.shape != (count, shape.p) or inputs.shape != (count, shape.m):
            raise ModelError(
                f"measurements: expected y of shape {(count, shape.p)} and u of shape "
                f"{(count, shape.m)}, got {samples.shape} and {inputs.shape}"
            )
        return times, samples, inputs

    def estimate(self, stamp: int) -> Estimate | None:
        """Return the estimate at a stamp [ns].

        Returns:
            None before the first measurement, too long after the last, or if the estimate is not
            finite, which is counted.
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

    @property
    def _judged(self) -> list[int]:
        """Numbers of measurements that the estimator itself refused, in part at least, by code."""
        last = self._last
        return [0] * len(REASONS) if last is None else last["judged"].tolist()
