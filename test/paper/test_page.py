# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The paper's examples run again: what holds, what does not, and the page that says so."""

import ast
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsobs_ros.errors import ModelError
from tsobs_ros.paper.claims import Claim, Verdict, claims_text
from tsobs_ros.paper.examples import example_2
from tsobs_ros.paper.page import PaperReport, html_page, make_paper_report, markdown
from tsobs_ros.paper.runs import ExampleRun, run_example

ROOT = Path(__file__).resolve().parents[2]
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> PaperReport:
    folder = tmp_path_factory.mktemp("paper")
    return make_paper_report(folder / "new" / "folder", progress=False, seeds=4)


@pytest.fixture(scope="module")
def run(report: PaperReport) -> ExampleRun:
    return report.runs["example_1"]


@pytest.fixture(scope="module")
def numbers(report: PaperReport) -> dict[str, Any]:
    return report.as_mapping()["numbers"]


@pytest.mark.parametrize("name", ["example_1", "example_2"])
def test_errors_vanish_without_uncertainty(numbers: dict[str, Any], name: str) -> None:
    settled = numbers[name]["settled"]
    assert max(settled["adaptive"]["lambda_0"]["largest"]) < 1e-3
    assert max(settled["fixed"]["lambda_0"]["largest"]) < 5e-5


def test_errors_do_not_vanish_with_uncertainty(numbers: dict[str, Any]) -> None:
    expected = {
        "example_1": [0.0082, 0.0113, 0.0027],
        "example_2": [0.0194, 0.0252, 0.0055],
    }
    for name, rms in expected.items():
        settled = numbers[name]["settled"]
        fixed = settled["fixed"]["lambda_1"]["rms_state"]
        np.testing.assert_allclose(fixed, rms, atol=6e-5)
        np.testing.assert_allclose(settled["adaptive"]["lambda_1"]["rms_state"], fixed, rtol=0.05)
        assert min(settled["adaptive"]["lambda_1"]["largest"]) > 3e-3


def test_lyapunov_function_falls_without_uncertainty(run: ExampleRun) -> None:
    V = run.lyapunov("adaptive")
    assert np.diff(V[:, 0]).max() < 1e-6 * V[0, 0]
    assert V[-1, 0] < 0.01 * V[0, 0]
    # It is V for Ξ = 0, so it has no reason to fall where there is an uncertainty.
    assert np.diff(V[:, 1]).max() > 1e-6 * V[0, 1]


def test_estimates_do_not_depend_on_the_measurement(run: ExampleRun) -> None:
    fixed, fed = run.estimates["fixed"], run.estimates["noise_fed"]
    np.testing.assert_allclose(fed.states, fixed.states, atol=1e-12)
    assert np.abs(fed.disturbance - fixed.disturbance).max() > 1.0
    assert max(run.difference(each, 10.0) for each in ("model_only", "consistent")) < 2e-5
    assert run.estimates["consistent"].adaptation.max() < 1e-12


def test_step_is_short_enough(report: PaperReport) -> None:
    usual, coarse = report.runs["example_2"], run_example(example_2(), period=8e-3, duration=4.0)
    halved = slice(0, 2 * len(coarse.plant.times) - 1, 2)
    late = coarse.plant.times > 3.0
    np.testing.assert_allclose(coarse.plant.states, usual.plant.states[halved], atol=1e-5)
    for variant in ("adaptive", "consistent", "fixed", "model_only"):
        difference = coarse.estimates[variant].states - usual.estimates[variant].states[halved]
        assert np.abs(difference).max() < 3e-4
        assert np.abs(difference[late]).max() < 3e-5


def test_printed_gains_lose_to_every_other_observer(numbers: dict[str, Any]) -> None:
    numbers = numbers["example_3"]
    assert numbers["paper"]["x3_rmse_mean"] > 0.3
    for name in ("PO", "PIO", "ours", "EKF", "EKF clean"):
        assert numbers[name]["x3_rmse_mean"] < 0.1 * numbers["paper"]["x3_rmse_mean"]


def test_certified_observer_beats_high_gain_observers(numbers: dict[str, Any]) -> None:
    numbers = numbers["example_3"]
    for name in ("PO", "PIO"):
        for what in ("x3_rmse_mean", "normalised_rmse_mean"):
            assert numbers["ours"][what] < numbers[name][what]
        # The best θ lies inside the grid, not at its end.
        assert 0.6 < numbers[name]["theta"] < 7.0
    assert numbers["ours"]["x3_rmse_mean"] < 1.05 * numbers["EKF"]["x3_rmse_mean"]


def test_verdicts_are_as_documented(report: PaperReport) -> None:
    counts = dict.fromkeys(Verdict, 0)
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    documented = dict(re.findall(r"^\| (.+?) \| \*\*(.+?)\*\*", text, flags=re.MULTILINE))
    for claim in report.claims:
        counts[claim.verdict] += 1
        assert documented[claim.claim] == claim.verdict.value
    assert len(documented) == len(report.claims)
    assert min(counts.values()) >= 2


def test_every_claim_names_a_test_that_exists(report: PaperReport) -> None:
    for claim in report.claims:
        file, _, name = claim.test.partition("::")
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_files_are_complete(report: PaperReport) -> None:
    assert len(report.figures) == 17
    markdown = (report.output / "paper.md").read_text(encoding="utf-8")
    page = report.page.read_text(encoding="utf-8")
    for figure in report.figures:
        assert figure.read_bytes().startswith(PNG)
        assert f"({figure.name})" in markdown
    assert page.count("data:image/png;base64,") == 17
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    for claim in report.claims:
        assert claim.claim in markdown
    assert "NOT DETECTABLE" in page
    stored = json.loads((report.output / "paper.json").read_text(encoding="utf-8"))
    assert stored == json.loads(json.dumps(report.as_mapping()))
    assert "DOES NOT HOLD" in str(report)


def test_no_runs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="seeds: expected at least 1, got 0"):
        make_paper_report(tmp_path / "never", seeds=0)
    assert not (tmp_path / "never").exists()


def test_tables_escape_what_would_break_them() -> None:
    claim = Claim("a | b < c", Verdict.HOLDS_ONLY_IF, "x > 0", "|x| = 1", "test/a.py::b")
    row = [claim.claim, claim.judgement, claim.number, claim.test]
    parts = [("table", (("claim", "verdict", "number", "test"), [row]))]
    assert r"| a \| b < c | holds only if x > 0 | \|x\| = 1 |" in markdown(parts)
    page = html_page(parts)
    assert "a | b &lt; c" in page
    assert '<td class="holds_only_if">holds only if x &gt; 0</td>' in page
    assert claims_text([claim]).startswith("HOLDS ONLY IF  a | b < c\n")
