# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A run as an interactive page: the figure's panels, to zoom into and to read values from."""

import html
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from tsobs_ros.checks import Array
from tsobs_ros.report import panels as content
from tsobs_ros.report.panels import ERROR, Picture, Plot
from tsobs_ros.style import INK, MUTED

_ROW = 210
_HEAD = 130
_PIECE = 2**16
_LABEL_WIDTH = 24
_CELL: dict[str, Any] = {}


def write_html(picture: Picture, path: Path) -> None:
    """Write a page that needs nothing but itself: no network, no second file.

    plotly.js is inlined, which is most of the page's 6 MB: with a script beside it, a page that is
    sent or moved alone would be blank.

    Args:
        picture: What is shown.
        path: The page; it is replaced.

    Raises:
        OSError: The page cannot be written.
    """
    with path.open("w", encoding="utf-8") as page:
        page.write(f"<html>\n<head><title>{html.escape(picture.name)}</title>")
        page.write('<meta charset="utf-8" /></head>\n<body>\n<script>')
        # In pieces, and before there is a figure: together they would take several times as much.
        script = get_plotlyjs()
        for begin in range(0, len(script), _PIECE):
            page.write(script[begin : begin + _PIECE])
        del script
        page.write("</script>\n")
        page.write(
            _figure(picture).to_html(
                include_plotlyjs=False,
                full_html=False,
                div_id="run",  # a random one would make each page of the same run another
                config={"displaylogo": False, "responsive": True},
            )
        )
        page.write("\n</body>\n</html>\n")


def _figure(picture: Picture) -> Any:
    panels = picture.panels
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
        _add_plot(figure, panel.values, panel.unit, (row, 1))
        if panel.error is not None:
            _add_plot(figure, panel.error, panel.unit, (row, 2))
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
    _mark_events(figure, picture)
    figure.update_layout(
        template="plotly_white",
        height=_HEAD + _ROW * len(panels),
        margin={"l": 80, "r": 30, "t": _HEAD, "b": 50},
        font={"color": INK, "size": 12},
        title={
            "text": f"<b>{html.escape(picture.name)}</b><br><span style='font-size:13px;"
            f"color:{MUTED}'>{picture.headline}</span>",
            "x": 0.01,
            "xanchor": "left",
        },
        legend={"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0.0},
        hovermode="x",
    )
    # All follow the first, so that zooming into one zooms into all.
    figure.update_xaxes(
        range=picture.time_range, matches="x", showticklabels=False, showspikes=True
    )
    for row, column in [(rows[-1], 1), *([(rows_with_error[-1], 2)] if rows_with_error else [])]:
        figure.update_xaxes(
            title_text="time since the first sample [s]", showticklabels=True, row=row, col=column
        )
    return figure


def _add_plot(figure: Any, plot: Plot, unit: str, place: tuple[int, int]) -> None:
    row, column = place
    for sigmas, times, lower, upper in plot.bands or ():
        known = np.isfinite(lower)
        times, lower, upper = times[known], lower[known], upper[known]
        _add(
            figure,
            f"bound {sigmas:g}σ",
            np.concatenate([times, times[::-1]]),
            np.concatenate([upper, lower[::-1]]),
            place,
            fill="toself",
            fillcolor="rgba(0, 114, 178, 0.15)",
            line={"width": 0},
            hoverinfo="skip",
        )
    if plot.dots is not None:
        name = plot.label if plot.estimate is None else "measured"
        dot = {"size": 2.5, "color": content.MEASUREMENT_COLOUR}
        _add(figure, name, *plot.dots, place, mode="markers", marker=dot)
    if plot.truth is not None:
        line = {"color": content.TRUTH_COLOUR, "width": 4}
        _add(figure, "true", *plot.truth, place, line=line)
    if plot.estimate is not None:
        name = ERROR if plot.label == ERROR else "estimated"
        line = {"color": content.ESTIMATE_COLOUR, "width": 1.5}
        _add(figure, name, *plot.estimate, place, line=line)
    if plot.other is not None:
        curve, name = plot.other
        _add(figure, name, *curve, place, line={"color": MUTED, "dash": "dash", "width": 1})
    for begin, end in plot.spans:
        figure.add_vrect(
            begin, end, fillcolor=content.EVENT_COLOUR, opacity=0.15, line_width=0,
            layer="below", row=row, col=column,
        )  # fmt: skip
    if plot.level is not None:
        line = {"color": MUTED, "dash": "dash", "width": 1}
        for sign in (-1.0, 1.0):
            figure.add_hline(sign * plot.level[0], row=row, col=column, line=line)
    title = "<br>".join([*wrap(plot.label, _LABEL_WIDTH), *([f"[{unit}]"] if unit else [])])
    figure.update_yaxes(title_text=title, range=plot.limits, row=row, col=column)


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
        showlegend=name not in known and name != ERROR and not name.startswith("innovation"),
        **style,
    )
    figure.add_trace(trace, row=place[0], col=place[1])


def _mark_events(figure: Any, picture: Picture) -> None:
    for begin, end in picture.unsettled:
        figure.add_vrect(
            begin, end, fillcolor=content.SETTLING_COLOUR, opacity=1.0, line_width=0, layer="below"
        )
    for event in picture.events:
        if event.what != "start":
            line = {"color": content.EVENT_COLOUR, "dash": "dot", "width": 1}
            figure.add_vline(event.time, line=line)
