# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers of several outputs, of torques and of T–S systems, live."""

import math
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState
from staging import to_stamp, values
from staging.stage import BEGIN, PERIOD, Event, Stage, Watcher, replayed

from tsobs_ros.design.file import load_design, load_request, save_design
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.plant import Scenario, SimulatedOutput, TorqueDisturbance
from tsobs_ros.simulation.scenarios import simulate
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import BiasStep

RATE = 50.0
STEP = round(1e9 / RATE)
CONTACT, CONTACT_AT, BIAS = 4.0, 2.0, 0.05
NAMES = ["elbow", "elbow_motor"]


def check_names(watcher: Watcher, **names: list[str]) -> None:
    """Check the entries in all messages of some topics."""
    found = {topic: {tuple(each.message.name) for each in watcher.of(topic)} for topic in names}
    assert found == {topic: {tuple(each)} for topic, each in names.items()}


def test_a_contact_is_estimated_and_an_encoder_that_stops_is_reported(
    stage: Stage, both_design: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    scenario = Scenario(
        rate=RATE,
        outputs=(
            SimulatedOutput("link_angle", Sensor(1e-3), (BiasStep(BIAS, 0.0),)),
            SimulatedOutput("motor_angle", Sensor(1e-3)),
        ),
        torque_disturbance=TorqueDisturbance(link=(BiasStep(CONTACT, CONTACT_AT),)),
    )
    run = simulate(scenario, [3], 8.0)

    def events(first: int, count: int, *present: int) -> list[Event]:
        """Return samples with the entries of some of the encoders."""
        found = []
        for k in range(first, first + count):
            message = JointState(
                name=[NAMES[output] for output in present],
                position=[float(run.measurements[0, k, output]) for output in present],
                effort=[float(run.torques[0, k, 0])] * len(present),
            )
            message.header.stamp = to_stamp(BEGIN + k * STEP)
            found.append(Event(BEGIN + k * STEP, message))
        return found

    observer = stage.add(rate=RATE, joints=["elbow"], design=str(both_design), torque_warn=[2.0])
    stage.step(BEGIN - STEP)
    watcher, tracker = stage.watcher, observer.joints[0].tracker
    before = events(0, 170, 0, 1)
    stage.play(before, period=STEP)

    sides, outputs = ["elbow_link", "elbow_motor"], ["elbow/link_angle", "elbow/motor_angle"]
    check_names(
        watcher, joint_states=sides, error_bound=sides, disturbance=outputs,
        disturbance_bound=outputs, innovation=outputs, torque_disturbance=["elbow_link"],
        torque_disturbance_bound=["elbow_link"],
    )  # fmt: skip
    torque, bound = (
        [each.message.effort[0] for each in watcher.of(topic)]
        for topic in ("torque_disturbance", "torque_disturbance_bound")
    )
    touched = round(CONTACT_AT * RATE)
    assert all(abs(torque[k]) < 4.0 * bound[k] for k in range(50, touched))
    assert abs(torque[-1] - CONTACT) < 4.0 * bound[-1]
    bias = watcher.of("disturbance")[-1].message.position[0]
    limit = 4.0 * watcher.of("disturbance_bound")[-1].message.position[0]
    assert bias == pytest.approx(BIAS, abs=limit)
    found = stage.statuses()
    status = found["observer: torque disturbance"]
    assert status.level == DiagnosticStatus.WARN
    assert float(values(status)["link [N m]"]) == pytest.approx(torque[-1], rel=1e-3)
    for output in ("link_angle", "motor_angle"):
        assert found[f"observer: sensor fault of {output}"].level < DiagnosticStatus.ERROR

    narrow = watcher.of("error_bound")[-1].message.position[1]
    after = events(170, 180, 0)
    stage.play(after, period=STEP)
    assert (tracker.used, int(tracker.state["sensors"]["missing"][0, 1])) == (350, 180)
    assert all(each.message.name == outputs[:1] for each in watcher.of("innovation")[170:])
    assert watcher.of("error_bound")[-1].message.position[1] > 10.0 * narrow
    found = stage.statuses()
    fault = found["observer: sensor fault of motor_angle"]
    assert (fault.level, fault.message) == (DiagnosticStatus.ERROR, "missing")
    assert values(fault)["since"].startswith("for ")
    assert values(found["observer: measurements"])["motor_angle: missing"] == "180"
    assert replayed(watcher, observer, [*before, *after]) >= 350
    log = capfd.readouterr().err
    for text in (
        "at the link, beyond 2 N m",
        "motor_angle is missing: expected position of elbow_motor",
        "position of elbow_motor missing, effort of elbow",
    ):
        assert text in log


def test_a_system_alone_has_the_names_of_its_file(
    stage: Stage, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "pendulum.design.yaml"
    save_design(synthesise(load_request(config_path("ts_example.request.yaml"))), path)
    observer = stage.add(joints=["pendulum"], design=str(path), rate=200.0)
    stage.step(BEGIN - PERIOD)
    events = []
    for k in range(60):
        stamp, angle = BEGIN + k * PERIOD, 0.01 * k
        message = JointState(
            name=["drive", "gyroscope", "encoder"],
            position=[0.1, 0.3 * math.cos(angle), 0.3 * math.sin(angle)],
        )
        message.header.stamp = to_stamp(stamp)
        events.append(Event(stamp, message))
    # Without a gyroscope, and without any output.
    events[30].message.position[1] = math.nan
    events[40].message.name = ["drive"]
    stage.play(events)

    assert observer.joints[0].tracker.used == 59
    states, outputs = ["angle", "rate"], ["encoder", "gyroscope"]
    check_names(
        stage.watcher, joint_states=states, error_bound=states, disturbance=outputs,
        disturbance_bound=outputs,
    )  # fmt: skip
    assert len(stage.watcher.of("joint_states")[-1].message.velocity) == 0
    innovations = {each.stamp: list(each.message.name) for each in stage.watcher.of("innovation")}
    assert innovations.pop(events[30].at) == ["encoder"]
    assert all(names == outputs for names in innovations.values())
    found = stage.statuses()
    domain = found["observer: premise domain"]
    assert domain.level == DiagnosticStatus.OK
    assert domain.message == load_design(path).request.claim
    assert "magnitude [rad/s]" in values(found["observer: sensor fault of gyroscope"])
    assert "observer: hypothesis" not in found
    rejected = values(found["observer: measurements"])
    assert rejected["rejected: wrong joint or shape"] == "1"
    assert "position of encoder missing, position of gyroscope missing" in capfd.readouterr().err
    good = [event for event in events if event is not events[40]]
    assert replayed(stage.watcher, observer, good) >= 59
