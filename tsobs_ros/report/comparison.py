# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers over the same measurements, side by side, as numbers and as text for terminals.

The reference is an EKF with the disturbance model, noise and start of the design, and with a gate
(`estimation.baselines`). Where ours learns parameters there are two, as only the truth shows which
one is the better rival: one keeps the nominal parameters, the other has them as states.
"""

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.design.file import DesignFile
from tsobs_ros.errors import BagReadError, printable
from tsobs_ros.estimation.baselines import GATE
from tsobs_ros.estimation.records import HEALTH
from tsobs_ros.methods import EKFS, ObserverSettings
from tsobs_ros.replay.estimate import Observer, Run, make_runs, run_all, without_misfits
from tsobs_ros.replay.places import places_of
from tsobs_ros.replay.source import BagSource, Source
from tsobs_ros.report.held_out import HeldOutErrors, HeldOutSensor
from tsobs_ros.report.metrics import SIGMAS, RunMetrics, innovation_std, measure, root_mean
from tsobs_ros.report.quantities import QUANTITIES, outputs_of
from tsobs_ros.report.run import (
    ESTIMATED,
    TRUE,
    Asked,
    RecordedRun,
    Rows,
    read_rows,
    row_type,
    rows_of,
    run_of,
)
from tsobs_ros.series import Spool

DIVERGED = 1e6
"""No joint's error is so large [rad, rad/s]; the number is not worth a column of digits."""

THETAS = tuple(np.geomspace(0.7, 20.0, 12).tolist())
"""θ to choose the best from for observers of high gain [rad/s]."""

HIGH_GAIN = ("high_gain", "proportional_integral")
MAX_TUNED = 50_000
"""Measurements of a recording in which the best θ is looked for, which takes two dozen runs."""

_NOTHING = "–"
_EKFS = {
    "ekf_plain": "no gate",
    "ekf": "the nominal parameters",
    "ekf_augmented": "the uncertain parameters as states",
}


class EkfComparison(NamedTuple):
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

    @property
    def note(self) -> str:
        """The line on what the EKF has in common with ours, and in what it differs."""
        better = ", the better one of ekf and ekf_augmented" if self.rivals > 1 else ""
        return f"{_about_ekfs([self.method], self.ekf)}{better}"

    def as_mapping(self) -> dict[str, Any]:
        """Return the EKF's errors and the ratios as plain data."""
        return {
            "method": self.method,
            "rmse": {one.key: one.rmse for one in self.ekf.quantities},
            "normalised_rmse": self.ekf.normalised_rmse,
            "ratio": self.ratios,
            "normalised_ratio": self.normalised_ratio,
        }


