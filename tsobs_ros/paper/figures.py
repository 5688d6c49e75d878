# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The figures of the method's three examples, laid out as in the paper, and some it lacks.

Each is drawn twice: for a wide page and, with all panels below each other, for a narrow one.
The text that was available gives no numbers of the paper's figures, so a label names the example.
"""

import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tsobs_ros.checks import Array
from tsobs_ros.model.fuzzy import RuleBase
from tsobs_ros.paper.examples import example_3
from tsobs_ros.paper.runs import SETTLED, WINDOW_START, ArmComparison, ExampleRun
from tsobs_ros.style import MUTED, STYLE

Panels = Sequence[Sequence[Axes]]
"""The panels of a figure, [row][column]."""

LABELS = {
    "PO": "PO",
    "PIO": "PIO",
    "paper": "method's observer",
    "ours": "certified T–S observer",
    "EKF": "EKF",
    "EKF clean": "EKF without\nbias state",
}
"""The observers of Example 3 by name, as figures and tables call them."""

_TRUTH, _ESTIMATE, _SECOND, _THIRD, _FOURTH = "#1F2933", "#D1495B", "#00798C", "#EDAE49", "#7A5195"
_LIGHT, _GREY = "#8CC7D0", "#9AA5B1"
_COLOURS = dict(zip(LABELS, (_THIRD, _FOURTH, _ESTIMATE, _SECOND, MUTED, _GREY), strict=True))
_DPI = 130
_WIDTH = 9.6
_NARROW, _NARROW_DPI = 4.3, 180
_COMPARED = ("PO", "PIO", "paper", "ours")
_FLOOR = 1e-17
_CASES = ("λ = 0: no uncertainty", "λ = 1: with the printed ΔA")
_HAT = "\N{COMBINING CIRCUMFLEX ACCENT}"
_LOW = "₁₂₃₄"
_INNOVATION_SHOWN = 2.5
_ARM_SHOWN = 20.0
_UNITS = ("x₁ [rad]", "x₂ [rad/s]", "x₃ [rad/s²]", "x₄ [rad/s³]")


class Drawn(NamedTuple):
    """A figure.

    Attributes:
        path: PNG for a wide page.
        narrow: PNG for a narrow page.
        label: Whether the paper has it, and where.
        caption: What there is to see.
    """

    path: Path
    narrow: Path
    label: str
    caption: str


class _Figure(NamedTuple):
    key: str
    heading: str
    caption: str
    fill: Callable[[Panels], None]
    rows: int
    columns: int
    row_height: float
    share_x: bool = True
    in_paper: bool = True


def draw_example(run: ExampleRun, folder: Path) -> list[Drawn]:
    """Draw all figures of Example 1 or 2 into a folder and return them.

    Raises:
        OSError: A file cannot be written.
    """
    faults = run.example.name == "example_2"
    letter, key = ("f", "faults") if faults else ("ω", "disturbances")
    what = "sensor faults" if faults else "disturbances"
    adaptive = run.estimates["adaptive"]
    true_disturbance = np.repeat(run.plant.disturbance[:, np.newaxis], 2, axis=1)
    states = partial(_pairs, run, "x", run.plant.states, adaptive.states)
    disturbances = partial(_pairs, run, letter, true_disturbance, adaptive.disturbance)
    weights = partial(
        _memberships,
        run.example.system.rule_base,
        (1.0, "the premise variable", "y₁"),
        (run.plant.times, run.plant.weights[:, 0], "the run, λ = 0"),
    )
    return _draw(
        run.example.name,
        folder,
        _Figure(
            "states",
            "states and their estimates",
            "Without uncertainty (λ = 0) the estimates run into the states; with it (λ = 1) a "
            "small error stays.",
            states, 3, 2, 1.7,
        ),
        _Figure(
            key,
            f"{what} and their estimates",
            f"What the sensors add to the outputs, and its estimate: {letter}{_HAT} is what is "
            "left of the measurement after the estimated output.",
            disturbances, 3, 2, 1.7,
        ),
        _Figure(
            "errors",
            "estimation errors",
            "Without uncertainty all errors vanish, with it they stay at about a hundredth.",
            partial(_errors, run, letter), 2, 2, 2.3,
        ),
        _Figure(
            "memberships",
            "membership functions",
            "The weights of the two rules, over the measured output that they depend on and "
            "along the run.",
            weights, 1, 2, 2.3, share_x=False,
        ),
        _Figure(
            "adaptation",
            "the learnt uncertainty Ξ̂",
            "Size of what the adaptive law has learnt, ‖Ξ̂‖ of the larger rule. It is the same "
            "with and without uncertainty, so it says nothing about ΔA; and it stays at zero if "
            "the observer starts with an estimate that fits the first measurement.",
            partial(_adaptation, run), 1, 2, 2.7, in_paper=False,
        ),
        _Figure(
            "innovation",
            "the innovation does not depend on the plant",
            "y − ŷ dies out alike for the right plant, for one with ΔA and for noise in place of "
            "the measurement; and the state estimates hardly change if the measurement is replaced "
            "or left out.",
            partial(_innovation, run), 1, 2, 2.7, in_paper=False,
        ),
        _Figure(
            "noise_fed",
            "the output replaced by white noise, λ = 0",
            "Fed with noise, the observer gives the same estimates as fed with the measurement: "
            "it runs the model and looks at the measurement only for the rules' weights.",
            partial(_noise_fed, run), 3, 1, 1.7, in_paper=False,
        ),
    )  # fmt: skip


def draw_arm(comparison: ArmComparison, folder: Path) -> list[Drawn]:
    """Draw all figures of Example 3 into a folder and return them.

    Raises:
        OSError: A file cannot be written.
    """
    rule_base, runs = example_3().system.rule_base, comparison.trajectories
    shown = runs.times <= _ARM_SHOWN
    weights = partial(
        _memberships,
        rule_base,
        (np.pi / 2, "the link's angle", "x₁ [rad]"),
        (runs.times[shown], rule_base.weights(runs.states[0][shown, :1]), "the first run"),
    )
    states, x3 = partial(_arm_states, comparison), partial(_third_state, comparison)
    return _draw(
        "example_3",
        folder,
        _Figure(
            "states",
            "states and the method's observer with the printed gains",
            "The estimates oscillate beside the states: nothing draws them to the arm's motion.",
            states, 2, 2, 2.2,
        ),
        _Figure(
            "disturbance",
            "disturbance and its estimates",
            "The disturbance of this example is the sensor's noise. Above the method's estimate "
            "of it, below that of the certified observer of this package.",
            partial(_arm_disturbance, comparison), 2, 1, 2.0,
        ),
        _Figure(
            "memberships",
            "membership functions",
            "The weights of the two rules, over the link's angle and along the first run.",
            weights, 1, 2, 2.3, share_x=False,
        ),
        _Figure(
            "x3",
            "x₃ by PO, PIO, the method's observer and ours",
            "x₃ is the motor's angle, times k/J₁. Each observer has a panel of its own: its "
            "estimate beside the truth, and the error. PO and PIO have the speed θ that is best "
            "for them.",
            x3, len(_COMPARED), 2, 1.7,
        ),
        _Figure(
            "rmse",
            "RMSE of x₃ and of all states, every run",
            "Each point is a run; lines and numbers are means.",
            partial(_rmse, comparison), 1, 2, 2.6, share_x=False, in_paper=False,
        ),
    )  # fmt: skip


def _draw(name: str, folder: Path, *figures: _Figure) -> list[Drawn]:
    drawn = []
    for one in figures:
        example = f"Example {name[-1]}"
        label = f"Figure of {example} in the paper" if one.in_paper else "Not in the paper"
        wide, narrow = (folder / f"{name}_{one.key}{suffix}.png" for suffix in ("", "_narrow"))
        for path in (wide, narrow):
            _draw_one(one, f"{example}: {one.heading}", path, narrow=path is narrow)
        drawn.append(Drawn(wide, narrow, label, one.caption))
    return drawn


def _draw_one(one: _Figure, heading: str, path: Path, *, narrow: bool) -> None:
    """Draw a figure; a narrow one has the columns of panels below each other."""
    rows, columns = (one.rows * one.columns, 1) if narrow else (one.rows, one.columns)
    width, dpi = (_NARROW, _NARROW_DPI) if narrow else (_WIDTH, _DPI)
    lines = textwrap.wrap(heading, 42 if narrow else 110)
    with matplotlib.rc_context(STYLE):
        height = 0.75 + 0.2 * len(lines) + rows * one.row_height
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle("\n".join(lines), fontsize=11.0, fontweight="bold", x=0.01, ha="left")
        axes = figure.subplots(rows, columns, squeeze=False)
        panels = axes.T.reshape(one.columns, one.rows).T if narrow else axes
        if one.share_x:
            for column in panels.T:
                for panel in column[:-1]:
                    panel.sharex(column[-1])
                    panel.tick_params(labelbottom=False)
        one.fill(panels.tolist())
        figure.savefig(path, dpi=dpi, metadata={"Software": None})


def _label_time(axes: Panels) -> None:
    for panel in axes[-1]:
        panel.set_xlabel("time [s]")


def _legend(panel: Axes, *, columns: int = 2) -> None:
    """Put a legend into a panel's upper right, with head room so that it covers no line."""
    low, high = panel.get_ylim()
    panel.set_ylim(low, high + 0.22 * (high - low))
    panel.legend(
        ncols=columns, loc="upper right", borderaxespad=0.2, handlelength=1.8, columnspacing=1.2
    )


