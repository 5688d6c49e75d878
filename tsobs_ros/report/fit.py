# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of a fit: numbers, how well they predict, what the model lacks, and the residuals."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tsobs_ros import __version__
from tsobs_ros.checks import Array
from tsobs_ros.estimation.health import Level
from tsobs_ros.identification.likelihood import GATE
from tsobs_ros.identification.result import Fit
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.report.page import write_html
from tsobs_ros.report.panels import (
    MEASUREMENT_COLOUR,
    Curve,
    Picture,
    Plot,
    Style,
    limits_around,
    lines,
    thinned_curve,
)
from tsobs_ros.report.quantities import outputs_of
from tsobs_ros.report.summary import About, Summary, Table
from tsobs_ros.style import BLUE, ORANGE

_EXPECTED = (0.8, 1.25)
"""Innovations by their expected size, of a model that is about right."""

_CORRELATED, _SIMULATED = 0.2, 50.0
"""Correlation of neighbours from which on there is more to predict, and a poor simulation [%]."""

_DOTS, _GROUPS = 2500, 40
"""Dots over another quantity than time, and groups of neighbours whose means are drawn."""

_SEEN = ("hardly", "yes")


def write_page(path: Path, fit: Fit, names: str) -> None:
    """Write a fit to recordings of some names as a page that needs nothing but itself.

    Raises:
        OSError: The page cannot be written.
    """
    begin, end = fit.traces.time[[0, -1]].tolist()
    part = f"the {'held-out' if fit.samples[1] else 'last (fitted)'} {end - begin:.3g} s"
    headline = "{:,} samples fitted  ·  {:,} held out  ·  {:,} outliers  ·  figures: {}".format(
        *fit.samples, fit.outliers, part
    )
    facts = [
        ("recordings", names),
        ("rate", f"{fit.request.rate:g} Hz"),
        ("version of this report", f"tsobs_ros {__version__}"),
    ]
    tables = (
        Table("What it was made with", ("what", "value"), facts, 2),
        Table("Remarks", ("",), [(note,) for note in fit.notes], 1),
    )
    about = About(_verdict(fit, part), tables, list(_tables(fit, part)))
    write_html(Picture(f"Fit to {names}", headline, tuple(_rows(fit)), (begin, end)), path, about)


def _verdict(fit: Fit, part: str) -> Summary:
    """Return in plain words how well a fit predicts, what is not shown, and what it lacks."""
    hidden = [each.name for each in fit.numbers if not each.seen]
    still = "; ".join(each.what for each in fit.lacks if not each.is_added)
    sentences = [
        *(
            f"Of the {_words(each.name)} in {part}, it predicts {_percent(each.one_step)} one "
            f"sample ahead and {_percent(each.free_run)} over {each.horizon:g} s from the torque "
            "alone."
            for each in fit.outputs
        ),
        f"Hardly shown by the recordings: {', '.join(map(_words, hidden)) or 'none'}.",
        f"The model still lacks {still or 'nothing that the recordings show'}.",
    ]
    is_good = not still and not any(name.startswith("arm.") for name in hidden)
    for each in fit.outputs:
        is_good &= _EXPECTED[0] <= each.innovation_std <= _EXPECTED[1]
        is_good &= abs(each.correlation) <= _CORRELATED and not each.free_run < _SIMULATED
    return Summary(Level.OK if is_good else Level.WARN, " ".join(sentences))


