# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Several joints, each an arm or a T–S system of its design file, in the same messages."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter

from tsobs_ros.errors import ParameterError
from tsobs_ros.nodes.plant_simulator import create
from tsobs_ros.nodes.plant_simulator.node import plants_of
from tsobs_ros.nodes.plant_simulator.parameters import PlantSimulatorParameters
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

BOTH = """
arm: {link_inertia: 0.5, motor_inertia: 1.0, stiffness: 200.0, gravity_torque: 0.0}
uncertainty: {}
rate: 500.0
outputs:
  - {measures: motor_angle, measurement_std: 0.001}
  - {measures: link_angle, measurement_std: 0.002, disturbance: [{kind: bias}]}
  - {measures: link_velocity, measurement_std: 0.05}
torque_disturbance: {link: [{kind: gauss_markov, std: 2.0, time_constant: 0.5}]}
"""
PERIOD, START = 5_000_000, 100_000_000


@pytest.fixture
def joints(tmp_path: Path) -> dict[str, Any]:
    """Parameters of three joints: a design, a request of an arm, one of a T–S system."""
    (tmp_path / "elbow.request.yaml").write_text(BOTH)
    return {
        "rate": 200.0,
        "joints": ["shoulder", "elbow", "pendulum"],
        "design": str(config_path(SHIPPED_DESIGN)),
        "joint_designs": [
            "",
            str(tmp_path / "elbow.request.yaml"),
            str(config_path("ts_example.request.yaml")),
        ],
    }


def entry(message: Any, name: str, field: str = "position") -> float:
    return float(getattr(message, field)[message.name.index(name)])


def test_joints_of_design_files_are_in_the_same_messages(
    listener: Any, joints: dict[str, Any]
) -> None:
    given = {
        **joints,
        "signals": [
            "elbow/link_torque: {kind: bias_step, amplitude: 3.0, start: 0.1}",
            "elbow/torque: {kind: constant, amplitude: 0.25}",
            "pendulum/gyroscope: {kind: bias_step, amplitude: 0.5, start: 0.1}",
        ],
        "affected": ["shoulder/link_angle", "elbow/motor_angle"],
        "dropouts.interval": 0.2,
        "dropouts.duration": 0.1,
        "joint_mismatch": ["shoulder/stiffness: 0.2", "pendulum/gravity: -0.1"],
        "seed": 7,
        # The wall clock may stand still for a second on a busy machine, and the stamps then jump.
        "publish_clock": True,
    }
    listener.start(**given)
    listener.wait_for(listener.measurements, 100)
    parameters = PlantSimulatorParameters(
        **{k: tuple(v) if isinstance(v, list) else v for k, v in given.items() if "." not in k}
    )
    assert parameters.scenarios()["shoulder"].true_arm.stiffness == 12.0
    plants = plants_of(parameters)
    runs = [plant.run(1000) for plant in plants]
    # The first samples may have come before all subscriptions were matched.
    first = listener.states[0]
    seen = runs[0].physical[:, 0].tolist().index(entry(first.message, "shoulder_link"))
    begin = first.stamp - seen * PERIOD
    for stamp, message in listener.measurements:
        k = (stamp - begin) // PERIOD
        lost = k >= 40 and k % 40 < 20
        # The shoulder has no other output, the elbow has.
        others = {"elbow", "elbow_motor", "pendulum/drive", "pendulum/encoder"}
        assert set(message.name) == {
            *others, "pendulum/gyroscope", *([] if lost else ["shoulder"]),
        }  # fmt: skip
        if not lost:
            assert entry(message, "shoulder") == runs[0].measurements[k, 0]
            assert entry(message, "shoulder", "effort") == runs[0].torques[k, 0]
        motor = entry(message, "elbow_motor")
        assert math.isnan(motor) if lost else motor == runs[1].measurements[k, 0]
        assert entry(message, "elbow") == runs[1].measurements[k, 1]
        assert entry(message, "elbow", "velocity") == runs[1].measurements[k, 2]
        assert entry(message, "elbow", "effort") == 0.25
        assert message.header.frame_id == ""
        assert math.isnan(entry(message, "elbow_motor", "effort"))
        assert entry(message, "pendulum/gyroscope") == runs[2].measurements[k, 1]
        assert math.isnan(entry(message, "pendulum/gyroscope", "effort"))
    for stamp, message in listener.states:
        k = (stamp - begin) // PERIOD
        assert entry(message, "elbow_motor", "velocity") == runs[1].physical[k, 3]
        assert entry(message, "pendulum/angle") == runs[2].physical[k, 0]
    for stamp, message in listener.disturbances:
        assert entry(message, "pendulum/gyroscope") == (0.5 if stamp - begin >= START else 0.0)
        assert entry(message, "shoulder") == entry(message, "elbow/link_angle") == 0.0
    for stamp, message in listener.torques:
        assert list(message.name) == [
            "shoulder_motor", "shoulder_link", "elbow_motor", "elbow_link",
        ]  # fmt: skip
        assert list(message.effort) == [0.0, 0.0, 0.0, 3.0 if stamp - begin >= START else 0.0]