def _pairs(run: ExampleRun, letter: str, truth: Array, estimates: Array, axes: Panels) -> None:
    times = run.plant.times
    for row, panels in enumerate(axes):
        name, estimate = f"{letter}{_LOW[row]}", f"{letter}{_HAT}{_LOW[row]}"
        for case, panel in enumerate(panels):
            panel.plot(times, truth[:, case, row], color=_TRUTH, label=name)
            values = estimates[:, case, row]
            panel.plot(times, values, color=_ESTIMATE, linestyle="--", label=estimate)
            panel.set_ylabel(name)
            panel.set_xlim(times[0], times[-1])
            if row == 0:
                panel.set_title(_CASES[case], loc="left")
            if case == 0:
                _legend(panel)
    _label_time(axes)


def _errors(run: ExampleRun, disturbance: str, axes: Panels) -> None:
    times = run.plant.times
    rows = (("x", run.state_error("adaptive")), (disturbance, run.disturbance_error("adaptive")))
    for (letter, error), panels in zip(rows, axes, strict=True):
        for case, panel in enumerate(panels):
            for index, colour in enumerate((_TRUTH, _ESTIMATE, _SECOND)):
                name = f"{letter}{_LOW[index]}"
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
            panel.set_ylabel(f"{letter} − {letter}{_HAT}")
            panel.set_xlim(times[0], times[-1])
            if letter == "x":
                panel.set_title(_CASES[case], loc="left")
            _legend(panel, columns=3)
    _label_time(axes)


