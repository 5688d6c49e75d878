# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An observer's process in real time, with a robot's /joint_states."""

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState
from staging import diagnostics, to_nanoseconds, to_stamp, values

import tsobs_ros as ts
from tsobs_ros.series import NANOSECONDS

README = (Path(__file__).resolve().parents[2] / "README.md").read_text(encoding="utf-8")
PERIOD, DURATION = 5_000_000, 1.5
NAMES = ["wrist", "shoulder", "elbow"]


def test_the_joint_states_of_a_robot_are_measurements(
    ros: Any, ros_process: Callable[..., Any], design: ts.Design
) -> None:
    """As ros2_control's broadcaster publishes them: all in one message, in any order, reliably.

    Effort is measured, so it is the torque up to the stamp, and NaN for a joint that has none.
    """
    (remapping,) = set(re.findall(r"-r joint_measurements:=\S*\w", README))
    runs = {name: ts.simulate(design, duration=60.0, seed=seed) for seed, name in enumerate(NAMES)}
    node = ros.node("joint_state_broadcaster")
    publisher = node.create_publisher(JointState, "joint_states", 10)
    began, sent = node.get_clock().now().nanoseconds, 0

    def publish() -> None:
        nonlocal sent
        while began + sent * PERIOD <= node.get_clock().now().nanoseconds:
            message = JointState(name=NAMES)
            message.header.stamp = to_stamp(began + sent * PERIOD)
            message.position = [float(runs[name].angle[sent]) for name in NAMES]
            message.velocity = [float(runs[name].state[sent, 1]) for name in NAMES]
            measured = float(runs["elbow"].torque[max(sent - 1, 0)])
            message.effort = [math.nan, math.nan, measured]
            publisher.publish(message)
            sent += 1

    kept: dict[str, list[JointState]] = {"joint_states": [], "error_bound": []}
    statuses = diagnostics(ros)
    for topic, messages in kept.items():
        node.create_subscription(JointState, f"observer/{topic}", messages.append, 100)
    observer = ros_process(
        "observer",
        arguments=["--ros-args", *remapping.split(), "-p", "joints:=[elbow, wrist]"],
    )
    observer.wait_for_line("certificate holds")
    began = node.get_clock().now().nanoseconds
    node.create_timer(PERIOD / NANOSECONDS, publish)

    def newest() -> tuple[float, JointState, JointState] | None:
        """Return the newest estimate with its bound, and the time since the beginning [s]."""
        bounds = {to_nanoseconds(each.header.stamp): each for each in kept["error_bound"]}
        for state in kept["joint_states"][::-1]:
            if (stamp := to_nanoseconds(state.header.stamp)) in bounds:
                return (stamp - began) / NANOSECONDS, state, bounds[stamp]
        return None

    def refused(joint: str) -> int:
        status = statuses.get(f"observer: {joint}: measurements")
        return int(values(status)["rejected: unknown input"]) if status else -1

    def is_done() -> bool:
        found = newest()
        there = found is not None and found[0] > DURATION
        return there and refused("wrist") > 50 and refused("elbow") >= 0

    ros.spin_until(is_done, 40.0, "estimates and counts")
    seconds, state, bound = newest() or (0.0, JointState(), JointState())
    for name in ("elbow", "wrist"):
        place = state.name.index(f"{name}_link")
        truth = [np.interp(seconds, runs[name].time, each) for each in runs[name].state.T]
        estimate = np.array([state.position[place], state.velocity[place]])
        limit = np.array([bound.position[place], bound.velocity[place]])
        assert (np.abs(estimate - truth[:2]) < 4.0 * limit).all(), name
    # Without a torque the bound is larger, and the angle is used all the same.
    assert (
        bound.position[state.name.index("wrist_link")]
        > bound.position[state.name.index("elbow_link")]
    )
    assert refused("elbow") == 0
