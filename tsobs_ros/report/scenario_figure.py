# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of observers on simulated scenarios as one picture, a row of points for each scenario."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from tsobs_ros.report.comparison import number_text
from tsobs_ros.report.scenario_table import BOUNDS
from tsobs_ros.style import INK, MUTED, STYLE

_MARKERS = {
    "certified": ("o", "#00798C"),
    "certified_fixed": ("o", "#8CC7D0"),
    "ekf_plain": ("^", "#F2C572"),
    "ekf": ("^", "#C98A12"),
    "ekf_augmented": ("v", "#8A5A00"),
    "high_gain": ("s", "#9AA5B1"),
    "proportional_integral": ("s", "#52606D"),
    "paper": ("X", "#D1495B"),
}
"""Shape and colour of each observer; families differ in shape, so that no reader needs colours."""

_WIDTH, _ROW, _FRAME, _DPI = 10.0, 0.9, 1.75, 140
_FEWEST, _MOST = 10.0, 90.0
# One that diverged must not squeeze the others into a corner.
_LARGEST = 3.0


def draw_comparison(comparison: Mapping[str, Any], path: Path) -> None:
    """Draw the normalised RMSE of all observers on all scenarios, 1400 pixels wide as PNG.

    Raises:
        OSError: The file cannot be written.
    """
    scenarios = comparison["scenarios"]
    observers = [name for name in comparison["observers"] if name not in BOUNDS]
    count = len(scenarios)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(_WIDTH, _FRAME + _ROW * count), layout="constrained")
        axes = figure.subplots()
        places = np.arange(len(observers)) + 0.5
        heights = 0.72 * (places / len(observers) - 0.5)
        for name, height in zip(observers, heights.tolist(), strict=True):
            marker, colour = _MARKERS[name]
            axes.plot([], [], marker, color=colour, label=name)
            for number, row in enumerate(scenarios.values()):
                error = row[name]["normalised_rmse"]
                if error is None or not error <= _LARGEST:
                    axes.text(
                        0.995, number + height, f"{name}: {number_text(error)} →",
                        transform=axes.get_yaxis_transform(), ha="right", va="center",
                        fontsize=7.5, color=MUTED,
                    )  # fmt: skip
                    continue
                each = [float(one or 0.0) for one in row[name]["normalised_rmse_of_runs"]]
                reach = np.percentile(each, (_FEWEST, _MOST))
                axes.plot(reach, [number + height] * 2, color=colour, linewidth=1.4)
                axes.plot(
                    [error], [number + height], marker, color=colour, markersize=6.5,
                    markeredgecolor="white", markeredgewidth=0.6,
                )  # fmt: skip
        for name, style in zip(BOUNDS, (":", "-"), strict=True):
            axes.plot([], [], color=INK, linestyle=style, linewidth=1.6, label=name)
            for number, row in enumerate(scenarios.values()):
                if (least := row.get(name, {}).get("normalised_rmse")) is not None:
                    ends = [number - 0.42, number + 0.42]
                    axes.plot([least] * 2, ends, color=INK, linestyle=style, linewidth=1.6)
        axes.set_yticks(range(count), list(scenarios))
        axes.set_ylim(count - 0.5, -0.5)
        axes.set_yticks(np.arange(0.5, count - 1), minor=True)
        axes.grid(visible=False, axis="y", which="major")
        axes.grid(visible=True, axis="y", which="minor", color="#C4C9D0")
        axes.tick_params(axis="y", length=0, which="both", labelcolor=INK, labelsize=10)
        axes.set_xscale("log")
        axes.set_xlim(right=min(axes.get_xlim()[1], _LARGEST))
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(
            f"normalised RMSE of all states: root mean square over {comparison['seeds']} runs, "
            f"{_FEWEST:g} to {_MOST:g} % of the runs"
        )
        figure.suptitle(
            "Errors of all observers; none that is unbiased can be left of the lines",
            fontsize=12.0, fontweight="bold", x=0.01, ha="left",
        )  # fmt: skip
        figure.legend(loc="outside lower left", ncols=6, fontsize=9)
        figure.savefig(path, dpi=_DPI, metadata={"Software": None})
