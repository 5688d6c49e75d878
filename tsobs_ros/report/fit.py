# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of a fit: the numbers, their predictions, flaws of the model, and the residuals."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tsobs_ros import __version__
from tsobs_ros.checks import Array
from tsobs_ros.identification.diagnosis import HORIZON
from tsobs_ros.identification.likelihood import GATE
from tsobs_ros.identification.result import Fit
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.report.page import write_html
from tsobs_ros.report.panels import Picture, Plot, Table, limits_around, lines, thinned_curve
from tsobs_ros.report.quantities import outputs_of

_GROUPS = 40
"""Groups of neighbouring velocities whose means are drawn."""

_SEEN = ("hardly", "yes")


def write_page(path: Path, fit: Fit, names: str) -> None:
    """Write a fit as a page that needs nothing but itself; `names` are those of the recordings.

    Raises:
        OSError: The page cannot be written.
    """
    begin, end = fit.traces.time[[0, -1]].tolist()
    part = f"the {'held-out' if fit.samples[1] else 'last (fitted)'} {end - begin:.3g} s"
    headline = f"{fit.request.rate:g} Hz  ·  {fit.outliers:,} large innovations  ·  figures: {part}"
    rows = [
        (n.name, f"{n.before:.4g}", f"{n.value:.4g}", f"{n.std:.2g}", n.unit, _SEEN[n.seen])
        for n in fit.numbers
    ]
    numbers = Table("Numbers", ("number", "before", "fitted", "1σ", "unit", "shown"), rows)
    lines = str(fit).splitlines()[1 + len(rows) :]
    lines.append(f"made by tsobs_ros {__version__}")
    found = Table("What was found", ("",), [(line,) for line in lines], 1)
    shown = Picture(f"Fit to {names}", headline, tuple(_rows(fit)), (begin, end))
    write_html(shown, path, first=[numbers, found])


def _rows(fit: Fit) -> Iterator[tuple[Plot, ...]]:
    """Yield the plots of a page: outputs with residuals, torques, friction."""
    traces, gap = fit.traces, 4.0 * fit.request.period
    columns = traces.measured.T, traces.simulated.T, traces.predicted.T, traces.residual.T
    each = zip(outputs_of(fit.request), fit.outputs, *columns, strict=True)
    for (name, unit), one, measured, simulated, predicted, residual in each:
        values = {"measured": measured, "simulated": simulated, "predicted": predicted}
        curves = tuple(thinned_curve(key, traces.time, y, max_gap=gap) for key, y in values.items())
        remark = (
            f"{one.one_step:.3g} % predicted one sample ahead",
            f"{one.free_run:.3g} % simulated, from the estimate every {HORIZON:g} s",
        )
        value = Plot(name, unit, limits_around(values.values()), curves, remark)
        yield value, _residual(name, traces.time, residual, gap)
    torques = {
        "applied": (traces.time, traces.torque),
        "unexplained": (traces.time, traces.unexplained),
    }
    yield lines("torque", "N m", torques, gap), _friction(fit)


def _residual(name: str, time: Array, r: Array, gap: float) -> Plot:
    """Return the plot of innovations divided by their expected 1σ."""
    there = np.isfinite(r)
    time, r = time[there], r[there]
    share = 100.0 * float((np.abs(r) > SIGMAS).sum()) / max(len(r), 1)
    curve = thinned_curve("measured", time, r, max_gap=gap)._replace(name="residual")
    size = min(max(4.5, 1.1 * float(np.abs(r).max(initial=0.0))), 2.0 * GATE)
    remark = (f"– – ±{SIGMAS:g}σ", f"{share:.2g} % outside; 0.27 % if normal")
    label = f"residual of {name}"
    return Plot(label, "expected 1σ", (-size, size), (curve,), remark, level=SIGMAS)


def _friction(fit: Fit) -> Plot:
    """Return the plot of friction over motor velocity: fitted, and with the unexplained torque."""
    speed, fitted = fit.traces.velocity, -fit.joint.friction[0] * np.sign(fit.traces.velocity)
    groups = np.array_split(np.argsort(speed), min(_GROUPS, len(speed)))
    at, with_rest, alone = (
        np.array([values[group].mean() for group in groups])
        for values in (speed, fitted + fit.traces.unexplained, fitted)
    )
    curves = {"with the unexplained torque": (at, with_rest), "fitted": (at, alone)}
    plot = lines("friction and unexplained torque", "N m", curves)
    return plot._replace(axis="motor velocity [rad/s]")
