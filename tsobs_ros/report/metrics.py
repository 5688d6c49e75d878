# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of a run's estimates, and the validity of their published bounds.

Errors are judged over the *settled* parts of a run: without some seconds after the start and after
each jump of a sensor's true disturbance, as no estimator can know the new value at once.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array, Flags
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import TSRequest
from tsobs_ros.report.quantities import Quantity
from tsobs_ros.report.run import RecordedRun

SIGMAS = 3.0
"""An error counts as inside its bound up to this multiple of the bound's 1σ."""

SETTLE_TIME = 5.0
"""Time that does not count after the first estimate and each jump of a true disturbance [s]."""

SCALE: tuple[float, ...] = (0.226, 0.60, 0.355, 0.464)
"""Root mean square of the default arm's motion (rad, rad/s), by which its errors are normalised."""

# A fault that chatters is one event: jumps this soon after the previous one do not count [s].
_SAME_JUMP = 0.1


class QuantityMetrics(NamedTuple):
    """One estimated quantity over the settled parts; None if the data for it are missing.

    Attributes:
        rmse: Root mean square error, in the quantity's unit.
        bound: Root mean square of the published 1σ bound.
        ratio: rmse / bound; at most 1, except by chance, if the certificate's model is right.
        inside: Fraction of samples with an error inside `SIGMAS` times the bound.
    """

    quantity: Quantity
    rmse: float | None
    bound: float | None
    ratio: float | None
    inside: float | None

    def as_mapping(self) -> dict[str, float | None]:
        """Return the numbers as plain data that JSON can hold."""
        return dict(zip(self._fields[1:], self[1:], strict=True))


Windows = tuple[tuple[float, float], ...]
"""Parts of a run as (begin, end) in seconds since its origin."""


class Jump(NamedTuple):
    """A jump of a true disturbance: seconds since the run's origin, and its size."""

    time: float
    size: float


