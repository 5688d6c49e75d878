# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What errors have to settle from, how long that takes them, and what remains of a run."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array
from tsobs_ros.report.run import RecordedRun

Windows = tuple[tuple[float, float], ...]
"""Parts of a run as (begin, end) in seconds since its origin."""

_SAME_JUMP = 0.1


class Jump(NamedTuple):
    """A sudden change of the true disturbance: when [s] since the origin, and by what [rad]."""

    time: float
    size: float


@dataclass(frozen=True)
class Event:
    """Something that errors have to settle from.

    Attributes:
        what: "start" or "jump".
        time: Seconds since the run's origin.
        size: Change of the true disturbance [rad]; 0 for the start.
        settled_after: Seconds until all errors are inside their settled bounds and stay there for
            the hold time; None if they never are before the next event, or without truth.
    """

    what: str
    time: float
    size: float
    settled_after: float | None


def find_jumps(run: RecordedRun, threshold: float) -> tuple[Jump, ...]:
    """Return the jumps of the true disturbance between the first estimate and the last.

    Args:
        run: The recorded run.
        threshold: Change from one sample to the next that is a jump [rad].
    """
    if run.true_disturbance is None:
        return ()
    times = run.true_disturbance.seconds(run.origin)
    steps = np.diff(run.true_disturbance.values[:, 0])
    found, last = [], -math.inf
    for place in np.flatnonzero(np.abs(steps) > threshold):
        time = float(times[place + 1])
        # A fault that chatters is one event, which begins with its first jump.
        if run.times[0] < time <= run.times[-1] and time - last > _SAME_JUMP:
            found.append(Jump(time, float(steps[place])))
        last = time
    return tuple(found)


def settled_windows(
    run: RecordedRun, jumps: Sequence[Jump], after_start: float, after_jump: float
) -> Windows:
    """Return the parts of a run without the time after its start and after each jump.

    The run ends with its last measurement: what an observer that is left running predicts after
    that says nothing about it.

    Args:
        run: The recorded run.
        jumps: Its jumps, in order.
        after_start: What to leave out after the first estimate [s].
        after_jump: What to leave out after a jump [s].
    """
    measured = run.measurements.ordered().seconds(run.origin)
    last = min([float(run.times[-1]), *measured[-1:].tolist()])
    starts = run.times[0] + after_start
    # A jump during the start does not end the start, hence the running maximum.
    begins = np.maximum.accumulate([starts] + [jump.time + after_jump for jump in jumps]).tolist()
    ends = [jump.time for jump in jumps] + [last]
    return tuple((a, b) for a, b in zip(begins, ends, strict=True) if a < b)


def inside_windows(times: Array, windows: Windows) -> NDArray[np.bool_]:
    """Return which times [s] lie in one of the windows, their ends not included, shape (n,)."""
    inside = np.zeros(len(times), dtype=bool)
    for begin, end in windows:
        inside |= (times >= begin) & (times < end)
    return inside


def settle_events(
    times: Array, jumps: Sequence[Jump], error: Array | None, limits: Array, hold_time: float
) -> tuple[Event, ...]:
    """Return the start and the jumps with the time the errors took to settle after each.

    Args:
        times: Of the errors [s], shape (m,).
        jumps: In order.
        error: NaN where unknown, shape (m, k); None without truth.
        limits: Largest error that counts as small, shape (m, k). The smallest over the run is
            what counts: the bound is wide while an estimate settles.
        hold_time: How long the errors must stay small [s].
    """
    begins = [float(times[0])] + [jump.time for jump in jumps]
    ends = [*begins[1:], math.inf]
    outside = None if error is None else _outside(error, limits)
    return tuple(
        Event(
            "jump" if place else "start",
            begin,
            jumps[place - 1].size if place else 0.0,
            None if outside is None else _settling(times, outside, begin, end, hold_time),
        )
        for place, (begin, end) in enumerate(zip(begins, ends, strict=True))
    )


def _outside(error: Array, limits: Array) -> NDArray[np.bool_]:
    """Return at which times some error is not known to be small, shape (m,)."""
    judged = np.isfinite(error).any(axis=0) & np.isfinite(limits).any(axis=0)
    smallest = np.where(np.isfinite(limits), limits, np.inf).min(axis=0)
    # "Not inside" rather than "outside", so that an unknown error is not taken for a small one.
    return np.asarray(~(np.abs(error) <= smallest)[:, judged].all(axis=1))


def _settling(
    times: Array, outside: NDArray[np.bool_], begin: float, end: float, hold_time: float
) -> float | None:
    """Return how long after `begin` the errors have come to stay small, None if not by `end`."""
    here = (times >= begin) & (times < end)
    times, outside = times[here], outside[here]
    if not len(times):
        return None
    # Quiet spells lie between neighbouring errors that are too large, and at both ends.
    borders = [-1, *np.flatnonzero(outside).tolist(), len(times)]
    for before, after in pairwise(borders):
        if after - before > 1 and times[after - 1] - times[before + 1] >= hold_time:
            return float(times[before + 1] - begin)
    return None
