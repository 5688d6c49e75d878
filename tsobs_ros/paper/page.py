# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs paper`: the method's examples run again, its figures, and the verdicts on its claims.

Files written: `example_*.png`, `paper.md`, `paper.html` (needs no other file) and `paper.json`.
"""

import base64
import html
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from tsobs_ros.checks import Array
from tsobs_ros.design.file import load_design
from tsobs_ros.errors import ModelError
from tsobs_ros.paper.analysis import analyse, check_stability
from tsobs_ros.paper.claims import Claim, Verdict, check_printed, claims_text, judge
from tsobs_ros.paper.examples import PaperExample, example_1, example_2, example_3
from tsobs_ros.paper.figures import LABELS, draw_arm, draw_example
from tsobs_ros.paper.runs import (
    WINDOW_START,
    ArmComparison,
    ExampleRun,
    compare_on_arm,
    run_example,
)
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.style import GRID, INK, MUTED

_TITLE = "The adaptive T–S observer: what its paper claims and what holds"
_INTRODUCTION = (
    "The three examples of T. V. Dang, W.-J. Wang, L. Luoh, C.-H. Sun, “Adaptive observer design "
    "for the uncertain Takagi–Sugeno fuzzy system with output disturbance” (IET Control Theory & "
    "Applications, 2011), run again, with each claim judged by a number that this run computed. "
    "The text that was available has lost its minus signs and every π; tsobs_ros/paper/examples.py "
    "explains how they were put back, and docs/method.md has the proofs of the propositions."
)
_STYLE = f"""
:root {{ color-scheme: light; }}
body {{ font: 16px/1.55 system-ui, sans-serif; color: {INK}; background: #fff;
       max-width: 68rem; margin: 2rem auto; padding: 0 1.25rem; }}