def test_a_joint_is_commanded_and_disturbed_by_itself_while_running(
    listener: Any, joints: dict[str, Any]
) -> None:
    node = listener.start(**joints, command_timeout=0.0, torque_limit=5.0)
    listener.wait_for(listener.measurements, 1)
    for values in ((1.0,), (), (1.0, math.nan, 1.0), (math.inf, 1.0, 1.0)):
        listener.command(*values)
    listener.command(9.0, -1.0, 9.0)
    listener.wait_until(
        lambda: entry(listener.measurements[-1].message, "shoulder", "effort") == 5.0, "the command"
    )
    message = listener.measurements[-1].message
    assert entry(message, "elbow", "effort") == -1.0
    assert entry(message, "pendulum/drive") == 9.0
    assert node.rejected_commands == 4
    (refused,) = node.set_parameters([Parameter("signals", value=["elbow/wrist: bias_step"])])
    assert "parameter 'signals[0]': expected one of shoulder/link_angle" in refused.reason
    line = "elbow/link_angle: {kind: bias_step, amplitude: 0.3}"
    (accepted,) = node.set_parameters([Parameter("signals", value=[line])])
    assert accepted.successful
    listener.wait_until(
        lambda: entry(listener.disturbances[-1].message, "elbow/link_angle") == 0.3, "the fault"
    )
    values = {tuple(item.message.position) for item in listener.disturbances}
    assert {sum(map(abs, each)) for each in values} == {0.0, 0.3}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda p: p.update(joint_designs=["a.yaml"]), "joint_designs: expected one for each of"),
        (lambda p: p.update(joint_designs=["", "a.yaml", ""]), "a.yaml"),
        (lambda p: p.update(joints=["a", "a", "b"]), "joints: expected names, each once"),
        (lambda p: p.update(signals=["elbow/torque: ramp"]), r"signals\[0\]': elbow/torque: kind"),
        (lambda p: p.update(signals=["- a"]), r"signals\[0\]': expected one 'name: value'"),
        (
            lambda p: p.update(signals=["elbow/link_torque: {kind: ramp, slope: 1.0}"]),
            r"signals\[0\]': elbow/link_torque: .*slope",
        ),
        (lambda p: p.update(affected=["elbow/link"]), r"affected\[0\]': expected one of"),
        (lambda p: p.update(joint_mismatch=["pendulum/g: 0.1"]), r"joint_mismatch\[0\]"),
        (lambda p: p.update(initial_state=[0.1]), r"initial_state: expected 4 \+ 4 \+ 2 numbers"),
        (lambda p: p.update({"payload.joints": ["pendulum"]}), "payload.joints: expected arms"),
    ],
)
def test_what_names_no_joint_or_signal_is_refused(
    ros: Any, joints: dict[str, Any], change: Callable[[dict[str, Any]], None], reason: str
) -> None:
    change(joints)
    overrides = [Parameter(name, value=value) for name, value in joints.items()]
    with pytest.raises(ParameterError, match=reason):
        create(context=ros.context, parameter_overrides=overrides)
