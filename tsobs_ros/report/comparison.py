# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers over the same measurements, side by side, as numbers and as text for terminals.

The reference is an EKF with the disturbance model, noise and start of the design, and with a gate
(`estimation.baselines`). Where ours learns parameters there are two, as only the truth shows which
one is the better rival: one keeps the nominal parameters, the other has them as states.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.joint_series import JointSeries
from tsobs_ros.design.file import ArmDesignFile
from tsobs_ros.design.record import Design
from tsobs_ros.errors import BagReadError, printable
from tsobs_ros.estimation.baselines import GATE
from tsobs_ros.methods import EKFS, ObserverSettings
from tsobs_ros.replay.estimate import Observer, Run, make_runs, run_all
from tsobs_ros.replay.source import BagSource, Source, Truth, passes
from tsobs_ros.replay.table import EstimateTable
from tsobs_ros.report.metrics import (
    QUANTITIES,
    SIGMAS,
    MetricsOptions,
    RunMetrics,
    measure,
    root_mean_square,
)
from tsobs_ros.report.run import RecordedRun, Series, Stamps

DIVERGED = 1e6
"""No joint's error is so large [rad, rad/s]; the number is not worth a column of digits."""

THETAS = tuple(np.geomspace(0.7, 20.0, 12).tolist())
"""θ to choose the best from for observers of high gain [rad/s]."""

HIGH_GAIN = ("high_gain", "proportional_integral")
MAX_TUNED = 50_000
"""Measurements of a recording in which the best θ is looked for, which takes two dozen runs."""

_NOTHING = "–"
_EKFS = {
    "ekf": "the nominal parameters",
    "ekf_augmented": "the uncertain parameters as states",
}


@dataclass(frozen=True)
class EkfComparison:
    """Errors of a run's observer next to an EKF's on the same data and windows.

    Attributes:
        observer: Metrics of the recorded estimates.
        ekf: Metrics of the EKF.
        method: Its name, one of `methods.EKFS`.
        rivals: How many there were to choose the best from.
    """

    observer: RunMetrics
    ekf: RunMetrics
    method: str = EKFS[0]
    rivals: int = 1

    @property
    def ratios(self) -> dict[str, float | None]:
        """RMSE of the observer over that of the EKF, by quantity; None without truth."""
        pairs = zip(self.observer.quantities, self.ekf.quantities, strict=True)
        return {ours.key: _ratio(ours.rmse, theirs.rmse) for ours, theirs in pairs}

    @property
    def normalised_ratio(self) -> float | None:
        """Normalised RMSE of the observer over that of the EKF; None without truth."""
        return _ratio(self.observer.normalised_rmse, self.ekf.normalised_rmse)

    def as_mapping(self) -> dict[str, Any]:
        """Return the EKF's errors and the ratios as plain data."""
        return {
            "method": self.method,
            "rmse": {one.key: one.rmse for one in self.ekf.quantities},
            "normalised_rmse": self.ekf.normalised_rmse,
            "ratio": self.ratios,
            "normalised_ratio": self.normalised_ratio,
        }


