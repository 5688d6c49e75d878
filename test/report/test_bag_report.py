# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A report on a bag: the same numbers in the table, the JSON and the figures' captions."""

import json
from dataclasses import replace

import pytest

import tsobs_ros as ts
from tsobs_ros.errors import BagReadError, OutputError
from tsobs_ros.methods import EKFS
from tsobs_ros.report.bag_report import make_bag_report
from tsobs_ros.report.metrics import innovation_std, measure
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

SHIPPED = str(config_path(SHIPPED_DESIGN))


def test_a_report_of_a_simulated_bag(simulated, messages_of, write_bag, design, tmp_path) -> None:
    output = tmp_path / "new" / "folder"

    bag = write_bag(messages_of(simulated))
    report, text = make_bag_report(bag, output, design=SHIPPED)

    std = innovation_std(design)
    expected = measure(simulated, std)
    assert report["normalised_rmse"] == pytest.approx(expected.normalised_rmse, rel=1e-9)
    assert report["nis"] == pytest.approx(expected.nis, rel=1e-9)
    # The very number that `tsobs compare` shows.
    rows = {row.observer: row.metrics for row in ts.compare(bag, SHIPPED, methods=EKFS)}
    best = min(rows, key=lambda name: rows[name].normalised_rmse)
    ekf, ours = report["ekf"], report["quantities"]
    assert (ekf["method"], ekf["normalised_rmse"]) == (best, rows[best].normalised_rmse)
    assert 0.5 < ekf["normalised_ratio"] < 1.3
    assert ekf["ratio"]["disturbance"] == ours["disturbance"]["rmse"] / ekf["rmse"]["disturbance"]
    names = ["report.png", "report.html", "report.json"]
    assert report["files"] == [str(output / name) for name in names]
    assert sorted(path.name for path in output.iterdir()) == sorted(names)
    assert json.loads((output / "report.json").read_text()) == json.loads(json.dumps(report))
    assert report["summary"]["level"] == "OK"
    assert f"{ours['link_angle']['rmse']:#.3g}" in text
    assert all(f"wrote {output / name}" in text for name in names)
    assert text.count("note:") == 1  # there are no diagnostics
    with pytest.raises(OutputError, match=r"report\.png: exists already; --force replaces it"):
        make_bag_report(bag, output, design=SHIPPED)


def test_a_report_of_a_robot_lists_what_happened_to_the_estimates(
    troubled, messages_of, write_bag, tmp_path
) -> None:
    """Without truth, and with one in twenty of the messages, which are quick to write."""
    parts = {
        name: part if name == "health" else part.take(slice(None, None, 20))
        for name, part in troubled.parts.items()
        if "true" not in name
    }
    bag = write_bag(messages_of(replace(troubled, parts=parts)))
    (tmp_path / "report.json").write_text("old")

    report, text = make_bag_report(bag, tmp_path, ekf=False, force=True)

    assert report["ekf"] is None
    assert json.loads((tmp_path / "report.json").read_text())["estimates"] == 200
    assert "note: the bag has no ground truth" in text
    health = report["health"]
    assert [(round(one["time"]), one["kind"], one["level"]) for one in health["events"]] == [
        (0, "state", "OK"), (0, "bound", "OK"), (5, "noise", "WARN"), (8, "bound", "WARN"),
        (10, "bound", "OK"), (12, "noise", "OK"), (15, "hypothesis", "WARN"),
    ]  # fmt: skip
    assert all(one["text"] in text for one in health["events"])
    assert "bounds 90.5 % certified, 9.5 % contradicted; claimed" in text


def test_a_bag_without_an_estimate_says_so(short, messages_of, write_bag, tmp_path) -> None:
    messages = messages_of(short)
    messages["/observer/joint_states"] = []

    refusal = r"no estimate of elastic_joint from 200 measurements on /joint_measurements"
    with pytest.raises(BagReadError, match=refusal):
        make_bag_report(write_bag(messages), tmp_path, ekf=False)
