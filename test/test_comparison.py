# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers on the same scenarios, and the bound that none of them may beat."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tsobs_ros.cli.main import main
from tsobs_ros.comparison import compare_scenarios, fitted, why_unbounded
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.errors import ModelError
from tsobs_ros.methods import CONTENDERS
from tsobs_ros.report.scenario_table import BOUNDS, Runs, ScenarioComparison, typical
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.scenarios import SCENARIOS

SEEDS = 4


@pytest.fixture(scope="module")
def comparison(design: Design) -> ScenarioComparison:
    return compare_scenarios(design, ("stiff", "student", "friction"), SEEDS, duration=15.0)


def squared(runs: Runs) -> np.ndarray:
    return np.array([[one.rmse for one in run.quantities] for run in runs]) ** 2


@pytest.mark.parametrize(
    ("bound", "observers", "scenarios"),
    [
        ("pcrb", ("certified_fixed", "ekf_plain", "ekf"), ("student",)),
        ("pcrb_augmented", ("certified", "ekf_augmented"), ("stiff", "student")),
    ],
)
def test_no_unbiased_observer_has_smaller_errors_than_the_bound(
    bound: str, observers: tuple[str, ...], scenarios: tuple[str, ...], comparison
) -> None:
    for row in comparison.rows:
        if row.scenario not in scenarios:
            continue
        (least,) = squared(row.cells[bound])
        for name in observers:
            squares = squared(row.cells[name])
            chance = 3.0 * squares.std(axis=0, ddof=1) / math.sqrt(SEEDS)
            assert (squares.mean(axis=0) + chance > least).all(), (row.scenario, name)
            # Nor is it so small that it says nothing.
            assert typical(row.cells[name]) < 3.5 * typical(row.cells[bound])


def test_it_is_as_good_as_the_better_kalman_filter_where_the_arm_is_not_as_designed(
    comparison,
) -> None:
    ratios = {}
    for row in comparison.rows:
        rivals = [typical(row.cells[name]) for name in ("ekf", "ekf_augmented")]
        ratios[row.scenario] = typical(row.cells["certified"]) / min(rivals)
    assert ratios["stiff"] < 2.0
    assert ratios["student"] < 1.3
    assert ratios["friction"] < 0.8


def test_what_has_no_bound_is_named_with_the_reason(comparison) -> None:
    text = str(comparison)

    assert not comparison.rows[-1].cells.keys() & {*BOUNDS}
    assert "no bound for friction: it has friction" in text
    table = {line.split()[0]: line.split()[1:] for line in text.splitlines()[2:12]}
    assert table["pcrb"][-1] == table["pcrb_augmented"][-1] == "–"
    assert all(math.isfinite(float(cell)) for cell in table["certified"])
    assert "high_gain, proportional_integral: take an offset of the sensor for motion" in text
    unbounded = {name for name, scenario in SCENARIOS.items() if why_unbounded(scenario)}
    assert unbounded >= {"stiff_bursts", "coarse", "late_10ms", "backlash_0.03", "correlated_0.9"}
    assert not unbounded & {"noise", "stiff", "student", "drift", "dropouts"}


def test_another_arm_is_compared_by_the_observers_that_fit_it() -> None:
    design = load_design(config_path("elastic_joint_fixed.design.yaml"))
    request = replace(design.arm_request, arm=replace(design.arm_request.arm, link_damping=0.1))
    other = Design(request, design.P, design.K, design.solver)

    found = compare_scenarios(other, ["noise"], 2, duration=8.0)

    assert fitted(SCENARIOS["noise"], other).arm == request.arm
    assert set(found.names) == {*CONTENDERS, "pcrb"} - {"ekf_augmented", "paper"}
    assert "ekf_augmented is left out: " in str(found)
    assert typical(found.rows[0].cells["certified"]) < 0.1
    with pytest.raises(ModelError, match="paper is left out: method paper: expected"):
        compare_scenarios(other, ["noise"], 2, ["paper"])


def test_files_are_written_and_not_replaced(tmp_path: Path, capsys) -> None:
    command = ["compare", "--scenario", "noise", "--scenario", "friction", "--seeds", "2"]
    command += ["--duration", "7", "--method", "certified", "paper", "--output", str(tmp_path)]

    assert main([*command, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert json.loads((tmp_path / "compare.json").read_text(encoding="utf-8")) == printed
    assert list(printed["scenarios"]) == ["noise", "friction"]
    assert printed["scenarios"]["friction"]["unbounded"].startswith("friction")
    assert set(printed["observers"]) == {"certified", "paper", *BOUNDS}
    assert (tmp_path / "compare.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")

    assert main(command) == 1
    assert "compare.png: exists already; --force replaces it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--scenario", "storm"], "scenario: expected one of noise, .*, got 'storm'"),
        (["log.csv", "--seeds", "3"], "--seeds: is for scenarios"),
        (["--design", "a", "b"], "--design: expected one file, got 2"),
    ],
)
def test_what_does_not_fit_is_refused(options: list[str], message: str, capsys) -> None:
    assert main(["compare", *options]) == 1
    error = capsys.readouterr().err
    assert re.search(message, error)


def test_only_arms_are_compared() -> None:
    with pytest.raises(ModelError, match="arm"):
        compare_scenarios(load_design(config_path("paper_example_1.design.yaml")))