@dataclass(frozen=True)
class ObserverErrors:
    """Errors of one observer at one joint.

    Attributes:
        observer: Its name.
        joint: The joint's name.
        innovation_rms: Of all innovations [rad]; None without any.
        metrics: Errors against the truth if it is known, and the innovations' consistency;
            None without estimates.
    """

    observer: str
    joint: str
    innovation_rms: float | None
    metrics: RunMetrics | None

    @property
    def normalised_rmse(self) -> float:
        """Normalised RMSE of the states, infinite if it is not known."""
        known = None if self.metrics is None else self.metrics.normalised_rmse
        return math.inf if known is None else known

    def as_mapping(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold."""
        return {
            "observer": self.observer,
            "joint": self.joint,
            "innovation_rms": self.innovation_rms,
            **({} if self.metrics is None else self.metrics.as_mapping()),
        }


def expected_innovation(design: Design) -> float:
    """Return the 1σ of an innovation that a design's certificate expects [rad]."""
    C = design.request.flow.output_matrix
    covariance = C @ design.covariance_bound @ C.T + design.request.measurement_covariance
    return float(np.sqrt(covariance[0, 0]))


def compare_with_ekf(
    run: RecordedRun,
    bag: Path,
    files: Mapping[str, ArmDesignFile],
    settings: ObserverSettings,
    options: MetricsOptions | None = None,
) -> EkfComparison:
    """Run EKFs over the measurements of a recorded run, as `tsobs compare` does.

    If ours learns parameters, there are two: one with the nominal parameters, and one that has
    those as states. The comparison is with the better one.

    Args:
        run: The recorded run.
        bag: The bag that it is from.
        files: Design file of each joint that the observer observed.
        settings: Those that it ran with.
        options: Options of the measures.
    """
    source = BagSource(bag, topic=run.topic, joints=tuple(files))
    learns = settings.learnt(files[run.joint].design)
    observers = [
        Observer(method, replace(settings, method=method), tuple(files.values()))
        for method in (EKFS if learns else EKFS[:1])
    ]
    runs = make_runs(source, observers, rate=None, as_live=True)
    run_all(source, runs, None)
    own = [one for one in compare_runs(source, runs, options) if one.joint == run.joint]
    best = min(own, key=lambda one: one.normalised_rmse)
    if best.metrics is None:
        raise BagReadError(f"{bag}: no EKF could be run over the measurements of {run.joint}")
    return EkfComparison(measure(run, options), best.metrics, best.observer, len(own))


def tune(source: Source, observers: Sequence[Observer]) -> tuple[list[Observer], list[str]]:
    """Return the observers, those of high gain with the best θ of `THETAS`, and remarks on them.

    The best one has the smallest error of the states over the settled parts. Without a truth, or
    in a recording of more than `MAX_TUNED` measurements, θ is left as it is.
    """
    tuned, remarks = [], []
    for one in observers:
        if one.settings.method not in HIGH_GAIN:
            tuned.append(one)
            continue
        choices = [
            replace(one, name=f"{theta:.2f}", settings=replace(one.settings, theta=theta))
            for theta in (THETAS if source.count <= MAX_TUNED else ())
        ]
        errors = dict.fromkeys((choice.name for choice in choices), 0.0)
        if choices:
            runs = make_runs(source, choices, rate=None, as_live=True)
            run_all(source, runs, None)
            for row in compare_runs(source, runs):
                errors[row.observer] += row.normalised_rmse
        best = min(choices, key=lambda choice: errors[choice.name], default=one)
        if errors and errors[best.name] < math.inf:
            tuned.append(replace(best, name=one.name))
            remarks.append(f"{one.name}: θ = {best.name} rad/s, the best of {len(choices)}")
        else:
            tuned.append(one)
            remarks.append(f"{one.name}: θ = {one.settings.theta:g} rad/s, not tuned to this arm")
    return tuned, remarks


def compare_runs(
    source: Source, runs: Sequence[Run], options: MetricsOptions | None = None
) -> list[ObserverErrors]:
    """Measure finished runs over the same measurements; if time restarted, the longest pass."""
    truth, options = source.truth(), options or MetricsOptions()
    errors = []
    for joint, name in enumerate(source.joints):
        for run in runs:
            recorded = _recorded_run(source, run, joint, truth)
            metrics = None
            if recorded is not None:
                std = expected_innovation(run.observer.designs[joint])
                metrics = measure(recorded, replace(options, innovation_std=std))
            innovation = root_mean_square(run.table.innovations[:, joint])
            errors.append(ObserverErrors(run.observer.name, name, innovation, metrics))
    return errors


def _recorded_run(source: Source, run: Run, joint: int, truth: Truth) -> RecordedRun | None:
    """Return a joint's part of a run as if it had been recorded; None without estimates."""
    ticks = np.flatnonzero(np.isfinite(run.table.states[:, joint, 0]))
    if not len(ticks):
        return None
    spans = passes(run.schedule.stamps[ticks].tolist())
    begin, end = max(spans, key=lambda span: span[1] - span[0])
    ticks = ticks[begin:end]
    samples = run.samples
    there = samples.complete[:, joint]
    measured = np.column_stack([samples.y[there, joint], samples.u[there, joint]])
    return RecordedRun(
        name=run.observer.name,
        joint=source.joints[joint],
        measurements=Series(samples.stamps[there], measured),
        stamps=run.schedule.stamps[ticks],
        truth=_series(truth.states, 2 * joint, 2),
        true_disturbance=_series(truth.disturbance, joint, 1),
        passes=len(spans),
        **_estimates_of(run.table, samples.stamps, joint, ticks),
    )


def _estimates_of(
    table: EstimateTable,
    stamps: Stamps,
    joint: int = 0,
    ticks: slice | NDArray[np.intp] = slice(None),
) -> dict[str, Any]:
    """Return the estimates of a joint at some ticks as the fields of a `RecordedRun`.

    Args:
        table: The estimates.
        stamps: Of the measurements [ns].
        joint: Index of the joint.
        ticks: Some of the ticks.
    """
    used = ~np.isnan(table.innovations[:, joint])
    return {
        "states": table.states[ticks, joint],
        "state_bounds": table.state_bounds[ticks, joint],
        "disturbance": table.disturbances[ticks, joint, 0],
        "disturbance_bounds": table.disturbance_bounds[ticks, joint, 0],
        "innovations": Series(stamps[used], table.innovations[used, joint, np.newaxis]).ordered(),
    }


def _series(series: JointSeries | None, begin: int, names: int) -> Series | None:
    """Return some neighbouring names of a topic, None if no message has them."""
    if series is None:
        return None
    chosen = slice(begin, begin + names)
    there = series.named[:, chosen].all(axis=1)
    if not there.any():
        return None
    values = series.values[there, chosen]
    return Series(series.stamps[there], values.reshape(len(values), -1)).ordered()


def _ratio(ours: float | None, theirs: float | None) -> float | None:
    return None if ours is None or not theirs else ours / theirs


def render_comparison(rows: Sequence[ObserverErrors]) -> str:
    """Return a table for each joint: errors if the truth is known, and the innovations."""
    parts = []
    joints = list(dict.fromkeys(row.joint for row in rows))
    for joint in joints:
        own = [row for row in rows if row.joint == joint]
        title = [printable(joint)] if len(joints) > 1 else []
        ekfs = [row.observer for row in own if row.observer in _EKFS]
        notes = [_note(own), *([about_ekfs(ekfs)] if ekfs else [])]
        parts.append("\n".join([*title, *_aligned(_cells(own)), "", *notes]))
    return "\n\n".join(parts)


def about_ekfs(methods: Sequence[str], *, better: bool = False) -> str:
    """Return the line on what EKFs have in common with ours, and in what they differ."""
    known = ", ".join(f"{name} has {_EKFS[name]}" for name in methods)
    better_one = ", the better one of ekf and ekf_augmented" if better else ""
    return (
        f"EKF: same disturbance model, noise and data as ours, gated at {GATE:g}σ; "
        f"{known}{better_one}"
    )


def _cells(rows: Sequence[ObserverErrors]) -> list[list[str]]:
    cells = [["RMSE", "unit", *(row.observer for row in rows)]]

    def add(name: str, unit: str, value: Callable[[RunMetrics], float | None]) -> None:
        measured = [None if row.metrics is None else value(row.metrics) for row in rows]
        cells.append([name, unit, *map(_number, measured)])

    def rmse(metrics: RunMetrics, key: str) -> float | None:
        return metrics[key].rmse

    if any(row.metrics is not None and row.metrics.has_truth for row in rows):
        for key, name, unit in QUANTITIES:
            add(name, unit, partial(rmse, key=key))
        add("all states, normalised", "", lambda metrics: metrics.normalised_rmse)
    cells.append(["innovation", "rad", *(_number(row.innovation_rms) for row in rows)])
    add("innovation² / expected", "", lambda metrics: metrics.nis)
    return cells


def _note(rows: Sequence[ObserverErrors]) -> str:
    first = next((row.metrics for row in rows if row.metrics is not None), None)
    if first is None:
        return "no estimates"
    if not first.windows:
        return "the recording is too short to have a settled part, so there are no errors"
    if not first.has_truth:
        return "the recording has no ground truth, so there are innovations but no errors"
    return f"errors over the {first.settled_time:.1f} s that count as settled"


def render_metrics(metrics: RunMetrics, comparison: EkfComparison | None = None) -> str:
    """Return the metrics as a table with a line on the run above and on its events below.

    Args:
        metrics: Of the recorded estimates.
        comparison: With an EKF on the same data; adds two columns.
    """
    rows = [["", "unit", "RMSE", "bound (1σ)", "RMSE/bound", f"inside {SIGMAS:g}σ"]]
    for quantity in QUANTITIES:
        one = metrics[quantity.key]
        inside = _NOTHING if one.inside is None else f"{100.0 * one.inside:.1f} %"
        numbers = [_number(one.rmse), _number(one.bound), _quotient(one.ratio), inside]
        rows.append([quantity.name, quantity.unit, *numbers])
    rows.append(["all states, normalised", "", _number(metrics.normalised_rmse), "", "", ""])
    below = _events(metrics)
    if comparison is not None:
        errors = [one.rmse for one in comparison.ekf.quantities]
        errors.append(comparison.ekf.normalised_rmse)
        ratios = [*comparison.ratios.values(), comparison.normalised_ratio]
        rows[0] += ["EKF RMSE", "RMSE/EKF"]
        for row, error, ratio in zip(rows[1:], errors, ratios, strict=True):
            row += [_number(error), _quotient(ratio)]
        below.append(about_ekfs([comparison.method], better=comparison.rivals > 1))
    above = (
        f"{metrics.measurements} measurements, {metrics.estimates} estimates in "
        f"{metrics.duration:.1f} s; errors over the {metrics.settled_time:.1f} s that count as "
        "settled"
    )
    return "\n".join([above, "", *_aligned(rows), "", *below])


def _events(metrics: RunMetrics) -> list[str]:
    lines = []
    for event in metrics.events if metrics.has_truth else ():
        if event.settled_after is not None:
            settled = f"errors settled after {event.settled_after:.2f} s"
        else:
            settled = "settling not seen"
        what = "start" if event.what == "start" else f"jump of {event.size:+.3g} rad"
        lines.append(f"{what} at {event.time:.2f} s: {settled}")
    if metrics.nis is not None:
        lines.append(f"innovations: mean square {metrics.nis:.3g} × what the design expects")
    return lines


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table: a head with a rule below it, two columns of text, numbers."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row[:2], widths[:2], strict=True)]
        cells += [cell.rjust(width) for cell, width in zip(row[2:], widths[2:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return [lines[0], "─" * max(map(len, lines)), *lines[1:]]


def _number(value: float | None) -> str:
    if value is None:
        return _NOTHING
    return "diverged" if value > DIVERGED else f"{value:#.3g}"


def _quotient(value: float | None) -> str:
    return _NOTHING if value is None else f"{value:.2f}"
