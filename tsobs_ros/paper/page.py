# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs paper`: the method's examples run again, its figures, and the verdicts on its claims.

Files written: `example_*.png`, those for narrow pages `example_*_narrow.png`, `paper.md`,
`paper.html` (needs no other file) and `paper.json`.
"""

import base64
import html
import json
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from tsobs_ros.checks import Array
from tsobs_ros.design.file import load_design
from tsobs_ros.errors import ModelError
from tsobs_ros.files import require_new, written_whole
from tsobs_ros.paper.analysis import analyse, check_stability
from tsobs_ros.paper.claims import Claim, Verdict, check_printed, claims_text, judge
from tsobs_ros.paper.examples import PaperExample, example_1, example_2, example_3
from tsobs_ros.paper.figures import LABELS, Drawn, draw_arm, draw_example
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
.short {{ border: 1px solid #c4c9d0; border-left: 4px solid #00798c; padding: .2rem 1rem; }}
dt {{ font-weight: 600; margin-top: .6rem; }} dd {{ margin: 0 0 0 1.2rem; }}
table {{ border-collapse: collapse; width: 100%; font-size: .86rem; line-height: 1.4; }}
th {{ text-align: left; border-bottom: 2px solid #c4c9d0; padding: .4rem .6rem; }}
td {{ vertical-align: top; border-bottom: 1px solid {GRID}; padding: .45rem .6rem; }}
.holds, .holds_only_if, .does_not_hold {{ border-left: 4px solid; min-width: 13rem; }}
.holds {{ border-left-color: #00798c; }} .holds_only_if {{ border-left-color: #edae49; }}
.does_not_hold {{ border-left-color: #d1495b; }}
.test {{ font: .72rem/1.4 ui-monospace, monospace; overflow-wrap: anywhere; color: {MUTED}; }}
figcaption {{ color: {MUTED}; font-size: .9rem; }} figcaption b {{ color: {INK}; }}
figure {{ margin: 1.5rem 0; }} img {{ max-width: 100%; height: auto; }}
pre {{ background: #f5f7fa; padding: .8rem; white-space: pre-wrap; font-size: .8rem;
      line-height: 1.45; overflow-wrap: anywhere; }}
@media (max-width: 44rem) {{
  body {{ margin: 1rem auto; padding: 0 .9rem; }} h1 {{ font-size: 1.35rem; }}
  thead {{ position: absolute; left: -100rem; }}
  table, tbody, tr, td {{ display: block; }} table {{ font-size: .95rem; }}
  tr {{ border-bottom: 2px solid #c4c9d0; padding: .5rem 0; }}
  td {{ border-bottom: 0; padding: .15rem .6rem; }} td:empty {{ display: none; }}
  td[data-head]::before {{ content: attr(data-head) ": "; color: {MUTED}; }}
  .test {{ font-size: .8rem; }}
}}
@media print {{ body {{ max-width: none; margin: 0; }} figure, tr {{ break-inside: avoid; }} }}
"""


_SYMBOLS = (
    ("x, x̂", "the states and their estimates; y is measured, u is known"),
    ("ω (f in Example 2)", "what disturbs the outputs, and may be anything; in Example 3 noise"),
    ("ΔA", "the uncertainty: how the true system differs from the model"),
    (
        "λ",
        "how much of the printed ΔA the simulated system has: 0 for none, so that the model is "
        "right, 1 for all of it",
    ),
    (
        "Ξ̂",
        "what the adaptive law learns, meant to stand for ΔA; without adaptation it is zero",
    ),
    (
        "PO, PIO",
        "two older observers to compare with: proportional, and proportional with an integral; "
        "both take noise and disturbance for motion",
    ),
    (
        "θ [1/s]",
        "the speed of PO and PIO, whose poles are at −θ(1, 1.1, …): a larger θ follows the motion "
        "faster and lets more noise through; the one with the smallest error of x₃ is taken",
    ),
)


@dataclass(frozen=True)
class PaperReport:
    """The results of `tsobs paper` and the files it wrote.

    Attributes:
        output: The folder.
        claims: The table of claims.
        numbers: What was measured, by example, as plain data.
        figures: The figures; each has a narrow twin.
        seconds: Computing time [s].
    """

    output: Path
    claims: tuple[Claim, ...]
    numbers: dict[str, Any]
    figures: tuple[Drawn, ...]
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
            "figures": [str(figure.path) for figure in self.figures],
        }

    def __str__(self) -> str:
        done = f"{len(self.figures)} figures in {self.output}, page {self.page}"
        return f"{claims_text(self.claims)}\n\n{done} ({self.seconds:.0f} s)"


def make_paper_report(
    output: Path, *, progress: bool = True, seeds: int = 20, force: bool = False
) -> PaperReport:
    """Run the three examples, judge the claims, draw the figures and write the page.

    Args:
        output: Folder to write to; made if missing.
        progress: Whether to show a progress bar on stderr.
        seeds: Noisy runs of Example 3, at least 1.
        force: Whether to replace existing files.

    Raises:
        OutputError: The folder has such files already, or a file cannot be written.
        ModelError: `seeds` is below 1.
    """
    if seeds < 1:
        raise ModelError(f"seeds: expected at least 1, got {seeds!r}")
    names = [f"paper.{kind}" for kind in ("html", "md", "json")]
    require_new([*map(output.joinpath, names), *output.glob("example_*.png")], force=force)
    started = time.perf_counter()
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
    with written_whole(output, force=force) as folder:
        figures = {name: draw_example(run, folder) for name, run in runs.items()}
        figures[arm.name] = draw_arm(comparison, folder)
        parts = _parts(claims, runs, comparison, "\n\n".join(map(_analysis, examples)), figures)
        drawn = tuple(
            one._replace(path=output / one.path.name, narrow=output / one.narrow.name)
            for own in figures.values()
            for one in own
        )
        seconds = time.perf_counter() - started
        report = PaperReport(output, claims, _numbers(runs, comparison), drawn, seconds)
        page, table, data = (folder / name for name in names)
        page.write_text(html_page(parts), encoding="utf-8")
        table.write_text(markdown(parts), encoding="utf-8")
        text = json.dumps(report.as_mapping(), indent=2, ensure_ascii=False)
        data.write_text(text + "\n", encoding="utf-8")
    return report


