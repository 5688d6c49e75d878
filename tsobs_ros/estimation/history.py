# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The history of an estimator in compiled code: a ring of states, one after each measurement.

A late measurement is put in its place by rewinding to the state before it, so the estimate equals,
bit for bit, the one that arrival in order would have given. However many are late, one rewind
serves all that come together: the cost is one pass over the history.
"""

import math
from functools import cache
from typing import Any

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled, compiled_nogil, inlined
from tsobs_ros.estimation.records import Basis, RejectReason
from tsobs_ros.estimation.state import correction_type, readout_type, work_type
from tsobs_ros.estimation.steps import correct, predict, read, write_row
from tsobs_ros.estimation.torque import take_torque
from tsobs_ros.model.matrices import has_finite, is_finite
from tsobs_ros.model.stepping import Room, record_type

REASONS = (None, *RejectReason)
"""Reasons of rejection by their codes; 0 is a measurement that was used."""

USED = 0
NON_FINITE, DUPLICATE, TOO_OLD, FROM_FUTURE, GATED, ZERO_STAMP, IMPLAUSIBLE_TORQUE = (
    REASONS.index(reason)
    for reason in (
        RejectReason.NON_FINITE,
        RejectReason.DUPLICATE,
        RejectReason.TOO_OLD,
        RejectReason.FROM_FUTURE,
        RejectReason.GATED,
        RejectReason.ZERO_STAMP,
        RejectReason.IMPLAUSIBLE_TORQUE,
    )
)

CORRECTING = (USED, IMPLAUSIBLE_TORQUE)
"""Outcomes of measurements whose angle was used."""

_OF_CERTIFICATE, _OUTSIDE = Basis.LEARNT.value, Basis.OUTSIDE.value

SPARE = 2
"""States at the end of a ring: one in a gap, and one that is read."""

EXTRA = 2
"""Numbers of `estimate_at` behind those of `write_row`: in the domain or not, and the age [s]."""


@cache
def memory_type(room: Room) -> np.dtype[Any]:
    """Return the type of what a history needs besides its ring.

    first, length: of the states in the ring. has_base: whether the first of them is only kept to
    rewind to. generation: count of changes. coasted_periods: whole periods of a gap, after the
    newest measurement at `coasted_generation`, for which there is a state. accepted to refused:
    counts, the last by the codes of `REASONS`. span: how far back a late measurement may reach
    [ns]. future: how far ahead of the clock a stamp may lie [ns]. restart_after: the longest gap
    [ns]. max_steps: the largest number of measurements. x_max: half width of the certificate's
    domain. The rest is scratch; y, u: of the measurement in hand.
    """
    count = np.int64
    return record_type(
        [
            ("first", count),
            ("length", count),
            ("has_base", count),
            ("generation", count),
            ("coasted_generation", count),
            ("coasted_periods", count),
            ("accepted", count),
            ("rewinds", count),
            ("forgotten", count),
            ("bad_outputs", count),
            ("refused", count, (len(REASONS),)),
            ("span", count),
            ("future", count),
            ("restart_after", count),
            ("max_steps", count),
            ("x_max", np.float64),
            ("y", np.float64, (room.p,)),
            ("u", np.float64, (room.m,)),
            ("correction", correction_type(room)),
            ("readout", readout_type(room)),
            ("work", work_type(room)),
        ]
    )


@compiled
def offer(
    models: Any,
    memories: Any,
    ring: Any,
    stamps: Any,
    y: Array,
    u: Array,
    now: int,
    outcomes: Any,
    output_codes: Any,
    innovations: Array,
    expected_std: Array,
) -> None:
    """Use measurements, or refuse them.

    They may be in any order; in ascending order of stamps, late ones cost one rewind in all.

    Args:
        models: Model record, shape (1,).
        memories: Record of `memory_type`, shape (1,).
        ring: State records, `max_steps` + 2 + `SPARE` or more.
        stamps: Of N measurements [ns], shape (N,).
        y: NaN of an output that is missing, shape (N, p).
        u: Inputs from each measurement until the next one, shape (N, m).
        now: Time on the clock of the stamps [ns].
        outcomes: Codes of `REASONS`, written, shape (N,).
        output_codes: Those of each output, written, shape (N, p): of a measurement that is used
            `USED`, `GATED`, or `NON_FINITE` of one that is missing.
        innovations: y − ŷ of those that are used, NaN if missing, written, shape (N, p).
        expected_std: 1σ expected of each, written, shape (N, p).
    """
    model, memory = models[0], memories[0]
    count, i = len(stamps), 0
    # In a rewind: the measurements after the late one, to be used again.
    late, again = 0, 0
    later_stamps = np.empty(0, np.int64)
    later_y, later_u = np.empty((0, 1)), np.empty((0, 1))
    while i < count or again < late:
        newest = newest_stamp(memory, ring)
        # One that is older than its predecessor waits until a rewind is over.
        repeated = again < late and (
            i >= count or stamps[i] > later_stamps[again] or stamps[i] < newest
        )
        if repeated:
            stamp, sample, inputs = later_stamps[again], later_y[again], later_u[again]
            again += 1
        else:
            stamp, sample, inputs = stamps[i], y[i], u[i]
            code = _refusal(model, memory, ring, stamp, sample, inputs, now, newest)
            if code == USED and again < late and stamp == later_stamps[again]:
                code = DUPLICATE
            if code != USED:
                memory.refused[code] += 1
                outcomes[i] = code
                for j in range(model.p):
                    output_codes[i, j] = code
                i += 1
                continue
            if again >= late and memory.length > 0 and stamp < newest:
                place = _count_before(memory, ring, stamp)
                late, again = memory.length - place, 0
                later_stamps = np.empty(late, np.int64)
                later_y, later_u = np.empty((late, model.p)), np.empty((late, model.m))
                for j in range(late):
                    step = ring[slot_of(memory, ring, place + j)]
                    later_stamps[j] = step.stamp
                    for c in range(model.p):
                        later_y[j, c] = step.y[c]
                    for c in range(model.m):
                        later_u[j, c] = step.u[c]
                memory.length = place
            if again < late:
                memory.rewinds += 1
            memory.accepted += 1
        code = _advance(model, memory, ring, stamp, sample, inputs)
        if not repeated:
            outcomes[i] = code
            for j in range(model.p):
                if not math.isfinite(sample[j]):
                    output_codes[i, j] = NON_FINITE
                else:
                    output_codes[i, j] = USED if memory.correction.weight[j] > 0.0 else GATED
                innovations[i, j] = memory.correction.innovation[j]
                variance = memory.correction.innovation_covariance[j, j]
                expected_std[i, j] = math.sqrt(variance) if variance >= 0.0 else math.nan
            i += 1


@compiled
def estimate_at(models: Any, memories: Any, ring: Any, stamp: int, row: Array) -> bool:
    """Write the estimate at a stamp; return whether there is one.

    There is none before the first measurement, too long after the last, or if it is not finite,
    which is counted.

    Args:
        models: Model record, shape (1,).
        memories: Record of `memory_type`, shape (1,).
        ring: State records.
        stamp: [ns].
        row: As of `write_row`, and behind that whether the state is in the certificate's domain,
            and the time since the newest measurement before it [s].
    """
    model, memory = models[0], memories[0]
    place = memory.length - 1
    if memory.length > 0 and stamp < newest_stamp(memory, ring):
        place = _count_before(memory, ring, stamp + 1) - 1
    if place < 0:
        return False
    scratch, coasted = len(ring) - 1, len(ring) - 2
    step = ring[slot_of(memory, ring, place)]
    elapsed = stamp - step.stamp
    if elapsed > memory.restart_after:
        return False
    remaining, period, shown = elapsed / 1e9, model.period, step
    if elapsed > 0:
        ring[scratch] = step
        # Whole periods of a gap are remembered from one call to the next; without that every call
        # in a long gap would predict through the whole gap again.
        whole = math.floor(remaining / period) if remaining > 2.0 * period else 0
        taken, memorable = 0, place == memory.length - 1
        known = memorable and memory.coasted_generation == memory.generation
        if known and 0 < memory.coasted_periods <= whole:
            ring[scratch] = ring[coasted]
            taken = memory.coasted_periods
        while True:
            length = period
            if taken >= whole:
                length = remaining - whole * period
                if whole > 0 and memorable:
                    ring[coasted] = ring[scratch]
                    memory.coasted_periods = whole
                    memory.coasted_generation = memory.generation
            elif taken == 0:
                # Two at once, so that it is no regular step for the estimator.
                length = 2.0 * period
            if length > 0.0:
                predict(model, ring[scratch], step.held[:], length, taken >= whole, memory.work)
            if taken >= whole:
                break
            taken += 2 if taken == 0 else 1
        shown = ring[scratch]
    read(model, shown, memory.readout, memory.work)
    if memory.readout.finite == 0:
        memory.bad_outputs += 1
        return False
    inside = abs(memory.readout.state[0]) <= memory.x_max
    if not inside and (memory.readout.basis <= _OF_CERTIFICATE or shown.certified != 0):
        memory.readout.basis = _OUTSIDE
    end = write_row(model, memory.readout, row)
    row[end] = 1.0 if inside else 0.0
    row[end + 1] = remaining
    return True


@compiled_nogil
def follow(
    models: Any, memories: Any, ring: Any, stamps: Any, y: Array, u: Array, there: Any, rows: Array
) -> None:
    """Use measurements in ascending order of stamps, those that are finite, and estimate at each.

    Args:
        models: Model record, shape (1,).
        memories: Record of `memory_type`, shape (1,).
        ring: State records.
        stamps: Of N measurements [ns], shape (N,).
        y: NaN of an output that is missing, shape (N, p).
        u: Shape (N, m).
        there: Whether there is an estimate, written, shape (N,).
        rows: The estimates, as of `estimate_at`, written where there are any, shape (N, width).
    """
    model, memory = models[0], memories[0]
    for i in range(len(stamps)):
        if _is_readable(model, y[i], u[i]):
            memory.accepted += 1
            _advance(model, memory, ring, stamps[i], y[i], u[i])
        else:
            memory.refused[NON_FINITE] += 1
        there[i] = estimate_at(models, memories, ring, stamps[i], rows[i])


@compiled
def copy_history(memories: Any, ring: Any, other_memories: Any, other_ring: Any) -> None:
    """Copy a history to records of the same sizes, without the states that it has forgotten."""
    memory, coasted = memories[0], len(ring) - SPARE
    other_memories[0] = memory
    for place in range(memory.length):
        slot = slot_of(memory, ring, place)
        other_ring[slot] = ring[slot]
    other_ring[coasted] = ring[coasted]


@compiled
def forget(memories: Any, ring: Any) -> None:
    """Forget all measurements, but not the counts."""
    memory = memories[0]
    if memory.length > 0:
        memory.bad_outputs += ring[slot_of(memory, ring, memory.length - 1)].failures
    memory.first, memory.length, memory.has_base, memory.coasted_periods = 0, 0, 0, 0


@inlined
def _advance(model: Any, memory: Any, ring: Any, stamp: int, y: Array, u: Array) -> int:
    """Predict to a measurement from the newest state, correct, and remember.

    Returns:
        The measurement's outcome.
    """
    place = slot_of(memory, ring, memory.length)
    gated, implausible, restarts, failures = 0, 0, 0, 0
    restart = memory.length == 0
    if memory.length > 0:
        last = ring[slot_of(memory, ring, memory.length - 1)]
        gated, implausible = last.gated, last.implausible
        restarts, failures = last.restarts, last.failures
        if stamp - last.stamp > memory.restart_after:
            restart = True
            restarts += 1
        else:
            ring[place] = last
            duration = (stamp - last.stamp) / 1e9
            # bool(0) and not False, for which `predict` would be compiled once more.
            predict(model, ring[place], last.held[:], duration, bool(0), memory.work)
    state, correction = ring[place], memory.correction
    # A part of a record costs nothing to pass on; a part of an array counts references.
    sample, inputs = memory.y[:], memory.u[:]
    for i in range(model.p):
        sample[i] = y[i]
    for i in range(model.m):
        inputs[i] = u[i]
    for attempt in range(2):
        if restart:
            ring[place] = model.initial
        take_torque(model, state, inputs)
        correct(model, state, sample, correction)
        total = 0.0
        for i in range(model.p):
            if math.isfinite(y[i]):
                total += correction.innovation[i]
            for j in range(model.p):
                total += correction.innovation_covariance[i, j]
        if attempt > 0 or math.isfinite(total):
            break
        # Start over, from this measurement.
        restart = True
        restarts += 1
        failures += 1
    code = IMPLAUSIBLE_TORQUE if state.torque_unknown != 0 else USED
    used = bool(0)
    for i in range(model.p):
        used = used or correction.weight[i] > 0.0
    if not used:
        code = GATED
    state.stamp = stamp
    for i in range(model.m):
        state.u[i] = u[i]
    state.gated = gated + 1 if code == GATED else gated
    state.implausible = implausible + 1 if code == IMPLAUSIBLE_TORQUE else implausible
    state.restarts, state.failures = restarts, failures
    memory.length += 1
    memory.generation += 1
    # Forget what is out of reach, and what is too much.
    while True:
        steps = memory.length - memory.has_base
        oldest = ring[slot_of(memory, ring, memory.has_base)].stamp
        expired = oldest < stamp - memory.span
        if not expired and steps <= memory.max_steps:
            break
        if not expired:
            memory.forgotten += 1
        if memory.has_base != 0:
            memory.first = slot_of(memory, ring, 1)
            memory.length -= 1
        memory.has_base = 1
    return code


@inlined
def slot_of(memory: Any, ring: Any, place: int) -> int:
    """Return where a state is, given its place from the oldest on."""
    slot: int = (memory.first + place) % (len(ring) - SPARE)
    return slot


@inlined
def newest_stamp(memory: Any, ring: Any) -> int:
    """Return the newest stamp [ns], 0 if there is none."""
    if memory.length == 0:
        return 0
    stamp: int = ring[slot_of(memory, ring, memory.length - 1)].stamp
    return stamp


@inlined
def _count_before(memory: Any, ring: Any, stamp: int) -> int:
    """Return the number of states in the ring before a stamp [ns]."""
    low, high = 0, memory.length
    while low < high:
        middle = (low + high) // 2
        if ring[slot_of(memory, ring, middle)].stamp < stamp:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def _is_readable(model: Any, y: Array, u: Array) -> bool:
    """Return whether an output and all inputs are numbers, but for a torque, which is judged."""
    return has_finite(y, model.p) and (model.torque_limit > 0.0 or is_finite(u, model.m))


@compiled
def _refusal(
    model: Any, memory: Any, ring: Any, stamp: int, y: Array, u: Array, now: int, newest: int
) -> int:
    """Return the code of the reason why a measurement cannot be used, or `USED`."""
    if not _is_readable(model, y, u):
        return NON_FINITE
    if stamp <= 0:
        return ZERO_STAMP
    if stamp > now + memory.future:
        return FROM_FUTURE
    if memory.length == 0 or stamp > newest:
        return USED
    base = ring[memory.first]
    if stamp < newest - memory.span or (memory.has_base != 0 and stamp <= base.stamp):
        return TOO_OLD
    place = _count_before(memory, ring, stamp)
    if place < memory.length and ring[slot_of(memory, ring, place)].stamp == stamp:
        return DUPLICATE
    return USED
