# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Several joints, each an arm or a T–S system of its design file, in the same messages."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from staging import start, to_nanoseconds

from tsobs_ros.errors import TsobsError
from tsobs_ros.model.arm import TorquePath
from tsobs_ros.nodes import observer, plant_simulator
from tsobs_ros.nodes.plant_simulator import plants_of
from tsobs_ros.nodes.plant_simulator.parameters import PlantSimulatorParameters
from tsobs_ros.paper.examples import example_1, example_2
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

BOTH = """
arm: {link_inertia: 0.5, motor_inertia: 1.0, stiffness: 200.0, gravity_torque: 0.0}
uncertainty: {}
rate: 500.0
outputs:
  - {measures: motor_angle, measurement_std: 0.001, delay: 0.004}
  - {measures: link_angle, measurement_std: 0.002, disturbance: [{kind: bias}]}
  - {measures: link_velocity, measurement_std: 0.05}
torque_disturbance: {link: [{kind: gauss_markov, std: 2.0, time_constant: 0.5}]}
torque: {gain: 0.9, offset: 0.1, delay: 0.003}
"""

PERIOD, START = 20_000_000, 100_000_000


@pytest.fixture
def joints(tmp_path: Path) -> dict[str, Any]:
    """Parameters of three joints: a design, a request of an arm, one of a T–S system."""
    (tmp_path / "elbow.request.yaml").write_text(BOTH)
    return {
        "rate": 50.0,
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
            "shoulder/link_angle: {dropout_interval: 0.2, dropout_duration: 0.1}",
            "motor_angle: {dropout_interval: 0.2, dropout_duration: 0.1}",
        ],
        "joint_mismatch": ["shoulder/stiffness: 0.2", "pendulum/gravity: -0.1"],
        "seed": 7,
        # The wall clock may stand still for a second on a busy machine, and the stamps then jump.
        "publish_clock": True,
    }
    listener.start(**given)
    listener.wait_for(listener.measurements, 30)
    parameters = PlantSimulatorParameters(
        **{name: tuple(v) if isinstance(v, list) else v for name, v in given.items()}
    )
    assert parameters.scenarios["shoulder"].true_arm.stiffness == 12.0
    elbow = parameters.scenarios["elbow"]
    assert elbow.torque == TorquePath(0.9, 0.1, 0.003)
    assert [output.delay for output in elbow.outputs] == [0.004, 0.0, 0.0]
    plants = plants_of(parameters)
    runs = [plant.run(1000) for plant in plants]
    # The first samples may have come before all subscriptions were matched.
    first = listener.states[0]
    seen = runs[0].physical[:, 0].tolist().index(entry(first.message, "shoulder_link"))
    begin = first.stamp - seen * PERIOD
    for stamp, message in listener.measurements:
        k = (stamp - begin) // PERIOD
        lost = k >= 10 and k % 10 < 5
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
    ros: Any, listener: Any, joints: dict[str, Any], capfd: pytest.CaptureFixture[str]
) -> None:
    node = listener.start(**joints, command_timeout=0.0, torque_limit=5.0)
    listener.wait_for(listener.measurements, 1)
    for values in ((1.0,), (), (1.0, math.nan, 1.0), (math.inf, 1.0, 1.0)):
        listener.command(*values)
    listener.command(9.0, -1.0, 9.0)
    ros.spin_until(
        lambda: entry(listener.measurements[-1].message, "shoulder", "effort") == 5.0,
        what="the command",
    )
    message = listener.measurements[-1].message
    assert entry(message, "elbow", "effort") == -1.0
    assert entry(message, "pendulum/drive") == 9.0
    logged = capfd.readouterr().err
    assert "rejected 1 torque commands so far: expected 3 finite numbers, got [1.0]" in logged
    (refused,) = node.set_parameters([Parameter("signals", value=["elbow/wrist: bias_step"])])
    assert "parameter 'signals[0]': expected one of shoulder/" in refused.reason
    line = "elbow/link_angle: {kind: bias_step, amplitude: 0.3}"
    (accepted,) = node.set_parameters([Parameter("signals", value=[line])])
    assert accepted.successful
    ros.spin_until(
        lambda: entry(listener.disturbances[-1].message, "elbow/link_angle") == 0.3,
        what="the fault",
    )
    values = {tuple(item.message.position) for item in listener.disturbances}
    assert {sum(map(abs, each)) for each in values} == {0.0, 0.3}
    # One for all outputs.
    node.set_parameters([Parameter("disturbance.kind", value="bias_step")])
    ros.spin_until(
        lambda: entry(listener.disturbances[-1].message, "shoulder") == 0.1, what="the other fault"
    )


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("joint_designs", ["a.yaml"], "joint_designs: expected one for each of"),
        ("joint_designs", ["", "a.yaml", ""], "a.yaml"),
        ("signals", ["elbow/torque: ramp"], r"signals\[0\]': elbow/torque: kind"),
        ("signals", ["elbow/link_torque: {kind: ramp, slope: 1.0}"], r"elbow/link_torque: .*slope"),
        ("signals", ["elbow/link_angle: {dropout: 1.0}"], r"elbow/link_angle: .*dropout"),
        ("joint_mismatch", ["pendulum/g: 0.1"], r"joint_mismatch\[0\]"),
        ("signals", ["torque: {kind: file, file: no.csv}"], "cannot read it: No such file"),
        ("initial_state", [0.1], r"initial_state: expected 4 \+ 4 \+ 2 numbers"),
    ],
)
def test_what_names_no_joint_or_signal_is_refused(
    ros: Any, joints: dict[str, Any], name: str, value: list[str], reason: str
) -> None:
    with pytest.raises(TsobsError, match=reason):
        start(ros, "plant_simulator", **joints | {name: value})


