# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A sensor that is kept from all observers, and the errors of estimates against it."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.checks import Array, positive
from tsobs_ros.errors import BagReadError, LogError
from tsobs_ros.replay.health import CLAIMED
from tsobs_ros.replay.source import BagSource
from tsobs_ros.report.metrics import QuantityMetrics, Windows, inside_windows, quantity_metrics
from tsobs_ros.report.quantities import Quantity, quantities_of
from tsobs_ros.report.run import RecordedRun, align, interpolate, read_series
from tsobs_ros.series import Series, Stamps

_MIN_READINGS, _MAX_READINGS = 20, 50_000
_NEIGHBOURS, _ROUNDED = 7, 1e-9


def read_held_out(source: BagSource, std: float | None = None) -> "list[HeldOutSensor]":
    """Return the held-out sensor of each joint of a source whose designs are known.

    The 1σ of its noise (rad, rad/s) is `std`, or estimated from its high frequencies. The list is
    empty if nothing is held out.

    Raises:
        ModelError: The noise is not above 0.
        BagReadError: The bag does not have the sensor.
        LogError: There are too few readings.
    """
    name, _, place = (source.held_out or "").partition("=")
    if not name:
        return []
    (side, _, kind), columns = name.partition("_"), source.held_out_columns
    topic, _, entry = place.partition(":") if place[:1] in ("/", ":") else ("", "", place)
    topic, entry = ("", "") if columns else (topic, entry)
    topic, field = topic or source.topic, "position" if kind == "angle" else "velocity"
    asked = {}
    for number, (joint, own) in enumerate(zip(source.joints, source.signals, strict=True)):
        names = [entry or topics.sides(joint)[side == "motor"]]
        # In measurements, the joint's name stands for the side that the observer assumes.
        outputs = source.requests[number].output_names
        link = joint in source.with_motors or any("link" in output for output in outputs)
        if not entry and (topic != source.topic or link == (side == "link")):
            names.insert(0, joint)
        groups = [[(each, field)] for each in names]
        where = f"{field} of {' or '.join(names)} on {topic}"
        if columns:
            where = f"column {columns[number]!r}"
        elif topic == source.topic and groups[0][0] in own.outputs:
            raise BagReadError(f"{source.path}: {where} is what the observer measures")
        asked[where] = topic, groups
    (quantity,) = (one for one in quantities_of(source.requests[0]) if one.key == name)
    given = None if std is None else positive("held_out_std", std)
    sensors = []
    for where, readings in read_series(source, asked).items():
        some = readings.take(slice(_MAX_READINGS))
        some = some.take(np.isfinite(some.values[:, 0]))
        _require_enough(len(some.stamps), quantity, where)
        noise = given or _noise_std(some.stamps, some.values[:, 0])
        sensors.append(HeldOutSensor(quantity, where, noise, given is None, readings))
    return sensors


class HeldOutSensor(NamedTuple):
    """A joint's held-out sensor: its column or entry, 1σ of its noise, its readings."""

    quantity: Quantity
    source: str
    std: float
    std_is_estimated: bool
    readings: Series

    @property
    def note(self) -> str:
        """The line on the sensor and on the meaning of the errors."""
        origin = "estimated from its high frequencies" if self.std_is_estimated else "as given"
        return (
            f"held out: {self.quantity.name}, {self.source}; its noise of {self.std:.3g} "
            f"{self.quantity.unit} ({origin}) is part of the errors and added to the bounds; the "
            "bias is the mean of estimate − sensor, as of encoders with different zeros"
        )

    def errors(self, run: RecordedRun, windows: Windows) -> "HeldOutErrors | None":
        """Return the errors of a run; None without health, readings or finite estimates.

        Estimates are interpolated to the stamps of the readings, not across gaps.

        Raises:
            LogError: There are too few readings between settled estimates.
        """
        one = run.of(self.quantity)
        health, readings = run.part("health"), run.part("held_out")
        if not (len(health.stamps) and len(readings.stamps) and np.isfinite(one.values).any()):
            return None
        settled = inside_windows(readings.seconds(run.origin), windows)
        readings = readings.take(settled & np.isfinite(readings.values[:, 0]))
        found = interpolate(Series(run.stamps, one.values[:, np.newaxis]), readings.stamps)
        error = (found - readings.values)[:, 0]
        known = np.isfinite(error)
        where = f"{self.source}, between settled estimates"
        _require_enough(int(known.sum()), self.quantity, where)
        claims = align(health, run.stamps)[:, CLAIMED]
        bounds = Series(run.stamps, np.column_stack([one.bounds, claims]))
        error, (bound, claimed) = error[known], interpolate(bounds, readings.stamps)[known].T
        limit = np.where(claimed == 1.0, np.hypot(bound, self.std), np.nan)
        bias = float(error.mean())
        return HeldOutErrors(
            self,
            len(error),
            float(np.isfinite(limit).mean()),
            bias,
            float(np.median(np.abs(error))),
            float(np.abs(error).max()),
            quantity_metrics(self.quantity, error, limit),
            quantity_metrics(self.quantity, error - bias, limit),
        )


class HeldOutErrors(NamedTuple):
    """Errors of estimates against a held-out sensor over the settled parts, its noise included.

    Attributes:
        samples: Number of the sensor's readings between estimates.
        claimed: Share of these readings for which a bound is claimed.
        bias: Mean of estimate − sensor.
        median: Median of the errors without their signs, which the sensor's outliers do not move.
        largest: Largest error, without its sign.
        with_bias: Sizes of the errors; the square of the noise is added to that of a claimed bound.
        without_bias: Sizes of the errors without their mean.
    """

    sensor: HeldOutSensor
    samples: int
    claimed: float
    bias: float
    median: float
    largest: float
    with_bias: QuantityMetrics
    without_bias: QuantityMetrics

    def as_mapping(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold."""
        sensor = {key: getattr(self.sensor, key) for key in ("source", "std", "std_is_estimated")}
        sizes = {key: getattr(self, key).as_mapping() for key in ("with_bias", "without_bias")}
        quantity = {"quantity": self.sensor.quantity.key, "unit": self.sensor.quantity.unit}
        return {**self._asdict(), **sizes, "sensor": quantity | sensor}


def _require_enough(count: int, quantity: Quantity, where: str) -> None:
    if count < _MIN_READINGS:
        raise LogError(
            f"held-out {quantity.key}: expected at least {_MIN_READINGS} readings in {where}, got "
            f"{count}"
        )


def _noise_std(stamps: Stamps, values: Array) -> float:
    """Return the 1σ of noise: the misfit of polynomials to neighbours, or rounding if larger."""
    steps = np.abs(np.diff(values))
    rounding = float(steps[steps > _ROUNDED].min(initial=np.inf)) / math.sqrt(12.0)
    rounding = rounding if math.isfinite(rounding) else 0.0
    stamps, places = np.unique(stamps, return_index=True)
    if len(stamps) < _NEIGHBOURS:
        return rounding
    times = sliding_window_view((stamps - stamps[0]) / np.median(np.diff(stamps)), _NEIGHBOURS)
    # Weights of the highest divided difference.
    apart = times[:, :, np.newaxis] - times[:, np.newaxis, :] + np.eye(_NEIGHBOURS)
    weights = 1.0 / apart.prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    rest = np.sum(weights * sliding_window_view(values[places], _NEIGHBOURS), axis=1)
    # The median ignores outliers; it is 0.6745 σ for a normal distribution.
    return max(float(np.median(np.abs(rest))) / 0.6745, rounding)
