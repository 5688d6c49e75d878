# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The figures of the method's Example 3: one noisy run, and x₃ by every observer."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from tsobs_ros.paper.comparison import WINDOW_START, Comparison
from tsobs_ros.paper.examples import example_3
from tsobs_ros.paper.style import (
    ESTIMATE,
    FOURTH,
    GREY,
    MUTED,
    SECOND,
    THIRD,
    TRUTH,
    label_time,
    legend,
    save_figure,
)

Panels = Sequence[Sequence[Axes]]

FIGURES = 5
"""Figures of Example 3."""

LABELS = {
    "PO": "PO",
    "PIO": "PIO",
    "paper": "paper's observer",
    "ours": "certified T–S observer",
    "EKF": "EKF",
    "EKF clean": "EKF without\nbias state",
}
COLOURS = {
    "PO": THIRD,
    "PIO": FOURTH,
    "paper": ESTIMATE,
    "ours": SECOND,
    "EKF": MUTED,
    "EKF clean": GREY,
}

_SHOWN = 20.0
_UNITS = ("x₁ [rad]", "x₂ [rad/s]", "x₃ [rad/s²]", "x₄ [rad/s³]")


def draw_arm(
    comparison: Comparison, folder: Path, advance: Callable[[], None] = lambda: None
) -> list[Path]:
    """Draw all figures of Example 3 and return their paths.

    Args:
        comparison: The runs.
        folder: Where to.
        advance: Called after each figure.
    """
    figures: tuple[tuple[str, str, Callable[[Comparison, Panels], None], int, int, float], ...] = (
        ("states", "states and the paper's observer with its printed gains", _states, 2, 2, 2.2),
        ("disturbance", "disturbance and its estimates", _disturbance, 2, 1, 2.0),
        ("memberships", "membership functions", _memberships, 1, 2, 2.3),
        ("x3", "x₃ by PO, PIO, the paper's observer and ours", _third_state, 2, 1, 2.3),
        ("rmse", "RMSE of x₃ and of all states, every run", _rmse, 1, 2, 2.6),
    )
    assert len(figures) == FIGURES
    paths = []
    for key, heading, fill, rows, columns, height in figures:
        paths.append(
            save_figure(
                folder / f"example_3_{key}.png",
                f"Example 3: {heading}",
                _filled(fill, comparison),
                rows=rows,
                columns=columns,
                row_height=height,
                share_x=key not in ("memberships", "rmse"),
            )
        )
        advance()
    return paths


def _filled(
    fill: Callable[[Comparison, Panels], None], comparison: Comparison
) -> Callable[[Panels], None]:
    return lambda axes: fill(comparison, axes)


def _states(comparison: Comparison, axes: Panels) -> None:
    times, truth = comparison.trajectories.times, comparison.trajectories.states[0]
    shown = times <= _SHOWN
    panels = [panel for row in axes for panel in row]
    for index, panel in enumerate(panels):
        panel.plot(times[shown], truth[shown, index], color=TRUTH, label="true")
        estimate = comparison["paper"].example[shown, index]
        panel.plot(times[shown], estimate, color=ESTIMATE, linestyle="--", label="estimate")
        panel.set_ylabel(_UNITS[index])
        panel.set_xlim(0.0, _SHOWN)
    legend(panels[0])
    label_time(axes)


def _disturbance(comparison: Comparison, axes: Panels) -> None:
    runs = comparison.trajectories
    shown = runs.times <= _SHOWN
    times = runs.times[shown]
    # The disturbance of this example is all of y − x₁, which is what is left of y for each.
    noise = (runs.measurements[0, :, 0] - runs.states[0, :, 0])[shown]
    for panels, name in zip(axes, ("paper", "ours"), strict=True):
        panel = panels[0]
        panel.plot(times, noise, color=TRUTH, linewidth=0.7, label="d = y − x₁")
        estimate = (runs.measurements[0, :, 0] - comparison[name].example[:, 0])[shown]
        panel.plot(
            times,
            estimate,
            color=COLOURS[name],
            linewidth=0.7,
            alpha=0.8,
            label=f"y − x\N{COMBINING CIRCUMFLEX ACCENT}₁, {LABELS[name]}",
        )
        panel.set_ylabel("d [rad]")
        panel.set_xlim(0.0, _SHOWN)
        legend(panel)
    label_time(axes)


