# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The figures of the method's three examples, laid out as in the paper."""

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tsobs_ros.checks import Array, Flags
from tsobs_ros.model.fuzzy import RuleBase
from tsobs_ros.paper.examples import example_3
from tsobs_ros.paper.runs import SETTLED, ArmComparison, ExampleRun
from tsobs_ros.style import MUTED, STYLE

LABELS = {
    "PO": "PO",
    "PIO": "PIO",
    "paper": "method's observer",
    "ours": "certified T–S observer",
    "EKF": "EKF",
    "EKF clean": "EKF without bias state",
}
"""The observers of Example 3 by name, as figures and tables call them."""

_TRUTH, _ESTIMATE, _SECOND, _THIRD, _FOURTH = "#1F2933", "#D1495B", "#00798C", "#EDAE49", "#7A5195"
_COLOURS = dict(zip(LABELS, (_THIRD, _FOURTH, _ESTIMATE, _SECOND, MUTED, "#9AA5B1"), strict=True))
_CASES = ("λ = 0: no uncertainty", "λ = 1: with the printed ΔA")
_HAT = "\N{COMBINING CIRCUMFLEX ACCENT}"
_LOW = "₁₂₃₄"
_ARM_SHOWN = 20.0
_UNITS = ("x₁ [rad]", "x₂ [rad/s]", "x₃ [rad/s²]", "x₄ [rad/s³]")


class _Line(NamedTuple):
    x: Array
    y: Array
    label: str
    colour: str = _TRUTH
    style: str = "-"
    width: float = 1.3


class _Panel(NamedTuple):
    lines: Sequence[_Line]
    ylabel: str = ""
    title: str = ""
    xlabel: str = "time [s]"
    ylim: tuple[float, float] | None = None


def draw_example(run: ExampleRun, folder: Path) -> Iterator[tuple[str, str]]:
    """Draw all figures of Example 1 or 2 into a folder; yield each file's name and its caption.

    Raises:
        OSError: A file cannot be written.
    """
    name, plant, adaptive = run.example.name, run.plant, run.estimates["adaptive"]
    letter, key, what = "ω", "disturbances", "disturbances"
    if name == "example_2":
        letter, key, what = "f", "faults", "sensor faults"
    true_disturbance = np.repeat(plant.disturbance[:, np.newaxis], 2, axis=1)
    history = (plant.times, plant.premises[:, 0], "the run, λ = 0")
    yield _draw(
        folder / f"{name}_states.png",
        "states and their estimates",
        "Without uncertainty (λ = 0) the estimates run into the states; with it (λ = 1) a small "
        "error stays.",
        _pairs(run, "x", plant.states, adaptive.x),
    )
    yield _draw(
        folder / f"{name}_{key}.png",
        f"{what} and their estimates",
        f"What the sensors add to the outputs, and its estimate: {letter}{_HAT} is what is left of "
        "the measurement after the estimated output.",
        _pairs(run, letter, true_disturbance, adaptive.disturbance),
    )
    yield _draw(
        folder / f"{name}_errors.png",
        "estimation errors",
        "Without uncertainty all errors vanish, with it they stay at about a hundredth.",
        _errors(run, letter),
    )
    yield _draw(
        folder / f"{name}_memberships.png",
        "membership functions",
        "The weights of the two rules, over the measured output that they depend on and along the "
        "run.",
        _memberships(run.example.system.rule_base, (1.0, "y₁"), history),
    )


def draw_arm(comparison: ArmComparison, folder: Path) -> Iterator[tuple[str, str]]:
    """Draw all figures of Example 3 into a folder; yield each file's name and its caption.

    Raises:
        OSError: A file cannot be written.
    """
    runs = comparison.trajectories
    shown = runs.times <= _ARM_SHOWN
    history = (runs.times[shown], runs.states[0][shown, :1], "the first run")
    yield _draw(
        folder / "example_3_states.png",
        "states and the method's observer with the printed gains",
        "The estimates oscillate beside the states: nothing draws them to the arm's motion.",
        _arm_states(comparison, shown),
    )
    yield _draw(
        folder / "example_3_disturbance.png",
        "disturbance and its estimates",
        "The disturbance of this example is the sensor's noise. Above the method's estimate of it, "
        "below that of the certified observer of this package.",
        _arm_disturbance(comparison, shown),
    )
    yield _draw(
        folder / "example_3_memberships.png",
        "membership functions",
        "The weights of the two rules, over the link's angle and along the first run.",
        _memberships(example_3().system.rule_base, (np.pi / 2, "x₁ [rad]"), history),
    )
    yield _draw(
        folder / "example_3_x3.png",
        "x₃ by PO, PIO, the method's observer and ours",
        "x₃ is the motor's angle, times k/J₁. Each observer has a panel of its own: its estimate "
        "beside the truth, and the error. PO and PIO have the speed θ that is best for them.",
        _third_state(comparison, shown),
    )


def _draw(
    path: Path, heading: str, caption: str, panels: Sequence[Sequence[_Panel]]
) -> tuple[str, str]:
    heading = f"Example {path.name.removeprefix('example_')[0]}: {heading}"
    rows, columns = len(panels), len(panels[0])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 0.9 + 1.9 * rows), layout="constrained")
        figure.suptitle(heading, fontsize=11.0, fontweight="bold", x=0.01, ha="left")
        axes = figure.subplots(rows, columns, squeeze=False)
        for place, panel in zip(axes.flat, chain(*panels), strict=True):
            _fill(place, panel)
        figure.savefig(path, dpi=130, metadata={"Software": None})
    return path.name, f"{heading}. {caption}"


