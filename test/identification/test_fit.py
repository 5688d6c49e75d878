# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fits of joints whose numbers are known: they are found, and nothing that was not shown."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identified_joint import ARM, WRONG, recorded, request_of, run_of

import tsobs_ros as ts
from tsobs_ros.design.request import Output, TorqueDisturbance
from tsobs_ros.identification.fit import _with_zero, maximise
from tsobs_ros.identification.joint import Unknowns
from tsobs_ros.identification.recordings import read
from tsobs_ros.identification.result import request_text
from tsobs_ros.model.arm import TorquePath
from tsobs_ros.model.disturbance import DisturbanceTerm
from tsobs_ros.model.flow import ProcessNoise

pytestmark = pytest.mark.xdist_group("fit")  # its fixture takes seconds

RUBBING = {"motor_coulomb": 0.01}
LATE = request_of(ARM, torque=TorquePath(1.0, 0.01, 0.003))


@pytest.fixture(scope="module")
def rubbing() -> ts.Fit:
    """A fit of a joint with friction and a late, offset torque, from a sheet that is all wrong."""
    outputs = ["motor_angle.measurement_std", "link_angle.measurement_std"]
    free = ["arm", "torque.delay", "torque.offset", "motor_friction", "link_friction"]
    log = recorded(LATE, 6.0, 3, RUBBING)
    return ts.fit(request_of(WRONG), log, free=[*free, "process_noise", *outputs])


def test_a_joint_is_found_from_a_sheet_that_is_wrong_everywhere(rubbing: ts.Fit) -> None:
    for name in ("link_inertia", "motor_inertia", "stiffness", "gravity_torque", "motor_damping"):
        number, true = rubbing.number(name), getattr(ARM, name)
        assert abs(number.value - true) < 4.0 * number.std, name
        assert number.std < 0.06 * true, name
        assert number.seen, name
    friction, delay = rubbing.number("motor_friction"), rubbing.number("torque.delay")
    assert friction.value == pytest.approx(0.01, abs=4.0 * friction.std)
    assert delay.value == pytest.approx(0.003, abs=4.0 * delay.std)
    assert rubbing.number("torque.offset").value == pytest.approx(0.01, abs=0.005)


def test_what_was_found_is_named_and_what_is_not_shown_is_not_claimed(rubbing: ts.Fit) -> None:
    text = str(rubbing)

    _, added = text.split("found, and in the fitted request:\n")
    assert "\n  Coulomb friction of the motor, 0.0" in f"\n{added}"
    assert "\n  delay of the torque, 0.00" in added
    assert not rubbing.number("link_damping").seen
    assert not rubbing.number("link_friction").significant
    assert any("link_damping" in each for each in rubbing.unseen)


def test_a_request_that_trusts_its_model_too_much_does_not_keep_its_wrong_numbers() -> None:
    """Every sample would be an outlier of them, and without gravity no other number is likelier."""
    rng = np.random.default_rng(3)
    sheet = ts.ElasticJointArm(300.0, 150.0, 6e4, 0.0, 0.0, 200.0)
    names = ("link_inertia", "motor_inertia", "stiffness", "motor_damping")
    true = {name: getattr(sheet, name) * rng.uniform(0.75, 1.25) for name in names}
    request = request_of(
        sheet,
        outputs=(Output("motor_angle", 2e-4), Output("link_angle", 2e-4)),
        process_noise=ProcessNoise(1e-6, 1e-6),
        rate=100.0,
        uncertainty=dict.fromkeys(
            ("stiffness", "link_inverse_inertia", "motor_inverse_inertia"), 0.3
        ),
    )
    tones = np.outer(np.arange(2501) / 100.0, [0.31, 0.53, 0.97, 1.7, 2.9])
    torque = 114.0 * np.sin(2.0 * np.pi * tones + rng.uniform(0.0, 6.28, 5)).sum(axis=1)
    arm = replace(request, arm=replace(sheet, **true), process_noise=ProcessNoise(1e-7, 1e-7))
    found = ts.fit(request, recorded(arm, 25.0, 3, torque=torque))
    assert found.number("stiffness").value == pytest.approx(true["stiffness"], rel=0.01)
    assert found.outliers < 100


