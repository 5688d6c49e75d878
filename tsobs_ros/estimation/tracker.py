# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The tracker of one joint: measurements in the order of their stamps, estimates at any stamp.

Live, measurements are late, doubled, out of order, from the future or missing. What cannot be used
is refused with a reason and counted. What is late is put in its place; see `history`.
"""

import math
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsobs_ros.checks import Array, check_each, non_negative, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import Estimator, Rows, State, copy_records
from tsobs_ros.estimation.history import REASONS, History
from tsobs_ros.estimation.records import (
    Basis,
    Estimate,
    Hypothesis,
    Innovation,
    Learning,
    Measurement,
    RejectReason,
)
from tsobs_ros.model.prediction import Record
from tsobs_ros.series import NANOSECONDS

_BASES, _LEARNINGS, _HYPOTHESES = tuple(Basis), tuple(Learning), tuple(Hypothesis)
"""By their codes: to make them from numbers would take longer."""

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
        codes: 0 of those used, else the place of the reason in `history.REASONS`, shape (N,).
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
        history: States after the last measurements, and counts.
    """

    def __init__(self, estimator: Estimator, options: TrackerOptions) -> None:
        self.estimator = estimator
        self.options = options
        self.history = History(estimator, options.max_steps)
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

    @property
    def memory(self) -> Record:
        """Counts and limits, a record that core/history.h describes, shape (1,)."""
        return self.history.memory

    @property
    def ring(self) -> Record:
        """States after the last measurements."""
        return self.history.ring

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

    @property
    def newest(self) -> int | None:
        """Stamp of the newest measurement in use [ns], None before the first."""
        return self.history.newest or None

    @property
    def state(self) -> State | None:
        """The state after the newest measurement, None before the first."""
        if self.history.last is None:
            return None
        place = self.history.place_of_last
        return State(copy_records(self.ring[place : place + 1]), self.estimator.shape)

    @property
    def used(self) -> int:
        """Number of measurements that were used, angle and torque."""
        return int(self.memory["accepted"][0]) - sum(self._judged.values())

    @property
    def rejected(self) -> Counter[RejectReason]:
        """Number of measurements not used, by reason."""
        refused = self.memory["refused"][0].tolist()
        counts = {r: n for r, n in zip(REASONS, refused, strict=True) if r is not None and n}
        return Counter(counts | {reason: n for reason, n in self._judged.items() if n})

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
        last = self.history.last
        return 0 if last is None else int(last["restarts"])

    @property
    def failures(self) -> int:
        """Number of numerical failures: states or outputs that were not finite."""
        last = self.history.last
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
        last = self.history.last
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
        self.history.offer(
            stamps, sample, inputs, now, codes, output_codes, innovation, expected_std
        )
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
        self.history.offer(times, samples, inputs, now, *outcomes)
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
        rows = self.estimator.new_rows(len(times))
        self.history.follow(times, samples, inputs, rows)
        return self.estimator.as_rows(rows)

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
        if not self.history.estimate_at(stamp, row):
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
    def _judged(self) -> dict[RejectReason, int]:
        """Numbers of measurements that the estimator itself refused, wholly or in part."""
        last = self.history.last
        if last is None:
            return {}
        return {
            RejectReason.GATED: int(last["gated"]),
            RejectReason.IMPLAUSIBLE_TORQUE: int(last["implausible"]),
            RejectReason.UNKNOWN_INPUT: int(last["unknown_inputs"]),
        }
