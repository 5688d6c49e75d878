# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How good the estimates of a run are, and whether their certified bounds hold.

Errors are judged over the *settled* parts of a run: what remains without some seconds after the
start and after each jump of the true disturbance, which no estimator can know at once.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array, as_matrix, non_negative, positive
from tsobs_ros.report.run import RecordedRun
from tsobs_ros.report.settling import (
    Event,
    Windows,
    find_jumps,
    inside_windows,
    settle_events,
    settled_windows,
)

SIGMAS = 3.0
"""Errors count as inside their bound up to this many of its 1σ."""


class Quantity(NamedTuple):
    """What is estimated: a key for programs, a name for people, a unit."""

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
    """How a run is measured.

    Attributes:
        start_settle_time: Time after the first estimate that does not count [s].
        jump_settle_time: Time after a jump of the true disturbance that does not count [s].
        jump_threshold: Change of the true disturbance from one sample to the next that is a jump
            [rad]; about 1σ of the sensor's noise, and several times what a fault of 0.4 rad at
            3 rad/s moves in a sample at 200 Hz.
        hold_time: Errors have settled when they stay inside their bound for so long [s].
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
        for name in ("start_settle_time", "jump_settle_time", "hold_time"):
            non_negative(name, getattr(self, name))
        positive("jump_threshold", self.jump_threshold)
        for value in as_matrix("scale", self.scale, (4,)):
            positive("scale", float(value))
        if self.innovation_std is not None:
            positive("innovation_std", self.innovation_std)


@dataclass(frozen=True)
class QuantityMetrics:
    """One estimated quantity over the settled parts; None where there is nothing to tell it from.

    Attributes:
        key: As in `QUANTITIES`.
        rmse: Root mean square error, in the quantity's unit.
        bound: Root mean square of the published 1σ bound.
        ratio: rmse / bound; at most 1, up to chance, where the certificate's model is true.
        inside: Fraction of samples with an error inside `SIGMAS` times the bound.
    """

    key: str
    rmse: float | None
    bound: float | None
    ratio: float | None
    inside: float | None


@dataclass(frozen=True)
class RunMetrics:
    """The measured run.

    Attributes:
        quantities: One for each of `QUANTITIES`, in that order.
        normalised_rmse: Root mean square over the four states of RMSE / scale; None without truth.
        nis: Mean normalised innovation squared over the settled parts, 1 where the innovations
            are as large as the design expects; None if that is not known.
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

    def __getitem__(self, key: str) -> QuantityMetrics:
        """Return the metrics of one quantity.

        Raises:
            KeyError: There is no such quantity.
        """
        for quantity in self.quantities:
            if quantity.key == key:
                return quantity
        raise KeyError(key)

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
        options: How; the defaults if None.
    """
    options = options or MetricsOptions()
    jumps = find_jumps(run, options.jump_threshold)
    windows = settled_windows(run, jumps, options.start_settle_time, options.jump_settle_time)
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
        events=settle_events(run.times, jumps, error, SIGMAS * bounds, options.hold_time),
        windows=windows,
        settled_time=sum(end - begin for begin, end in windows),
        duration=float(run.times[-1] - run.times[0]),
        estimates=len(run.stamps),
        measurements=len(run.measurements.stamps),
    )


def errors(run: RecordedRun) -> Array | None:
    """Return estimate − truth of all `QUANTITIES`, NaN where unknown, shape (m, 5).

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
    ratio = rmse / size if rmse is not None and size else None
    return QuantityMetrics(key, rmse, size, ratio, inside)


def root_mean_square(values: Array) -> float | None:
    """Return the root mean square of the finite values, None if there is none."""
    finite = values[np.isfinite(values)]
    return math.sqrt(float(np.mean(finite**2))) if len(finite) else None


def _normalised(rmse: list[float | None], scale: tuple[float, ...]) -> float | None:
    relative = [e / s for e, s in zip(rmse, scale, strict=True) if e is not None]
    return math.sqrt(sum(r * r for r in relative) / 4.0) if len(relative) == 4 else None


def _nis(run: RecordedRun, windows: Windows, std: float | None) -> float | None:
    if std is None or run.innovations is None or not len(run.innovations.stamps):
        return None
    settled = inside_windows(run.innovations.seconds(run.origin), windows)
    size = root_mean_square(run.innovations.values[settled, 0])
    return None if size is None else (size / std) ** 2