def _tables(fit: Fit, part: str) -> Iterator[Table]:
    """Yield the tables of a page; those without rows are not shown."""
    rows = [
        (_words(n.name), f"{n.before:.4g}", f"{n.value:.4g}", f"{n.std:.2g}", n.unit, _SEEN[n.seen])
        for n in fit.numbers
    ]
    yield Table("Numbers", ("number", "before", "fitted", "1σ", "unit", "shown"), rows)
    predicted = [
        (_words(one.name), _percent(one.one_step), _percent(one.free_run),
         f"{one.innovation_std:.3g}", f"{one.correlation:.2f}")
        for one in fit.outputs
    ]  # fmt: skip
    head = ("output", "one sample ahead", "simulated", "innovations / expected", "correlation")
    note = (
        f"Of {part}, in pieces of {fit.outputs[0].horizon:g} s. 100 % is without error, 0 % no "
        "better than the mean. Correlation of neighbouring innovations is 0 if they are white."
    )
    yield Table("Prediction", head, predicted, 1, note)
    lacks = [
        (each.what, "the fitted request has it" if each.is_added else each.entry or "none")
        for each in fit.lacks
    ]
    yield Table("What the model lacked", ("what", "entry of the request that adds it"), lacks, 2)
    unseen = [(each,) for each in fit.unseen]
    yield Table("What the recordings do not show", ("motion that would show it",), unseen, 1)


def _rows(fit: Fit) -> Iterator[tuple[Plot, ...]]:
    """Yield the plots of a page: outputs with residuals, torques, friction."""
    traces, gap = fit.traces, 4.0 * fit.request.period
    columns = traces.measured.T, traces.simulated.T, traces.predicted.T, traces.residual.T
    each = zip(outputs_of(fit.request), fit.outputs, *columns, strict=True)
    for (name, unit), one, measured, simulated, predicted, residual in each:
        values = {"measured": measured, "simulated": simulated, "predicted": predicted}
        curves = tuple(thinned_curve(key, traces.time, y, max_gap=gap) for key, y in values.items())
        remark = (
            f"{_percent(one.one_step)} predicted one sample ahead",
            f"{_percent(one.free_run)} simulated, from the estimate every {one.horizon:g} s",
        )
        value = Plot(name, unit, limits_around(values.values()), curves, remark)
        yield value, _residual(name, traces.time, residual, gap)
    torques = {
        "applied": (traces.time, traces.torque),
        "unexplained": (traces.time, traces.unexplained),
    }
    speed = traces.state[:, 3]
    friction = -fit.joint.friction[0] * np.sign(speed)
    yield lines("torque", "N m", torques, gap), _friction(speed, traces.unexplained, friction)


def _words(name: str) -> str:
    """Return the name of an output, or of a number by its place in the request, for people."""
    plain = name.removeprefix("arm.").replace("measurement_std", "noise")
    return plain.replace(".", ": ").replace("_", " ")


def _percent(value: float) -> str:
    return f"{value:.3g} %" if math.isfinite(value) else "not known"


def _residual(name: str, time: Array, r: Array, gap: float) -> Plot:
    """Return the plot of innovations by their expected 1σ."""
    there = np.isfinite(r)
    time, r = time[there], r[there]
    share = 100.0 * float((np.abs(r) > SIGMAS).sum()) / max(len(r), 1)
    curve = thinned_curve("measured", time, r, max_gap=gap)._replace(name="residual")
    size = min(max(4.5, 1.1 * float(np.abs(r).max(initial=0.0))), 2.0 * GATE)
    remark = (f"– – ±{SIGMAS:g}σ", f"{share:.2g} % outside; 0.27 % if normal")
    label = f"residual of {name}"
    return Plot(label, "expected 1σ", (-size, size), (curve,), remark, level=SIGMAS)


def _friction(speed: Array, rest: Array, fitted: Array) -> Plot:
    """Return the plot of fitted friction and the rest over the speed, with neighbours' means."""
    order, y = np.argsort(speed), fitted + rest
    groups = np.array_split(order, min(_GROUPS, len(order)))
    at, means = (np.array([values[each].mean() for each in groups]) for values in (speed, y))
    some = order[:: max(1, len(order) // _DOTS)]
    curves = (
        Curve("samples", speed[some], y[some], Style(MEASUREMENT_COLOUR, 0.6, ".")),
        Curve("fitted", speed[some], fitted[some], Style(ORANGE, 1.8)),
        Curve("mean", at, means, Style(BLUE, 2.0)),
    )
    limits = limits_around([np.quantile(y, (0.002, 0.998)), fitted])
    label = "friction and unexplained torque"
    return Plot(label, "N m", limits, curves, axis="motor velocity [rad/s]")
