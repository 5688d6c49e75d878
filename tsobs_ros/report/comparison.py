# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of observers over the same measurements, as numbers and as text for terminals.

The reference is an EKF with the disturbance model, noise and start of the design, and with a gate
(`estimation.baselines`). If our observer learns parameters, there are two EKFs, as only the truth
shows which is the better rival: one keeps the nominal parameters, the other has them as states.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.design.record import Design
from tsobs_ros.errors import BagReadError, printable
from tsobs_ros.estimation.records import HEALTH
from tsobs_ros.methods import EKFS, ObserverSettings
from tsobs_ros.replay.estimate import Observer, Run, run_observers, without_misfits
from tsobs_ros.replay.source import BagSource
from tsobs_ros.report.held_out import HeldOutErrors, HeldOutSensor
from tsobs_ros.report.metrics import SIGMAS, RunMetrics, innovation_std, measure, root_mean
from tsobs_ros.report.quantities import outputs_of
from tsobs_ros.report.run import ESTIMATED, RecordedRun, recorded_parts, run_of
from tsobs_ros.series import Series

DIVERGED = 1e6
"""Larger errors are shown as a word, as no joint's error is so large [rad, rad/s]."""

_NOTHING = "–"
_EKFS = {
    "ekf_plain": "no gate",
    "ekf": "the nominal parameters",
    "ekf_augmented": "the uncertain parameters as states",
}


