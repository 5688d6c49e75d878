# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers side by side: each measured as if it had been recorded."""

import pytest

import tsobs_ros as ts
from tsobs_ros.cli.main import main
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.replay.estimate import Observer, run_observers
from tsobs_ros.replay.source import BagSource
from tsobs_ros.report.comparison import measure_runs, render_comparison
from tsobs_ros.report.metrics import innovation_std, measure
from tsobs_ros.report.run import read_run


def test_each_is_measured_as_if_it_had_been_recorded(
    simulated, write_bag, messages_of, design, tmp_path
) -> None:
    source = BagSource(write_bag(messages_of(simulated)))
    settings = [ObserverSettings(method=method) for method in ("certified", "ekf", "high_gain")]
    observers = [Observer(one.method, one, (design,)) for one in settings]
    # Of windows, the errors are those of the whole.
    options = {"as_live": False, "window": 400, "keep": True}
    runs = run_observers(source, observers, tmp_path / "new", **options)

    errors = [one for one, _ in measure_runs(source, runs)]

    std = innovation_std(design)
    for one in errors[:2]:
        recorded = BagSource(tmp_path / "new")
        run = read_run(recorded, design.request, observer=one.observer)
        assert one.metrics == measure(run, std)
    assert errors[2].metrics["link_angle"].rmse > errors[0].metrics["link_angle"].rmse
    assert errors[2].metrics["disturbance"].rmse is None
    lines = {line.split("  ")[0]: line.split() for line in render_comparison(errors).splitlines()}
    assert lines["RMSE"] == ["RMSE", "unit", "certified", "ekf", "high_gain"]
    assert lines["sensor disturbance"][-1] == "–"
    assert float(lines["link angle"][-3]) < float(lines["link angle"][-1])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, None),
        ({"noise_std": 0.09}, "times as large as the design expects, as of a noisier sensor"),
        ({"arm": ElasticJointArm(link_inertia=2.0, stiffness=4.0)}, "seems to be of another arm"),
        ({"factor": 10.0}, "the torque of another sign, unit or joint"),
        ({"factor": -1.0}, "the sensor oscillates, or the torque is wrong; check its sign"),
    ],
)
def test_a_design_that_does_not_fit_is_named_as_the_likely_cause(
    design, tmp_path, capsys, change, said
) -> None:
    factor = change.pop("factor", 1.0)
    run = ts.simulate(change.pop("arm", design), duration=25.0, seed=3, **change)
    rows = zip(run.time.tolist(), run.angle.tolist(), run.torque.tolist(), strict=True)
    lines = [f"{t:.4f},{y:.6f},{factor * u:.6f}" for t, y, u in rows]
    log = tmp_path / "log.csv"
    log.write_text("\n".join(["time [s],angle [rad],torque [N m]", *lines]))

    assert main(["estimate", str(log)]) == 0

    warnings = [line for line in capsys.readouterr().out.splitlines() if "warning: " in line]
    assert len(warnings) == (said is not None)
    assert said is None or said in warnings[0]
