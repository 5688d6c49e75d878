# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""T–S systems in the observer node, alone and beside an arm."""

import math
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState
from staging.stage import BEGIN, PERIOD, Event, Stage, replayed, values
from staging.stamps import to_stamp

from tsobs_ros.design.file import load_design, load_request, save_design
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.resources import config_path

EXAMPLE = config_path("paper_example_1.design.yaml")


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
    assert "position of encoder missing (names ['drive'])" in capfd.readouterr().err
    good = [event for event in events if event is not events[40]]
    assert replayed(stage.watcher, observer, good) >= 59
    assert stage.watcher.broken == []
