# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A run as one picture, drawn without any display and without matplotlib's global state."""

import gc
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from tsobs_ros.report import panels as content
from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.report.panels import ERROR, TIME, Panel, Picture, Plot
from tsobs_ros.style import MUTED, STYLE

_WIDTH = 10.0
_DPI = 140
_TALL, _FLAT = 1.72, 1.35
_TOP, _BOTTOM = 1.0, 0.52
_LEFT, _MARGIN = 0.092, 0.01
"""Shares of the width: left of the panels, and at least left of their labels."""
_FAINT, _STRONG = 0.13, 0.32
_JUMPS = {"jump": "fault {:+.2g} rad", "step": "torque {:+.2g} N m"}
_LABEL_WIDTH = 20


def draw_run(picture: Picture, *paths: Path) -> None:
    """Draw a run, 1400 pixels wide as PNG.

    Args:
        picture: What is shown.
        paths: Its files, `.png`, `.pdf` or `.svg`; they are replaced.

    Raises:
        OSError: A file cannot be written.
    """
    with matplotlib.rc_context(STYLE):
        figure = _figure(picture)
        for path in paths:
            # Without the date the same run gives the same file.
            metadata = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(path.suffix)
            figure.savefig(path, dpi=_DPI, metadata=metadata or {})
        del figure
    # Its parts refer to each other, and would else stay as long as the page needs memory.
    gc.collect()


def _figure(picture: Picture) -> Figure:
    # Those of another axis than time below the others.
    panels = sorted(picture.panels, key=lambda panel: panel.values.axis != TIME)
    last_of_time = sum(panel.values.axis == TIME for panel in panels) - 1
    with_errors = any(panel.error is not None for panel in panels)
    heights = [_TALL if panel.values.estimate else _FLAT for panel in panels]
    height = sum(heights) + _TOP + _BOTTOM
    figure = Figure(figsize=(_WIDTH, height))
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        len(panels),
        2,
        width_ratios=[1.45, 1.0] if with_errors else [4.6, 1.0],
        height_ratios=heights,
        left=_LEFT,
        right=0.985,
        top=1.0 - _TOP / height,
        bottom=_BOTTOM / height,
        hspace=0.3 if with_errors else 0.16,
        wspace=0.27 if with_errors else 0.02,
    )
    left: list[Axes] = []
    right: list[Axes] = []
    for row, panel in enumerate(panels):
        follows = left and panel.values.axis == TIME
        left.append(figure.add_subplot(grid[row, 0], sharex=left[0] if follows else None))
        _draw(left[-1], panel.values, panel.unit)
        if panel.error is None:
            _write_beside(left[-1], panel)
        else:
            right.append(figure.add_subplot(grid[row, 1], sharex=left[0]))
            _draw(right[-1], panel.error, panel.unit)
            right[-1].set_title("  ·  ".join(panel.remark), loc="left", fontsize=7.8, pad=5)
    for column in (left[: last_of_time + 1], right):
        for axes in column:
            _mark_events(axes, picture)
            axes.tick_params(labelbottom=axes is column[-1])
        if column:
            column[-1].set_xlabel(TIME)
    for axes, panel in zip(left, panels, strict=True):
        if panel.values.axis != TIME:
            axes.set_xlabel(panel.values.axis)
    left[0].xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10]))
    left[0].set_xlim(picture.time_range)
    _label_jumps(left[0], picture)
    figure.align_ylabels(left)
    figure.align_ylabels(right)
    # Numbers of many digits push the labels outwards.
    figure.draw_without_rendering()
    outermost = min(axes.yaxis.label.get_window_extent().x0 for axes in left)
    lacking = _MARGIN - outermost / float(figure.bbox.width)
    grid.update(left=_LEFT + max(lacking, 0.0))
    for axes in (*left, *right):
        place = axes.get_subplotspec()
        if place is not None:
            axes.set_position(place.get_position(figure))
    _head(figure, picture, height)
    return figure


def _head(figure: Figure, picture: Picture, height: float) -> None:
    def at(inches: float) -> float:
        return 1.0 - inches / height

    # A name is no formula.
    figure.text(
        0.02, at(0.14), picture.name, fontsize=13, fontweight="bold", va="top", parse_math=False
    )
    figure.text(0.02, at(0.40), picture.headline, fontsize=9, color=MUTED, va="top")
    figure.legend(
        handles=_legend(picture),
        loc="upper left",
        bbox_to_anchor=(0.013, at(0.58)),
        ncols=7,
        handlelength=1.6,
        columnspacing=1.6,
        borderpad=0.0,
    )


def _legend(picture: Picture) -> list[Line2D | Patch]:
    entries: list[Line2D | Patch] = [
        Line2D(
            [], [], marker="o", ls="", ms=3.5, color=content.MEASUREMENT_COLOUR, label="measured"
        )
    ]
    if picture.has_truth:
        entries.append(Line2D([], [], color=content.TRUTH_COLOUR, lw=3.0, label="true"))
    blue = content.ESTIMATE_COLOUR
    if any(panel.values.rival is not None for panel in picture.panels):
        entries.append(Line2D([], [], color=content.RIVAL_COLOUR, lw=1.3, ls=":", label="EKF"))
    return [
        *entries,
        Line2D([], [], color=blue, lw=1.3, label="estimated"),
        Patch(color=blue, alpha=_STRONG, lw=0, label="bound 1σ"),
        Patch(color=blue, alpha=_FAINT, lw=0, label=f"bound {SIGMAS:g}σ"),
        Patch(color="#E4E7EB", lw=0, label="not counted"),
    ]


