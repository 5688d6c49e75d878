# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How the figures of the method's examples look: one style, no display, no global state."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

INK, MUTED, GREY, GRID = "#1F2933", "#52606D", "#9AA5B1", "#E3E6EA"
TRUTH, ESTIMATE, SECOND, THIRD, FOURTH = "#1F2933", "#D1495B", "#00798C", "#EDAE49", "#7A5195"
LIGHT = "#8CC7D0"

_DPI = 130
_WIDTH = 9.6
_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.edgecolor": "#C4C9D0",
    "axes.linewidth": 0.8,
    "axes.labelcolor": INK,
    "axes.titlesize": 9.5,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.3,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
}

Draw = Callable[[Sequence[Sequence[Axes]]], None]
"""Fills the panels, [row][column]."""


def save_figure(
    path: Path,
    title: str,
    draw: Draw,
    *,
    rows: int = 1,
    columns: int = 1,
    row_height: float = 1.75,
    share_x: bool = True,
) -> Path:
    """Draw and save a grid of panels as PNG.

    Args:
        path: The file; it is replaced.
        title: Above the panels.
        draw: Fills them.
        rows: Number of rows of panels.
        columns: Number of columns.
        row_height: [inch].
        share_x: Whether the panels of a column share their x axis.

    Returns:
        The path.

    Raises:
        OSError: The file cannot be written.
    """
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH, 0.95 + rows * row_height), layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title, fontsize=11.0, fontweight="bold", x=0.01, ha="left")
        axes = figure.subplots(rows, columns, sharex="col" if share_x else "none", squeeze=False)
        draw(axes.tolist())
        figure.savefig(path, dpi=_DPI, metadata={"Software": None})
    return path


def label_time(axes: Sequence[Sequence[Axes]]) -> None:
    """Write the time axis under the lowest panels."""
    for panel in axes[-1]:
        panel.set_xlabel("time [s]")


def legend(panel: Axes, *, columns: int = 2) -> None:
    """Put a legend into a panel's upper right, with head room so that it covers no line."""
    low, high = panel.get_ylim()
    panel.set_ylim(low, high + 0.22 * (high - low))
    panel.legend(
        ncols=columns, loc="upper right", borderaxespad=0.2, handlelength=1.8, columnspacing=1.2
    )