class ObserverErrors(NamedTuple):
    """Errors of one observer at one joint.

    Attributes:
        observer: Its name.
        joint: The joint's name.
        innovation_rms: Of all innovations of each output; None without any.
        metrics: Errors against the truth if it is known, and the innovations' consistency;
            None without estimates.
        outputs: Names of the outputs, and their units.
        held_out: Errors against a sensor that no observer gets; None without one.
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


def compare_with_ekf(
    run: RecordedRun,
    metrics: RunMetrics,
    bag: Path,
    files: Mapping[str, DesignFile],
    settings: ObserverSettings,
) -> tuple[EkfComparison, RecordedRun]:
    """Return a comparison with an EKF over the measurements of a recorded run, and the EKF's run.

    If ours learns parameters, there are two EKFs: one with the nominal parameters, and one that has
    those as states. The comparison is with the better one.

    Args:
        run: The recorded run.
        metrics: Its metrics.
        bag: The bag that it is from.
        files: Design file of each joint that the observer observed.
        settings: Those that it ran with.
    """
    source = BagSource(bag, topic=run.topic, joints=tuple(files))
    learns = settings.learnt(files[run.joint].design)
    observers = [
        Observer(method, replace(settings, method=method), tuple(files.values()))
        for method in (EKFS if learns else EKFS[:1])
    ]
    results = _scores(source, without_misfits(observers)[0]).results()
    own = [one for one in results if one[0].joint == run.joint]
    best, theirs = min(own, key=lambda one: one[0].normalised_rmse)
    if best.metrics is None or theirs is None:
        raise BagReadError(f"{bag}: no EKF could be run over the measurements of {run.joint}")
    return EkfComparison(metrics, best.metrics, best.observer, len(own)), theirs


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
        errors: defaultdict[str, float] = defaultdict(float)
        for row in compare_observers(source, choices) if choices else ():
            errors[row.observer] += row.normalised_rmse
        best = min(choices, key=lambda choice: errors[choice.name], default=one)
        if choices and errors[best.name] < math.inf:
            remarks.append(f"{one.name}: θ = {best.name} rad/s, the best of {len(choices)}")
        else:
            best = one
            remarks.append(f"{one.name}: θ = {one.settings.theta:g} rad/s, not tuned to this arm")
        tuned.append(replace(best, name=one.name))
    return tuned, remarks


def compare_observers(
    source: Source, observers: Sequence[Observer], sensors: Sequence[HeldOutSensor] = ()
) -> list[ObserverErrors]:
    """Run observers when the recorded one estimated, if there is one, and measure them.

    Args:
        source: The measurements.
        observers: The observers.
        sensors: Of each joint one that they do not get, to measure them against.
    """
    return _scores(source, observers, sensors).errors()


def _scores(
    source: Source, observers: Sequence[Observer], sensors: Sequence[HeldOutSensor] = ()
) -> "RunScores":
    runs = make_runs(source, observers, rate=None, as_live=True)
    scores = RunScores(source, runs, sensors)
    run_all(source, runs, None, after_window=scores.add)
    return scores


class RunScores:
    """Measures runs over the same measurements; if time restarted, the longest pass.

    Their estimates are kept in temporary files, 0.2 kB for each.

    Args:
        source: The measurements.
        runs: The runs.
        sensors: Of each joint one that no run gets, to measure them against.
    """

    def __init__(
        self,
        source: Source,
        runs: Sequence[Run],
        sensors: Sequence[HeldOutSensor] = (),
    ) -> None:
        self._source, self._sensors = source, sensors
        self._measured = [
            Spool(row_type(len(own.outputs) + len(own.inputs))) for own in source.signals
        ]
        self._kept: list[tuple[Run, int, dict[str, Spool]]] = []
        for joint, run in product(range(len(source.joints)), runs):
            own = run.signals[joint]
            p, plant, t = len(own.outputs), len(own.states), len(own.torques)
            widths = dict(zip(ESTIMATED, (plant, plant, p, p, t, t), strict=True))
            widths |= {"innovation": p} | ({"health": len(HEALTH)} if sensors else {})
            kept = {key: Spool(row_type(width)) for key, width in widths.items()}
            self._kept.append((run, joint, kept))

    def add(self) -> None:
        """Add a window's measurements, and what the runs have made of it."""
        samples = self._kept[0][0].window.samples
        for joint, measured in enumerate(self._measured):
            own, places = samples[samples.complete[:, joint]], self._source.signals[joint]
            y, u = own.y[:, joint, : len(places.outputs)], own.u[:, joint, : len(places.inputs)]
            measured.add(rows_of(own, np.hstack([y, u])))
        for run, joint, kept in self._kept:
            innovations = run.innovations[joint]
            there = np.flatnonzero(np.isfinite(run.values(joint, "state")[:, 0]))
            used = np.flatnonzero(np.isfinite(innovations).any(axis=1))
            kept["innovation"].add(rows_of(run.window.samples[used], innovations[used]))
            for key in kept.keys() - {"innovation"}:
                found = run.values(joint, *(HEALTH if key == "health" else (key,)))[there]
                if found.shape[1]:
                    kept[key].add(rows_of(run.window.ticks[there], found))

    def errors(self) -> list[ObserverErrors]:
        """Return the errors of all observers, joint by joint.

        Raises:
            LogError: Too few readings of a held-out sensor are between estimates.
        """
        return [errors for errors, _ in self.results()]

    def results(self) -> Iterator[tuple[ObserverErrors, RecordedRun | None]]:
        """Yield the errors of each observer with its run, None if it made no estimate."""
        truth = self._truth()
        for one, joint, kept in self._kept:
            name, method = self._source.joints[joint], one.observer.name
            design = one.observer.designs[joint]
            found = {key: spool.read() for key, spool in kept.items()}
            rms = tuple(map(root_mean, found["innovation"].values.T))
            run = metrics = held_out = None
            if len(found["state"]):
                found |= truth[joint] | {"measurements": self._measured[joint].read()}
                if self._sensors:
                    found["held_out"] = self._sensors[joint].rows
                run = run_of(found, method, name, design.request)
                metrics = measure(run, innovation_std(design))
                if self._sensors:
                    held_out = self._sensors[joint].errors(run, metrics.windows)
            outputs = tuple(outputs_of(design.request))
            yield ObserverErrors(method, name, rms, metrics, outputs, held_out), run

    def _truth(self) -> list[dict[str, Rows]]:
        """Return the recorded truth of each joint."""
        source, found = self._source, [dict[str, Rows]() for _ in self._source.joints]
        if isinstance(source, BagSource):
            each = zip(source.joints, source.signals, strict=True)
            places = [places_of(name, own, alone=source.alone) for name, own in each]
            asked = {
                (joint, key): Asked(source.truth[topic], [own[topic]])
                for joint, own in enumerate(places)
                for key, topic in TRUE.items()
                if topic in source.truth
            }
            for (joint, key), rows in read_rows(source.reader, asked, source.damaged).items():
                found[joint][key] = rows
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
        if first is not None and (ekfs := [r.observer for r in own if r.observer in _EKFS]):
            note.append(_about_ekfs(ekfs, first))
        note += dict.fromkeys(row.held_out.sensor.note for row in own if row.held_out)
        parts.append("\n".join([*title, *aligned(_cells(own, first)), "", *note]))
    return "\n\n".join(parts)


