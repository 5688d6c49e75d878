# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of a run's estimates, and the validity of their published bounds.

Errors are judged over the *settled* parts of a run: what remains without some seconds after the
start and after each jump of the true disturbance, which no estimator can know at once.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array, as_matrix, check_each, non_negative, positive
from tsobs_ros.report.run import RecordedRun

SIGMAS = 3.0
"""Errors count as inside their bound up to this many of its 1σ."""


SAME_JUMP = 0.1


class Quantity(NamedTuple):
    """An estimated quantity: a key for programs, a name for people, a unit."""

    key: str
    name: str
    unit: str


QUANTITIES = (
    Quantity("link_angle", "link angle", "rad"),
    Quantity("link_velocity", "link velocity", "rad/s"),
    Quantity("motor_angle", "motor angle", "rad"),
    Quantity("motor_velocity", "motor velocity", "rad/s"),
    Quantity("disturbance", "sensor disturbance", "rad"),
)


@dataclass(frozen=True)
class MetricsOptions:
    """Options of the measures of a run.

    Attributes:
        start_settle_time: Time after the first estimate that does not count [s].
        jump_settle_time: Time after a jump of the true disturbance that does not count [s].
        jump_threshold: Change of the true disturbance from one sample to the next that is a jump
            [rad]; about 1σ of the sensor's noise, and several times what a fault of 0.4 rad at
            3 rad/s moves in a sample at 200 Hz.
        hold_time: Time that errors must stay inside their bound to have settled [s].
        scale: Typical size of [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), which the normalised RMSE divides
            by; the default is the root mean square of the default arm's motion.
        innovation_std: 1σ the design expects of an innovation [rad]; None if unknown.

    Raises:
        ModelError: A time or size is negative, or not finite.
    """

    start_settle_time: float = 5.0
    jump_settle_time: float = 5.0
    jump_threshold: float = 0.03
    hold_time: float = 1.0
    scale: tuple[float, ...] = (0.226, 0.60, 0.355, 0.464)
    innovation_std: float | None = None

    def __post_init__(self) -> None:
        check_each(non_negative, self, "start_settle_time", "jump_settle_time", "hold_time")
        positive("jump_threshold", self.jump_threshold)
        for value in as_matrix("scale", self.scale, (4,)):
            positive("scale", float(value))
        if self.innovation_std is not None:
            positive("innovation_std", self.innovation_std)


@dataclass(frozen=True)
class QuantityMetrics:
    """One estimated quantity over the settled parts; None if the data for it are missing.

    Attributes:
        key: As in `QUANTITIES`.
        rmse: Root mean square error, in the quantity's unit.
        bound: Root mean square of the published 1σ bound.
        ratio: rmse / bound; at most 1, up to chance, if the certificate's model is true.
        inside: Fraction of samples with an error inside `SIGMAS` times the bound.
    """

    key: str
    rmse: float | None
    bound: float | None
    ratio: float | None
    inside: float | None


Windows = tuple[tuple[float, float], ...]
"""Parts of a run as (begin, end) in seconds since its origin."""


class Jump(NamedTuple):
    """A sudden change of the true disturbance: when [s] since the origin, and by what [rad]."""

    time: float
    size: float


@dataclass(frozen=True)
class Event:
    """A start or a jump, after which errors have to settle.

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


@dataclass(frozen=True)
class RunMetrics:
    """The measured run.

    Attributes:
        quantities: One for each of `QUANTITIES`, in that order.
        normalised_rmse: Root mean square over the four states of RMSE / scale; None without truth.
        nis: Mean normalised innovation squared over the settled parts, 1 if the innovations are
            as large as the design expects; None if that is not known.
        events: The start and the jumps, in order.
        windows: Settled parts as (begin, end) in seconds since the run's origin.
        settled_time: Their total length [s].
        duration: From the first estimate to the last [s].
        estimates: Number of estimates.
        measurements: Number of measurements.
    """

    quantities: tuple[QuantityMetrics, ...]
    normalised_rmse: float | None
    nis: float | None
    events: tuple[Event, ...]
    windows: Windows
    settled_time: float
    duration: float
    estimates: int
    measurements: int

    @property
    def has_truth(self) -> bool:
        """Whether the error of any quantity is known."""
        return any(one.rmse is not None for one in self.quantities)

    def __getitem__(self, key: str) -> QuantityMetrics:
        """Return the metrics of one quantity, else raise `KeyError`."""
        return {one.key: one for one in self.quantities}[key]

    def as_mapping(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold."""
        data = asdict(self)
        data["quantities"] = {one.pop("key"): one for one in data["quantities"]}
        data["windows"] = [list(window) for window in self.windows]
        data["events"] = list(data["events"])
        return data


