# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the observer reads from bytes is what rclpy would, and what it writes rclpy would write."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from staging import to_stamp
from std_msgs.msg import Header

from tsobs_ros.design.file import load_request
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output, TorqueDisturbance
from tsobs_ros.estimation.records import Estimate
from tsobs_ros.nodes.observer.messages import EstimatePublisher
from tsobs_ros.replay.samples import MISSING, NOT_NAMED, WRONG, Batch, MeasurementReader
from tsobs_ros.resources import config_path

ARM, SYSTEM = ArmRequest(), load_request(config_path("ts_example.request.yaml"))
BOTH_SIDES = ArmRequest(outputs=[Output("link_angle", 1e-3), Output("motor_angle", 1e-3)])
MOTOR = ArmRequest(outputs=[Output("motor_angle", 1e-3)])
VELOCITIES = ArmRequest(outputs=[Output("motor_velocity", 1e-3), Output("motor_angle", 1e-3)])
WAVE = (DisturbanceTerm("gauss_markov", {"std": 1.0, "time_constant": 1.0}),)
HIP, KNEE, DRIVE = "hip", "knee", ["drive", "gyroscope", "encoder"]
STAMP, NAN = 12_000_000_345, math.nan
JOINTS = {joint: ARM.signals(joint, alone=False) for joint in (HIP, KNEE)}


def message(names: list[str], position: list[float], effort: list[float], **header: Any) -> bytes:
    state = JointState(name=names, position=position, effort=effort)
    state.header = Header(**{"stamp": to_stamp(STAMP), **header})
    return bytes(serialize_message(state))


def shown(batch: Batch) -> list[Any]:
    """Return of each joint outputs and inputs of the only message, or the code of its rejection."""
    rows = zip(batch.y, batch.u, batch.codes[:, 0].tolist(), strict=True)
    return [code or (y[0].tolist(), u[0].tolist()) for y, u, code in rows]


@pytest.mark.parametrize(
    ("names", "position", "effort", "expected"),
    [
        (["knee", "x", "hip"], [1.0, 2.0, 3.0], [4.0, 5.0, 6.0],
         [([3.0], [6.0]), ([1.0], [4.0])]),
        (["hip", "hip"], [1.0, 2.0], [3.0, 4.0], [([1.0], [3.0]), NOT_NAMED]),
        (["hip", "knee"], [1.0, 2.0], [3.0], [([1.0], [3.0]), MISSING]),
        (["hip", "knee"], [1.0], [3.0, 4.0], [([1.0], [3.0]), WRONG]),
        (["x"], [1.0], [1.0], [WRONG, WRONG]),
    ],
)  # fmt: skip
def test_each_joint_finds_its_sample(
    names: list[str], position: list[float], effort: list[float], expected: list[Any]
) -> None:
    reader = MeasurementReader(JOINTS, assume_zero_torque=False)
    data = message(names, position, effort)
    for _ in range(2):  # the second time with what the reader remembers
        assert shown(reader.read([data])) == expected


