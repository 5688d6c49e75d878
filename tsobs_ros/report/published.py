# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The report on the published method: figures of its examples, and verdicts on its claims.

Files written: `example_1.png` to `example_3.png` and `paper.html`, which needs no other file.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.file import load_design
from tsobs_ros.files import require_new, written_whole
from tsobs_ros.paper.claims import VERDICTS, judge
from tsobs_ros.paper.examples import example_1, example_2
from tsobs_ros.paper.runs import SETTLED, ArmComparison, ExampleRun, compare_on_arm, run_example
from tsobs_ros.report.figures import draw_run
from tsobs_ros.report.page import write_html
from tsobs_ros.report.panels import Picture, Plot, Table, limits_around, lines, thinned_curve
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

_TITLE = "The adaptive T–S observer: what its paper claims and what holds"
_INTRODUCTION = (
    "The three examples of T. V. Dang, W.-J. Wang, L. Luoh, C.-H. Sun, “Adaptive observer design "
    "for the uncertain Takagi–Sugeno fuzzy system with output disturbance” (IET Control Theory & "
    "Applications, 2011), run again, with each claim judged by a number that this run computed. "
    "The text that was available has lost its minus signs and every π; docs/method.md explains "
    "how they were put back, and has the proofs of the propositions."
)
_SYMBOLS = (
    ("x, x̂", "states and their estimates"),
    ("y, u", "what is measured and what is known"),
    ("ω, f", "what disturbs the outputs, and may be anything; in Example 3 noise"),
    ("ΔA, λ", "how the true system differs from the model; λ = 1: by the printed ΔA"),
    ("Ξ̂", "what the adaptive law learns, meant to stand for ΔA; without adaptation it is zero"),
    ("PO, PIO", "two older observers, proportional, and proportional with an integral, with poles "
     "at −θ(1, 1.1, …); the θ [1/s] with the smallest error of x₃ is taken"),
)  # fmt: skip
_CASES = ("λ = 0: no uncertainty", "λ = 1: with the printed ΔA")
_HAT, _LOW, _UNITS = "\N{COMBINING CIRCUMFLEX ACCENT}", "₁₂₃₄", ("rad", "rad/s", "rad/s²", "rad/s³")
_SHOWN = 20.0
"""Length of time in the figures [s]."""

_LABELS = {
    "PO": "PO",
    "PIO": "PIO",
    "paper": "the method's observer",
    "ours": "certified T–S observer",
    "EKF": "EKF",
    "EKF clean": "EKF without bias state",
}
"""Labels of the observers of Example 3 in figures and tables, by name."""


def make_paper_report(
    output: Path, seeds: int, *, force: bool, advance: Callable[[int], None]
) -> tuple[dict[str, Any], str]:
    """Run the examples, judge the claims, draw the figures and write the page.

    `seeds` is the number of noisy runs of Example 3. Returns the claims, numbers and files as plain
    data, and the claims as text. `advance` is called after each of the three examples.

    Raises:
        OutputError: The folder has such files already, or a file cannot be written.
    """
    figures = [output / f"example_{number}.png" for number in (1, 2, 3)]
    page, started = output / "paper.html", time.perf_counter()
    require_new([page, *figures], force=force)
    runs = {}
    for name, example in (("example_1", example_1()), ("example_2", example_2())):
        runs[name] = run_example(example)
        advance(1)
    comparison = compare_on_arm(load_design(config_path(SHIPPED_DESIGN)), seeds)
    advance(1)
    claims, arm = judge(runs, comparison), _arm_numbers(comparison)
    data: dict[str, Any] = {
        "claims": [claim._asdict() for claim in claims],
        "numbers": arm,
        "page": str(page),
        "figures": [str(figure) for figure in figures],
    }
    rows = _rows(runs["example_1"], "ω"), _rows(runs["example_2"], "f"), _arm_rows(comparison)
    pictures = [
        Picture(f"Example {number}", "", tuple(own), (0.0, _SHOWN))
        for number, own in enumerate(rows, start=1)
    ]
    counts, error = Counter(claim.verdict for claim in claims), comparison.motor_angle
    holds, only_if, not_so = (counts[verdict] for verdict in VERDICTS)
    conclusion = (
        f"Of the {len(claims)} claims below, {holds} hold, {only_if} hold under a condition that "
        f"is named, and {not_so} do not hold. On the arm of Example 3 the method's error of x₃ is "
        f"{error['paper'] / min(error['PO'], error['PIO']):.0f} times that of the better one of "
        f"two simple observers, and {error['paper'] / error['ours']:.0f} times that of this "
        "package's, which has a model of the disturbance."
    )
    judged = [(each.claim, each.judgement, each.number) for each in claims]
    first = [
        Table("Claims", ("claim", "verdict", "number"), judged, 3, _INTRODUCTION),
        Table("Symbols", ("symbol", "meaning"), _SYMBOLS, 2),
    ]
    named = (
        tuple(plot._replace(label=f"{picture.name}: {plot.label}") for plot in row)
        for picture in pictures
        for row in picture.rows
    )
    whole = Picture(_TITLE, conclusion, tuple(named), (0.0, _SHOWN))
    with written_whole(output, force=force) as folder:
        for picture, path in zip(pictures, figures, strict=True):
            draw_run(picture, folder / path.name)
        write_html(whole, folder / page.name, [_table(arm)], first=first)
    seconds = time.perf_counter() - started
    return data, "\n".join([*map(str, claims), "", f"3 figures and {page} ({seconds:.0f} s)"])


