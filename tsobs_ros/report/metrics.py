# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of a run's estimates, and the validity of their published bounds.

Errors are judged over the *settled* parts of a run: what remains without some seconds after the
start and after each jump of the true disturbance, which no estimator can know at once.
"""

import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from tempfile import TemporaryFile
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


class Score(NamedTuple):
    """What is measured of a part of a run.

    Attributes:
        times: Of the estimates, since the run's origin [s], shape (m,).
        error: Estimate − truth of all `QUANTITIES`, NaN if unknown, shape (m, 5).
        bounds: 1σ bound of each, shape (m, 5).
        innovations: Time [s] and innovation [rad], shape (i, 2); None if not recorded.
        jumps: Time [s] and size [rad] of the true disturbance's large steps, shape (s, 2).
        measurements: Number of measurements.
        last_measured: Time of the last measurement [s].
        has_truth: Whether any truth was recorded.
    """

    times: Array
    error: Array
    bounds: Array
    innovations: Array | None
    jumps: Array
    measurements: int
    last_measured: float
    has_truth: bool


def score(run: RecordedRun, options: MetricsOptions) -> Score:
    """Return what is measured of a run, or of a part of it."""
    error, innovations = errors(run), None
    if run.innovations is not None:
        seconds = run.innovations.seconds(run.origin)
        innovations = np.column_stack([seconds, run.innovations.values[:, 0]])
    measured = run.measurements.seconds(run.origin)
    return Score(
        times=run.times,
        error=np.full((len(run.times), len(QUANTITIES)), np.nan) if error is None else error,
        bounds=np.column_stack([run.state_bounds, run.disturbance_bounds]),
        innovations=innovations,
        jumps=_large_steps(run, options.jump_threshold),
        measurements=len(measured),
        last_measured=float(measured.max(initial=-math.inf)),
        has_truth=error is not None,
    )


def measure(
    run: RecordedRun | Iterable[RecordedRun], options: MetricsOptions | None = None
) -> RunMetrics:
    """Measure a run.

    Args:
        run: The recorded run, or its parts; without truth only its bounds and innovations are
            measured.
        options: Options of the measures; the defaults if None.
    """
    options = options or MetricsOptions()
    if isinstance(run, RecordedRun):
        return measure_scores([score(run, options)], options)
    with closing(ScoreFile()) as scores:
        for part in run:
            scores.add(part, options)
        return measure_scores(scores, options)


class ScoreFile:
    """Scores of the parts of a run in a temporary file, 0.1 kB for each estimate.

    Attributes:
        count: Number of estimates.
        origin: Stamp that times count from [ns]; None before the first part.
        until: End of the parts until now [ns].
    """

    def __init__(self) -> None:
        self.count, self._parts = 0, 0
        self.origin: int | None = None
        self.until: int | None = None
        self._file = TemporaryFile()  # noqa: SIM115 (`close` closes it)

    def add(self, part: RecordedRun, options: MetricsOptions) -> None:
        """Add a part."""
        self.origin, self.until = part.origin, part.until
        self.count += len(part.stamps)
        self._parts += 1
        for one in score(part, options):
            np.save(self._file, np.zeros((0, 2)) if one is None else one)

    def close(self) -> None:
        """Delete the file."""
        self._file.close()

    def __iter__(self) -> Iterator[Score]:
        self._file.seek(0)
        for _ in range(self._parts):
            fields = [np.load(self._file) for _ in Score._fields]
            yield Score(*fields[:5], *(one.item() for one in fields[5:]))


def measure_scores(scores: Iterable[Score], options: MetricsOptions) -> RunMetrics:
    """Measure a run by its scores, which are gone through twice."""
    whole = _Whole()
    for one in scores:
        whole.add(one)
    jumps = whole.jumps()
    last = min(whole.last, whole.last_measured)
    windows = _settled_windows(
        whole.first, last, jumps, options.start_settle_time, options.jump_settle_time
    )
    quantities = [_Quantity(key) for key, _, _ in QUANTITIES]
    innovations = SquareSum()
    begins = [whole.first, *(jump.time for jump in jumps)]
    settlings = [_Settling(begin, options.hold_time) for begin in begins]
    for one in scores:
        settled = inside_windows(one.times, windows)
        for place, quantity in enumerate(quantities):
            quantity.add(one.error[settled, place], one.bounds[settled, place])
        if one.innovations is not None:
            of_settled = inside_windows(one.innovations[:, 0], windows)
            innovations.add(one.innovations[of_settled, 1])
        if whole.has_truth and len(one.times):
            outside = whole.is_outside(one)
            of_event = np.searchsorted(begins, one.times, side="right") - 1
            for event in range(max(0, int(of_event[0])), int(of_event[-1]) + 1):
                here = of_event == event
                settlings[event].add(one.times[here], outside[here])
    measured = tuple(quantity.result() for quantity in quantities)
    std, size = options.innovation_std, innovations.root_mean()
    known = std is not None and size is not None
    return RunMetrics(
        quantities=measured,
        normalised_rmse=_normalised([one.rmse for one in measured[:4]], options.scale),
        nis=_bounded((size / std) * (size / std)) if known and std and size is not None else None,
        events=tuple(
            Event("jump" if place else "start", one.begin, size, one.after)
            for place, (one, size) in enumerate(
                zip(settlings, [0.0, *(jump.size for jump in jumps)], strict=True)
            )
        ),
        windows=windows,
        settled_time=sum(end - begin for begin, end in windows),
        duration=whole.last - whole.first,
        estimates=whole.estimates,
        measurements=whole.measurements,
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


class _Whole:
    """What must be known of a whole run before it is measured."""

    def __init__(self) -> None:
        self.first, self.last = math.inf, -math.inf
        self.last_measured = -math.inf
        self.estimates, self.measurements, self.has_truth = 0, 0, False
        self._steps: list[Array] = []
        self._limits = np.full(len(QUANTITIES), np.inf)
        self._known = np.zeros(len(QUANTITIES), np.bool_)

    def add(self, part: Score) -> None:
        """Add a part."""
        if len(part.times):
            self.first = min(self.first, float(part.times[0]))
            self.last = float(part.times[-1])
        self.last_measured = max(self.last_measured, part.last_measured)
        self.estimates += len(part.times)
        self.measurements += part.measurements
        self.has_truth |= part.has_truth
        self._steps.append(part.jumps)
        limits = SIGMAS * part.bounds
        limits[~np.isfinite(limits)] = np.inf
        self._limits = np.minimum(self._limits, limits.min(axis=0, initial=np.inf))
        self._known |= np.isfinite(part.error).any(axis=0)

    def is_outside(self, part: Score) -> NDArray[np.bool_]:
        """Return at which times some error is not known to be small, shape (m,).

        The limit is the smallest of the run, as the bound is wide while an estimate settles.
        """
        judged = self._known & np.isfinite(self._limits)
        # "Not inside" rather than "outside", so that an unknown error is not taken for a small one.
        return np.asarray(~(np.abs(part.error) <= self._limits)[:, judged].all(axis=1))

    def jumps(self) -> tuple[Jump, ...]:
        """Return the jumps of the true disturbance during the estimates."""
        found, before = [], -math.inf
        for time, size in np.concatenate(self._steps).tolist() if self._steps else ():
            # A fault that chatters is one event, which begins with its first jump.
            if self.first < time <= self.last and time - before > SAME_JUMP:
                found.append(Jump(time, size))
            before = time
        return tuple(found)


class SquareSum:
    """A root mean square of finite values, summed up part by part."""

    def __init__(self) -> None:
        self._sum, self.count = 0.0, 0

    def add(self, values: Array) -> None:
        """Add values, shape (n,)."""
        finite = values[np.isfinite(values)]
        with np.errstate(over="ignore"):
            self._sum += float(np.sum(finite**2))
        self.count += len(finite)

    def root_mean(self) -> float | None:
        """Return the root mean square; None without a value."""
        return _bounded(math.sqrt(self._sum / self.count)) if self.count else None


class _Quantity:
    """Measures of one quantity, summed up part by part."""

    def __init__(self, key: str) -> None:
        self._key, self._inside = key, 0
        self._error, self._bound, self._bound_with_error = SquareSum(), SquareSum(), SquareSum()

    def add(self, error: Array, bound: Array) -> None:
        known = np.isfinite(error) & np.isfinite(bound)
        self._error.add(error)
        self._bound.add(bound)
        self._bound_with_error.add(bound[known])
        self._inside += int((np.abs(error[known]) <= SIGMAS * bound[known]).sum())

    def result(self) -> QuantityMetrics:
        rmse, known = self._error.root_mean(), self._bound_with_error
        if rmse is None:
            return QuantityMetrics(self._key, None, self._bound.root_mean(), None, None)
        size = known.root_mean()
        inside = self._inside / known.count if known.count else None
        return QuantityMetrics(
            self._key, rmse, size, _bounded(rmse / size) if size else None, inside
        )


def root_mean_square(values: Array) -> float | None:
    """Return the root mean square of the finite values, None if there is none."""
    squares = SquareSum()
    squares.add(values)
    return squares.root_mean()


def _normalised(rmse: list[float | None], scale: tuple[float, ...]) -> float | None:
    relative = [e / s for e, s in zip(rmse, scale, strict=True) if e is not None]
    if len(relative) < 4:
        return None
    return _bounded(math.sqrt(sum(r * r for r in relative) / 4.0))


def _bounded(value: float) -> float:
    """Return a number that JSON can hold: a diverged estimate is squared past the largest one."""
    return min(value, sys.float_info.max)


def _large_steps(run: RecordedRun, threshold: float) -> Array:
    """Return times [s] and sizes [rad] of the true disturbance's steps above a threshold [rad]."""
    if run.true_disturbance is None:
        return np.zeros((0, 2))
    stamps, values = run.true_disturbance
    steps = np.diff(values[:, 0])
    large = (np.abs(steps) > threshold) & run.covers(stamps[1:])
    seconds = run.true_disturbance.seconds(run.origin)[1:]
    return np.column_stack([seconds[large], steps[large]])