@pytest.mark.parametrize(
    ("request_", "names", "fields", "expected"),
    [
        # Some drivers have the torque with the motor.
        (BOTH_SIDES, ["hip_motor", "hip"],
         {"position": [2.0, 1.0], "effort": [4.0]}, ([1.0, 2.0], [4.0])),
        (BOTH_SIDES, ["hip"], {"position": [1.0], "effort": [3.0]}, ([1.0, NAN], [3.0])),
        (BOTH_SIDES, ["hip", "hip_motor"],
         {"position": [NAN, 2.0], "effort": [3.0, 3.0]}, ([NAN, 2.0], [3.0])),
        (BOTH_SIDES, ["hip", "hip_motor"], {"position": [1.0, 2.0]}, MISSING),
        (BOTH_SIDES, ["hip", "hip_motor"], {"velocity": [1.0, 2.0], "effort": [3.0, 3.0]}, WRONG),
        (VELOCITIES, ["hip"],
         {"position": [1.0], "velocity": [2.0], "effort": [3.0]}, ([2.0, 1.0], [3.0])),
        # A motor's own entry is its sensor; the joint's is then the link.
        (MOTOR, ["hip", "hip_motor"], {"position": [1.0, 2.0], "effort": [3.0]}, ([2.0], [3.0])),
        (MOTOR, ["hip_motor"], {"position": [2.0], "effort": [4.0]}, ([2.0], [4.0])),
        (MOTOR, ["hip"], {"position": [1.0], "effort": [3.0]}, ([1.0], [3.0])),
        (SYSTEM, DRIVE, {"position": [3.0, 2.0, 1.0]}, ([1.0, 2.0], [3.0])),
        (SYSTEM, DRIVE[1:], {"position": [1.0, 2.0]}, MISSING),
    ],
)  # fmt: skip
def test_what_a_message_lacks_of_several_outputs_is_nan(
    request_: Any, names: list[str], fields: dict[str, list[float]], expected: Any
) -> None:
    reader = MeasurementReader({HIP: request_.signals(HIP, alone=True)}, assume_zero_torque=False)
    data = bytes(serialize_message(JointState(name=names, **fields)))
    assert str(shown(reader.read([data]))) == str([expected])  # NaN equals NaN in text
    if isinstance(expected, int):
        assert "missing" in reader.describe(data, HIP)


def test_a_joint_with_the_name_of_a_motor_is_a_joint() -> None:
    joints = {joint: MOTOR.signals(joint, alone=False) for joint in (HIP, "hip_motor")}
    reader = MeasurementReader(joints, assume_zero_torque=False)
    data = message([*joints], [1.0, 2.0], [3.0, 4.0])
    assert shown(reader.read([data])) == [([1.0], [3.0]), ([2.0], [4.0])]


def test_messages_that_wait_together_come_in_the_order_of_their_stamps() -> None:
    reader = MeasurementReader(JOINTS, assume_zero_torque=False)
    data = [
        message([HIP, KNEE], [float(k), 10.0 * k], [0.0, 1.0], stamp=Time(sec=k, nanosec=5))
        for k in (3, 1, 4, 2)
    ]

    batch = reader.read([*data, b"rubbish"])

    assert batch.order == [4, 1, 3, 0, 2]
    assert batch.stamps[1:].tolist() == [k * 10**9 + 5 for k in (1, 2, 3, 4)]
    hip, knee = batch.y
    assert np.hstack([hip, knee])[1:].tolist() == [[k, 10.0 * k] for k in (1.0, 2.0, 3.0, 4.0)]
    assert np.hstack(batch.u)[1:].tolist() == [[0.0, 1.0]] * 4
    assert batch.codes.tolist() == [[WRONG, 0, 0, 0, 0]] * 2


GOOD = ([1.0], [3.0])
OTHERS = [f"joint_{index}" for index in range(3000)]
MANY = [NAN] * len(OTHERS)
MESSAGES = {
    "empty": (bytes(serialize_message(JointState())), WRONG),
    "no position": (message([HIP], [], [3.0]), WRONG),
    "more names than positions": (message(["x", HIP], [1.0], [3.0]), WRONG),
    "more positions than names": (message([HIP], [1.0, 9.0, 9.0], [3.0, 9.0]), GOOD),
    "thousands of joints": (message([*OTHERS, HIP], [*MANY, 1.0], [*MANY, 3.0]), GOOD),
    "very long name": (message(["x" * 100_000], [1.0], [3.0]), WRONG),
    "name that is not ascii": (message(["елбоу 关节\x1b[31m🦾"], [1.0], [3.0]), WRONG),
    "truncated": (message([HIP], [1.0], [3.0])[:50], WRONG),
    "random": (b"\x00\x01\x00\x00" + b"\xff" * 60, WRONG),
    "name that is not utf8": (message(["hipX"], [1.0], [3.0]).replace(b"pX", b"\xff\xfe"), WRONG),
}


@pytest.mark.parametrize("kind", MESSAGES)
def test_bad_messages_are_refused_in_a_short_line_or_read(kind: str) -> None:
    data, expected = MESSAGES[kind]
    reader = MeasurementReader({HIP: JOINTS[HIP]}, assume_zero_torque=False)
    assert shown(reader.read([data])) == [expected]
    assert len(reader.describe(data, HIP)) < 500