def _memberships(
    rule_base: RuleBase,
    premise: tuple[float, str, str],
    history: tuple[Array, Array, str],
    axes: Panels,
) -> None:
    (over, along), (limit, over_what, label), (times, weights, along_what) = (
        axes[0],
        premise,
        history,
    )
    z = np.linspace(-limit, limit, 201)
    grades = rule_base.weights(z[:, np.newaxis])
    for rule, (colour, style) in enumerate(((_TRUTH, "-"), (_ESTIMATE, "--"))):
        for panel, x, values in ((over, z, grades), (along, times, weights)):
            name = f"h{_LOW[rule]}"
            panel.plot(x, values[:, rule], color=colour, linestyle=style, label=name)
    over.set_title(f"over {over_what}", loc="left")
    over.set_xlabel(label)
    along.set_title(f"along {along_what}", loc="left")
    along.set_xlabel("time [s]")
    along.set_xlim(times[0], times[-1])
    for panel in (over, along):
        panel.set_ylabel("weight")
        _legend(panel)


def _innovation(run: ExampleRun, axes: Panels) -> None:
    times, (left, right) = run.plant.times, axes[0]
    for variant, case, label, colour, style, width in (
        ("fixed", 0, "fed with y", _SECOND, "-", 3.2),
        ("fixed", 1, "fed with y, plant with ΔA", _THIRD, "--", 2.0),
        ("noise_fed", 0, "fed with white noise", _ESTIMATE, ":", 2.0),
    ):
        size = np.linalg.norm(run.estimates[variant].innovation[:, case], axis=-1) + _FLOOR
        left.semilogy(times, size, color=colour, linestyle=style, linewidth=width, label=label)
    left.set_title("‖y − ŷ‖, no adaptation", loc="left")
    left.set_xlim(0.0, _INNOVATION_SHOWN)
    states = run.estimates["fixed"].states
    for variant, label, colour, width in (
        ("noise_fed", "fed with noise instead", _ESTIMATE, 0.8),
        ("model_only", "no measurement at all, model only", _SECOND, 1.3),
    ):
        change = np.abs(states - run.estimates[variant].states)[:, 0].max(axis=-1) + _FLOOR
        right.semilogy(times, change, color=colour, linewidth=width, label=label)
    right.set_title(f"change of x{_HAT}", loc="left")
    right.set_xlim(times[0], times[-1])
    for panel in (left, right):
        panel.set_ylim(1e-17, 3e1)
        panel.legend(loc="upper right")
    _label_time(axes)


