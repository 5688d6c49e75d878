# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The paper's examples run again: what holds, what does not, and the page that says so."""

import ast
import fcntl
import io
import json
import os
import re
from collections import Counter
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tsobs_ros.cli.main import main
from tsobs_ros.errors import ModelError
from tsobs_ros.paper.claims import Claim, Verdict, claims_text
from tsobs_ros.paper.examples import example_1
from tsobs_ros.paper.page import html_page, make_paper_report, markdown
from tsobs_ros.paper.runs import ExampleRun, run_example

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[2]
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="session")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that `tsobs paper` wrote, once for all workers of a test session."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    folder = root / "paper" / "new"
    with (root / "paper.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (root / "paper.txt").exists():
            with redirect_stdout(io.StringIO()) as printed:
                assert main(["paper", "--output", str(folder), "--seeds", "2"]) == 0
            (root / "paper.txt").write_text(printed.getvalue(), encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def report(output: Path) -> dict[str, Any]:
    return json.loads((output / "paper.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def numbers(report: dict[str, Any]) -> dict[str, Any]:
    return report["numbers"]


@pytest.fixture(scope="module")
def run() -> ExampleRun:
    """Example 1 without the time it needs to settle to its last digits."""
    return run_example(example_1(), period=8e-3, duration=6.0)


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
    assert max(run.difference(each, 5.0) for each in ("model_only", "consistent")) < 1e-2
    assert run.estimates["consistent"].adaptation.max() < 1e-12


@pytest.mark.parametrize("uncertainty", [0, 1])
def test_plants_move_by_their_equations(run: ExampleRun, uncertainty: int) -> None:
    example, plant, some = run.example, run.plant, slice(None, None, 50)
    A = example.system.A + uncertainty * example.delta_A

    def blended(first: Array, second: Array, z: float) -> Array:
        return first + min(z * z, 1.0) * (second - first)

    def rate(t: float, x: Array) -> Array:
        z = x[0] + example.disturbance(np.array(t))[0]
        return blended(*A, z) @ x + blended(*example.system.B, z) @ [np.sin(t)]

    exact = solve_ivp(
        rate, (0.0, 6.0), example.initial_state, "DOP853", plant.times[some], rtol=1e-10, atol=1e-12
    )
    np.testing.assert_allclose(plant.states[some, uncertainty], exact.y.T, atol=1e-7)
    for k, x in zip(range(0, len(plant.times), 50), exact.y.T, strict=True):
        z = x[0] + plant.disturbance[k, 0]
        expected = blended(*example.system.C, z) @ x + plant.disturbance[k]
        np.testing.assert_allclose(plant.outputs[k, uncertainty], expected, atol=1e-7)


def test_step_is_short_enough(run: ExampleRun) -> None:
    fine = run_example(example_1(), duration=1.6)
    halved, both = slice(0, None, 2), slice(0, len(fine.plant.times) // 2 + 1)
    np.testing.assert_allclose(run.plant.states[both], fine.plant.states[halved], atol=1e-5)
    for variant in ("adaptive", "consistent", "fixed", "model_only"):
        coarse = run.estimates[variant].states[both]
        difference = np.abs(coarse - fine.estimates[variant].states[halved])
        assert difference.max() < 1e-4


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


def test_verdicts_are_as_documented(report: dict[str, Any]) -> None:
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    documented = dict(re.findall(r"^\| (.+?) \| \*\*(.+?)\*\*", text, flags=re.MULTILINE))
    assert {each["claim"]: each["verdict"] for each in report["claims"]} == documented
    counts = Counter(documented.values())
    assert min(counts[each.value] for each in Verdict) >= 2


def test_every_claim_names_a_test_that_exists(report: dict[str, Any]) -> None:
    for claim in report["claims"]:
        file, _, name = claim["test"].partition("::")
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_files_are_complete(report: dict[str, Any], output: Path) -> None:
    markdown = (output / "paper.md").read_text(encoding="utf-8")
    page = Path(report["page"]).read_text(encoding="utf-8")
    figures = [Path(each) for each in report["figures"]]
    assert len(figures) == 19
    for figure in figures:
        assert figure.read_bytes().startswith(PNG)
        assert figure.with_stem(f"{figure.stem}_narrow").read_bytes().startswith(PNG)
        assert f"({figure.name})" in markdown
    assert page.count("data:image/png;base64,") == 2 * 19
    labels = Counter(re.findall("<figcaption><b>(.+?)</b>", page))
    assert labels == {
        "Figure of Example 1 in the paper.": 4,
        "Figure of Example 2 in the paper.": 4,
        "Figure of Example 3 in the paper.": 4,
        "Not in the paper.": 7,
    }
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    assert all(claim["claim"] in markdown for claim in report["claims"])
    assert "NOT DETECTABLE" in page
    printed = (output.parents[1] / "paper.txt").read_text(encoding="utf-8")
    assert printed.count("DOES NOT HOLD") == markdown.count("| does not hold")
    assert f"19 figures in {output}, page {report['page']}" in printed


def test_page_begins_with_what_it_comes_to(report: dict[str, Any], output: Path) -> None:
    page = (output / "paper.html").read_text(encoding="utf-8")
    counts = Counter(claim["verdict"] for claim in report["claims"])
    short = page[page.index("<h1>") : page.index("<h2>")]
    assert f"{counts['holds']} hold, {counts['holds only if']} hold under a condition" in short
    assert f"{counts['does not hold']} do not hold" in short
    assert short.count("<p>") == 6  # every sentence follows from a verdict, and is there
    assert re.search(r"its error of x₃ is \d\d times that of the better one", short)
    for symbol in ("λ", "θ [1/s]", "Ξ\u0302", "PO, PIO"):
        assert f"<dt>{symbol}</dt>" in page


@pytest.mark.parametrize("width", [390, 1280])
def test_page_is_readable_on_a_phone_and_on_a_desk(output: Path, browser: Any, width: int) -> None:
    page, messages = browser.new_page(viewport={"width": width, "height": 800}), []
    page.on("console", lambda message: messages.append(message.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.goto((output / "paper.html").as_uri())
    page.wait_for_function("[...document.images].every(image => image.complete)")
    assert page.evaluate("document.documentElement.scrollWidth") == width
    images = page.evaluate("[...document.images].map(i => [i.naturalWidth, i.width])")
    # The narrow figures have 9 points at 180 dots an inch, which are 10 pixels here.
    assert len(images) == 19
    assert all((natural < 800) == (width == 390) and shown <= width for natural, shown in images)
    hidden = page.evaluate(
        "[...document.querySelectorAll('td, p, dd, pre')].filter(e => e.scrollWidth > e.clientWidth"
        " + 1 && e.clientWidth > 0).map(e => e.textContent)"
    )
    assert (hidden, messages) == ([], [])
    page.close()


def test_existing_files_are_not_replaced(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "example_1_states.png").write_bytes(b"mine")
    assert main(["paper", "--output", str(tmp_path), "--seeds", "1"]) == 1
    assert "example_1_states.png: exists already; --force replaces it" in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["example_1_states.png"]


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