def _fill(axes: Axes, panel: _Panel) -> None:
    for line in panel.lines:
        x, y, label, colour, style, width = line
        axes.plot(x, y, style, color=colour, label=label, linewidth=width)
    axes.set_title(panel.title, loc="left")
    axes.set(ylabel=panel.ylabel, xlabel=panel.xlabel)
    low, high = panel.ylim or axes.get_ylim()  # head room, so that the legend covers no line
    axes.set_ylim(low, high + 0.25 * (high - low))
    axes.legend(ncols=3, loc="upper right", borderaxespad=0.2)


def _pairs(run: ExampleRun, letter: str, truth: Array, estimates: Array) -> list[list[_Panel]]:
    times = run.plant.times
    return [
        [
            _Panel(
                [
                    _Line(times, truth[:, case, row], f"{letter}{low}"),
                    _Line(
                        times, estimates[:, case, row], f"{letter}{_HAT}{low}", _ESTIMATE, "--"
                    ),
                ],
                f"{letter}{low}",
                _CASES[case],
            )
            for case in (0, 1)
        ]
        for row, low in enumerate(_LOW[: truth.shape[2]])
    ]  # fmt: skip


def _errors(run: ExampleRun, disturbance: str) -> list[list[_Panel]]:
    times, rows = run.plant.times, []
    for letter, error in (
        ("x", run.state_error("adaptive")),
        (disturbance, run.disturbance_error("adaptive")),
    ):
        row = []
        for case in (0, 1):
            lines = [
                _Line(times, error[:, case, index], f"{letter}{_LOW[index]}", colour)
                for index, colour in enumerate((_TRUTH, _ESTIMATE, _SECOND))
            ]
            settled = float(np.abs(error[times >= SETTLED, case]).max())
            title = f"{_CASES[case]}; largest from {SETTLED:g} s on: {settled:.1e}"
            row.append(_Panel(lines, f"{letter} − {letter}{_HAT}", title))
        rows.append(row)
    return rows


def _memberships(
    rule_base: RuleBase, premise: tuple[float, str], history: tuple[Array, Array, str]
) -> list[list[_Panel]]:
    """Return the weights over a premise up to a limit, and along a run of it."""
    (limit, label), (times, measured, along) = premise, history
    z = np.linspace(-limit, limit, 201)
    looks = (("h₁", _TRUTH, "-"), ("h₂", _ESTIMATE, "--"))
    panels = []
    for x, premises, title, xlabel in (
        (z, z[:, np.newaxis], f"over {label}", label),
        (times, measured, f"along {along}", "time [s]"),
    ):
        weights = zip(rule_base.weights(premises).T, looks, strict=True)
        lines = [_Line(x, values, *look) for values, look in weights]
        panels.append(_Panel(lines, "weight", title, xlabel))
    return [panels]


def _arm_states(comparison: ArmComparison, shown: Flags) -> list[list[_Panel]]:
    times, truth = comparison.trajectories.times[shown], comparison.trajectories.states[0]
    estimate = comparison.observers["paper"].example
    panels = [
        _Panel(
            [
                _Line(times, truth[shown, index], "true"),
                _Line(times, estimate[shown, index], "estimate", _ESTIMATE, "--"),
            ],
            unit,
        )
        for index, unit in enumerate(_UNITS)
    ]
    return [panels[:2], panels[2:]]


def _arm_disturbance(comparison: ArmComparison, shown: Flags) -> list[list[_Panel]]:
    runs = comparison.trajectories
    times, measured = runs.times[shown], runs.measurements[0, shown, 0]
    # The disturbance of this example is all of y − x₁, so each observer's is y − x̂₁.
    noise = _Line(times, measured - runs.states[0, shown, 0], "d = y − x₁", width=0.7)
    rows = []
    for name in ("paper", "ours"):
        estimate = measured - comparison.observers[name].example[shown, 0]
        label = f"y − x{_HAT}₁, {LABELS[name]}"
        line = _Line(times, estimate, label, _COLOURS[name], "-", 0.7)
        rows.append([_Panel([noise, line], "d [rad]")])
    return rows


def _third_state(comparison: ArmComparison, shown: Flags) -> list[list[_Panel]]:
    runs, rows = comparison.trajectories, []
    times, truth = runs.times[shown], runs.states[0, shown, 2]
    ylim = 1.6 * float(truth.min()), 1.6 * float(truth.max())
    for name in ("PO", "PIO", "paper", "ours"):
        observer, colour = comparison.observers[name], _COLOURS[name]
        estimate = observer.example[shown, 2]
        theta = "" if np.isnan(observer.theta) else f", θ = {observer.theta:.3g}/s"
        lines = [
            _Line(times, truth, "true", width=1.8),
            _Line(times, estimate, "estimate", colour, "--"),
        ]
        error = [_Line(times, estimate - truth, "error", colour)]
        title = f"{LABELS[name]}: RMSE {comparison.motor_angle[name]:.3g}"
        values = _Panel(lines, _UNITS[2], f"{LABELS[name]}{theta}", ylim=ylim)
        rows.append([values, _Panel(error, "error of x₃", title, ylim=(-3.0, 3.0))])
    return rows