def _settled_windows(
    first: float, last: float, jumps: Sequence[Jump], after_start: float, after_jump: float
) -> Windows:
    """Return the parts of a run without the times [s] after its start and after each jump.

    The run ends with its last measurement: predictions of an observer that is left running are no
    measure of it.
    """
    # A jump during the start does not end the start, hence the running maximum.
    starts = [first + after_start] + [jump.time + after_jump for jump in jumps]
    begins = np.maximum.accumulate(starts).tolist()
    ends = [jump.time for jump in jumps] + [last]
    return tuple((a, b) for a, b in zip(begins, ends, strict=True) if a < b)


def inside_windows(times: Array, windows: Windows) -> NDArray[np.bool_]:
    """Return which times [s] lie in one of the windows, their ends not included, shape (n,)."""
    # They neither overlap nor touch.
    edges = np.array(windows).reshape(-1)
    return np.asarray(np.searchsorted(edges, times, side="right") % 2 == 1)


class _Settling:
    """Finds when errors have come to stay small after an event, part by part.

    Args:
        begin: Time of the event [s].
        hold_time: Time that errors must stay small [s].

    Attributes:
        after: Seconds until then; None if not seen.
    """

    def __init__(self, begin: float, hold_time: float) -> None:
        self.begin, self._hold_time = begin, hold_time
        self.after: float | None = None
        self._quiet_since: float | None = None

    def add(self, times: Array, outside: NDArray[np.bool_]) -> None:
        """Add times and whether an error is too large then, shape (n,) each."""
        if self.after is not None or not len(times):
            return
        # Quiet spells lie between neighbouring errors that are too large, and at both ends.
        borders = np.concatenate([[-1], np.flatnonzero(outside), [len(times)]])
        for spell in np.flatnonzero(np.diff(borders) > 1).tolist():
            before, after = int(borders[spell]), int(borders[spell + 1])
            if before >= 0 or self._quiet_since is None:
                self._quiet_since = float(times[before + 1])
            if times[after - 1] - self._quiet_since >= self._hold_time:
                self.after = self._quiet_since - self.begin
                return
        if outside[-1]:
            self._quiet_since = None