def _draw(axes: Axes, plot: Plot, unit: str) -> None:
    axes.yaxis.set_major_locator(MaxNLocator(5, min_n_ticks=3))
    axes.tick_params(length=0)
    axes.set_ylabel(_label(plot.label, unit), linespacing=1.4)
    axes.set_ylim(plot.limits)
    if plot.dots is not None:
        # Thousands of dots as vectors would make an SVG slow and large.
        axes.plot(
            *plot.dots,
            "-" if plot.dense else ".",
            lw=0.5,
            ms=2.2,
            mew=0,
            color=content.MEASUREMENT_COLOUR,
            alpha=0.6,
            zorder=2,
            rasterized=True,
        )
    if plot.truth is not None:
        axes.plot(*plot.truth, color=content.TRUTH_COLOUR, lw=3.0, zorder=3)
    blue = content.ESTIMATE_COLOUR
    for sigmas, times, lower, upper in plot.bands or ():
        alpha = _STRONG - _FAINT if sigmas == 1.0 else _FAINT
        axes.fill_between(times, lower, upper, color=blue, alpha=alpha, lw=0, zorder=4)
    if plot.label == ERROR:
        axes.axhline(0.0, color=content.TRUTH_COLOUR, lw=1.6, zorder=4)
    if plot.estimate is not None:
        axes.plot(*plot.estimate, color=blue, lw=1.0, zorder=5)
    if plot.rival is not None:
        axes.plot(*plot.rival, color=content.RIVAL_COLOUR, lw=0.9, ls=":", zorder=4)
    for line in plot.lines:
        axes.plot(*line.curve, color=line.colour, lw=1.0, label=line.name, zorder=4)
    if len(plot.lines) > 1:
        axes.legend(loc="upper left", fontsize=7.5, ncols=4, borderpad=0.1, handlelength=1.2)
    names = list(dict.fromkeys(strip.name for strip in plot.strips))
    for level in sorted({strip.level for strip in plot.strips}):
        own = [strip for strip in plot.strips if strip.level == level]
        places = [names.index(strip.name) for strip in own]
        colour = content.LEVEL_COLOURS.get(level, content.EVENT_COLOUR)
        begins, ends = [strip.begin for strip in own], [strip.end for strip in own]
        axes.hlines(places, begins, ends, color=colour, lw=9)
    if names:
        axes.set_yticks(range(len(names)), [_plain(name) for name in names])
    if plot.other is not None:
        axes.plot(*plot.other[0], color=MUTED, lw=1.0, ls=(0, (5, 3)), zorder=4)
    _mark_spans(axes, plot.spans, color=content.EVENT_COLOUR, alpha=_FAINT, zorder=1)
    if plot.level is not None:
        for sign in (-1.0, 1.0):
            axes.axhline(sign * plot.level[0], color=MUTED, lw=0.9, ls=(0, (5, 3)), zorder=4)


def _plain(name: str) -> str:
    """Return a name that is no formula."""
    return name.replace("$", r"\$")


def _label(name: str, unit: str) -> str:
    """Return an axis label of two lines at most, for which there is room."""
    if len(name) < _LABEL_WIDTH:
        return f"{name}\n[{unit}]" if unit else name
    text = f"{name} [{unit}]" if unit else name
    return "\n".join(wrap(text, _LABEL_WIDTH, max_lines=2, placeholder=" …"))


def _write_beside(axes: Axes, panel: Panel) -> None:
    lines = list(panel.remark)
    for dashed in (panel.values.level, panel.values.other):
        if dashed is not None:
            lines.insert(0, f"– – {dashed[1]}")
    axes.text(
        1.02,
        0.5,
        "\n".join(lines),
        transform=axes.transAxes,
        va="center",
        fontsize=8.5,
        linespacing=1.55,
    )


def _mark_events(axes: Axes, picture: Picture) -> None:
    _mark_spans(axes, picture.unsettled, color=content.SETTLING_COLOUR, zorder=0)
    jumps = [event.time for event in picture.events if event.what != "start"]
    whole = axes.get_xaxis_transform()
    axes.vlines(
        jumps,
        0.0,
        1.0,
        transform=whole,
        color=content.EVENT_COLOUR,
        lw=1.0,
        ls=(0, (2, 2)),
        zorder=6,
    )


def _mark_spans(axes: Axes, spans: Sequence[tuple[float, float]], **style: Any) -> None:
    """Mark times over the whole height, as one artist: one each would make many events slow."""
    widths = [(begin, end - begin) for begin, end in spans]
    axes.broken_barh(widths, (0.0, 1.0), transform=axes.get_xaxis_transform(), lw=0, **style)


def _label_jumps(axes: Axes, picture: Picture) -> None:
    begin, end = axes.get_xlim()
    last = -np.inf
    for event in picture.events:
        # A label is up to 40 % wide, and must not cover the one before it.
        if event.what == "start" or event.time - last < 0.4 * (end - begin):
            continue
        last, after = event.time, event.settled_after
        late = event.time > 0.5 * (begin + end)
        settled = "" if after is None else f", settled after {after:.2g} s"
        axes.annotate(
            f"{_JUMPS[event.what].format(event.size)}{settled}",
            (event.time, 1.0),
            xycoords=axes.get_xaxis_transform(),
            xytext=(-4 if late else 4, 3),
            textcoords="offset points",
            ha="right" if late else "left",
            fontsize=8.5,
            color=content.EVENT_COLOUR,
        )