def _adaptation(run: ExampleRun, axes: Panels) -> None:
    times, (left, right) = run.plant.times, axes[0]
    largest = float(run.estimates["adaptive"].adaptation.max())
    for panel, variant, title in (
        (left, "adaptive", "from x̂(0) = 0, ω̂(0) = 0, as in the paper"),
        (right, "consistent", "from ω̂(0) = y(0) − C x̂(0), which fits"),
    ):
        sizes = run.estimates[variant].adaptation
        for case, colour, style, width in ((0, _SECOND, "-", 3.2), (1, _ESTIMATE, "--", 1.5)):
            panel.plot(
                times, sizes[:, case], color=colour, linestyle=style, linewidth=width,
                label=_CASES[case],
            )  # fmt: skip
        panel.set_title(title, loc="left")
        panel.set_ylabel("largest ‖Ξ̂‖")
        panel.set_xlim(times[0], times[-1])
        panel.set_ylim(-0.05 * largest, 1.05 * largest)
        _legend(panel, columns=1)
    _label_time(axes)


def _noise_fed(run: ExampleRun, axes: Panels) -> None:
    times, plant = run.plant.times, run.plant
    fixed, fed = run.estimates["fixed"], run.estimates["noise_fed"]
    noise = fed.disturbance[:, 0, 0] + fed.states[:, 0, 0]
    top, *below = (row[0] for row in axes)
    top.plot(times, noise, color=_FOURTH, linewidth=0.4, label="noise fed as y₁")
    top.plot(times, plant.outputs[:, 0, 0], color=_TRUTH, label="y₁")
    top.set_ylabel("output")
    for row, panel in enumerate(below):
        name, estimate = f"x{_LOW[row]}", f"x{_HAT}{_LOW[row]}"
        panel.plot(times, plant.states[:, 0, row], color=_TRUTH, label=name)
        values = fixed.states[:, 0, row]
        panel.plot(times, values, color=_LIGHT, linewidth=4.0, label=f"{estimate} from y")
        values = fed.states[:, 0, row]
        label = f"{estimate} from noise"
        panel.plot(times, values, color=_ESTIMATE, linestyle="--", label=label)
        panel.set_ylabel(name)
    for panel in (top, *below):
        panel.set_xlim(times[0], times[-1])
        _legend(panel, columns=3)
    _label_time(axes)


