# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers that were run over the same measurements, side by side in a table."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from tsobs_ros.bag.messages.joint_series import JointSeries
from tsobs_ros.replay.estimate import Run
from tsobs_ros.replay.source import Source, Truth, passes
from tsobs_ros.report.bag_report import expected_innovation
from tsobs_ros.report.metrics import QUANTITIES, MetricsOptions, RunMetrics, measure
from tsobs_ros.report.metrics import root_mean_square as rms
from tsobs_ros.report.reference import estimates_of
from tsobs_ros.report.run import RecordedRun
from tsobs_ros.report.series import Series
from tsobs_ros.report.table import aligned, number


@dataclass(frozen=True)
class ObserverErrors:
    """How good one observer was at one joint.

    Attributes:
        observer: Its name.
        joint: The joint's name.
        innovation_rms: Of all innovations [rad]; None without any.
        metrics: Errors against the truth where it is known, and the innovations' consistency;
            None without estimates.
    """

    observer: str
    joint: str
    innovation_rms: float | None
    metrics: RunMetrics | None

    def as_mapping(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold."""
        return {
            "observer": self.observer,
            "joint": self.joint,
            "innovation_rms": self.innovation_rms,
            **({} if self.metrics is None else self.metrics.as_mapping()),
        }


def compare_runs(
    source: Source, runs: Sequence[Run], options: MetricsOptions | None = None
) -> list[ObserverErrors]:
    """Measure finished runs over the same measurements.

    Where time restarted, the longest pass is measured.
    """
    truth = source.truth()
    return [
        _errors(source, run, joint, truth, options or MetricsOptions())
        for joint in range(len(source.joints))
        for run in runs
    ]


def render_comparison(rows: Sequence[ObserverErrors]) -> str:
    """Return a table for each joint: errors where the truth is known, and the innovations."""
    parts = []
    joints = list(dict.fromkeys(row.joint for row in rows))
    for joint in joints:
        own = [row for row in rows if row.joint == joint]
        title = [joint] if len(joints) > 1 else []
        parts.append("\n".join([*title, *aligned(_cells(own)), "", *_notes(own)]))
    return "\n\n".join(parts)


def _cells(rows: Sequence[ObserverErrors]) -> list[list[str]]:
    measured = [row.metrics for row in rows]
    cells = [["RMSE", "unit", *(row.observer for row in rows)]]

    def add(name: str, unit: str, value: Callable[[RunMetrics], float | None]) -> None:
        cells.append(
            [name, unit, *(number(None if each is None else value(each)) for each in measured)]
        )

    if any(metrics is not None and _is_judged(metrics) for metrics in measured):
        for key, name, unit in QUANTITIES:
            add(name, unit, partial(_rmse, key=key))
        add("all states, normalised", "", lambda metrics: metrics.normalised_rmse)
    cells.append(["innovation", "rad", *(number(row.innovation_rms) for row in rows)])
    add("innovation² / expected", "", lambda metrics: metrics.nis)
    return cells


def _rmse(metrics: RunMetrics, key: str) -> float | None:
    return metrics[key].rmse


def _notes(rows: Sequence[ObserverErrors]) -> list[str]:
    first = next((row.metrics for row in rows if row.metrics is not None), None)
    if first is None:
        return ["no estimates"]
    if not first.windows:
        return ["the recording is too short to have a settled part, so there are no errors"]
    if not _is_judged(first):
        return ["the recording has no ground truth, so there are innovations but no errors"]
    return [f"errors over the {first.settled_time:.1f} s that count as settled"]


def _is_judged(metrics: RunMetrics) -> bool:
    return any(one.rmse is not None for one in metrics.quantities)


def _errors(
    source: Source, run: Run, joint: int, truth: Truth, options: MetricsOptions
) -> ObserverErrors:
    recorded = recorded_run(source, run, joint, truth)
    metrics = None
    if recorded is not None:
        design = run.observer.designs[joint]
        metrics = measure(recorded, replace(options, innovation_std=expected_innovation(design)))
    return ObserverErrors(
        observer=run.observer.name,
        joint=source.joints[joint],
        innovation_rms=rms(run.table.innovations[:, joint]),
        metrics=metrics,
    )


def recorded_run(source: Source, run: Run, joint: int, truth: Truth) -> RecordedRun | None:
    """Return a joint's part of a run as if it had been recorded; None without estimates."""
    ticks = np.flatnonzero(np.isfinite(run.table.states[:, joint, 0]))
    if not len(ticks):
        return None
    spans = passes(run.schedule.stamps[ticks].tolist())
    begin, end = max(spans, key=lambda span: span[1] - span[0])
    ticks = ticks[begin:end]
    samples = source.samples
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
        **estimates_of(run.table, samples.stamps, joint, ticks),
    )


def _series(series: JointSeries | None, begin: int, names: int) -> Series | None:
    """Return some neighbouring names of a topic, None if it says nothing of them."""
    if series is None:
        return None
    chosen = slice(begin, begin + names)
    there = series.named[:, chosen].all(axis=1)
    if not there.any():
        return None
    values = series.values[there, chosen]
    return Series(series.stamps[there], values.reshape(len(values), -1)).ordered()
