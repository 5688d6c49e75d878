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
from tsobs_ros.errors import ModelError
from tsobs_ros.report.quantities import QUANTITIES, Quantity
from tsobs_ros.report.run import RecordedRun

SIGMAS = 3.0
"""Errors count as inside their bound up to this many of its 1σ."""


SAME_JUMP = 0.1
_JUMPS = {"disturbance": "jump", "torque": "step"}


@dataclass(frozen=True)
class MetricsOptions:
    """Options of the measures of a run.

    Attributes:
        start_settle_time: Time after the first estimate that does not count [s].
        jump_settle_time: Time after a jump of the true disturbance that does not count [s].
        jump_threshold: Change of an angle's true disturbance from one sample to the next that is a
            jump [rad]; about 1σ of the sensor's noise, and several times what a fault of 0.4 rad
            at 3 rad/s moves in a sample at 200 Hz.
        hold_time: Time that errors must stay inside their bound to have settled [s].
        scale: Typical size of each state, which the normalised RMSE divides by; the default is the
            root mean square of the default arm's motion (rad, rad/s).
        innovation_std: 1σ the design expects of each output's innovation; one number for all, None
            if unknown.

    Raises:
        ModelError: A time or size is negative, or not finite.
    """

    start_settle_time: float = 5.0
    jump_settle_time: float = 5.0
    jump_threshold: float = 0.03
    hold_time: float = 1.0
    scale: tuple[float, ...] = (0.226, 0.60, 0.355, 0.464)
    innovation_std: float | tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        check_each(non_negative, self, "start_settle_time", "jump_settle_time", "hold_time")
        positive("jump_threshold", self.jump_threshold)
        for value in as_matrix("scale", self.scale, (len(self.scale),)):
            positive("scale", float(value))
        for value in self.innovation_stds:
            positive("innovation_std", value)

    @property
    def innovation_stds(self) -> tuple[float, ...]:
        """1σ expected of each output's innovation; empty if unknown."""
        one = self.innovation_std
        return () if one is None else one if isinstance(one, tuple) else (one,)