def _arm_states(comparison: ArmComparison, axes: Panels) -> None:
    times, truth = comparison.trajectories.times, comparison.trajectories.states[0]
    shown = times <= _ARM_SHOWN
    panels = [panel for row in axes for panel in row]
    for index, panel in enumerate(panels):
        panel.plot(times[shown], truth[shown, index], color=_TRUTH, label="true")
        estimate = comparison["paper"].example[shown, index]
        panel.plot(times[shown], estimate, color=_ESTIMATE, linestyle="--", label="estimate")
        panel.set_ylabel(_UNITS[index])
        panel.set_xlim(0.0, _ARM_SHOWN)
    _legend(panels[0])
    _label_time(axes)


def _arm_disturbance(comparison: ArmComparison, axes: Panels) -> None:
    runs = comparison.trajectories
    shown = runs.times <= _ARM_SHOWN
    times, measured = runs.times[shown], runs.measurements[0, shown, 0]
    # The disturbance of this example is all of y − x₁, so each observer's is y − x̂₁.
    noise = measured - runs.states[0, shown, 0]
    for (panel,), name in zip(axes, ("paper", "ours"), strict=True):
        panel.plot(times, noise, color=_TRUTH, linewidth=0.7, label="d = y − x₁")
        panel.plot(
            times,
            measured - comparison[name].example[shown, 0],
            color=_COLOURS[name],
            linewidth=0.7,
            alpha=0.8,
            label=f"y − x{_HAT}₁, {LABELS[name]}",
        )
        panel.set_ylabel("d [rad]")
        panel.set_xlim(0.0, _ARM_SHOWN)
        _legend(panel)
    _label_time(axes)


def _third_state(comparison: ArmComparison, axes: Panels) -> None:
    runs = comparison.trajectories
    shown = runs.times <= _ARM_SHOWN
    times, truth = runs.times[shown], runs.states[0, shown, 2]
    for name, (left, right) in zip(_COMPARED, axes, strict=True):
        observer, colour = comparison[name], _COLOURS[name]
        estimate = observer.example[shown, 2]
        theta = "" if np.isnan(observer.theta) else f", θ = {observer.theta:.3g}/s"
        left.plot(times, truth, color=_TRUTH, label="true", linewidth=1.8)
        left.plot(times, estimate, color=colour, linestyle="--", label="estimate")
        left.set_title(f"{LABELS[name]}{theta}", loc="left")
        left.set_ylabel(_UNITS[2])
        left.set_ylim(1.6 * float(truth.min()), 1.6 * float(truth.max()))
        right.plot(times, estimate - truth, color=colour)
        mean = float(observer.motor_angle.mean())
        right.set_title(f"{LABELS[name]}: RMSE {mean:.3g}", loc="left")
        right.set_ylabel("error of x₃")
        right.set_ylim(-3.0, 3.0)
        for panel in (left, right):
            panel.set_xlim(0.0, _ARM_SHOWN)
    _legend(axes[0][0])
    _label_time(axes)


def _rmse(comparison: ArmComparison, axes: Panels) -> None:
    observers = comparison.observers
    names = [LABELS[each.name].replace(" observer", "\nobserver") for each in observers]
    for panel, values, title in (
        (axes[0][0], [each.motor_angle for each in observers], "x₃ [rad/s²]"),
        (axes[0][1], [each.normalised for each in observers], "all states, normalised"),
    ):
        for place, (each, errors) in enumerate(zip(observers, values, strict=True)):
            places = place + np.linspace(-0.18, 0.18, len(errors))
            panel.semilogy(places, errors, "o", color=_COLOURS[each.name], markersize=3.5)
            mean = float(errors.mean())
            panel.hlines(mean, place - 0.32, place + 0.32, color=_TRUTH, linewidth=1.4)
            panel.annotate(
                f"{mean:.3g}",
                (place, float(errors.max())),
                xytext=(0, 6),
                textcoords="offset points",
                ha="center",
                color=_TRUTH,
                fontsize=8.5,
            )
        panel.set_xticks(range(len(names)), names)
        panel.tick_params(axis="x", labelsize=7.5)
        panel.set_title(f"RMSE of {title}, {WINDOW_START:g} s to the end", loc="left")
        low, high = panel.get_ylim()
        panel.set_ylim(low, 2.0 * high)
