# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The paper's examples run again: what holds, what does not, and the page that says so."""

import html
import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tsobs_ros.cli.main import main
from tsobs_ros.design.record import Design
from tsobs_ros.paper.claims import VERDICTS, Claim, judge
from tsobs_ros.paper.examples import example_1, example_2
from tsobs_ros.paper.runs import ArmComparison, ExampleRun, compare_on_arm, run_example

pytestmark = pytest.mark.xdist_group("paper")  # its fixtures take seconds

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[2]
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def runs() -> dict[str, ExampleRun]:
    return {"example_1": run_example(example_1()), "example_2": run_example(example_2())}


@pytest.fixture(scope="module")
def run(runs: dict[str, ExampleRun]) -> ExampleRun:
    return runs["example_1"]


@pytest.fixture(scope="module")
def comparison(design: Design) -> ArmComparison:
    return compare_on_arm(design, 2)


@pytest.fixture(scope="module")
def claims(runs: dict[str, ExampleRun], comparison: ArmComparison) -> list[Claim]:
    return judge(runs, comparison)


def test_errors_vanish_without_uncertainty_only(claims: list[Claim]) -> None:
    numbers = {each.claim: each.number for each in claims}
    largest = numbers["Without uncertainty, state and disturbance errors vanish."]
    assert all(float(each) < 1e-3 for each in re.findall(r"[\d.]+e-\d+", largest))
    text = numbers["With the printed ΔA (λ = 1), the errors vanish, too."]
    *rms, change = re.findall(r"0\.\d{4}|\d+ %", text)
    expected = [0.0082, 0.0113, 0.0027, 0.0194, 0.0252, 0.0055]
    np.testing.assert_allclose(np.array(rms, float), expected, rtol=0.05)
    assert int(change.rstrip(" %")) <= 5


def test_lyapunov_function_falls_without_uncertainty(run: ExampleRun) -> None:
    V = run.lyapunov("adaptive")
    assert np.diff(V[:, 0]).max() < 1e-6 * V[0, 0]
    assert V[-1, 0] < 0.01 * V[0, 0]
    # It is V for Ξ = 0, so it has no reason to fall where there is an uncertainty.
    assert np.diff(V[:, 1]).max() > 1e-6 * V[0, 1]


@pytest.mark.parametrize("uncertainty", [0, 1])
def test_plants_move_by_their_equations(run: ExampleRun, uncertainty: int) -> None:
    example, some = run.example, slice(None, None, 50)
    A, B = example.system.A + uncertainty * example.delta_A, example.system.B

    def measured(t: float, x: Array) -> tuple[Array, Array]:
        omega = example.disturbance(np.array(t))
        h2 = min((x[0] + omega[0]) ** 2, 1.0)
        h = np.array([1.0 - h2, h2])
        return h, np.tensordot(h, example.system.rule_outputs, 1) @ x + omega

    def rate(t: float, x: Array) -> Array:
        h, _ = measured(t, x)
        return np.tensordot(h, A, 1) @ x + np.tensordot(h, B, 1) @ [np.sin(t)]

    times, options = run.times[some], {"rtol": 1e-10, "atol": 1e-12}
    span = (0.0, run.times[-1])
    exact = solve_ivp(rate, span, example.initial_state, "DOP853", times, **options).y.T
    outputs = [measured(t, x)[1] for t, x in zip(times, exact, strict=True)]
    np.testing.assert_allclose(run.states[some, uncertainty], exact, atol=1e-6)
    np.testing.assert_allclose(run.outputs[some, uncertainty], outputs, atol=1e-6)


def test_printed_gains_lose_to_all_and_the_certified_observer_beats_high_gain(
    comparison: ArmComparison,
) -> None:
    errors, ours = comparison.motor_angle, comparison.observers["ours"]
    assert errors.pop("paper") > max(0.3, 10.0 * max(errors.values()))
    assert errors["ours"] < 1.05 * errors["EKF"]
    for name in ("PO", "PIO"):
        other = comparison.observers[name]
        assert ours.motor_angle.mean() < other.motor_angle.mean()
        assert ours.normalised.mean() < other.normalised.mean()
        # The best θ lies inside the grid, not at its end.
        assert 0.6 < other.theta < 7.0


def test_verdicts_are_as_documented(claims: list[Claim]) -> None:
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    documented = dict(re.findall(r"^\| (.+?) \| \*\*(.+?)\*\*", text, flags=re.MULTILINE))
    assert {each.claim: each.verdict for each in claims} == documented
    counts = Counter(documented.values())
    assert min(counts[each] for each in VERDICTS) >= 2


@pytest.mark.slow
def test_the_page_has_every_claim_and_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["paper", "--output", str(tmp_path / "new"), "--seeds", "2", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    page = Path(report["page"]).read_text(encoding="utf-8")
    assert len(report["figures"]) == 3
    assert all(Path(each).read_bytes().startswith(PNG) for each in report["figures"])
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    counts = Counter(claim["verdict"] for claim in report["claims"])
    short = page[page.index("<h1>") : page.index("<h2>")]
    assert f"{counts['holds']} hold, {counts['holds only if']} hold under a condition" in short
    assert re.search(r"error of x₃ is \d\d times that of the better one", short)
    assert all(html.escape(claim["claim"]) in page for claim in report["claims"])
    for title in ("Example 1: ω₂", "Example 2: f − f\N{COMBINING CIRCUMFLEX ACCENT}"):
        assert page.count(f"<h3>{title}</h3>") == 2
    assert page.count("<h3>Example 3: x₃ [rad/s²]</h3>") == 5


def test_existing_files_are_not_replaced(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "example_1.png").write_bytes(b"mine")
    assert main(["paper", "--output", str(tmp_path), "--seeds", "1"]) == 1
    assert "example_1.png: exists already; --force replaces it" in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["example_1.png"]