@pytest.mark.parametrize(("sec", "nanosec"), [(9, 3_000_000_345), (-5, 0)])
def test_any_stamp_is_the_sum_of_its_seconds_and_nanoseconds(sec: int, nanosec: int) -> None:
    reader = MeasurementReader(JOINTS, assume_zero_torque=False)
    batch = reader.read([message([HIP], [1.0], [3.0], stamp=Time(sec=sec, nanosec=nanosec))])
    assert batch.stamps.tolist() == [sec * 10**9 + nanosec]


@given(data=st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    reader = MeasurementReader(JOINTS, assume_zero_torque=False)
    valid = message(["hip", "knee"], [1.0, 2.0], [3.0, 4.0])
    for each in (data, valid[: len(data)], valid[: len(data) // 2] + data):
        assert [y.shape for y in reader.read([each]).y] == [(1, 1)] * len(JOINTS)
        assert reader.describe(each, "hip")


def test_what_is_published_is_what_rclpy_would_send(ros: Any) -> None:
    """Of an arm without bounds, one with torques, and a T–S system among them."""
    node = ros.node("observer")
    pushed = ArmRequest(torque_disturbance=TorqueDisturbance(link=WAVE, motor=WAVE))
    requests: dict[str, Any] = {"hip": ArmRequest(), "arm": pushed, "tank": SYSTEM}
    joints = {joint: each.signals(joint, alone=False) for joint, each in requests.items()}
    publisher = EstimatePublisher(node, joints, [("stiffness",), (), ()])
    topics = [each for each in node.publishers if each.msg_type is JointState]
    kept: dict[str, JointState] = {}
    for topic in (each.topic_name for each in topics):
        keep = partial(kept.__setitem__, topic.rpartition("/")[2])
        node.create_subscription(JointState, topic, keep, 10)
    ros.spin_until(lambda: all(each.get_subscription_count() for each in topics), what="matching")
    one, two = np.array([1.0]), np.array([5.0, 6.0])
    hip = Estimate(STAMP, state=np.array([1.0, 2.0, 3.0, 4.0]), disturbance=one,
                   disturbance_rate=0.0 * one, parameters=-one, parameter_bound=one,
                   parameters_valid=True)  # fmt: skip
    arm = hip._replace(state_bound=0.5 * hip.state, torque_disturbance=two, parameters_valid=False)
    tank = Estimate(STAMP, state=two, disturbance=two, disturbance_rate=two)

    publisher.publish(STAMP, {0: hip, 1: arm, 2: tank})
    publisher.publish_innovations([STAMP], [[NAN, 1.0, NAN, 2.0]])
    sides = ["hip_link", "hip_motor", "arm_link", "arm_motor"]
    outputs = ["tank/encoder", "tank/gyroscope"]
    expected: dict[str, dict[str, Any]] = {
        "joint_states": {
            "name": [*sides, "tank/angle", "tank/rate"],
            "position": [1.0, 3.0, 1.0, 3.0, 5.0, 6.0],
            "velocity": [2.0, 4.0, 2.0, 4.0, NAN, NAN],
        },
        "error_bound": {"name": sides[2:], "position": [0.5, 1.5], "velocity": [1.0, 2.0]},
        "disturbance": {
            "name": ["hip", "arm", *outputs],
            "position": [1.0, 1.0, 5.0, 6.0],
            "velocity": [0.0, 0.0, 5.0, 6.0],
        },
        "parameters_estimate": {"name": ["hip/stiffness"], "position": [-1.0]},
        "torque_disturbance": {"name": ["arm_motor", "arm_link"], "effort": [5.0, 6.0]},
        "innovation": {"name": ["arm", "tank/gyroscope"], "position": [1.0, 2.0]},
    }
    ros.spin_until(lambda: kept.keys() >= expected.keys(), what="the messages")
    for topic, fields in expected.items():
        wanted = JointState(**fields)
        wanted.header.stamp = to_stamp(STAMP)
        # NaN equals NaN in text.
        assert str(kept[topic]) == str(wanted)
