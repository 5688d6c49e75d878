# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers of several outputs, of torques and of T–S systems, live."""

import math
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Log
from sensor_msgs.msg import JointState
from staging import to_stamp, values
from staging.stage import BEGIN, PERIOD, Event, Stage, replayed

from tsobs_ros.design.file import load_design, load_request, save_design
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.plant import Scenario, SimulatedOutput, TorqueDisturbance, Trajectories
from tsobs_ros.simulation.scenarios import simulate
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep

RATE = 50.0
STEP = round(1e9 / RATE)
CONTACT, CONTACT_AT = 4.0, 2.0
BIAS = 0.05
NAMES = ["elbow", "elbow_motor"]


@pytest.fixture(scope="module")
def run() -> Trajectories:
    """Both encoders of an arm, the link's with a bias, and a contact from some time on."""
    scenario = Scenario(
        rate=RATE,
        outputs=(
            SimulatedOutput("link_angle", Sensor(1e-3), (BiasStep(BIAS, 0.0),)),
            SimulatedOutput("motor_angle", Sensor(1e-3)),
        ),
        torque_disturbance=TorqueDisturbance(link=(BiasStep(CONTACT, CONTACT_AT),)),
    )
    return simulate(scenario, [3], 8.0)


def events(run: Trajectories, first: int, count: int, *present: int) -> list[Event]:
    """Return samples with the entries of some of the encoders."""
    found = []
    for k in range(first, first + count):
        stamp = BEGIN + k * STEP
        message = JointState(
            name=[NAMES[output] for output in present],
            position=[float(run.measurements[0, k, output]) for output in present],
            effort=[float(run.torques[0, k, 0])] * len(present),
        )
        message.header.stamp = to_stamp(stamp)
        found.append(Event(stamp, message))
    return found


def test_a_contact_is_estimated_and_an_encoder_that_stops_is_reported(
    stage: Stage, both_design: Path, run: Trajectories
) -> None:
    logged: list[Log] = []
    stage.node.create_subscription(Log, "/rosout", logged.append, 100)
    observer = stage.add(rate=RATE, joints=["elbow"], design=str(both_design), torque_warn=[2.0])
    stage.step(BEGIN - STEP)
    watcher = stage.watcher

    def logs(text: str) -> bool:
        return any(line.level == Log.WARN and text in line.msg for line in logged)

    before = events(run, 0, 170, 0, 1)
    stage.play(before, period=STEP)

    outputs = ["elbow/link_angle", "elbow/motor_angle"]
    for topic, names in {
        "joint_states": ["elbow_link", "elbow_motor"],
        "error_bound": ["elbow_link", "elbow_motor"],
        **dict.fromkeys(("disturbance", "disturbance_bound", "innovation"), outputs),
        "torque_disturbance": ["elbow_link"],
        "torque_disturbance_bound": ["elbow_link"],
    }.items():
        assert {tuple(each.message.name) for each in watcher.of(topic)} == {tuple(names)}
    torque, bound = (
        np.array([each.message.effort[0] for each in watcher.of(topic)])
        for topic in ("torque_disturbance", "torque_disturbance_bound")
    )
    touched = round(CONTACT_AT * RATE)
    assert (np.abs(torque[50:touched]) < 4.0 * bound[50:touched]).all()
    assert abs(torque[-1] - CONTACT) < 4.0 * bound[-1]
    bias = watcher.of("disturbance")[-1].message.position[0]
    assert bias == pytest.approx(
        BIAS, abs=4.0 * watcher.of("disturbance_bound")[-1].message.position[0]
    )
    stage.wait_until(lambda: logs("at the link, beyond 2 N m"), "the log of the contact")
    found = stage.statuses()
    status = found["observer: torque disturbance"]
    assert status.level == DiagnosticStatus.WARN
    assert float(values(status)["link [N m]"]) == pytest.approx(torque[-1], rel=1e-3)
    for output in ("link_angle", "motor_angle"):
        assert found[f"observer: sensor fault of {output}"].level < DiagnosticStatus.ERROR

    narrow = watcher.of("error_bound")[-1].message.position[1]
    after = events(run, 170, 180, 0)
    stage.play(after, period=STEP)
    assert observer.joints[0].tracker.used == 350
    assert observer.joints[0].tracker.output_counts[1]["missing"] == 180
    assert {tuple(each.message.name) for each in watcher.of("innovation")[170:]} == {
        ("elbow/link_angle",)
    }
    assert watcher.of("error_bound")[-1].message.position[1] > 10.0 * narrow
    found = stage.statuses()
    fault = found["observer: sensor fault of motor_angle"]
    assert (fault.level, fault.message) == (DiagnosticStatus.ERROR, "missing")
    assert values(fault)["since"].startswith("for ")
    assert values(found["observer: measurements"])["motor_angle: missing"] == "180"
    assert found["observer: sensor fault of link_angle"].message != "missing"
    stage.wait_until(
        lambda: logs("motor_angle is missing: expected position of elbow_motor"), "its log"
    )
    assert logs("position of elbow_motor missing, effort of elbow")
    assert replayed(watcher, observer, [*before, *after]) >= 350


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The design file of the pendulum with an encoder and a gyroscope that is shipped."""
    path = tmp_path_factory.mktemp("designs") / "pendulum.design.yaml"
    save_design(synthesise(load_request(config_path("ts_example.request.yaml"))), path)
    return path


def swing(count: int, prefix: str = "") -> list[Event]:
    """Return messages about the pendulum."""
    found = []
    for k in range(count):
        stamp, angle = BEGIN + k * PERIOD, 0.01 * k
        message = JointState(
            name=[prefix + name for name in ("drive", "gyroscope", "encoder")],
            position=[0.1, 0.3 * math.cos(angle), 0.3 * math.sin(angle)],
        )
        message.header.stamp = to_stamp(stamp)
        found.append(Event(stamp, message))
    return found


def test_a_system_alone_has_the_names_of_its_file(
    stage: Stage, pendulum: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    observer = stage.add(joints=["pendulum"], design=str(pendulum), rate=200.0)
    stage.step(BEGIN - PERIOD)
    events = swing(60)
    # Without a gyroscope, and without any output.
    events[30].message.position[1] = math.nan
    events[40].message.name = ["drive"]
    events[40].message.position = [0.1]
    stage.play(events)

    assert observer.joints[0].tracker.used == 59
    states, outputs = ["angle", "rate"], ["encoder", "gyroscope"]
    for topic, names in {
        "joint_states": states,
        "error_bound": states,
        "disturbance": outputs,
        "disturbance_bound": outputs,
    }.items():
        assert {tuple(each.message.name) for each in stage.watcher.of(topic)} == {tuple(names)}
    assert len(stage.watcher.of("joint_states")[-1].message.velocity) == 0
    innovations = {each.stamp: list(each.message.name) for each in stage.watcher.of("innovation")}
    assert innovations.pop(events[30].at) == ["encoder"]
    assert set(map(tuple, innovations.values())) == {("encoder", "gyroscope")}
    found = stage.statuses()
    domain = found["observer: premise domain"]
    assert (domain.level, domain.message) == (
        DiagnosticStatus.OK, load_design(pendulum).request.claim
    )  # fmt: skip
    assert "magnitude [rad/s]" in values(found["observer: sensor fault of gyroscope"])
    assert "observer: hypothesis" not in found
    rejected = values(found["observer: measurements"])
    assert rejected["rejected: wrong joint or shape"] == "1"
    assert "position of encoder missing, position of gyroscope missing" in capfd.readouterr().err
    good = [event for event in events if event is not events[40]]
    assert replayed(stage.watcher, observer, good) >= 59