class ObserverErrors(NamedTuple):
    """Errors of one observer at one joint.

    Attributes:
        innovation_rms: Root mean square of all innovations of each output; None without any.
        metrics: Errors against the truth if it is known, and the innovations' consistency;
            None without estimates.
        outputs: Names of the outputs, and their units.
        held_out: Errors against a held-out sensor; None without one.
    """

    observer: str
    joint: str
    innovation_rms: tuple[float | None, ...]
    metrics: RunMetrics | None
    outputs: tuple[tuple[str, str], ...] = (("link angle", "rad"),)
    held_out: HeldOutErrors | None = None

    @property
    def normalised_rmse(self) -> float:
        """Normalised RMSE of the states, infinite if it is not known."""
        known = None if self.metrics is None else self.metrics.normalised_rmse
        return math.inf if known is None else known

    def as_mapping(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold."""
        names = (name for name, _ in self.outputs)
        rms: Any = dict(zip(names, self.innovation_rms, strict=True))
        return {
            "observer": self.observer,
            "joint": self.joint,
            "innovation_rms": rms if len(rms) > 1 else self.innovation_rms[0],
            **({} if self.metrics is None else self.metrics.as_mapping()),
            **({} if self.held_out is None else {"held_out": self.held_out.as_mapping()}),
        }


def best_ekf(
    source: BagSource, design: Design, settings: ObserverSettings
) -> tuple[str, RunMetrics, RecordedRun]:
    """Return the EKF with the smallest errors for the only joint of a bag: name, errors and run.

    If our observer with this design and these settings learns parameters, two EKFs are run: one
    with the nominal parameters, and one with the uncertain parameters as states.
    """
    methods = EKFS if settings.learnt(design) else EKFS[:1]
    observers = [Observer(name, replace(settings, method=name), (design,)) for name in methods]
    fitting, _ = without_misfits(observers)
    runs = run_observers(source, fitting, keep=True)
    best, run = min(measure_runs(source, runs), key=lambda one: one[0].normalised_rmse)
    if best.metrics is None or run is None:
        raise BagReadError(f"{source.path}: no EKF could be run over the measurements")
    return best.observer, best.metrics, run


def measure_runs(
    source: BagSource, runs: Sequence[Run], sensors: Sequence[HeldOutSensor] = ()
) -> list[tuple[ObserverErrors, RecordedRun | None]]:
    """Measure runs that have kept their estimates; if time restarted, measure the longest pass.

    `sensors` has the held-out sensor of each joint, or is empty. Returns, joint by joint, each
    observer's errors with its run, which is None without estimates.

    Raises:
        LogError: There are too few readings of a held-out sensor between estimates.
    """
    found = []
    for joint, name in enumerate(source.joints):
        common = recorded_parts(source, joint)
        for one in runs:
            method, design = one.observer.name, one.observer.designs[joint]
            (made, errors), run, metrics, held_out = one.kept(joint), None, None, None
            errors = errors.take(np.flatnonzero(np.isfinite(errors.values).any(axis=1)))
            there = np.isfinite(made.rows["state"][:, 0])
            made = made if there.all() else made[there]
            if len(made):
                columns = {key: made.rows[key] for key in ESTIMATED}
                if sensors:
                    columns["health"] = np.stack([made.rows[key] for key in HEALTH], axis=1)
                parts = common | {
                    key: Series(made.stamps, values, made.log_times)
                    for key, values in columns.items()
                    if values.shape[1]
                }
                parts |= {"innovation": errors}
                parts |= {"held_out": sensors[joint].readings} if sensors else {}
                run = run_of(parts, method, name, design.request)
                metrics = measure(run, innovation_std(design))
                held_out = sensors[joint].errors(run, metrics.windows) if sensors else None
            rms, outputs = map(root_mean, errors.values.T), outputs_of(design.request)
            row = ObserverErrors(method, name, tuple(rms), metrics, tuple(outputs), held_out)
            found.append((row, run))
    return found


def render_comparison(rows: Sequence[ObserverErrors]) -> str:
    """Return a table for each joint: errors if the truth is known, and the innovations."""
    parts = []
    joints = list(dict.fromkeys(row.joint for row in rows))
    for joint in joints:
        own = [row for row in rows if row.joint == joint]
        first = next((row.metrics for row in own if row.metrics is not None), None)
        title = [printable(joint)] if len(joints) > 1 else []
        note = [_note(first)]
        if ekfs := [row.observer for row in own if row.observer in _EKFS]:
            note.append(about_ekfs(ekfs))
        note += dict.fromkeys(row.held_out.sensor.note for row in own if row.held_out)
        parts.append("\n".join([*title, *aligned(_cells(own, first)), "", *note]))
    return "\n\n".join(parts)


def about_ekfs(methods: Sequence[str]) -> str:
    """Return the line that compares EKFs with our observer, and with each other."""
    known = ", ".join(f"{name} has {_EKFS[name]}" for name in methods)
    return f"EKF: same disturbance model, noise and data as ours; {known}"


def _cells(rows: Sequence[ObserverErrors], first: RunMetrics | None) -> list[list[str]]:
    metrics = [row.metrics for row in rows]
    cells = [["RMSE", "unit", *(row.observer for row in rows)]]
    if first is not None and any(one is not None and one.has_truth for one in metrics):
        for place, one in enumerate(first.quantities):
            rmse = (None if each is None else each.quantities[place].rmse for each in metrics)
            cells.append([one.quantity.name, one.quantity.unit, *map(number_text, rmse)])
        known = (None if each is None else each.normalised_rmse for each in metrics)
        cells.append(["all states, normalised", "", *map(number_text, known)])
    for place, (output, unit) in enumerate(rows[0].outputs):
        name = "innovation" if len(rows[0].outputs) == 1 else f"innovation of {output}"
        cells.append([name, unit, *(number_text(row.innovation_rms[place]) for row in rows)])
    nis = (None if each is None else each.nis for each in metrics)
    cells.append(["innovation² / expected", "", *map(number_text, nis)])
    held_out = [row.held_out for row in rows]
    units = [one.sensor.quantity.unit for one in held_out if one is not None]
    for label, key, text in _HELD_OUT if units else ():
        values = (None if one is None else attrgetter(key)(one) for one in held_out)
        cells.append([label, units[0] if text is number_text else "", *map(text, values)])
    return cells


def _note(metrics: RunMetrics | None) -> str:
    if metrics is None:
        return "no estimates"
    if not metrics.windows:
        return f"there are no errors, as the recording is {metrics.unsettled}"
    if not metrics.has_truth:
        return "the recording has no ground truth, so there are innovations but no errors"
    return f"errors over the {metrics.settled_time:.1f} s that count as settled"


def metrics_cells(metrics: RunMetrics, ekf: RunMetrics | None = None) -> list[list[str]]:
    """Return the cells of a table of a run's metrics, its head first; an EKF adds two columns."""
    rows = [["", "unit", "RMSE", "bound (1σ)", "RMSE/bound", f"inside {SIGMAS:g}σ"]]
    for one in metrics.quantities:
        sizes = [number_text(one.rmse), number_text(one.bound)]
        numbers = [*sizes, _quotient(one.ratio), _share(one.inside)]
        rows.append([one.quantity.name, one.quantity.unit, *numbers])
    rows.append(["all states, normalised", "", number_text(metrics.normalised_rmse), "", "", ""])
    if ekf is not None:
        rows[0] += ["EKF RMSE", "RMSE/EKF"]
        ours, theirs = (
            [*(one.rmse for one in each.quantities), each.normalised_rmse]
            for each in (metrics, ekf)
        )
        for row, own, error in zip(rows[1:], ours, theirs, strict=True):
            row += [number_text(error), _quotient(ratio(own, error))]
    return rows


def aligned(rows: Sequence[Sequence[str]], text_columns: int = 2) -> list[str]:
    """Return the lines of a table: a head with a rule below it, columns of text, then numbers."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(
            cell.ljust(width) if place < text_columns else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
    return [lines[0], "─" * max(map(len, lines)), *lines[1:]]


def number_text(value: float | None) -> str:
    """Return an error with three digits, or a dash if there is none, or a word if it is huge."""
    if value is None:
        return _NOTHING
    return "diverged" if value > DIVERGED else f"{value:#.3g}"


def _quotient(value: float | None) -> str:
    return _NOTHING if value is None else f"{value:.2f}"


def _share(value: float | None) -> str:
    return _NOTHING if value is None else f"{100.0 * value:.1f} %"


_HELD_OUT = (
    ("held-out sensor", "with_bias.rmse", number_text),
    (f"  inside {SIGMAS:g}σ", "with_bias.inside", _share),
    ("  median", "median", number_text),
    ("  largest", "largest", number_text),
    ("  bias", "bias", number_text),
    ("  without bias", "without_bias.rmse", number_text),
    (f"  without bias, inside {SIGMAS:g}σ", "without_bias.inside", _share),
    ("  bounds claimed", "claimed", _share),
)
"""Rows of errors against a held-out sensor."""


def ratio(ours: float | None, theirs: float | None) -> float | None:
    """Return how large our error is relative to another one."""
    return None if ours is None or not theirs else ours / theirs