def test_held_out_samples_are_predicted(rubbing: ts.Fit) -> None:
    assert rubbing.samples == (2251, 750)
    for output in rubbing.outputs:
        assert output.one_step > 95.0
        assert output.free_run > 80.0
        assert output.innovation_std == pytest.approx(1.0, abs=0.1)
        assert abs(output.correlation) < 0.1


def test_the_fitted_request_is_one_like_any_other(rubbing: ts.Fit, tmp_path: Path) -> None:
    path = tmp_path / "fitted.request.yaml"
    path.write_text(request_text(rubbing, "recording.csv"), encoding="utf-8")

    request = ts.load_request(path)

    assert request == rubbing.request
    assert request.torque.delay == pytest.approx(0.003, abs=5e-4)
    friction = dict(request.torque_disturbance.motor[0])
    assert friction["kind"] == "gauss_markov"
    assert friction["std"] == pytest.approx(rubbing.number("motor_friction").value, rel=1e-5)
    assert 0.03 < friction["time_constant"] < 1.0
    assert "\n# arm.stiffness " in path.read_text(encoding="utf-8")


def test_an_observer_of_the_fit_is_as_good_as_one_of_the_truth(rubbing: ts.Fit) -> None:
    """From the motor's encoder alone, on another motion."""
    run = run_of(LATE, 6.0, 9, RUBBING)
    errors, late = [], run.time > 1.0
    for request in (rubbing.before, rubbing.request):
        motor = replace(request, outputs=request.outputs[:1])
        made = ts.estimate(ts.synthesise(motor), run.time, run.angle[:, 0], run.torque)
        error = made.state[late, 0] - run.state[late, 0]
        errors.append(float(np.sqrt(np.square(error).mean())))
    inside, claimed = np.abs(error) <= 3.0 * made.state_bound[late, 0], made.claimed[late]

    assert errors[1] < 0.3 * errors[0]
    assert inside[claimed].mean() >= 0.97
    assert claimed.mean() >= 0.97


def test_several_logs_know_more_than_one_and_a_fit_is_reproducible() -> None:
    request, sheet = request_of(ARM, "motor_angle"), request_of(WRONG, "motor_angle")
    logs = [recorded(request, 2.5, seed) for seed in (1, 2)]
    one, again, both = (ts.fit(sheet, *each, free=["arm"]) for each in (logs[:1], logs[:1], logs))

    assert one.request == again.request
    assert {each.name.partition(".")[0] for each in one.numbers} == {"arm"}
    assert both.samples[0] == pytest.approx(2 * one.samples[0], rel=0.01)
    assert both.number("stiffness").std < one.number("stiffness").std


def test_outliers_change_neither_numbers_nor_predictions() -> None:
    time, y, u = recorded(request_of(ARM), 4.0)
    spoilt = y.copy()
    spoilt[::97, 1] += 2.5
    spoilt[5::97, 0] -= 0.03
    free = ["arm", "motor_angle.measurement_std", "link_angle"]
    clean, found = (ts.fit(request_of(ARM), (time, each, u), free=free) for each in (y, spoilt))

    for one, other in zip(clean.numbers, found.numbers, strict=True):
        assert abs(one.value - other.value) < one.std, one.name
    for one, other in zip(clean.outputs, found.outputs, strict=True):
        assert other.one_step == pytest.approx(one.one_step, abs=0.2)
    assert "note: the arrays: 21 of 2,001 samples of link_angle are outliers" in str(found)


