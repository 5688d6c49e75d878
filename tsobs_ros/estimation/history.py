# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The history of an estimator: a ring of states, one after each measurement.

A late measurement is put in its place by rewinding to the state before it, so the estimate equals,
bit for bit, the one that arrival in order would have given. However many are late, one rewind
serves all that come together: the cost is one pass over the history. core/history.c does it.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.model.prediction import Record

REASONS = (None, *RejectReason)
"""Reasons of rejection by their codes; 0 is a measurement that was used."""

USED = 0
NON_FINITE, GATED, IMPLAUSIBLE_TORQUE, UNKNOWN_INPUT = (
    REASONS.index(reason)
    for reason in (
        RejectReason.NON_FINITE,
        RejectReason.GATED,
        RejectReason.IMPLAUSIBLE_TORQUE,
        RejectReason.UNKNOWN_INPUT,
    )
)

CORRECTING = (USED, IMPLAUSIBLE_TORQUE, UNKNOWN_INPUT)
"""Outcomes of measurements whose outputs were used."""

SPARE = 2
"""States at the end of a ring: one in a gap, and one that is read."""

_MEMORY = record_type("history")


class History:
    """The states of one estimator after the last measurements, and what was counted.

    Its arrays keep their addresses, which the core looks up once.

    Args:
        estimator: The estimator.
        max_steps: Largest number of measurements that are kept.

    Attributes:
        memory: All but the states, a record that core/history.h describes, shape (1,).
        ring: States; the place of the oldest one and their number are in the memory.
    """

    def __init__(self, estimator: Estimator, max_steps: int) -> None:
        self.memory: Record = np.zeros(1, _MEMORY)
        self.ring: Record = np.zeros(max_steps + 2 + SPARE, estimator.new_states(0).dtype)
        model = estimator.model.view(np.float64)
        self._records = (
            native.Memory(model),
            native.Memory(self.memory.view(np.float64)),
            native.Memory(self.ring.view(np.float64)),
            native.Memory(np.zeros(native.history_scratch_size(model, len(self.ring)))),
        )

    @property
    def newest(self) -> int:
        """The newest stamp [ns], 0 if there is none."""
        last = self.last
        return 0 if last is None else int(last["stamp"])

    @property
    def place_of_last(self) -> int:
        """Where the newest state is in the ring, if there is one."""
        memory = self.memory[0]
        return int((memory["first"] + memory["length"] - 1) % (len(self.ring) - SPARE))

    @property
    def last(self) -> "np.void | None":
        """The newest state, None before the first."""
        return self.ring[self.place_of_last] if self.memory["length"][0] else None

    def offer(
        self,
        stamps: NDArray[np.int64],
        y: Array,
        u: Array,
        now: int,
        outcomes: NDArray[np.int64],
        output_codes: NDArray[np.int64],
        innovations: Array,
        expected_std: Array,
    ) -> None:
        """Use measurements in any order, or refuse them; see core/history.h.

        Args:
            stamps: Of N measurements [ns], shape (N,); ascending, late ones cost one rewind.
            y: NaN of an output that is missing, shape (N, p).
            u: Inputs from each measurement until the next one, shape (N, m).
            now: Time on the clock of the stamps [ns].
            outcomes: Codes of `REASONS`, written, shape (N,).
            output_codes: `USED`, `GATED`, or `NON_FINITE` of each output, written, shape (N, p).
            innovations: y − ŷ, NaN if not used, written, shape (N, p).
            expected_std: 1σ expected of each, written, shape (N, p).

        Raises:
            ValueError: An array is too short.
        """
        native.history_offer(
            *self._records, stamps, y, u, now, outcomes, output_codes, innovations, expected_std
        )

    def estimate_at(self, stamp: int, row: Array) -> bool:
        """Write the estimate at a stamp; return whether there is one.

        There is none before the first measurement, too long after the last, or if it is not finite,
        which is counted.

        Args:
            stamp: [ns].
            row: Of `Estimator.new_rows`, written.

        Raises:
            ValueError: The row is too short.
        """
        return native.history_estimate(*self._records, stamp, row)

    def follow(self, stamps: NDArray[np.int64], y: Array, u: Array, rows: Array) -> None:
        """Use measurements in ascending order of stamps, and estimate at each.

        Args:
            stamps: Of N measurements, later than any before [ns], shape (N,).
            y: NaN of an output that is missing, shape (N, p).
            u: Shape (N, m).
            rows: The estimates, as of `estimate_at`, NaN where there is none, shape (N, width).

        Raises:
            ValueError: An array is too short.
        """
        count = len(stamps)
        codes, innovations = np.empty((2, *y.shape), np.int64), np.empty((2, *y.shape))
        outcomes, newest, there = np.empty((3, count), np.int64)
        known = np.arange(1, count + 1)
        self.advance(
            stamps, y, u, outcomes, codes[0], *innovations,
            stamps, stamps, known, newest, there, rows, 2**62,
        )  # fmt: skip
        rows[there == 0] = np.nan

    def advance(self, *arguments: Any) -> None:
        """Offer measurements, and estimate at ticks, without other threads waiting.

        See `native.history_advance`, whose arguments these are.
        """
        native.history_advance(*self._records, *arguments)

    def forget(self) -> None:
        """Forget all measurements, but not the counts."""
        if (last := self.last) is not None:
            self.memory["bad_outputs"] += last["failures"]
        for name in ("first", "length", "has_base", "coasted_periods"):
            self.memory[name] = 0