def _memberships(comparison: Comparison, axes: Panels) -> None:
    over, along = axes[0]
    rule_base = example_3().system.rule_base
    angle = np.linspace(-np.pi / 2, np.pi / 2, 201)
    runs = comparison.trajectories
    shown = runs.times <= _SHOWN
    weights = rule_base.weights(angle[:, np.newaxis])
    history = rule_base.weights(runs.states[0][shown, :1])
    for rule, (colour, style) in enumerate(((TRUTH, "-"), (ESTIMATE, "--"))):
        label = f"h{'₁₂'[rule]}"
        over.plot(angle, weights[:, rule], color=colour, linestyle=style, label=label)
        along.plot(runs.times[shown], history[:, rule], color=colour, linestyle=style, label=label)
    over.set_title("over the link's angle", loc="left")
    over.set_xlabel("x₁ [rad]")
    along.set_title("along the first run", loc="left")
    along.set_xlabel("time [s]")
    along.set_xlim(0.0, _SHOWN)
    for panel in (over, along):
        panel.set_ylabel("weight")
    legend(over)
    legend(along)


def _third_state(comparison: Comparison, axes: Panels) -> None:
    runs = comparison.trajectories
    shown = runs.times <= _SHOWN
    times, truth = runs.times[shown], runs.states[0, shown, 2]
    above, below = axes[0][0], axes[1][0]
    above.plot(times, truth, color=TRUTH, label="true", linewidth=1.8)
    for each in comparison.observers:
        if each.name.startswith("EKF"):
            continue
        estimate = each.example[shown, 2]
        style = "--" if each.name == "paper" else "-"
        label = LABELS[each.name]
        above.plot(times, estimate, color=COLOURS[each.name], linestyle=style, label=label)
        below.plot(times, estimate - truth, color=COLOURS[each.name], linestyle=style, label=label)
    above.set_ylabel("x₃ [rad/s²]")
    below.set_ylabel("error of x₃")
    low = float(truth.min())
    above.set_ylim(1.6 * low, 1.6 * float(truth.max()))
    below.set_ylim(-3.0, 3.0)
    for panel in (above, below):
        panel.set_xlim(0.0, _SHOWN)
    legend(above, columns=5)
    label_time(axes)


def _rmse(comparison: Comparison, axes: Panels) -> None:
    names = [LABELS[each.name].replace(" observer", "\nobserver") for each in comparison.observers]
    for panel, values, title in (
        (axes[0][0], [each.motor_angle for each in comparison.observers], "x₃ [rad/s²]"),
        (axes[0][1], [each.normalised for each in comparison.observers], "all states, normalised"),
    ):
        for place, (each, run_values) in enumerate(zip(comparison.observers, values, strict=True)):
            spread = np.linspace(-0.18, 0.18, len(run_values))
            panel.semilogy(
                place + spread, run_values, "o", color=COLOURS[each.name], markersize=3.5
            )
            mean = float(run_values.mean())
            panel.hlines(mean, place - 0.32, place + 0.32, color=TRUTH, linewidth=1.4)
            panel.annotate(
                f"{mean:.3g}",
                (place, float(run_values.max())),
                xytext=(0, 6),
                textcoords="offset points",
                ha="center",
                color=TRUTH,
                fontsize=8.5,
            )
        panel.set_xticks(range(len(names)), names)
        panel.tick_params(axis="x", labelsize=7.5)
        panel.set_title(f"RMSE of {title}, {WINDOW_START:g} s to the end", loc="left")
        low, high = panel.get_ylim()
        panel.set_ylim(low, 2.0 * high)