def test_without_a_zero_of_one_angle_the_gate_does_not_keep_out_the_other() -> None:
    """The zeros of two precise encoders are nearly unknown, but not their difference."""
    precise = tuple(Output(name, 1e-5) for name in ("motor_angle", "link_angle"))
    request = request_of(ARM, outputs=precise, process_noise=ProcessNoise(1e-8, 1e-8))
    _, (recording,), _ = read(request, [recorded(request, 3.0)])
    free = ["motor_angle.offset", "link_angle.offset", "torque.offset"]
    best = maximise(Unknowns.of(request, free), recording, lambda _: None)
    drifted = best.coordinates + np.array([0.0, 2.0, 2.0])
    found = _with_zero(
        best._replace(coordinates=drifted, std=np.ones(3)), recording, lambda _: None
    )

    assert found.evaluation.outliers == 0
    assert {each.name: each.value for each in found.numbers}["link_angle.offset"] < 1e-5


def test_friction_is_in_the_request_in_its_full_size_beside_a_drift() -> None:
    drift = TorqueDisturbance((DisturbanceTerm("gauss_markov", {"std": 0.002}),))
    sheet = request_of(ARM, torque_disturbance=drift)
    log = recorded(request_of(ARM), 4.0, 3, RUBBING)
    found = ts.fit(sheet, log, free=["motor_friction", "torque_disturbance"])

    (term,) = found.request.torque_disturbance.motor
    assert term["std"] == pytest.approx(found.number("motor_friction").value, rel=1e-5)


def test_a_stiffness_that_never_bends_is_not_found() -> None:
    """Slow motion without a load on the spring says nothing about it."""
    light = ts.ElasticJointArm(0.0059, 0.0021, 1.61, 0.0, 0.0, 0.1109)
    slow = 0.01 * np.sin(0.6 * np.arange(5001) / 500.0)
    still = request_of(light, "motor_angle", process_noise=ProcessNoise(1e-8, 1e-8))
    found = ts.fit(still, recorded(still, 10.0, torque=slow), free=["arm"])

    stiffness = found.number("stiffness")
    assert stiffness.std > 0.15 * ARM.stiffness
    assert abs(stiffness.value - ARM.stiffness) < 3.0 * stiffness.std


def test_the_gain_is_found_where_an_inertia_is_known() -> None:
    truth = request_of(ARM, "motor_angle", torque=TorquePath(gain=0.8))
    asked = request_of(ARM, "motor_angle", uncertainty={"torque_gain": 0.4})
    found = ts.fit(asked, recorded(truth, 4.0), free=["torque.gain", "motor_damping"])

    gain = found.number("torque.gain")
    assert gain.value == pytest.approx(0.8, abs=4.0 * gain.std)
    assert found.request.torque.gain == pytest.approx(gain.value, rel=1e-5)
    assert "torque_gain" not in found.request.uncertainty


def test_a_sensor_that_shows_what_the_arm_does_not_do_gets_a_disturbance() -> None:
    """Else process noise would explain everything, and a free run nothing."""
    time, y, u = recorded(request_of(ARM), 3.0, 5)
    white, wobble = np.random.default_rng(1).standard_normal(len(time)), np.zeros(len(time))
    for k in range(1, len(time)):
        wobble[k] = 0.9355 * wobble[k - 1] + 0.3533 * white[k]
    y[:, 1] += 0.1 * y[:, 1].std() * wobble
    found = ts.fit(request_of(ARM), (time, y, u), free=["process_noise", "link_angle"])

    assert found.request.outputs[1].disturbance[0]["kind"] == "gauss_markov"
    assert "  something that link_angle shows and the arm does not do: " in str(found)


def test_what_a_fitted_model_still_lacks_is_named() -> None:
    time, y, u = recorded(request_of(ARM), 3.0)
    y[:, 1] += 0.05
    text = str(ts.fit(request_of(ARM), (time, y, u), free=["link_angle.offset"]))

    _, rest = text.split("the model still lacks:\n")
    assert rest.startswith("  offset of link_angle, 0.05 rad; subtract it")
