# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Metrics as text for terminals: aligned columns, plain characters."""

from collections.abc import Sequence

from tsobs_ros.report.metrics import QUANTITIES, SIGMAS, RunMetrics
from tsobs_ros.report.reference import EkfComparison

_NOTHING = "–"
_ABOUT_THE_EKF = "EKF: same model, data and windows, plain: it does not look for outliers or jumps"


def render_metrics(metrics: RunMetrics, comparison: EkfComparison | None = None) -> str:
    """Return the metrics as a table with a line on the run above and on its events below.

    Args:
        metrics: Of the recorded estimates.
        comparison: With an EKF on the same data; adds two columns.
    """
    head = ["", "unit", "RMSE", "bound (1σ)", "RMSE/bound", f"inside {SIGMAS:g}σ"]
    if comparison is not None:
        head += ["EKF RMSE", "RMSE/EKF"]
    rows = [head]
    for quantity in QUANTITIES:
        one = metrics[quantity.key]
        row = [quantity.name, quantity.unit, number(one.rmse), number(one.bound)]
        row += [ratio(one.ratio), _percent(one.inside)]
        if comparison is not None:
            row += [number(comparison.ekf[quantity.key].rmse)]
            row += [ratio(comparison.ratios[quantity.key])]
        rows.append(row)
    total = ["all states, normalised", "", number(metrics.normalised_rmse), "", "", ""]
    if comparison is not None:
        total += [number(comparison.ekf.normalised_rmse), ratio(comparison.normalised_ratio)]
    rows.append(total)
    last = [] if comparison is None else [_ABOUT_THE_EKF]
    return "\n".join([_first_line(metrics), "", *aligned(rows), "", *_events(metrics), *last])


def _first_line(metrics: RunMetrics) -> str:
    return (
        f"{metrics.measurements} measurements, {metrics.estimates} estimates in "
        f"{metrics.duration:.1f} s; errors over the {metrics.settled_time:.1f} s that count as "
        "settled"
    )


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table: a head with a rule below it, two columns of text, numbers."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0]), row[1].ljust(widths[1])]
        cells += [cell.rjust(width) for cell, width in zip(row[2:], widths[2:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    rule = "─" * max(len(line) for line in lines)
    return [lines[0], rule, *lines[1:]]


def _events(metrics: RunMetrics) -> list[str]:
    lines = []
    judged = any(quantity.rmse is not None for quantity in metrics.quantities)
    for event in metrics.events if judged else ():
        if event.settled_after is not None:
            settled = f"errors settled after {event.settled_after:.2f} s"
        else:
            settled = "settling not seen"
        what = "start" if event.what == "start" else f"jump of {event.size:+.3g} rad"
        lines.append(f"{what} at {event.time:.2f} s: {settled}")
    if metrics.nis is not None:
        lines.append(f"innovations: mean square {metrics.nis:.3g} × what the design expects")
    return lines


def number(value: float | None) -> str:
    """Return a number with three digits."""
    return _NOTHING if value is None else f"{value:#.3g}"


def ratio(value: float | None) -> str:
    """Return a ratio with two decimals."""
    return _NOTHING if value is None else f"{value:.2f}"


def _percent(value: float | None) -> str:
    return _NOTHING if value is None else f"{100.0 * value:.1f} %"
