# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The figure of a run, drawn without any display and without matplotlib's global state."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from tsobs_ros.report.metrics import SIGMAS
from tsobs_ros.report.panels import (
    BAND_COLOUR,
    EVENT_COLOUR,
    SETTLING_COLOUR,
    STYLES,
    TIME,
    Picture,
    Plot,
)
from tsobs_ros.style import MUTED, STYLE

_WIDTH, _ROW, _HEAD, _DPI = 10.0, 1.6, 1.5, 140
_FAINT = 0.15
_JUMP: dict[str, Any] = {"color": EVENT_COLOUR, "lw": 1.0, "ls": (0, (2, 2))}
# The largest number of characters in a line of a label, and of a remark.
_LABEL_WIDTH, _REMARK_WIDTH = 20, 70


def draw_run(picture: Picture, path: Path) -> None:
    """Draw a run, 1400 pixels wide.

    Raises:
        OSError: The file cannot be written.
    """
    # Dollar signs in a name do not begin a formula.
    with matplotlib.rc_context({**STYLE, "text.parse_math": False}):
        _figure(picture).savefig(path, dpi=_DPI, metadata={"Software": None})


def _figure(picture: Picture) -> Figure:
    """Return the figure: values and errors side by side, then two plots per row."""
    pairs = [plot for row in picture.rows if len(row) == 2 for plot in row]
    singles = [row[0] for row in picture.rows if len(row) == 1]
    plots = [*pairs, *singles]
    rows = -(-len(plots) // 2)
    figure = Figure(figsize=(_WIDTH, _ROW * rows + _HEAD), layout="constrained")
    grid = figure.add_gridspec(rows, 2)
    made: list[Axes] = []
    for place, plot in enumerate(plots):
        row, column = divmod(place, 2)
        alone = column == 0 and plot is plots[-1]
        where = grid[row, :] if alone else grid[row, column]
        shared = made[0] if made else None
        made.append(figure.add_subplot(where, sharex=shared))
        _draw(made[-1], plot, picture)
        if row == rows - 1:
            made[-1].set_xlabel(TIME)
        else:
            made[-1].tick_params(labelbottom=False)
    made[0].xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10]))
    made[0].set_xlim(picture.time_range)
    figure.align_ylabels(made[::2])
    figure.align_ylabels(made[1::2])
    figure.legend(
        handles=_legend(picture),
        title=f"{picture.name}\n{picture.headline}",
        title_fontproperties={"weight": "bold", "size": 10},
        alignment="left",
        loc="outside upper left",
        ncols=8,
        handlelength=1.6,
        columnspacing=1.6,
    )
    return figure


def _legend(picture: Picture) -> list[Line2D | Patch]:
    drawn = {curve.name for plot in picture.plots for curve in plot.curves}
    entries: list[Line2D | Patch] = [
        Line2D([], [], color=style.colour, label=name, lw=style.width, ls=style.dash)
        if style.dash != "."
        else Line2D([], [], color=style.colour, label=name, ls="", marker="o", ms=3.5)
        for name, style in STYLES.items()
        if name in drawn
    ]
    bands = ((1.0, 2.0 * _FAINT), (SIGMAS, _FAINT)) if any(p.bands for p in picture.plots) else ()
    return [
        *entries,
        *(Patch(color=BAND_COLOUR, alpha=a, lw=0, label=f"bound {s:g}σ") for s, a in bands),
        *([Patch(color="#E4E7EB", lw=0, label="not counted")] if picture.unsettled else []),
        *([Line2D([], [], label="true jump", **_JUMP)] if picture.jumps else []),
    ]


def _draw(axes: Axes, plot: Plot, picture: Picture) -> None:
    axes.yaxis.set_major_locator(MaxNLocator(5, min_n_ticks=3))
    axes.tick_params(length=0)
    label = wrap(plot.title, _LABEL_WIDTH, max_lines=2, placeholder=" …")
    axes.set_ylabel("\n".join(label), linespacing=1.4)
    axes.set_ylim(plot.limits)
    remark = wrap("  ·  ".join(plot.remark), _REMARK_WIDTH, max_lines=2, placeholder=" …")
    axes.set_title("\n".join(remark), loc="left", fontsize=7.8, pad=4)
    for band in plot.bands:
        axes.fill_between(band.times, band.lower, band.upper, color=BAND_COLOUR, alpha=_FAINT, lw=0)
    for curve in plot.curves:
        colour, width, dash = curve.style
        look: dict[str, Any] = {"ls": dash, "lw": width, "solid_capstyle": "butt"}
        if dash == ".":
            look = {"ls": "", "marker": ".", "ms": 2.2, "mew": 0}
        axes.plot(curve.times, curve.values, color=colour, label=curve.name, **look)
    if plot.own:
        axes.legend(loc="upper left", fontsize=7.5, ncols=2, borderpad=0.1, handlelength=1.2)
    if plot.rows:
        axes.set_yticks(range(len(plot.rows)), plot.rows)
    for level in (-plot.level, plot.level) if plot.level else ():
        axes.axhline(level, color=MUTED, lw=0.9, ls=(0, (5, 3)))
    _mark(axes, picture.unsettled, color=SETTLING_COLOUR, zorder=0)
    _mark(axes, plot.spans, color=EVENT_COLOUR, alpha=_FAINT)
    whole = axes.get_xaxis_transform()
    axes.vlines(picture.jumps, 0.0, 1.0, transform=whole, zorder=6, **_JUMP)


def _mark(axes: Axes, spans: Sequence[tuple[float, float]], **style: Any) -> None:
    """Mark times over the whole height, by one artist: with many events, one each would be slow."""
    widths = [(begin, end - begin) for begin, end in spans]
    axes.broken_barh(widths, (0.0, 1.0), transform=axes.get_xaxis_transform(), lw=0, **style)