@dataclass(frozen=True)
class QuantityMetrics:
    """One estimated quantity over the settled parts; None if the data for it are missing.

    Attributes:
        key: The quantity's.
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
    """A sudden change of a true disturbance.

    Attributes:
        time: Seconds since the origin.
        size: Change, in the disturbance's unit.
        of: Place of the disturbance among the run's quantities.
    """

    time: float
    size: float
    of: int


@dataclass(frozen=True)
class Event:
    """A start or a jump, after which errors have to settle.

    Attributes:
        what: "start", "jump" of an output's disturbance, or "step" of a torque disturbance.
        time: Seconds since the run's origin.
        size: Change of the true disturbance, in its unit; 0 for the start.
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
        quantities: One for each of the run's quantities, in that order.
        normalised_rmse: Root mean square over the states of RMSE / scale; None without truth.
        nis: Mean normalised innovation squared over the settled parts, 1 if the innovations are
            as large as the design expects; None if that is not known.
        output_nis: The same of each output.
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
    output_nis: tuple[float | None, ...]
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

    @property
    def last(self) -> float:
        """Time of the last estimate since the run's origin [s]."""
        return self.events[0].time + self.duration

    def __contains__(self, key: str) -> bool:
        return any(one.key == key for one in self.quantities)

    def __getitem__(self, key: str) -> QuantityMetrics:
        """Return the metrics of one quantity, else raise `KeyError`."""
        return {one.key: one for one in self.quantities}[key]

    def as_mapping(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold."""
        data = asdict(self)
        data["quantities"] = {one.pop("key"): one for one in data["quantities"]}
        data["windows"] = [list(window) for window in self.windows]
        data["events"] = list(data["events"])
        if len(self.output_nis) <= 1:
            del data["output_nis"]
        return data


class Score(NamedTuple):
    """What is measured of a part of a run.

    Attributes:
        times: Of the estimates, since the run's origin [s], shape (m,).
        error: Estimate − truth of all k quantities, NaN if unknown, shape (m, k).
        bounds: 1σ bound of each, shape (m, k).
        innovations: Time [s] and innovations of the outputs, shape (i, 1 + p); None if not
            recorded.
        jumps: Time [s], size and quantity of true disturbances' large steps, shape (s, 3).
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
    innovations = None
    if run.innovations is not None:
        seconds = run.innovations.seconds(run.origin)
        innovations = np.column_stack([seconds, run.innovations.values])
    measured = run.measurements.seconds(run.origin)
    each = [run.of(quantity) for quantity in run.quantities]
    return Score(
        times=run.times,
        error=np.column_stack([one.error for one in each]),
        bounds=np.column_stack([one.bounds for one in each]),
        innovations=innovations,
        jumps=_large_steps(run, options.jump_threshold),
        measurements=len(measured),
        last_measured=float(measured.max(initial=-math.inf)),
        has_truth=any(one.truth is not None for one in each),
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
        return measure_scores([score(run, options)], options, run.quantities)
    with closing(ScoreFile()) as scores:
        for part in run:
            scores.add(part, options)
        return measure_scores(scores, options, scores.quantities)


class ScoreFile:
    """Scores of the parts of a run in a temporary file, 0.1 kB for each estimate.

    Attributes:
        count: Number of estimates.
        origin: Stamp that times count from [ns]; None before the first part.
        until: End of the parts until now [ns].
        quantities: What the scores are of.
    """

    def __init__(self) -> None:
        self.count, self._parts = 0, 0
        self.quantities: tuple[Quantity, ...] = QUANTITIES
        self.origin: int | None = None
        self.until: int | None = None
        self._file = TemporaryFile()  # noqa: SIM115 (`close` closes it)

    def add(self, part: RecordedRun, options: MetricsOptions) -> None:
        """Add a part."""
        self.origin, self.until, self.quantities = part.origin, part.until, part.quantities
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


def measure_scores(
    scores: Iterable[Score],
    options: MetricsOptions,
    quantities: Sequence[Quantity] = QUANTITIES,
) -> RunMetrics:
    """Measure a run by its scores of some quantities, which are gone through twice."""
    whole = _Whole(len(quantities))
    for one in scores:
        whole.add(one)
    jumps = whole.jumps()
    last = min(whole.last, whole.last_measured)
    windows = _settled_windows(
        whole.first, last, jumps, options.start_settle_time, options.jump_settle_time
    )
    sums = [_Quantity(quantity.key) for quantity in quantities]
    innovations: list[SquareSum] = []
    begins = [whole.first, *(jump.time for jump in jumps)]
    settlings = [_Settling(begin, options.hold_time) for begin in begins]
    for one in scores:
        settled = inside_windows(one.times, windows)
        for place, quantity in enumerate(sums):
            quantity.add(one.error[settled, place], one.bounds[settled, place])
        if one.innovations is not None:
            of_settled = inside_windows(one.innovations[:, 0], windows)
            outputs = one.innovations.shape[1] - 1
            innovations += [SquareSum() for _ in range(outputs - len(innovations))]
            for output, squares in enumerate(innovations, 1):
                squares.add(one.innovations[of_settled, output])
        if whole.has_truth and len(one.times):
            outside = whole.is_outside(one)
            of_event = np.searchsorted(begins, one.times, side="right") - 1
            for event in range(max(0, int(of_event[0])), int(of_event[-1]) + 1):
                here = of_event == event
                settlings[event].add(one.times[here], outside[here])
    measured = tuple(one.result() for one in sums)
    stds = options.innovation_stds
    stds = stds * len(innovations) if len(stds) == 1 else stds
    nis = tuple(
        None if (size := each.root_mean()) is None else _bounded((size / std) * (size / std))
        for each, std in zip(innovations, stds, strict=False)
    )
    states = [
        one.rmse
        for one, quantity in zip(measured, quantities, strict=True)
        if quantity.kind == "state"
    ]
    if len(states) != len(options.scale):
        raise ModelError(
            f"scale: expected {len(states)} sizes, one a state, got {len(options.scale)}"
        )
    return RunMetrics(
        quantities=measured,
        normalised_rmse=_normalised(states, options.scale),
        nis=_mean(nis, [one.count for one in innovations]),
        output_nis=nis,
        events=tuple(
            Event("start", one.begin, 0.0, one.after)
            if jump is None
            else Event(_JUMPS[quantities[jump.of].kind], one.begin, jump.size, one.after)
            for one, jump in zip(settlings, [None, *jumps], strict=True)
        ),
        windows=windows,
        settled_time=sum(end - begin for begin, end in windows),
        duration=whole.last - whole.first,
        estimates=whole.estimates,
        measurements=whole.measurements,
    )


class _Whole:
    """What must be known of a whole run before it is measured."""

    def __init__(self, quantities: int) -> None:
        self.first, self.last = math.inf, -math.inf
        self.last_measured = -math.inf
        self.estimates, self.measurements, self.has_truth = 0, 0, False
        self._steps: list[Array] = []
        self._limits = np.full(quantities, np.inf)
        self._known = np.zeros(quantities, np.bool_)

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
        """Return the jumps of the true disturbances during the estimates."""
        found, before = [], -math.inf
        steps = np.concatenate(self._steps) if self._steps else np.zeros((0, 3))
        for time, size, quantity in steps[np.argsort(steps[:, 0], kind="stable")].tolist():
            # A fault that chatters is one event, which begins with its first jump.
            if self.first < time <= self.last and time - before > SAME_JUMP:
                found.append(Jump(time, size, int(quantity)))
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


def _normalised(rmse: list[float | None], scale: tuple[float, ...]) -> float | None:
    relative = [e / s for e, s in zip(rmse, scale, strict=True) if e is not None]
    if len(relative) < len(scale):
        return None
    return _bounded(math.sqrt(sum(r * r for r in relative) / len(scale)))


def _mean(values: Sequence[float | None], counts: Sequence[int]) -> float | None:
    """Return the mean of values that are means of so many, None without any."""
    known = [(value, n) for value, n in zip(values, counts, strict=False) if value is not None]
    if len(known) <= 1:
        return known[0][0] if known else None
    return _bounded(sum(value * n for value, n in known) / sum(n for _, n in known))


def _bounded(value: float) -> float:
    """Return a number that JSON can hold: a diverged estimate is squared past the largest one."""
    return min(value, sys.float_info.max)


def _large_steps(run: RecordedRun, threshold: float) -> Array:
    """Return time [s], size and quantity of steps of the truth above thresholds, shape (s, 3)."""
    found = [np.zeros((0, 3))]
    for place, quantity in enumerate(run.quantities):
        limit = threshold if quantity.jump is None else quantity.jump
        truth = run.of(quantity).truth if limit < math.inf else None
        if truth is None:
            continue
        steps = np.diff(truth.values[:, 0])
        large = (np.abs(steps) > limit) & run.covers(truth.stamps[1:])
        times = truth.seconds(run.origin)[1:][large]
        found.append(np.column_stack([times, steps[large], np.full(len(times), float(place))]))
    return np.concatenate(found)


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
