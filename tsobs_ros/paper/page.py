# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs paper`: the method's examples run again, its figures, and the verdicts on its claims.

Files written: `example_*.png`, `paper.html` (needs no other file) and `paper.json`.
"""

import base64
import html
import json
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from tsobs_ros.checks import Array
from tsobs_ros.design.file import load_design
from tsobs_ros.errors import ModelError
from tsobs_ros.files import require_new, written_whole
from tsobs_ros.paper.analysis import check_autonomous_innovation, check_matching, check_stability
from tsobs_ros.paper.augmentation import Augmentation
from tsobs_ros.paper.claims import Claim, Verdict, judge
from tsobs_ros.paper.examples import PaperExample, example_1, example_2, example_3
from tsobs_ros.paper.figures import draw_arm, draw_example
from tsobs_ros.paper.runs import ArmComparison, ExampleRun, compare_on_arm, run_example
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.style import GRID, INK, MUTED

PAGE, _DATA = "paper.html", "paper.json"
_TITLE = "The adaptive T–S observer: what its paper claims and what holds"
_INTRODUCTION = (
    "The three examples of T. V. Dang, W.-J. Wang, L. Luoh, C.-H. Sun, “Adaptive observer design "
    "for the uncertain Takagi–Sugeno fuzzy system with output disturbance” (IET Control Theory & "
    "Applications, 2011), run again, with each claim judged by a number that this run computed. "
    "The text that was available has lost its minus signs and every π; docs/method.md explains "
    "how they were put back, and has the proofs of the propositions."
)
_STYLE = f"""
body {{ font: 16px/1.55 system-ui, sans-serif; color: {INK}; max-width: 68rem;
       margin: 2rem auto; padding: 0 1rem; }}
