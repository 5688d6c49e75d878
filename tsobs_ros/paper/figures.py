# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The figures of the method's Examples 1 and 2, laid out as in the paper, and two it lacks."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from tsobs_ros.checks import Array
from tsobs_ros.paper.runs import SETTLED, ExampleRun
from tsobs_ros.paper.style import (
    ESTIMATE,
    FOURTH,
    LIGHT,
    MUTED,
    SECOND,
    THIRD,
    TRUTH,
    label_time,
    legend,
    save_figure,
)

Panels = Sequence[Sequence[Axes]]

FIGURES = 6
"""Figures of an example."""

_CASES = ("λ = 0: no uncertainty", "λ = 1: with the printed ΔA")
_FLOOR = 1e-17
_INNOVATION_SHOWN = 2.5


class _Figure(NamedTuple):
    key: str
    heading: str
    fill: Callable[[ExampleRun, Panels], None]
    rows: int
    columns: int = 2
    row_height: float = 2.3
    share_x: bool = True


def draw_example(
    run: ExampleRun, folder: Path, advance: Callable[[], None] = lambda: None
) -> list[Path]:
    """Draw all figures of Example 1 or 2 and return their paths.

    Args:
        run: The example's run.
        folder: Where to.
        advance: Called after each figure.
    """
    name = run.example.name
    key, what = ("faults", "sensor faults") if _faults(run) else ("disturbances", "disturbances")
    figures = (
        _Figure("states", "states and their estimates", _states, 3, row_height=1.7),
        _Figure(key, f"{what} and their estimates", _disturbances, 3, row_height=1.7),
        _Figure("errors", "estimation errors", _errors, 2),
        _Figure("memberships", "membership functions", _memberships, 1, share_x=False),
        _Figure(
            "innovation",
            "the innovation does not hear the plant (not in the paper)",
            _innovation,
            1,
            row_height=2.7,
        ),
        _Figure(
            "noise_fed",
            "the output replaced by white noise (not in the paper), λ = 0",
            _noise_fed,
            3,
            columns=1,
            row_height=1.7,
        ),
    )
    assert len(figures) == FIGURES
    paths = []
    for figure in figures:
        path = folder / f"{name}_{figure.key}.png"
        paths.append(
            save_figure(
                path,
                f"Example {name[-1]}: {figure.heading}",
                _filled(figure, run),
                rows=figure.rows,
                columns=figure.columns,
                row_height=figure.row_height,
                share_x=figure.share_x,
            )
        )
        advance()
    return paths


def _filled(figure: _Figure, run: ExampleRun) -> Callable[[Panels], None]:
    return lambda axes: figure.fill(run, axes)


def _faults(run: ExampleRun) -> bool:
    return run.example.name == "example_2"


def _signal(run: ExampleRun, index: int) -> str:
    return f"f{_low(index)}" if _faults(run) else f"ω{_low(index)}"


def _low(index: int) -> str:
    return "₁₂₃₄"[index]


def _hat(text: str) -> str:
    return f"{text[0]}\N{COMBINING CIRCUMFLEX ACCENT}{text[1:]}"


def _states(run: ExampleRun, axes: Panels) -> None:
    names = [f"x{_low(row)}" for row in range(3)]
    truth = run.plant.states.transpose(1, 0, 2)
    _pairs(run, axes, names, truth, run.estimates["adaptive"].states)


def _disturbances(run: ExampleRun, axes: Panels) -> None:
    names = [_signal(run, row) for row in range(3)]
    truth = np.repeat(run.plant.disturbance[np.newaxis], 2, axis=0)
    _pairs(run, axes, names, truth, run.estimates["adaptive"].disturbance)


def _pairs(
    run: ExampleRun, axes: Panels, names: Sequence[str], truth: Array, estimates: Array
) -> None:
    times = run.plant.times
    for row, name in enumerate(names):
        for case, panel in enumerate(axes[row]):
            panel.plot(times, truth[case, :, row], color=TRUTH, label=name)
            estimate = estimates[:, case, row]
            panel.plot(times, estimate, color=ESTIMATE, linestyle="--", label=_hat(name))
            panel.set_ylabel(name)
            panel.set_xlim(times[0], times[-1])
            if row == 0:
                panel.set_title(_CASES[case], loc="left")
            if case == 0:
                legend(panel)
    label_time(axes)