@dataclass(frozen=True)
class RunMetrics:
    """The metrics of a run.

    Attributes:
        quantities: The metrics of each of the run's quantities, in that order.
        normalised_rmse: Root mean square over the states of RMSE / scale; None without truth.
        nis: Mean normalised innovation squared over the settled parts, 1 if the innovations are
            as large as the design expects; None if that is not known.
        output_nis: The same for each output.
        jumps: Jumps of the true disturbances, in order.
        windows: Settled parts as (begin, end) in seconds since the run's origin.
        settled_time: Their total length [s].
        first: Time of the first estimate since the run's origin [s].
        duration: Time from the first to the last estimate [s].
    """

    quantities: tuple[QuantityMetrics, ...]
    normalised_rmse: float | None
    nis: float | None
    output_nis: tuple[float | None, ...]
    jumps: tuple[Jump, ...]
    windows: Windows
    settled_time: float
    first: float
    duration: float
    estimates: int
    measurements: int

    @property
    def has_truth(self) -> bool:
        """Whether the error of any quantity is known."""
        return any(one.rmse is not None for one in self.quantities)

    @property
    def unsettled(self) -> str:
        """The reason why no part is settled, if none is."""
        if self.duration <= SETTLE_TIME or not self.jumps:
            return f"too short: no part lies {SETTLE_TIME:g} s after the first estimate"
        return f"never settled: the true disturbance jumps {len(self.jumps)} times"

    @property
    def last(self) -> float:
        """Time of the last estimate since the run's origin [s]."""
        return self.first + self.duration

    def __getitem__(self, key: str) -> QuantityMetrics:
        """Return the metrics of one quantity, else raise `KeyError`."""
        return {one.quantity.key: one for one in self.quantities}[key]

    def as_mapping(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold."""
        data = {
            **vars(self),
            "quantities": {one.quantity.key: one.as_mapping() for one in self.quantities},
            "jumps": [one._asdict() for one in self.jumps],
        }
        if len(self.output_nis) <= 1:
            del data["output_nis"]
        return data


def innovation_std(design: Design) -> tuple[float, ...]:
    """Return the 1σ of each output's innovation that a design's certificate expects."""
    request = design.request
    C = request.flow.output_matrix
    covariance = C @ design.covariance_bound @ C.T + request.measurement_covariance
    return tuple(np.sqrt(covariance.diagonal()).tolist())


def measure(
    run: RecordedRun, innovation_std: Sequence[float] = (), settle_time: float = SETTLE_TIME
) -> RunMetrics:
    """Measure a run; without truth only its bounds and innovations are measured.

    `innovation_std` is the 1σ that the design expects of each output's innovation, empty if
    unknown; a `settle_time` [s] after the first estimate and after each jump does not count.
    """
    times, scale = run.times, SCALE
    if isinstance(run.request, TSRequest):  # sizes of the states before any measurement
        scale = tuple(np.asarray(run.request.initial_std).tolist())
    measured = run.part("measurements").seconds(run.origin)
    jumps, first, last = _jumps(run), float(times[0]), float(times[-1])
    # Predictions after the last measurement, of an observer left running, do not count.
    end = min(last, float(measured.max(initial=-math.inf)))
    # A jump during the start does not end the start, hence the running maximum.
    edges = [one.time for one in jumps]
    begins = np.maximum.accumulate([first, *edges]) + settle_time
    windows = tuple((a, b) for a, b in zip(begins.tolist(), [*edges, end], strict=True) if a < b)
    settled = inside_windows(times, windows)
    quantities = []
    for quantity in run.quantities:
        one = run.of(quantity)
        quantities.append(quantity_metrics(quantity, one.error[settled], one.bounds[settled]))
    nis, output_nis = _innovations(run, windows, innovation_std)
    normalised, rmse = None, [one.rmse for one in quantities[: len(scale)]]
    if None not in rmse:
        shares = [(error or 0.0) / size for error, size in zip(rmse, scale, strict=True)]
        normalised = _bounded(math.sqrt(sum(one * one for one in shares) / len(shares)))
    return RunMetrics(
        quantities=tuple(quantities),
        normalised_rmse=normalised,
        nis=nis,
        output_nis=output_nis,
        jumps=tuple(jumps),
        windows=windows,
        settled_time=sum(end - begin for begin, end in windows),
        first=first,
        duration=last - first,
        estimates=len(times),
        measurements=len(measured),
    )


def root_mean(values: Array) -> float | None:
    """Return the root mean square of the finite values; None without any."""
    finite = values[np.isfinite(values)]
    with np.errstate(over="ignore"):
        return _bounded(math.sqrt(np.mean(np.square(finite)))) if len(finite) else None


def quantity_metrics(quantity: Quantity, error: Array, bound: Array) -> QuantityMetrics:
    """Return the metrics of a quantity's errors and 1σ bounds, NaN if unknown, shape (n,)."""
    rmse = root_mean(error)
    if rmse is None:
        return QuantityMetrics(quantity, None, root_mean(bound), None, None)
    known = np.isfinite(error) & np.isfinite(bound)
    size = root_mean(bound[known])
    inside = float(np.mean(np.abs(error[known]) <= SIGMAS * bound[known])) if known.any() else None
    return QuantityMetrics(quantity, rmse, size, _bounded(rmse / size) if size else None, inside)


def _innovations(
    run: RecordedRun, windows: Windows, stds: Sequence[float]
) -> tuple[float | None, tuple[float | None, ...]]:
    """Return the mean square of all innovations over the expected one, and that of each output."""
    innovation = run.part("innovation")
    if not (len(innovation.stamps) and stds):
        return None, ()
    settled = innovation.take(inside_windows(innovation.seconds(run.origin), windows))
    scaled = settled.values / np.array(stds)
    sizes = [root_mean(one) for one in (scaled, *scaled.T)]
    nis, *of_outputs = (None if size is None else _bounded(size * size) for size in sizes)
    return nis, tuple(of_outputs)


def _bounded(value: float) -> float:
    """Return a number that JSON can hold: the square of a diverged estimate may overflow."""
    return min(value, sys.float_info.max)


def _jumps(run: RecordedRun) -> list[Jump]:
    """Return the jumps of the true disturbances during the estimates."""
    found: list[Jump] = []
    for quantity in run.quantities:
        truth = run.of(quantity).truth if quantity.jump < math.inf else None
        if truth is None:
            continue
        steps, times = np.diff(truth.values[:, 0]), truth.seconds(run.origin)[1:]
        large = np.abs(steps) > quantity.jump
        each = zip(times[large].tolist(), steps[large].tolist(), strict=True)
        found += [Jump(time, size) for time, size in each]
    found.sort(key=lambda jump: jump.time)
    before = [-math.inf, *(one.time for one in found)]
    return [
        jump
        for jump, last in zip(found, before, strict=False)
        if run.times[0] < jump.time <= run.times[-1] and jump.time - last > _SAME_JUMP
    ]


def inside_windows(times: Array, windows: Windows) -> Flags:
    """Return which times [s] lie in one of the windows, begin <= time < end, shape (n,)."""
    # The windows neither overlap nor touch.
    return np.asarray(np.searchsorted(np.ravel(windows), times, side="right") % 2 == 1)