RATE, SECONDS, SETTLED = 250.0, 10.0, 9.0
# Driven time starts at 1 s.
BEGIN, END = 1_000_000_000, 11_000_000_000


@pytest.mark.slow
@pytest.mark.parametrize(("number", "example"), [(1, example_1()), (2, example_2())])
def test_the_published_observer_follows_the_published_plant(
    listener: Any, number: int, example: Any
) -> None:
    ros, estimates = listener.ros, []
    listener.node.create_subscription(JointState, "observer/joint_states", estimates.append, 5000)
    files = [
        *("--params-file", str(config_path(f"paper_example_{number}.nodes.yaml"))),
        *("-p", f"design:={config_path(f'paper_example_{number}.design.yaml')}"),
    ]
    clock = ["-p", "publish_clock:=true", "-p", "real_time_factor:=1.0"]
    wait = ["-p", "wait_for_subscribers:=2", "-p", f"duration:={SECONDS}"]
    simulated = ["-p", "use_sim_time:=true", "-p", "publish_on:=measurement"]
    for module, extra in ((observer, simulated), (plant_simulator, [*clock, *wait])):
        arguments = ["--ros-args", *files, *extra]
        ros.add(module.create(context=ros.context, cli_args=arguments))
    truth = (listener.states, listener.disturbances)
    ros.spin_until(
        lambda: all(each and each[-1].stamp == END for each in truth), 60.0, "the end of the run"
    )
    times = np.arange(round(SECONDS * RATE) + 1) / RATE
    # The first samples may have come before all subscriptions were matched.
    for each in listener.disturbances:
        row = example.disturbance(times)[round((each.stamp - BEGIN) * RATE / 1e9)]
        np.testing.assert_allclose(each.message.position, row, atol=1e-10)
    true_times = [(each.stamp - BEGIN) / 1e9 for each in listener.states]
    states = np.array([each.message.position for each in listener.states])
    errors = []
    for message in estimates:
        time = (to_nanoseconds(message.header.stamp) - BEGIN) / 1e9
        if SETTLED < time < SECONDS:
            assert list(message.name) == ["x1", "x2", "x3"]
            true = [np.interp(time, true_times, column) for column in states.T]
            errors.append(np.array(message.position) - true)
    # What the printed uncertainty leaves of the error, about twice the RMS of docs/method.md.
    assert 0.0 < np.abs(errors).max() < 0.05