def _about_ekfs(methods: Sequence[str], metrics: RunMetrics) -> str:
    """Return the line on what EKFs have in common with ours, and in what they differ."""
    of_arm = metrics.quantities[0].quantity in QUANTITIES
    known = ", ".join(f"{name} has {_EKFS[name]}" for name in methods)
    gate = f"gated at {GATE:g}σ" if of_arm else "not gated"
    return f"EKF: same disturbance model, noise and data as ours, {gate}; {known}"


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
        return "the recording is too short to have a settled part, so there are no errors"
    if not metrics.has_truth:
        return "the recording has no ground truth, so there are innovations but no errors"
    return f"errors over the {metrics.settled_time:.1f} s that count as settled"


def render_metrics(metrics: RunMetrics, comparison: EkfComparison | None = None) -> str:
    """Return the metrics as a table with a line on the run above and on its events below.

    Args:
        metrics: Of the recorded estimates.
        comparison: With an EKF on the same data; adds two columns.
    """
    above = (
        f"{metrics.measurements} measurements, {metrics.estimates} estimates in "
        f"{metrics.duration:.1f} s; errors over the {metrics.settled_time:.1f} s that count as "
        "settled"
    )
    below = []
    for event in metrics.events if metrics.has_truth else ():
        unit = {"start": "", "jump": "rad", "step": "N m"}[event.what]
        what = f"{event.what} of {event.size:+.3g} {unit}" if unit else event.what
        settled = "settling not seen"
        if event.settled_after is not None:
            settled = f"errors settled after {event.settled_after:.2f} s"
        below.append(f"{what} at {event.time:.2f} s: {settled}")
    if metrics.nis is not None:
        below.append(f"innovations: mean square {metrics.nis:.3g} × what the design expects")
    if comparison is not None:
        below.append(comparison.note)
    return "\n".join([above, "", *aligned(metrics_cells(metrics, comparison)), "", *below])


def metrics_cells(metrics: RunMetrics, comparison: EkfComparison | None = None) -> list[list[str]]:
    """Return the cells of the same table, its head first."""
    rows = [["", "unit", "RMSE", "bound (1σ)", "RMSE/bound", f"inside {SIGMAS:g}σ"]]
    for one in metrics.quantities:
        sizes = [number_text(one.rmse), number_text(one.bound)]
        numbers = [*sizes, _quotient(one.ratio), _share(one.inside)]
        rows.append([one.quantity.name, one.quantity.unit, *numbers])
    rows.append(["all states, normalised", "", number_text(metrics.normalised_rmse), "", "", ""])
    if comparison is not None:
        rmse = [one.rmse for one in comparison.ekf.quantities]
        errors = [*rmse, comparison.ekf.normalised_rmse]
        ratios = [*comparison.ratios.values(), comparison.normalised_ratio]
        rows[0] += ["EKF RMSE", "RMSE/EKF"]
        for row, error, ratio in zip(rows[1:], errors, ratios, strict=True):
            row += [number_text(error), _quotient(ratio)]
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
    """Return an error with three digits, or a word if there is none or it is huge."""
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
    ("  largest", "largest", number_text),
    ("  bias", "bias", number_text),
    ("  without bias", "without_bias.rmse", number_text),
    (f"  without bias, inside {SIGMAS:g}σ", "without_bias.inside", _share),
    ("  bounds claimed", "claimed", _share),
)
"""Rows of errors against a held-out sensor."""


def _ratio(ours: float | None, theirs: float | None) -> float | None:
    return None if ours is None or not theirs else ours / theirs
