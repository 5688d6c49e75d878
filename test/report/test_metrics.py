# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Metrics against errors that were put in by hand, and against an EKF that is the same observer."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, TorqueDisturbance
from tsobs_ros.report.comparison import ObserverErrors, metrics_cells, render_comparison
from tsobs_ros.report.metrics import measure
from tsobs_ros.report.run import RecordedRun
from tsobs_ros.series import Series

PERIOD = 5_000_000
START = 1_000_000_000
BOUND = 0.1


@pytest.fixture
def exact() -> RecordedRun:
    """Forty seconds of an arm at rest, estimated without error; the bias is 0.1 from 20 s on."""
    stamps, nothing = START + np.arange(8001) * PERIOD, np.zeros((8001, 4))
    bias = np.where(stamps >= START + 20_000_000_000, 0.1, 0.0)[:, np.newaxis]
    return RecordedRun(
        name="run",
        joint="elastic_joint",
        parts={
            "measurements": Series(stamps, nothing[:, :2]),
            "state": Series(stamps, nothing),
            "state_bound": Series(stamps, nothing + BOUND),
            "disturbance": Series(stamps, bias),
            "disturbance_bound": Series(stamps, nothing[:, :1] + BOUND),
            "true_state": Series(stamps, nothing),
            "true_disturbance": Series(stamps, bias),
        },
    )


def changed(run: RecordedRun, **values: np.ndarray) -> RecordedRun:
    """Return the run with other values of some parts at the estimates' stamps."""
    return replace(run, parts=run.parts | {k: Series(run.stamps, v) for k, v in values.items()})


def with_error(run, begin: float, end: float, size: float, column: int = 0):
    """Return the run with an error of one state in part of it."""
    states = run.parts["state"].values.copy()
    states[(run.times >= begin) & (run.times < end), column] += size
    return changed(run, state=states)


def test_errors_count_where_the_run_is_settled(exact) -> None:
    run = with_error(exact, 10.0, 15.0, 0.06)  # 5 of 15 + 15 settled seconds
    run = with_error(run, 0.0, 5.0, 9.0)
    run = with_error(run, 20.0, 25.0, 9.0)

    metrics = measure(run)

    assert metrics.windows == ((5.0, 20.0), (25.0, 40.0))
    assert metrics.settled_time == pytest.approx(30.0)
    link = metrics["link_angle"]
    assert link.rmse == pytest.approx(0.06 / math.sqrt(6.0), rel=1e-6)
    assert (link.bound, link.ratio) == pytest.approx((BOUND, 0.6 / math.sqrt(6.0)), rel=1e-6)
    assert link.inside == 1.0
    assert metrics["motor_velocity"].rmse == metrics["disturbance"].rmse == 0.0


def test_inside_counts_three_sigma_and_the_normalised_error_weighs_the_states(exact) -> None:
    for size, inside in ((0.31, 0.9), (-0.29, 1.0)):
        metrics = measure(with_error(exact, 10.0, 13.0, size, column=2))
        assert metrics["motor_angle"].inside == pytest.approx(inside)
    run = changed(exact, state=np.tile(0.01 * np.array([0.226, 0.60, 0.355, 0.464]), (8001, 1)))
    assert measure(run).normalised_rmse == pytest.approx(0.01)


def test_small_steps_of_the_disturbance_are_no_jumps(exact) -> None:
    ramp = 0.2 * np.sin(3.0 * exact.times)[:, np.newaxis]
    chatter = exact.parts["true_disturbance"].values.copy()
    chatter[4001:4010:2] = 0.0

    assert measure(changed(exact, true_disturbance=ramp)).jumps == ()
    (jump,) = measure(changed(exact, true_disturbance=chatter)).jumps
    assert jump == (20.0, pytest.approx(0.1))


def test_friction_that_reverses_unsettles_nothing_but_a_sensor_that_jumps_does(exact) -> None:
    term = DisturbanceTerm("gauss_markov", {"std": 0.1, "time_constant": 0.5})
    request = ArmRequest(torque_disturbance=TorqueDisturbance((term,)))
    friction = 5.0 * np.sign(np.sin(3.0 * exact.times))[:, np.newaxis]
    run = changed(replace(exact, request=request), true_torque_disturbance=friction)
    assert measure(run).windows == measure(exact).windows

    chattering = measure(changed(exact, true_disturbance=friction))
    assert (chattering.windows, chattering.unsettled[:13]) == ((), "never settled")


def test_what_is_not_known_is_left_out(exact) -> None:
    known = {name: part for name, part in exact.parts.items() if "true" not in name}
    blind = measure(replace(exact, parts=known))
    assert blind.windows == ((5.0, 40.0),)
    assert blind["link_angle"].bound == pytest.approx(BOUND)
    assert all(one.rmse is one.ratio is one.inside is None for one in blind.quantities)
    assert blind.normalised_rmse is None

    bounds = exact.parts["state_bound"].values.copy()
    bounds[2000:2400] = np.nan
    run = with_error(changed(exact, state_bound=bounds), 12.0, 13.0, 9.0)
    truth = exact.parts["true_state"].take((exact.times < 12.0) | (exact.times > 13.0))
    run = replace(run, parts=run.parts | {"true_state": truth})
    found = measure(run)["link_angle"]
    assert (found.rmse, found.bound, found.inside) == (0.0, pytest.approx(BOUND), 1.0)


def test_the_innovation_is_measured_against_the_expected_one(exact) -> None:
    values = np.full((8001, 1), 0.03)
    values[exact.times < 5.0] = 9.0
    run = changed(exact, innovation=values)

    assert measure(run, [0.02]).nis == pytest.approx(2.25)
    assert measure(run).nis is measure(exact, [0.02]).nis is None


@pytest.mark.parametrize("size", [2e83, 1e200])
def test_a_diverged_observer_is_called_so_and_stays_plain_data(exact, size) -> None:
    run = changed(with_error(exact, 5.0, 40.0, size), innovation=np.full((8001, 1), size))
    metrics = measure(run, [0.02])
    rows = [ObserverErrors("high_gain", "elbow", (size,), metrics)]

    json.dumps(rows[0].as_mapping(), allow_nan=False)
    lines = {x.split("  ")[0]: x.split()[-1] for x in render_comparison(rows).splitlines() if x}
    for name in ("link angle", "all states, normalised", "innovation", "innovation² / expected"):
        assert lines[name] == "diverged"
    assert lines["link velocity"] == "0.00"
    assert "diverged" in metrics_cells(metrics)[1]
