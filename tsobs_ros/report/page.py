# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A run as an interactive page: the figure's panels, to zoom into and to read values from."""

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from tsobs_ros.checks import Array
from tsobs_ros.report import panels as content
from tsobs_ros.report.metrics import SIGMAS, RunMetrics
from tsobs_ros.report.panels import MAX_BAND, Panel
from tsobs_ros.report.run import RecordedRun
from tsobs_ros.style import INK, MUTED

_ROW = 210
_HEAD = 130
_CELL: dict[str, Any] = {}


def write_html(
    run: RecordedRun, metrics: RunMetrics, path: Path, innovation_std: float | None = None
) -> None:
    """Write a page that needs nothing but itself: no network, no second file.

    plotly.js is inlined, which is most of the page's 6 MB: with a script beside it, a page that is
    sent or moved alone would be blank.

    Args:
        run: The recorded run, with or without truth.
        metrics: Its metrics.
        path: The page; it is replaced.
        innovation_std: 1σ the design expects of an innovation [rad]; None if unknown.

    Raises:
        OSError: The page cannot be written.
    """
    shown = content.panels(run, metrics, innovation_std)
    figure = _figure(run, metrics, shown)
    text = figure.to_html(
        include_plotlyjs=True,
        full_html=True,
        div_id="run",  # a random one would make each page of the same run another
        config={"displaylogo": False, "responsive": True},
    )
    title = f"<head><title>{html.escape(run.name)}</title>"
    path.write_text(text.replace("<head>", title, 1), encoding="utf-8")


def _figure(run: RecordedRun, metrics: RunMetrics, panels: Sequence[Panel]) -> Any:
    rows_with_error = [row for row, panel in enumerate(panels, 1) if panel.error is not None]
    rows = range(1, len(panels) + 1)
    columns = 2 if rows_with_error else 1
    figure = make_subplots(
        rows=len(rows),
        cols=columns,
        # No empty plot beside a panel that has no error.
        specs=[[_CELL, _CELL if row in rows_with_error else None][:columns] for row in rows],
        column_widths=[0.6, 0.4][:columns],
        vertical_spacing=0.035,
        horizontal_spacing=0.08,
    )
    for row, panel in enumerate(panels, start=1):
        _add_values(figure, panel, row)
        if panel.error is not None:
            _add_error(figure, panel, row)
    _mark_events(figure, run, metrics)
    figure.update_layout(
        template="plotly_white",
        height=_HEAD + _ROW * len(panels),
        margin={"l": 80, "r": 30, "t": _HEAD, "b": 50},
        font={"color": INK, "size": 12},
        title={
            "text": f"<b>{html.escape(run.name)}</b><br><span style='font-size:13px;"
            f"color:{MUTED}'>{content.headline(run, metrics)}</span>",
            "x": 0.01,
            "xanchor": "left",
        },
        legend={"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0.0},
        hovermode="x",
    )
    # All follow the first, so that zooming into one zooms into all.
    figure.update_xaxes(
        range=content.time_range(run), matches="x", showticklabels=False, showspikes=True
    )
    for row, column in [(rows[-1], 1), *([(rows_with_error[-1], 2)] if rows_with_error else [])]:
        figure.update_xaxes(
            title_text="time since the first sample [s]", showticklabels=True, row=row, col=column
        )
    return figure


def _add_values(figure: Any, panel: Panel, row: int) -> None:
    if panel.estimate is not None and panel.bound is not None:
        _add_bound(figure, panel.estimate.times, panel.estimate.values, panel.bound, row, 1)
    if panel.dots is not None:
        _add(
            figure,
            "measured" if panel.truth or panel.estimate else panel.title,
            panel.dots.times,
            panel.dots.values,
            (row, 1),
            mode="markers",
            marker={"size": 2.5, "color": content.MEASUREMENT_COLOUR},
        )
    if panel.truth is not None:
        line = {"color": content.TRUTH_COLOUR, "width": 4}
        _add(figure, "true", panel.truth.times, panel.truth.values, (row, 1), line=line)
    if panel.estimate is not None:
        line = {"color": content.ESTIMATE_COLOUR, "width": 1.5}
        _add(figure, "estimated", *panel.estimate, (row, 1), line=line)
    if panel.level is not None:
        for sign in (-1.0, 1.0):
            figure.add_hline(
                sign * panel.level[0],
                row=row,
                col=1,
                line={"color": MUTED, "dash": "dash", "width": 1},
            )
    figure.update_yaxes(
        title_text=f"{panel.title}<br>[{panel.unit}]", range=panel.limits, row=row, col=1
    )


def _add_error(figure: Any, panel: Panel, row: int) -> None:
    assert panel.estimate is not None
    assert panel.error is not None
    times = panel.estimate.times
    if panel.bound is not None:
        _add_bound(figure, times, np.zeros(len(times)), panel.bound, row, 2)
    line = {"color": content.ESTIMATE_COLOUR, "width": 1.2}
    _add(figure, "error", times, panel.error, (row, 2), line=line)
    figure.update_yaxes(
        title_text=f"error<br>[{panel.unit}]",
        range=[-panel.max_error, panel.max_error],
        row=row,
        col=2,
    )
    figure.add_annotation(
        text="  ·  ".join(panel.remark),
        x=0.0,
        y=1.0,
        xref="x domain",
        yref="y domain",
        xanchor="left",
        yanchor="bottom",
        showarrow=False,
        row=row,
        col=2,
        font={"size": 11},
    )


def _add_bound(
    figure: Any, times: Array, centre: Array, bound: Array, row: int, column: int
) -> None:
    step = -(-len(times) // MAX_BAND)
    times, centre, bound = times[::step], centre[::step], bound[::step]
    known = np.isfinite(centre) & np.isfinite(bound)
    times, centre, bound = times[known], centre[known], bound[known]
    for sigmas in (SIGMAS, 1.0):
        edge = np.concatenate([centre + sigmas * bound, (centre - sigmas * bound)[::-1]])
        _add(
            figure,
            f"bound {sigmas:g}σ",
            np.concatenate([times, times[::-1]]),
            edge,
            (row, column),
            fill="toself",
            fillcolor="rgba(0, 114, 178, 0.15)",
            line={"width": 0},
            mode="lines",
            hoverinfo="skip",
        )


def _add(
    figure: Any, name: str, times: Array, values: Array, place: tuple[int, int], **style: Any
) -> None:
    """Add a curve; one of each name is in the legend and switches all of that name."""
    known = {trace.name for trace in figure.data}
    style.setdefault("mode", "lines")
    # A tenth of a millisecond and single precision are finer than any screen.
    trace = go.Scatter(
        x=np.round(times, 4).astype(np.float32),
        y=values.astype(np.float32),
        name=name,
        legendgroup=name,
        showlegend=name not in known and name not in ("error", "innovation"),
        **style,
    )
    figure.add_trace(trace, row=place[0], col=place[1])


def _mark_events(figure: Any, run: RecordedRun, metrics: RunMetrics) -> None:
    for begin, end in content.settling_spans(run, metrics):
        figure.add_vrect(
            begin, end, fillcolor=content.SETTLING_COLOUR, opacity=1.0, line_width=0, layer="below"
        )
    for event in metrics.events:
        if event.what == "jump":
            line = {"color": content.EVENT_COLOUR, "dash": "dot", "width": 1}
            figure.add_vline(event.time, line=line)