def _compared(
    label: str, unit: str, times: Array, truth: Array, estimate: Array, *remark: str
) -> Plot:
    """Return the plot of a truth and its estimate."""
    values = {"true": truth, "estimated": estimate}
    curves = tuple(thinned_curve(name, times, each) for name, each in values.items())
    # Estimates that are far off must not flatten the curve of the truth.
    room = 0.5 * np.ptp(truth)
    ends = np.clip(estimate, truth.min() - room, truth.max() + room)
    return Plot(label, unit, limits_around([truth, ends]), curves, remark)


def _rows(run: ExampleRun, letter: str) -> Iterator[tuple[Plot, ...]]:
    """Yield the rows of plots of Example 1 or 2, at λ = 0 and 1."""
    times, found = run.times, run.estimates["adaptive"]
    omega = np.repeat(run.disturbance[:, np.newaxis], 2, axis=1)
    pairs = (("x", run.states, found.x), (letter, omega, found.disturbance))
    for name, truth, estimate in pairs:
        for place, low in zip(range(truth.shape[2]), _LOW, strict=False):
            yield tuple(
                _compared(
                    f"{name}{low}", "", times, truth[:, case, place], estimate[:, case, place], text
                )
                for case, text in enumerate(_CASES)
            )
    for name, truth, estimate in pairs:
        row = []
        for case, text in enumerate(_CASES):
            error = (truth - estimate)[:, case]
            curves = {f"{name}{low}": (times, y) for low, y in zip(_LOW, error.T, strict=False)}
            largest = float(np.abs(error[times >= SETTLED]).max())
            remark = (text, f"largest from {SETTLED:g} s on: {largest:.1e}")
            row.append(lines(f"{name} − {name}{_HAT}", "", curves)._replace(remark=remark))
        yield tuple(row)


def _arm_rows(comparison: ArmComparison) -> Iterator[tuple[Plot, ...]]:
    """Yield the rows of plots of Example 3, for its first run."""
    runs = comparison.trajectories
    shown = runs.times <= _SHOWN
    times, truth, y = runs.times[shown], runs.states[0, shown], runs.measurements[0, shown, 0]
    made = {name: one.example[shown] for name, one in comparison.observers.items()}

    def state(name: str, place: int, *remark: str) -> Plot:
        estimate, label = made[name][:, place], f"x{_LOW[place]}"
        remark = (_LABELS[name], *remark)
        return _compared(label, _UNITS[place], times, truth[:, place], estimate, *remark)

    for first in (0, 2):
        yield state("paper", first), state("paper", first + 1)
    for name in ("PO", "PIO", "paper", "ours"):
        theta = comparison.observers[name].theta
        error = {"error": (times, made[name][:, 2] - truth[:, 2])}
        remark = (f"RMSE of all runs {comparison.motor_angle[name]:.3g}",)
        yield (
            state(name, 2, *([f"θ = {theta:.3g}/s"] if np.isfinite(theta) else [])),
            lines("error of x₃", _UNITS[2], error)._replace(remark=remark, limits=(-3.0, 3.0)),
        )
    # The disturbance of this example is all of y − x₁, so each observer estimates it as y − x̂₁.
    yield tuple(
        lines(
            "disturbance",
            "rad",
            {"y − x₁": (times, y - truth[:, 0]), f"y − x{_HAT}₁": (times, y - made[name][:, 0])},
        )._replace(remark=(_LABELS[name],))
        for name in ("paper", "ours")
    )


def _arm_numbers(comparison: ArmComparison) -> dict[str, Any]:
    """Return the numbers of Example 3 as plain data."""
    numbers: dict[str, Any] = {}
    for name, each in comparison.observers.items():
        numbers[name] = {"theta": each.theta if np.isfinite(each.theta) else None}
        for key, values in (("x3_rmse", each.motor_angle), ("normalised_rmse", each.normalised)):
            numbers[name][f"{key}_mean"] = float(values.mean())
            numbers[name][f"{key}_std"] = float(values.std(ddof=1)) if len(values) > 1 else 0.0
    return numbers


def _table(numbers: Mapping[str, Any]) -> Table:
    """Return the table of Example 3's errors."""
    rows = [
        (
            _LABELS[name] + (f", θ = {each['theta']:.3g}/s" if each["theta"] else ""),
            f"{each['x3_rmse_mean']:.4f} ± {each['x3_rmse_std']:.4f}",
            f"{each['normalised_rmse_mean']:.4f} ± {each['normalised_rmse_std']:.4f}",
        )
        for name, each in numbers.items()
    ]
    head = ("observer", "RMSE of x₃ [rad/s²]", "normalised RMSE of all states")
    return Table("Errors in Example 3 from 20 s on", head, rows)
