# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's parameters: refused with a reason, or taken over all at once."""

from pathlib import Path
from typing import Any

from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from staging import start
from std_msgs.msg import String

from tsobs_ros.design.published import read_record
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path

SHIPPED, FIXED = config_path(SHIPPED_DESIGN), str(config_path(FIXED_DESIGN))


def test_senseless_or_structural_changes_are_refused_with_a_reason(
    ros: Any,
) -> None:
    node = start(ros, "observer")
    for name, value, reason in (
        ("design", "other.yaml", "read-only"),
        ("when_stale", "loud", "must be one of"),
        ("coast_after", 10.0, "coast_after: expected at most stale_after"),
        ("supervision.gate", 0.5, "out of range"),
        ("fault.warn", 0.6, "'fault.*': disturbance error level: expected at least"),
    ):
        before = node.get_parameter(name).value
        (result,) = node.set_parameters([Parameter(name, value=value)])
        assert not result.successful
        assert reason in result.reason
        assert node.get_parameter(name).value == before


def test_a_request_changes_all_joints_or_nothing(ros: Any, tmp_path: Path) -> None:
    own = tmp_path / "own.design.yaml"
    own.write_text(SHIPPED.read_text(encoding="utf-8"), encoding="utf-8")
    node = start(ros, "observer", joints=["hip", "knee"], joint_designs=[str(own), ""])
    assert [joint.loaded.name for joint in node.joints] == [str(own), str(SHIPPED)]
    wanted = {"supervision.gate": 4.0, "fault.hold": 1.0, "coast_after": -1.0}
    parameters = [Parameter(name, value=value) for name, value in wanted.items()]
    before = {name: node.get_parameter(name).value for name in wanted}
    limits = node.joints[0].faults[0].limits
    gates = [joint.tracker.estimator.model["gate"] for joint in node.joints]
    assert [gate.tolist() for gate in gates] == [[5.0], [5.0]]
    assert not node.set_parameters_atomically(parameters).successful
    assert {name: node.get_parameter(name).value for name in wanted} == before
    assert [joint.faults[0].limits for joint in node.joints] == [limits, limits]

    assert node.set_parameters_atomically(parameters[:2]).successful
    for joint in node.joints:
        assert joint.faults[0].limits.hold == 1.0
        assert joint.tracker.estimator.model["gate"].tolist() == [4.0]


def test_what_runs_is_published_for_those_who_come_later(ros: Any) -> None:
    node = start(
        ros, "observer", joints=["hip", "knee"], joint_designs=[FIXED, ""], settle_time=1.5
    )
    ros.spin_until(lambda: node.active)
    assert node.set_parameters([Parameter("supervision.gate", value=4.0)])[0].successful
    listener, received = ros.node("listener"), list[Any]()
    qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    listener.create_subscription(String, "/observer/design", received.append, qos)
    ros.spin_until(lambda: received)

    record = read_record(received[-1].data)
    assert record.measurements == "/joint_measurements"
    own = {joint: one for one in record.designs for joint in one.joints}
    for joint, path in (("hip", FIXED), ("knee", str(SHIPPED))):
        assert own[joint].file == path
        assert own[joint].text == Path(path).read_text(encoding="utf-8")
    known = ObserverSettings().with_parameters(record.parameters)
    assert (known.settle_time, known.supervision.gate) == (1.5, 4.0)
    assert known == node.parameters.settings
