# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers side by side: each measured as if it had been recorded."""

from tsobs_ros.design.file import ArmDesignFile
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.replay.estimate import Observer, make_runs, run_all
from tsobs_ros.replay.source import BagSource
from tsobs_ros.report.comparison import compare_runs, expected_innovation, render_comparison
from tsobs_ros.report.metrics import MetricsOptions, measure
from tsobs_ros.report.run import read_run


def test_each_is_measured_as_if_it_had_been_recorded(
    simulated, write_bag, messages_of, design, tmp_path
) -> None:
    source = BagSource(write_bag(messages_of(simulated)))
    settings = [ObserverSettings(method=method) for method in ("certified", "ekf", "high_gain")]
    observers = [Observer(one.method, one, (ArmDesignFile.of(design),)) for one in settings]
    runs = make_runs(source, observers, rate=None, as_live=False)
    run_all(source, runs, tmp_path / "new")

    errors = compare_runs(source, runs)

    options = MetricsOptions(innovation_std=expected_innovation(design))
    for one in errors[:2]:
        recorded = read_run(tmp_path / "new", observer=one.observer)
        assert one.metrics == measure(recorded, options)
    assert errors[2].metrics["link_angle"].rmse > errors[0].metrics["link_angle"].rmse
    assert errors[2].metrics["disturbance"].rmse is None
    lines = {line.split("  ")[0]: line.split() for line in render_comparison(errors).splitlines()}
    assert lines["RMSE"] == ["RMSE", "unit", "certified", "ekf", "high_gain"]
    assert lines["sensor disturbance"][-1] == "–"
    assert float(lines["link angle"][-3]) < float(lines["link angle"][-1])