h1 {{ font-size: 1.6rem; line-height: 1.25; }} h2 {{ font-size: 1.2rem; margin-top: 2.5rem; }}
.wide {{ overflow-x: auto; }}
table {{ border-collapse: collapse; width: 100%; font-size: .86rem; line-height: 1.4; }}
th {{ text-align: left; border-bottom: 2px solid #c4c9d0; padding: .4rem .6rem; }}
td {{ vertical-align: top; border-bottom: 1px solid {GRID}; padding: .45rem .6rem; }}
.holds, .holds_only_if, .does_not_hold {{ border-left: 4px solid; min-width: 13rem; }}
.holds {{ border-left-color: #00798c; }} .holds_only_if {{ border-left-color: #edae49; }}
.does_not_hold {{ border-left-color: #d1495b; }}
.test {{ font: .72rem/1.4 ui-monospace, monospace; overflow-wrap: anywhere; color: {MUTED}; }}
figure {{ margin: 1.5rem 0; }} img {{ max-width: 100%; height: auto; }}
pre {{ background: #f5f7fa; padding: .8rem; white-space: pre-wrap; font-size: .8rem;
      line-height: 1.45; }}
"""


@dataclass(frozen=True)
class PaperReport:
    """The results of `tsobs paper` and the files it wrote.

    Attributes:
        output: The folder.
        claims: The table of claims.
        numbers: What was measured, by example, as plain data.
        figures: The figures.
        seconds: Computing time [s].
    """

    output: Path
    claims: tuple[Claim, ...]
    numbers: dict[str, Any]
    figures: tuple[Path, ...]
    seconds: float

    @property
    def page(self) -> Path:
        """The HTML page."""
        return self.output / "paper.html"

    def as_mapping(self) -> dict[str, Any]:
        """Return claims, every measured number and the files as plain data, for JSON."""
        return {
            "claims": [claim.as_mapping() for claim in self.claims],
            "numbers": self.numbers,
            "page": str(self.page),
            "figures": [str(figure) for figure in self.figures],
        }

    def __str__(self) -> str:
        done = f"{len(self.figures)} figures in {self.output}, page {self.page}"
        return f"{claims_text(self.claims)}\n\n{done} ({self.seconds:.0f} s)"


def make_paper_report(output: Path, *, progress: bool = True, seeds: int = 20) -> PaperReport:
    """Run the three examples, judge the claims, draw the figures and write the page.

    Args:
        output: Folder to write to; made if missing, files of the same names are replaced.
        progress: Whether to show a progress bar on stderr.
        seeds: Noisy runs of Example 3, at least 1.

    Raises:
        ModelError: `seeds` is below 1.
        OSError: The folder or a file cannot be written.
    """
    if seeds < 1:
        raise ModelError(f"seeds: expected at least 1, got {seeds!r}")
    started = time.perf_counter()
    output.mkdir(parents=True, exist_ok=True)
    examples = first, second, arm = example_1(), example_2(), example_3()
    runs = {}
    with tqdm(total=3, disable=not progress, unit="example", leave=False) as bar:
        for example in (first, second):
            runs[example.name] = run_example(example)
            bar.update()
        comparison = compare_on_arm(load_design(config_path(SHIPPED_DESIGN)), seeds)
        bar.update()
        verdict = check_stability(arm.system.A, arm.alpha)
        claims = tuple(judge(runs, verdict, check_printed(first, arm), comparison))
        figures = {name: draw_example(run, output) for name, run in runs.items()}
        figures[arm.name] = draw_arm(comparison, output)
    parts = _parts(claims, runs, comparison, "\n\n".join(map(_analysis, examples)), figures)
    paths = tuple(path for drawn in figures.values() for path in drawn)
    seconds = time.perf_counter() - started
    report = PaperReport(output, claims, _numbers(runs, comparison), paths, seconds)
    report.page.write_text(html_page(parts), encoding="utf-8")
    (output / "paper.md").write_text(markdown(parts), encoding="utf-8")
    text = json.dumps(report.as_mapping(), indent=2, ensure_ascii=False)
    (output / "paper.json").write_text(text + "\n", encoding="utf-8")
    return report


def _parts(
    claims: Iterable[Claim],
    runs: Mapping[str, ExampleRun],
    comparison: ArmComparison,
    analysis: str,
    figures: Mapping[str, Iterable[Path]],
) -> list[tuple[str, Any]]:
    """Return the page as (kind, content) pairs, for `markdown` and `html_page`."""
    rows = [(each.claim, each.judgement, each.number, each.test) for each in claims]
    parts: list[tuple[str, Any]] = [
        ("title", _TITLE),
        ("text", _INTRODUCTION),
        ("heading", "Claims"),
        ("table", (("claim", "verdict", "number", "test"), rows)),
        *_errors(runs),
        *_observers(comparison),
        ("heading", "Analysis"),
        ("code", analysis),
    ]
    for name, paths in figures.items():
        parts.append(("heading", f"Example {name[-1]}"))
        parts += [("figure", path) for path in paths]
    return parts


def markdown(parts: Iterable[tuple[str, Any]]) -> str:
    """Return a page's parts as Markdown; figures are links to files in its own folder."""
    texts = []
    for kind, content in parts:
        match kind:
            case "table":
                head, rows = content
                lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
                for row in rows:
                    cells = (cell.replace("|", "\\|") for cell in row)
                    lines.append("| " + " | ".join(cells) + " |")
                texts.append("\n".join(lines))
            case "figure":
                texts.append(f"![{content.stem}]({content.name})")
            case "code":
                texts.append(f"```\n{content}\n```")
            case _:
                texts.append({"title": "# ", "heading": "## "}.get(kind, "") + content)
    return "\n\n".join(texts) + "\n"


def html_page(parts: Iterable[tuple[str, Any]]) -> str:
    """Return a page's parts as one HTML file that needs no other."""
    body, tags = [], {"title": "h1", "heading": "h2", "code": "pre"}
    for kind, content in parts:
        match kind:
            case "table":
                body.append(f'<div class="wide">{_html_table(*content)}</div>')
            case "figure":
                data = base64.b64encode(content.read_bytes()).decode("ascii")
                name = html.escape(content.stem.replace("_", " "))
                image = f'<img alt="{name}" src="data:image/png;base64,{data}">'
                body.append(f"<figure>{image}</figure>")
            case _:
                tag = tags.get(kind, "p")
                body.append(f"<{tag}>{html.escape(content)}</{tag}>")
    content = "\n".join(body)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(_TITLE)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n{content}\n</body>\n</html>\n"
    )


def _html_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    cells = "".join(f"<th>{html.escape(each)}</th>" for each in head)
    lines = ["<table>", f"<thead><tr>{cells}</tr></thead>", "<tbody>"]
    for row in rows:
        cells = "".join(f"<td{_class(each)}>{html.escape(each)}</td>" for each in row)
        lines.append(f"<tr>{cells}</tr>")
    return "\n".join([*lines, "</tbody>", "</table>"])


def _class(cell: str) -> str:
    # "holds only if" begins with "holds" and must be tried before it.
    for verdict in (Verdict.HOLDS_ONLY_IF, Verdict.DOES_NOT_HOLD, Verdict.HOLDS):
        if cell == verdict.value or cell.startswith((f"{verdict.value} ", f"{verdict.value}:")):
            return f' class="{verdict.name.lower()}"'
    return ' class="test"' if cell.startswith("test/") else ""


def _analysis(example: PaperExample) -> str:
    delta_A = example.delta_A if example.delta_A.any() else None
    analysis = analyse(example.system, example.alpha, delta_A=delta_A)
    return f"Example {example.name[-1]}\n{analysis}"


def _errors(runs: Mapping[str, ExampleRun]) -> list[tuple[str, Any]]:
    head = ("", "adaptation", "ΔA", "RMS of x − x̂", "largest |x − x̂|", "largest |ω − ω̂|")
    rows = []
    for name, run in runs.items():
        n = run.plant.states.shape[-1]
        for variant, label in (("adaptive", "with adaptation"), ("fixed", "without")):
            for case in (0, 1):
                largest, rms = run.settled_error(variant, case), run.settled_rms(variant, case)
                numbers = [_row(each) for each in (rms, largest[:n], largest[n:])]
                rows.append([f"Example {name[-1]}", label, f"λ = {case}", *numbers])
    remark = (
        "λ = 0 is the system without uncertainty, λ = 1 with the printed ΔA. x̂̄(0) = 0, 20 s, "
        "step 4 ms."
    )
    return [("heading", "Errors from 10 s on"), ("table", (head, rows)), ("text", remark)]


def _observers(comparison: ArmComparison) -> list[tuple[str, Any]]:
    head = ("observer", "θ [1/s]", "RMSE of x₃ [rad/s²]", "normalised RMSE of all states")
    rows = []
    for each in comparison.observers:
        theta = "" if np.isnan(each.theta) else f"{each.theta:.3g}"
        spreads = [
            f"{errors.mean():.4f} ± {_deviation(errors):.4f}"
            for errors in (each.motor_angle, each.normalised)
        ]
        rows.append([LABELS[each.name].replace("\n", " "), theta, *spreads])
    remark = (
        f"Mean ± standard deviation over {len(comparison.observers[0].rmse)} runs, from "
        f"{WINDOW_START:g} s to the end; PO and PIO at the θ of the grid that is best for x₃. The "
        f"EKFs are plain, without gates or health logic."
    )
    return [("heading", "Example 3 on the same noise"), ("table", (head, rows)), ("text", remark)]


def _numbers(runs: Mapping[str, ExampleRun], comparison: ArmComparison) -> dict[str, Any]:
    numbers: dict[str, Any] = {}
    for name, run in runs.items():
        numbers[name] = {
            "lmi_seconds": run.design.solver.seconds,
            "epsilon": run.design.epsilon,
            "conditions": {each.name: each.number for each in run.design.conditions.conditions},
            "settled": {
                variant: {
                    f"lambda_{case}": {
                        "rms_state": run.settled_rms(variant, case).tolist(),
                        "largest": run.settled_error(variant, case).tolist(),
                    }
                    for case in (0, 1)
                }
                for variant in ("adaptive", "fixed")
            },
        }
    numbers["example_3"] = {
        each.name: {
            "theta": None if np.isnan(each.theta) else each.theta,
            "x3_rmse_mean": float(each.motor_angle.mean()),
            "x3_rmse_std": _deviation(each.motor_angle),
            "normalised_rmse_mean": float(each.normalised.mean()),
            "normalised_rmse_std": _deviation(each.normalised),
        }
        for each in comparison.observers
    }
    return numbers


def _deviation(values: Array) -> float:
    return float(values.std(ddof=1)) if len(values) > 1 else 0.0


def _row(values: Array) -> str:
    return " / ".join(f"{value:.1e}" if value < 1e-3 else f"{value:.4f}" for value in values)
