# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers on the same scenarios."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tsobs_ros.campaign.comparison import compare_scenarios, render_scenarios
from tsobs_ros.cli.main import main
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.errors import ModelError
from tsobs_ros.methods import METHODS
from tsobs_ros.resources import config_path


@pytest.fixture(scope="module")
def comparison(design: Design) -> dict[str, Any]:
    return compare_scenarios(design, ("stiff", "student", "friction"), 4, duration=15.0)


def test_it_is_as_good_as_the_better_kalman_filter_where_the_arm_is_not_as_designed(
    comparison: Any,
) -> None:
    for scenario, most in (("stiff", 2.0), ("student", 1.3), ("friction", 0.8)):
        scores = comparison["scenarios"][scenario]
        ours, *rivals = (
            scores[name]["normalised_rmse"] for name in ("certified", "ekf", "ekf_augmented")
        )
        assert ours / min(rivals) < most


def test_the_table_has_a_number_of_each_observer_in_each_scenario(comparison: Any) -> None:
    lines = render_scenarios(comparison).splitlines()

    assert lines[0].split() == ["stiff", "student", "friction"]
    table = {name: cells for name, *cells in map(str.split, lines[2 : 2 + len(METHODS)])}
    assert list(table) == list(METHODS)
    assert all(math.isfinite(float(cell)) for cell in table["certified"])


def test_a_scenario_without_errors_says_why(design: Design) -> None:
    found = compare_scenarios(design, ["noise"], 1, ["certified"], duration=2.0)
    assert found["scenarios"]["noise"]["certified"]["normalised_rmse"] is None
    assert "–: runs of noise are too short to settle" in render_scenarios(found)


def test_another_arm_is_compared_by_the_observers_that_fit_it() -> None:
    design = load_design(config_path("elastic_joint_fixed.design.yaml"))
    request = replace(design.arm_request, arm=replace(design.arm_request.arm, link_damping=0.1))
    other = Design(request, design.P, design.K, design.solver)

    found = compare_scenarios(other, ["noise"], 2, duration=8.0)

    assert set(found["observers"]) == set(METHODS) - {"ekf_augmented", "paper"}
    assert "ekf_augmented is left out: " in " ".join(found["notes"])
    assert found["scenarios"]["noise"]["certified"]["normalised_rmse"] < 0.1
    with pytest.raises(ModelError, match="paper is left out: method paper: expected"):
        compare_scenarios(other, ["noise"], 2, ["paper"])
    with pytest.raises(ModelError, match="arm"):
        compare_scenarios(load_design(config_path("paper_example_1.design.yaml")))


def test_files_are_written_and_not_replaced(tmp_path: Path, capsys: Any) -> None:
    command = ["compare", "--scenario", "noise", "--scenario", "friction", "--seeds", "2"]
    command += ["--duration", "7", "--method", "certified", "paper", "--output", str(tmp_path)]

    assert main([*command, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert json.loads((tmp_path / "compare.json").read_text(encoding="utf-8")) == printed
    assert list(printed["scenarios"]) == ["noise", "friction"]
    assert set(printed["observers"]) == {"certified", "paper"}

    assert main(command) == 1
    assert "compare.json: exists already; --force replaces it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--scenario", "storm"], "scenario: expected some of noise, .*, got 'storm'"),
        (["log.csv", "--seeds", "3"], "--seeds: is for scenarios"),
        (["--design", "a", "b"], "--design: expected one file, got 2"),
    ],
)
def test_what_does_not_fit_is_refused(options: list[str], message: str, capsys: Any) -> None:
    assert main(["compare", *options]) == 1
    assert re.search(message, capsys.readouterr().err)