def measure(run: RecordedRun, options: MetricsOptions | None = None) -> RunMetrics:
    """Measure a run.

    Args:
        run: The recorded run; without truth only its bounds and innovations are measured.
        options: Options of the measures; the defaults if None.
    """
    options = options or MetricsOptions()
    jumps = _find_jumps(run, options.jump_threshold)
    windows = _settled_windows(run, jumps, options.start_settle_time, options.jump_settle_time)
    settled = inside_windows(run.times, windows)
    error = errors(run)
    bounds = np.column_stack([run.state_bounds, run.disturbance_bounds])
    quantities = tuple(
        _quantity(key, None if error is None else error[settled, place], bounds[settled, place])
        for place, (key, _, _) in enumerate(QUANTITIES)
    )
    return RunMetrics(
        quantities=quantities,
        normalised_rmse=_normalised([one.rmse for one in quantities[:4]], options.scale),
        nis=_nis(run, windows, options.innovation_std),
        events=_settle_events(run.times, jumps, error, SIGMAS * bounds, options.hold_time),
        windows=windows,
        settled_time=sum(end - begin for begin, end in windows),
        duration=float(run.times[-1] - run.times[0]),
        estimates=len(run.stamps),
        measurements=len(run.measurements.stamps),
    )


def errors(run: RecordedRun) -> Array | None:
    """Return estimate − truth of all `QUANTITIES`, NaN if unknown, shape (m, 5).

    None without any truth; a truth that was not recorded in part is NaN.
    """
    states, disturbance = run.true_states, run.true_disturbance_held
    if states is None and disturbance is None:
        return None
    nothing = np.full(len(run.stamps), np.nan)
    return np.column_stack(
        [
            run.states - (nothing[:, np.newaxis] if states is None else states),
            run.disturbance - (nothing if disturbance is None else disturbance),
        ]
    )


def _quantity(key: str, error: Array | None, bound: Array) -> QuantityMetrics:
    if error is None or not np.isfinite(error).any():
        return QuantityMetrics(key, None, root_mean_square(bound), None, None)
    known = np.isfinite(error) & np.isfinite(bound)
    rmse, size = root_mean_square(error), root_mean_square(bound[known])
    inside = float((np.abs(error[known]) <= SIGMAS * bound[known]).mean()) if known.any() else None
    ratio = _bounded(rmse / size) if rmse is not None and size else None
    return QuantityMetrics(key, rmse, size, ratio, inside)


def root_mean_square(values: Array) -> float | None:
    """Return the root mean square of the finite values, None if there is none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return None
    with np.errstate(over="ignore"):
        return _bounded(math.sqrt(float(np.mean(finite**2))))


def _normalised(rmse: list[float | None], scale: tuple[float, ...]) -> float | None:
    relative = [e / s for e, s in zip(rmse, scale, strict=True) if e is not None]
    if len(relative) < 4:
        return None
    return _bounded(math.sqrt(sum(r * r for r in relative) / 4.0))


def _nis(run: RecordedRun, windows: Windows, std: float | None) -> float | None:
    if std is None or run.innovations is None or not len(run.innovations.stamps):
        return None
    settled = inside_windows(run.innovations.seconds(run.origin), windows)
    size = root_mean_square(run.innovations.values[settled, 0])
    return None if size is None else _bounded((size / std) * (size / std))


def _bounded(value: float) -> float:
    """Return a number that JSON can hold: a diverged estimate is squared past the largest one."""
    return min(value, sys.float_info.max)


def _find_jumps(run: RecordedRun, threshold: float) -> tuple[Jump, ...]:
    """Return the jumps of the true disturbance, above the threshold [rad] from sample to sample."""
    if run.true_disturbance is None:
        return ()
    times = run.true_disturbance.seconds(run.origin)
    steps = np.diff(run.true_disturbance.values[:, 0])
    found, last = [], -math.inf
    for place in np.flatnonzero(np.abs(steps) > threshold):
        time = float(times[place + 1])
        # A fault that chatters is one event, which begins with its first jump.
        if run.times[0] < time <= run.times[-1] and time - last > SAME_JUMP:
            found.append(Jump(time, float(steps[place])))
        last = time
    return tuple(found)


def _settled_windows(
    run: RecordedRun, jumps: Sequence[Jump], after_start: float, after_jump: float
) -> Windows:
    """Return the parts of a run without the times [s] after its start and after each jump.

    The run ends with its last measurement: predictions of an observer that is left running are no
    measure of it.
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


def _settle_events(
    times: Array, jumps: Sequence[Jump], error: Array | None, limits: Array, hold_time: float
) -> tuple[Event, ...]:
    """Return the start and the jumps with the time the errors took to settle after each.

    Args:
        times: Of the errors [s], shape (m,).
        jumps: In order.
        error: NaN if unknown, shape (m, k); None without truth.
        limits: Largest error that counts as small, shape (m, k). The smallest over the run is
            used: the bound is wide while an estimate settles.
        hold_time: Time that the errors must stay small [s].
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
