# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Motions keep their limits, show what is wanted, and lead a fit to the truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.cli.main import main
from tsobs_ros.design.request import Output, TorquePath
from tsobs_ros.errors import LogError, ModelError
from tsobs_ros.identification.excitation import Excitation, simulated, trial_arms
from tsobs_ros.replay.csv_file import read_torques
from tsobs_ros.resources import config_path

pytestmark = pytest.mark.xdist_group("motion")  # its fixture takes seconds

GEARED = ts.ArmRequest(
    ts.ElasticJointArm(1.0, 0.6, 150.0, 12.0, 0.2, 0.3),
    rate=100.0,
    outputs=(Output("motor_angle", 1e-3),),
    uncertainty={},
)
VERTICAL = replace(
    GEARED,
    arm=replace(GEARED.arm, gravity_torque=0.0),
    outputs=(Output("motor_angle", 1e-3), Output("link_angle", 1e-3)),
)
REST = (0.0, 0.0, 0.0, 0.0)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(GEARED, id="gravity"),
        pytest.param(VERTICAL, id="vertical", marks=pytest.mark.slow),
    ],
)
def motion(request: pytest.FixtureRequest) -> Excitation:
    return ts.excite(request.param, duration=12.0, max_velocity=3.0, seed=3, candidates=6)


def test_limits_hold_for_arms_that_the_search_did_not_see(motion: Excitation) -> None:
    limits, quiet = motion.limits, np.concatenate([motion.torque, np.zeros(100)])
    for arm in trial_arms(motion.request, 20, seed=99):
        states = simulated(arm, quiet)
        assert np.abs(states[:, ::2]).max() <= limits.angle
        assert np.abs(states[:, 1::2]).max() <= limits.velocity
    assert np.abs(motion.torque).max() <= limits.torque


def test_a_motion_begins_and_ends_at_rest_and_shows_the_arm(motion: Excitation) -> None:
    duration = float(motion.time[-1])
    run = ts.simulate(
        motion.request.arm, rate=100.0, duration=duration, torque=motion.torque, initial_state=REST
    )

    assert motion.torque[0] == motion.torque[-1] == 0.0
    assert np.abs(np.diff(motion.torque)).max() < 0.5 * np.abs(motion.torque).max()
    # But for what holding the torque from sample to sample changes.
    assert np.abs(run.state[-1]).max() < 0.02 * motion.limits.velocity
    assert np.abs(run.state[:, ::2] - motion.angles).max() < 0.05
    arm = {"arm.stiffness", "arm.link_inertia", "arm.motor_inertia", "arm.motor_damping"}
    assert arm.isdisjoint(motion.unseen)


@pytest.mark.slow
def test_a_fit_of_the_motion_finds_the_arm_behind_a_wrong_sheet() -> None:
    true = GEARED.arm
    sheet = replace(
        GEARED,
        arm=replace(
            true,
            stiffness=1.3 * true.stiffness,
            gravity_torque=0.75 * true.gravity_torque,
            link_inertia=1.25 * true.link_inertia,
            motor_inertia=0.8 * true.motor_inertia,
        ),
    )
    motion = ts.excite(sheet, duration=15.0, candidates=20)
    run = ts.simulate(
        replace(sheet, arm=true), duration=15.0, torque=motion.torque, initial_state=REST, seed=5
    )
    found = ts.fit(sheet, (run.time, run.angle, run.torque), held_out=0.0)

    for name in ("stiffness", "gravity_torque", "link_inertia", "motor_inertia"):
        number = found.number(name)
        assert abs(number.value - getattr(true, name)) < 3.0 * number.std, name
        # It was expected about as well as it came out.
        assert number.std < 4.0 * motion.number(name).std, name


@pytest.mark.slow
def test_a_command_is_what_the_request_s_torque_path_makes_the_motor_s_torque_of() -> None:
    request = replace(GEARED, torque=TorquePath(gain=2.0, offset=0.1))
    motion, direct = (
        ts.excite(one, duration=12.0, free=["stiffness"], max_torque=limit, candidates=1)
        for one, limit in ((request, 3.0), (GEARED, 5.9))
    )

    np.testing.assert_allclose(2.0 * motion.torque + 0.1, direct.torque, atol=1e-12)
    assert np.abs(motion.torque).max() <= motion.limits.torque


@pytest.mark.parametrize(
    ("changes", "options", "match"),
    [
        ({}, {"duration": 1.0}, r"duration: expected at least .* slowest frequency"),
        ({}, {"duration": 1e4}, "duration: expected at most"),
        ({}, {"max_angle": 1.5}, "max_angle: expected at most the request's x_max"),
        ({}, {"candidates": 0}, "candidates"),
        ({}, {"free": ["stifness"]}, "stiffness"),
        ({"torque_limit": 5.0}, {"max_torque": 6.0}, "torque_limit = 5, got 6"),
        ({}, {"max_torque": 1e-300}, "limits: expected room for a motion"),
        ({"rate": 15.0}, {}, "rate: expected at least"),
        ({"torque": TorquePath(offset=2.0)}, {"max_torque": 1.0}, "offset"),
    ],
)
def test_what_no_motion_can_satisfy_is_refused(changes: dict, options: dict, match: str) -> None:
    with pytest.raises(ModelError, match=match):
        ts.excite(replace(GEARED, **changes), **options)


def test_a_ts_system_has_no_numbers() -> None:
    system = ts.load_request(config_path("ts_example.request.yaml"))
    for function in (ts.excite, ts.fit):
        with pytest.raises(ModelError, match="T-S system"):
            function(system)


def test_the_command_writes_a_motion_that_its_seed_gives_again(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    request, output = tmp_path / "sheet.request.yaml", tmp_path / "motion.csv"
    request.write_text(
        "arm: {link_inertia: 1.0, motor_inertia: 0.6, stiffness: 150.0, gravity_torque: 12.0}\n"
        "rate: 50.0\n"
    )
    command = ["excite", str(request), "--output", str(output), "--duration", "12", "--json"]
    command += ["--candidates", "2", "--max-angle", "0.4"]
    output.write_text("mine")
    assert main(command) == 1
    assert "exists already; --force" in capsys.readouterr().err
    assert main([*command, "--force"]) == 0
    assert '"worst"' in capsys.readouterr().out
    assert "time [s],torque [N m],expected_link_angle" in output.read_text()
    motion = ts.excite(ts.load_request(request), duration=12.0, candidates=2, max_angle=0.4)
    time, torque = read_torques(output)
    np.testing.assert_allclose([time, torque], [motion.time, motion.torque], rtol=1e-8)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("time,torque\n", "no lines below"),
        ("time,angle\n0,1\n", "no column is called 'torque'"),
        ("time,torque\n0,1\n0,2\n", "line 3: its time is not after"),
        ("time,torque\n0,\n", "line 2: expected a time and a finite torque"),
    ],
)
def test_torque_files_of_no_use_are_refused(tmp_path: Path, text: str, match: str) -> None:
    path = tmp_path / "motion.csv"
    path.write_text("time [ms];torque [Nmm]\n10;500\n20;1500\n")
    assert [each.tolist() for each in read_torques(path)] == [[0.0, 0.01], [0.5, 1.5]]
    path.write_text(text)
    with pytest.raises(LogError, match=f"motion.csv: .*{match}"):
        read_torques(path)