def _errors(run: ExampleRun, axes: Panels) -> None:
    times = run.plant.times
    rows = (
        ("x − x\N{COMBINING CIRCUMFLEX ACCENT}", "x", run.state_error("adaptive")),
        (
            "f − f\N{COMBINING CIRCUMFLEX ACCENT}"
            if _faults(run)
            else "ω − ω\N{COMBINING CIRCUMFLEX ACCENT}",
            "f" if _faults(run) else "ω",
            run.disturbance_error("adaptive"),
        ),
    )
    for (label, letter, error), panels in zip(rows, axes, strict=True):
        for case, panel in enumerate(panels):
            for index, colour in enumerate((TRUTH, ESTIMATE, SECOND)):
                name = f"{letter}{_low(index)}"
                panel.plot(times, error[:, case, index], color=colour, label=name, linewidth=1.1)
            settled = float(np.abs(error[times >= SETTLED, case]).max())
            panel.text(
                0.98,
                0.74,
                f"largest from {SETTLED:g} s on: {settled:.1e}",
                transform=panel.transAxes,
                ha="right",
                color=MUTED,
            )
            panel.set_ylabel(label)
            panel.set_xlim(times[0], times[-1])
            if letter == "x":
                panel.set_title(_CASES[case], loc="left")
            legend(panel, columns=3)
    label_time(axes)


def _memberships(run: ExampleRun, axes: Panels) -> None:
    over, along = axes[0]
    z = np.linspace(-1.0, 1.0, 201)
    weights = run.example.system.rule_base.weights(z[:, np.newaxis])
    styles = ((TRUTH, "-"), (ESTIMATE, "--"))
    for rule, (colour, style) in enumerate(styles):
        label = f"h{_low(rule)}"
        over.plot(z, weights[:, rule], color=colour, linestyle=style, label=label)
        along.plot(
            run.plant.times,
            run.plant.weights[:, 0, rule],
            color=colour,
            linestyle=style,
            label=label,
        )
    over.set_title("over the premise variable", loc="left")
    over.set_xlabel("y₁")
    along.set_title("along the run, λ = 0", loc="left")
    along.set_xlabel("time [s]")
    along.set_xlim(run.plant.times[0], run.plant.times[-1])
    for panel in (over, along):
        panel.set_ylabel("weight")
        legend(panel)


def _innovation(run: ExampleRun, axes: Panels) -> None:
    times = run.plant.times
    lines = (
        ("fixed", 0, "fed with y", SECOND, "-", 3.2),
        ("fixed", 1, "fed with y, plant with ΔA", THIRD, "--", 2.0),
        ("noise_fed", 0, "fed with white noise", ESTIMATE, ":", 2.0),
    )
    left, right = axes[0]
    for variant, case, label, colour, style, width in lines:
        size = np.linalg.norm(run.estimates[variant].innovation[:, case], axis=-1)
        left.semilogy(
            times, size + _FLOOR, color=colour, linestyle=style, linewidth=width, label=label
        )
    left.set_title("‖y − ŷ‖, no adaptation", loc="left")
    left.set_ylim(1e-17, 3e1)
    left.set_xlim(0.0, _INNOVATION_SHOWN)
    left.legend(loc="upper right")
    fixed, fed = run.estimates["fixed"], run.estimates["noise_fed"]
    difference = np.abs(fixed.states - fed.states)[:, 0].max(axis=-1)
    right.semilogy(
        times, difference + _FLOOR, color=ESTIMATE, linewidth=0.8, label="fed with noise instead"
    )
    model = np.abs(fixed.states - run.estimates["model_only"].states)[:, 0].max(axis=-1)
    right.semilogy(times, model + _FLOOR, color=SECOND, label="no measurement at all, model only")
    right.set_title("how far x\N{COMBINING CIRCUMFLEX ACCENT} moves away", loc="left")
    right.set_ylim(1e-17, 3e1)
    right.set_xlim(times[0], times[-1])
    right.legend(loc="upper right")
    label_time(axes)


def _noise_fed(run: ExampleRun, axes: Panels) -> None:
    times = run.plant.times
    fixed, fed = run.estimates["fixed"], run.estimates["noise_fed"]
    noise_shown = fed.disturbance[:, 0, 0] + fed.states[:, 0, 0]
    top, middle, bottom = (row[0] for row in axes)
    top.plot(times, noise_shown, color=FOURTH, linewidth=0.4, label="noise that was fed as y₁")
    top.plot(times, run.plant.outputs[:, 0, 0], color=TRUTH, label="y₁")
    top.set_ylabel("output")
    for row, panel in ((0, middle), (1, bottom)):
        name = f"x{_low(row)}"
        panel.plot(times, run.plant.states[:, 0, row], color=TRUTH, label=name)
        estimate = fixed.states[:, 0, row]
        panel.plot(times, estimate, color=LIGHT, linewidth=4.0, label=f"{_hat(name)} from y")
        estimate = fed.states[:, 0, row]
        panel.plot(
            times, estimate, color=ESTIMATE, linestyle="--", label=f"{_hat(name)} from noise"
        )
        panel.set_ylabel(name)
    for panel in (top, middle, bottom):
        panel.set_xlim(times[0], times[-1])
        legend(panel, columns=3)
    label_time(axes)
