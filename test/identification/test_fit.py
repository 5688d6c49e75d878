# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fits of joints whose numbers are known: they are found, and nothing that was not shown."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from identified_joint import ARM, WRONG, request_of, tones

import tsobs_ros as ts
from tsobs_ros.design.file import load_request
from tsobs_ros.identification.result import request_text
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.model.torque_path import TorquePath

pytestmark = pytest.mark.xdist_group("fit")  # its fixtures take seconds

TRUE = {
    "link_inertia": ARM.link_inertia,
    "motor_inertia": ARM.motor_inertia,
    "stiffness": ARM.stiffness,
    "gravity_torque": ARM.gravity_torque,
    "motor_damping": ARM.motor_damping,
}


def require_found(found: ts.Fit, sigmas: float = 4.0) -> None:
    for name, true in TRUE.items():
        number = found.number(name)
        assert abs(number.value - true) < sigmas * number.std, name
        assert number.std < 0.05 * true, name
        assert number.seen, name


@pytest.fixture(scope="module")
def rubbing() -> tuple[Any, ts.Fit]:
    """A fit of a joint with friction and a late, offset torque; and its recording."""
    truth = request_of(ARM, torque=TorquePath(1.0, 0.01, 0.003))
    torque = tones(16.0, 3)
    friction = {"motor_coulomb": 0.01}
    start = [0.0] * 4
    run = ts.simulate(
        truth, duration=16.0, seed=3, torque=torque, friction=friction, initial_state=start
    )
    log = (run.time, run.angle, run.torque)
    return log, ts.fit(request_of(WRONG), log)


def test_a_joint_is_found_from_a_sheet_that_is_wrong_everywhere(rubbing: Any) -> None:
    _, found = rubbing

    require_found(found)
    friction, delay = found.number("motor_friction"), found.number("torque.delay")
    assert friction.value == pytest.approx(0.01, abs=4.0 * friction.std)
    assert delay.value == pytest.approx(0.003, abs=4.0 * delay.std)
    assert found.number("torque.offset").value == pytest.approx(0.01, abs=0.004)


def test_what_the_model_lacked_is_named_with_its_entry(rubbing: Any) -> None:
    _, found = rubbing
    lacking = "\n".join(each.what for each in found.lacks)

    assert "Coulomb friction of the motor, 0.00" in lacking
    assert "a delay of the torque, 0.00" in lacking


def test_what_the_motion_does_not_show_is_not_claimed(rubbing: Any) -> None:
    _, found = rubbing

    assert not found.number("link_damping").seen
    assert not found.number("link_friction").significant
    assert any("link_damping" in each.text for each in found.unseen)


def test_held_out_samples_are_predicted(rubbing: Any) -> None:
    _, found = rubbing
    before, after = found.log_likelihood_held_out

    assert found.samples == (6001, 2000)
    assert after > before + 5.0
    assert after == pytest.approx(found.log_likelihood[1], abs=0.2)
    for output in found.outputs:
        assert output.one_step > 95.0
        assert output.free_run > 80.0
        assert output.innovation_std == pytest.approx(1.0, abs=0.1)
        assert abs(output.correlation) < 0.1


def test_the_fitted_request_is_one_like_any_other(rubbing: Any, tmp_path: Path) -> None:
    _, found = rubbing
    path = tmp_path / "fitted.request.yaml"
    path.write_text(request_text(found, "recording.csv"), encoding="utf-8")

    request = load_request(path)

    assert request == found.request
    assert request.torque.delay == pytest.approx(0.003, abs=5e-4)
    friction = dict(request.torque_disturbance.motor[0])
    assert friction["kind"] == "gauss_markov"
    assert friction["std"] == pytest.approx(found.number("motor_friction").value, rel=1e-5)
    assert 0.03 < friction["time_constant"] < 1.0
    assert "fitted, ±" in path.read_text(encoding="utf-8")


def test_an_observer_of_the_fit_is_as_good_as_one_of_the_truth(rubbing: Any) -> None:
    """From the motor's encoder alone, on another motion."""
    _, found = rubbing
    truth = request_of(ARM, torque=TorquePath(1.0, 0.01, 0.003))
    friction, start = {"motor_coulomb": 0.01}, [0.0] * 4
    torque = tones(8.0, 9)
    run = ts.simulate(
        truth, duration=8.0, seed=9, torque=torque, friction=friction, initial_state=start
    )
    errors = []
    for request in (found.request, found.before):
        motor = request.with_outputs(request.outputs[:1])
        made = ts.estimate(ts.synthesise(motor), run.time, run.angle[:, 0], run.torque)
        late = run.time > 1.0
        error = made.state[late, 0] - run.state[late, 0]
        errors.append(float(np.sqrt(np.square(error).mean())))
        if request is found.request:
            inside = np.abs(error) <= 3.0 * made.state_bound[late, 0]
            assert inside[made.claimed[late]].mean() >= 0.97
            assert made.claimed[late].mean() >= 0.97

    assert errors[0] < 0.3 * errors[1]


def test_a_fit_is_reproducible(recorded: Any) -> None:
    log = recorded(request_of(ARM, "motor_angle"), duration=4.0)
    first, second = (
        ts.fit(request_of(WRONG, "motor_angle"), log, free=["stiffness", "motor_inertia"])
        for _ in range(2)
    )

    assert first.request == second.request
    assert [each.name for each in first.numbers] == ["arm.stiffness", "arm.motor_inertia"]


def test_several_logs_know_more_than_one(recorded: Any) -> None:
    request, sheet = request_of(ARM, "motor_angle"), request_of(WRONG, "motor_angle")
    logs = [recorded(request, duration=5.0, seed=seed) for seed in (1, 2)]
    one, both = ts.fit(sheet, logs[0], free=["arm"]), ts.fit(sheet, *logs, free=["arm"])

    assert both.samples[0] == pytest.approx(2 * one.samples[0], rel=0.01)
    assert both.number("stiffness").std < one.number("stiffness").std


def test_a_stiffness_that_never_bends_is_not_found(recorded: Any) -> None:
    """Slow motion without a load on the spring says nothing about it."""
    light = ts.ElasticJointArm(0.0059, 0.0021, 1.61, 0.0, 0.0, 0.1109)
    time = np.arange(5001) / 500.0
    slow = 0.01 * np.sin(0.6 * time)
    still = request_of(light, "motor_angle", process_noise=ProcessNoise(1e-8, 1e-8))
    found = ts.fit(still, recorded(still, duration=10.0, torque=slow), free=["arm"])

    stiffness = found.number("stiffness")
    assert stiffness.std > 0.15 * ARM.stiffness
    assert abs(stiffness.value - ARM.stiffness) < 3.0 * stiffness.std


def test_the_gain_is_found_where_an_inertia_is_known(recorded: Any) -> None:
    truth = request_of(ARM, "motor_angle", torque=TorquePath(gain=0.8))
    log = recorded(truth, duration=6.0)
    found = ts.fit(request_of(ARM, "motor_angle"), log, free=["torque.gain", "motor_damping"])

    gain = found.number("torque.gain")
    assert gain.value == pytest.approx(0.8, abs=4.0 * gain.std)
    assert found.request.torque.gain == pytest.approx(gain.value, rel=1e-5)