table {{ border-collapse: collapse; font-size: .86rem; display: block; overflow-x: auto; }}
th, td {{ text-align: left; vertical-align: top; border-bottom: 1px solid {GRID}; padding: .4rem; }}
.holds {{ border-left: 4px solid #00798c; }} .holds_only_if {{ border-left: 4px solid #edae49; }}
.does_not_hold {{ border-left: 4px solid #d1495b; }}
figure {{ margin: 1.5rem 0; }} img {{ max-width: 100%; height: auto; }}
figcaption {{ color: {MUTED}; font-size: .9rem; }}
pre {{ background: #f5f7fa; padding: .8rem; white-space: pre-wrap; overflow-wrap: anywhere; }}
"""
_SYMBOLS = (
    "x, x̂: the states and their estimates; y is measured, u is known.",
    "ω (f in Example 2): what disturbs the outputs, and may be anything; in Example 3 noise.",
    "ΔA: how the true system differs from the model; λ: how much of the printed ΔA it has, 0 or 1.",
    "Ξ̂: what the adaptive law learns, meant to stand for ΔA; without adaptation it is zero.",
    "PO, PIO: two older observers, proportional, and proportional with an integral, whose poles "
    "are at −θ(1, 1.1, …); the θ [1/s] with the smallest error of x₃ is taken.",
)


@dataclass(frozen=True)
class PaperReport:
    """The results of `tsobs paper` and the files it wrote.

    Attributes:
        output: The folder.
        claims: The table of claims.
        numbers: What was measured, by example, as plain data.
        captions: Those of the figures, by the files' names.
        seconds: Computing time [s].
    """

    output: Path
    claims: tuple[Claim, ...]
    numbers: dict[str, Any]
    captions: dict[str, str]
    seconds: float

    def as_mapping(self) -> dict[str, Any]:
        """Return claims, every measured number and the files as plain data, for JSON."""
        return {
            "claims": [claim.as_mapping() for claim in self.claims],
            "numbers": self.numbers,
            "page": str(self.output / PAGE),
            "figures": [str(self.output / name) for name in self.captions],
        }

    def __str__(self) -> str:
        done = f"{len(self.captions)} figures in {self.output}, page {self.output / PAGE}"
        return "\n".join([*map(str, self.claims), "", f"{done} ({self.seconds:.0f} s)"])


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
    names = [PAGE, _DATA]
    require_new([*map(output.joinpath, names), *output.glob("example_*.png")], force=force)
    started = time.perf_counter()
    examples, runs = (example_1(), example_2(), example_3()), {}
    with tqdm(total=3, disable=not progress, unit="example", leave=False) as bar:
        for example in examples[:2]:
            runs[example.name] = run_example(example)
            bar.update()
        comparison = compare_on_arm(load_design(config_path(SHIPPED_DESIGN)), seeds)
        bar.update()
        claims = tuple(judge(runs, comparison))
    with written_whole(output, force=force) as folder:
        of_examples = chain(*(draw_example(run, folder) for run in runs.values()))
        captions = dict([*of_examples, *draw_arm(comparison, folder)])
        seconds = time.perf_counter() - started
        report = PaperReport(output, claims, _numbers(runs, comparison), captions, seconds)
        parts = [
            f"<h1>{_TITLE}</h1>",
            *_elements("p", [conclusion(claims, comparison), _INTRODUCTION]),
            "<h2>Symbols</h2>",
            *_elements("p", _SYMBOLS),
            *(_figure(folder / name, caption) for name, caption in captions.items()),
            "<h2>Claims</h2>",
            _claims_table(claims),
            "<h2>Analysis</h2>",
            *_elements("pre", ["\n\n".join(map(analysis_of, examples))]),
            "<h2>Errors from 10 s on; in Example 3 from 20 s on</h2>",
            *_elements("pre", [_json(report.numbers)]),
        ]
        (folder / PAGE).write_text(_html(parts), encoding="utf-8")
        (folder / _DATA).write_text(_json(report.as_mapping()) + "\n", encoding="utf-8")
    return report


def _json(data: dict[str, Any]) -> str:
    return json.dumps(data, indent=2, ensure_ascii=False)


def conclusion(claims: Sequence[Claim], comparison: ArmComparison) -> str:
    """Return what the claims' verdicts and the errors on the arm come to, in a few words."""
    counts = Counter(claim.verdict for claim in claims)
    error = comparison.motor_angle
    return (
        f"Of the {len(claims)} claims below, {counts[Verdict.HOLDS]} hold, "
        f"{counts[Verdict.HOLDS_ONLY_IF]} hold under a condition that is named, and "
        f"{counts[Verdict.DOES_NOT_HOLD]} do not hold. On the arm of Example 3 the method's error "
        f"of x₃ is {error['paper'] / min(error['PO'], error['PIO']):.0f} times that of the better "
        f"one of two simple observers, and {error['paper'] / error['ours']:.0f} times that of this "
        "package's, which has a model of the disturbance."
    )


def _html(parts: Iterable[str]) -> str:
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{_TITLE}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


def _elements(tag: str, texts: Iterable[str]) -> list[str]:
    return [f"<{tag}>{html.escape(text)}</{tag}>" for text in texts]


def _figure(path: Path, caption: str) -> str:
    image = base64.b64encode(path.read_bytes()).decode("ascii")
    return (
        f'<figure>\n<img alt="{path.stem}" src="data:image/png;base64,{image}">\n'
        f"<figcaption>{html.escape(caption)}</figcaption>\n</figure>"
    )


def _claims_table(claims: Iterable[Claim]) -> str:
    rows = [
        f'<tr class="{each.verdict.name.lower()}">'
        + "".join(_elements("td", (each.claim, each.judgement, each.number, each.test)))
        for each in claims
    ]
    head = "".join(_elements("th", ("claim", "verdict", "number", "test")))
    return "\n".join(["<table>", f"<tr>{head}</tr>", *rows, "</table>"])


def analysis_of(example: PaperExample) -> str:
    """Return Propositions 1 to 3 of docs/method.md, checked on an example."""
    augmentation, change = Augmentation(example.system), example.delta_A
    proof, reason = check_stability(example.system.A, augmentation.alpha_1(example.alpha))
    answer = "INFEASIBLE" if proof.P is None else "FEASIBLE"
    lines = [
        f"Example {example.name[-1]}",
        str(check_autonomous_innovation(augmentation)),
        f"Proposition 2: (37) is {answer}: {reason}",
    ]
    if proof.P is not None and change.any():
        # S⁻ᵀ diag(P, I) S⁻¹ with S = [T [0; I]] solves (37) for a P on {C̄x̄ = 0}.
        lifted = augmentation.C_bar.T @ augmentation.C_bar
        lifted[: len(proof.P), : len(proof.P)] += proof.P
        lines.append(str(check_matching(augmentation, lifted, change)))
    return "\n".join(lines)


def _numbers(runs: Mapping[str, ExampleRun], comparison: ArmComparison) -> dict[str, Any]:
    numbers: dict[str, Any] = {}
    for name, run in runs.items():
        numbers[name] = {
            "lmi_seconds": run.design.seconds,
            "epsilon": run.design.epsilon,
            "conditions": {key: one.number for key, one in run.design.conditions.items()},
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
        name: {
            "theta": None if np.isnan(each.theta) else each.theta,
            "x3_rmse_mean": float(each.motor_angle.mean()),
            "x3_rmse_std": _deviation(each.motor_angle),
            "normalised_rmse_mean": float(each.normalised.mean()),
            "normalised_rmse_std": _deviation(each.normalised),
        }
        for name, each in comparison.observers.items()
    }
    return numbers


def _deviation(values: Array) -> float:
    return float(values.std(ddof=1)) if len(values) > 1 else 0.0