def _parts(
    claims: Sequence[Claim],
    runs: Mapping[str, ExampleRun],
    comparison: ArmComparison,
    analysis: str,
    figures: Mapping[str, Iterable[Drawn]],
) -> list[tuple[str, Any]]:
    """Return the page as (kind, content) pairs, for `markdown` and `html_page`."""
    rows = [(each.claim, each.judgement, each.number, each.test) for each in claims]
    parts: list[tuple[str, Any]] = [
        ("title", _TITLE),
        ("short", conclusion(claims, comparison)),
        ("text", _INTRODUCTION),
        ("heading", "Symbols"),
        ("terms", _SYMBOLS),
    ]
    for name, drawn in figures.items():
        parts.append(("heading", f"Example {name[-1]}"))
        parts += [("figure", each) for each in drawn]
    return [
        *parts,
        ("heading", "Claims"),
        ("table", (("claim", "verdict", "number", "test"), rows)),
        *_errors(runs),
        *_observers(comparison),
        ("heading", "Analysis"),
        ("code", analysis),
    ]


def conclusion(claims: Sequence[Claim], comparison: ArmComparison) -> list[str]:
    """Return what the claims' verdicts come to, in plain words; each follows from its claim."""
    counts = Counter(claim.verdict for claim in claims)
    verdicts = {claim.claim: claim.verdict for claim in claims}
    error = {each.name: float(each.motor_angle.mean()) for each in comparison.observers}
    lines = [
        f"Of the {len(claims)} claims below, {counts[Verdict.HOLDS]} hold, "
        f"{counts[Verdict.HOLDS_ONLY_IF]} hold under a condition that is named, and "
        f"{counts[Verdict.DOES_NOT_HOLD]} do not hold."
    ]
    for claim, verdict, text in (
        (
            "The output error y − ŷ corrects the state estimate.",
            Verdict.DOES_NOT_HOLD,
            "The observer does not correct its states by what it measures: as any disturbance is "
            "allowed in every output, a measurement says nothing about the states. The estimate "
            "is the model, run without feedback.",
        ),
        (
            "Without uncertainty, state and disturbance errors vanish.",
            Verdict.HOLDS_ONLY_IF,
            "So it is right in the end if the model is right and forgets its start, as in "
            "Examples 1 and 2 without uncertainty.",
        ),
        (
            "The adaptive law estimates the uncertainty.",
            Verdict.DOES_NOT_HOLD,
            "The adaptation learns nothing about the uncertainty, and with an uncertainty an error "
            "stays.",
        ),
        (
            "Example 3: the method's x₃ is better than that of PO and PIO.",
            Verdict.DOES_NOT_HOLD,
            f"On the arm of Example 3, which does not forget its start, its error of x₃ is "
            f"{error['paper'] / min(error['PO'], error['PIO']):.0f} times that of the better one "
            f"of two simple observers, and {error['paper'] / error['ours']:.0f} times that of this "
            "package's, which has a model of the disturbance.",
        ),
    ):
        lines += [text] if verdicts[claim] is verdict else []
    return lines


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
                name = content.path.name
                texts.append(f"![{content.path.stem}]({name})")
                texts.append(f"**{content.label}.** {content.caption}")
            case "short":
                texts.append("\n".join(f"> {line}" for line in content))
            case "terms":
                texts.append("\n".join(f"- **{term}**: {meaning}" for term, meaning in content))
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
                body.append(_html_table(*content))
            case "figure":
                body.append(_html_figure(content))
            case "short":
                lines = "\n".join(f"<p>{html.escape(line)}</p>" for line in content)
                body.append(f'<section class="short" aria-label="In short">\n{lines}\n</section>')
            case "terms":
                terms = (map(html.escape, pair) for pair in content)
                lines = "\n".join(f"<dt>{term}</dt><dd>{text}</dd>" for term, text in terms)
                body.append(f"<dl>\n{lines}\n</dl>")
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


def _html_figure(drawn: Drawn) -> str:
    """Return a figure, with its narrow twin on narrow pages."""
    wide, narrow = (
        f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
        for path in (drawn.path, drawn.narrow)
    )
    name = html.escape(drawn.path.stem.replace("_", " "))
    label, caption = html.escape(drawn.label), html.escape(drawn.caption)
    return (
        f'<figure>\n<picture><source media="(max-width: 44rem)" srcset="{narrow}">'
        f'<img alt="{name}" src="{wide}"></picture>\n'
        f"<figcaption><b>{label}.</b> {caption}</figcaption>\n</figure>"
    )


def _html_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    cells = "".join(f"<th>{html.escape(each)}</th>" for each in head)
    lines = ["<table>", f"<thead><tr>{cells}</tr></thead>", "<tbody>"]
    for row in rows:
        cells = "".join(
            f"<td{_class(each)}{_head(name)}>{html.escape(each)}</td>"
            for name, each in zip(head, row, strict=True)
        )
        lines.append(f"<tr>{cells}</tr>")
    return "\n".join([*lines, "</tbody>", "</table>"])


def _head(name: str) -> str:
    """Return the attribute that names a cell on narrow pages, which have no head."""
    return f' data-head="{html.escape(name)}"' if name not in ("", "claim", "verdict") else ""


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
