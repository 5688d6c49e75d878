# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs paper`: the method's three examples run again, its figures, and what holds of its claims.

Files written: `example_*.png`, `paper.md`, `paper.html` (needs no other file) and `paper.json`.
"""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from tsobs_ros.checks import Array
from tsobs_ros.design.file import load_design
from tsobs_ros.errors import ModelError
from tsobs_ros.paper import comparison as paper_comparison
from tsobs_ros.paper import figures as paper_figures
from tsobs_ros.paper import figures_arm as paper_figures_arm
from tsobs_ros.paper import runs as paper_runs
from tsobs_ros.paper.claim_table import Claim, claims_text
from tsobs_ros.paper.claims import judge
from tsobs_ros.paper.comparison import WINDOW_START, Comparison, compare_on_arm
from tsobs_ros.paper.examples import PaperExample, example_1, example_2, example_3
from tsobs_ros.paper.figures_arm import LABELS
from tsobs_ros.paper.page import Section, Table, write_html, write_markdown
from tsobs_ros.paper.printed_solutions import check_printed
from tsobs_ros.paper.runs import ExampleRun, run_example
from tsobs_ros.resources import config_path

_DESIGN = "elastic_joint.design.yaml"


@dataclass(frozen=True)
class PaperReport:
    """What `tsobs paper` found and wrote.

    Attributes:
        output: The folder.
        claims: The table of claims.
        numbers: Every measured number, plain data.
        page: The HTML page.
        figures: The figures.
        seconds: How long it took [s].
    """

    output: Path
    claims: tuple[Claim, ...]
    numbers: Mapping[str, Any]
    page: Path
    figures: tuple[Path, ...]
    seconds: float = field(compare=False)

    def as_mapping(self) -> dict[str, Any]:
        """Return the report as plain data, for JSON."""
        return {
            "claims": [claim.as_mapping() for claim in self.claims],
            "numbers": dict(self.numbers),
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
    # A page can be read, and its parts used, where no solver is installed.
    from tsobs_ros.paper.stability import common_lyapunov

    if seeds < 1:
        raise ModelError(f"seeds: expected at least 1, got {seeds!r}")
    started = time.perf_counter()
    output.mkdir(parents=True, exist_ok=True)
    examples = (example_1(), example_2())
    arm = example_3()
    work = len(examples) * (1 + paper_runs.WORK + paper_figures.FIGURES)
    work += paper_comparison.WORK + paper_figures_arm.FIGURES
    with tqdm(total=work, disable=not progress, unit="step", leave=False) as bar:

        def step() -> None:
            bar.update()

        def doing(what: str) -> Callable[[], None]:
            bar.set_description(what)
            return step

        runs = {each.name: _run(each, doing) for each in examples}
        verdict = common_lyapunov(arm.system.A, arm.alpha)
        design = load_design(config_path(_DESIGN))
        comparison = compare_on_arm(design, seeds, advance=doing("example 3, every observer"))
        claims = judge(runs, verdict, check_printed(examples[0], arm), comparison)
        sections = [
            Section(
                f"Example {name[-1]}",
                paper_figures.draw_example(run, output, doing("drawing")),
            )
            for name, run in runs.items()
        ]
        drawn = paper_figures_arm.draw_arm(comparison, output, doing("drawing"))
        sections.append(Section("Example 3", drawn))
    analysis = "\n\n".join(_analysis(each) for each in (*examples, arm))
    tables = [_residual_table(runs), _comparison_table(comparison)]
    page = output / "paper.html"
    write_markdown(output / "paper.md", claims, tables, analysis, sections)
    write_html(page, claims, tables, analysis, sections)
    report = PaperReport(
        output=output,
        claims=tuple(claims),
        numbers=_numbers(runs, comparison),
        page=page,
        figures=tuple(figure for section in sections for figure in section.figures),
        seconds=time.perf_counter() - started,
    )
    text = json.dumps(report.as_mapping(), indent=2, ensure_ascii=False)
    (output / "paper.json").write_text(text + "\n", encoding="utf-8")
    return report


def _run(example: PaperExample, doing: Callable[[str], Callable[[], None]]) -> ExampleRun:
    from tsobs_ros.paper.synthesis import design_adaptive_observer

    advance = doing(example.name.replace("_", " "))
    design = design_adaptive_observer(
        example.system, example.alpha, example.xi, Gamma=example.Gamma
    )
    advance()
    return run_example(example, design, advance=advance)


def _analysis(example: PaperExample) -> str:
    from tsobs_ros.paper.verdict import analyse

    delta_A = example.delta_A if example.delta_A.any() else None
    analysis = analyse(example.system, example.alpha, delta_A=delta_A)
    return f"Example {example.name[-1]}\n{analysis}"


def _residual_table(runs: Mapping[str, ExampleRun]) -> Table:
    rows = []
    for name, run in runs.items():
        for variant, label in (("adaptive", "with adaptation"), ("fixed", "without")):
            for case in (0, 1):
                largest = run.settled_error(variant, case)
                n = run.plant.states.shape[-1]
                rows.append(
                    [
                        f"Example {name[-1]}",
                        label,
                        f"λ = {case}",
                        _row(run.settled_rms(variant, case)),
                        _row(largest[:n]),
                        _row(largest[n:]),
                    ]
                )
    return Table(
        "Errors from 10 s on",
        ("", "adaptation", "ΔA", "RMS of x − x̂", "largest |x − x̂|", "largest |ω − ω̂|"),
        rows,
        "λ = 0 is the system without uncertainty, λ = 1 with the printed ΔA. x̂̄(0) = 0, 20 s, "
        "step 4 ms.",
    )


def _comparison_table(comparison: Comparison) -> Table:
    rows = []
    for each in comparison.observers:
        theta = "" if np.isnan(each.theta) else f"{each.theta:.3g}"
        label = LABELS[each.name].replace("\n", " ")
        rows.append([label, theta, _spread(each.motor_angle), _spread(each.normalised)])
    return Table(
        "Example 3 on the same noise",
        ("observer", "θ [1/s]", "RMSE of x₃ [rad/s²]", "normalised RMSE of all states"),
        rows,
        f"Mean ± standard deviation over {len(comparison.observers[0].rmse)} runs, from "
        f"{WINDOW_START:g} s to the end; PO and PIO at the θ of the grid that is best for x₃. The "
        f"EKFs are plain, without gates or health logic.",
    )


def _numbers(runs: Mapping[str, ExampleRun], comparison: Comparison) -> dict[str, Any]:
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


def _spread(values: Array) -> str:
    return f"{values.mean():.4f} ± {_deviation(values):.4f}"


def _deviation(values: Array) -> float:
    return float(values.std(ddof=1)) if len(values) > 1 else 0.0


def _row(values: Array) -> str:
    return " / ".join(f"{value:.1e}" if value < 1e-3 else f"{value:.4f}" for value in values)
