# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An observer's process in real time: a robot's /joint_states, and floods of bad messages."""

import math
import re
import signal
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from staging import diagnostics, to_nanoseconds, to_stamp, values
from staging.arm import Arm

import tsobs_ros as ts
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.nodes.observer.joints import NAMES as REASONS
from tsobs_ros.series import NANOSECONDS

README = (Path(__file__).resolve().parents[2] / "README.md").read_text(encoding="utf-8")
PERIOD, DURATION = 5_000_000, 4.0
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

    def elapsed() -> float:
        states = kept["joint_states"]
        return (to_nanoseconds(states[-1].header.stamp) - began) / NANOSECONDS if states else 0.0

    ros.spin_until(
        lambda: elapsed() > DURATION and len(kept["error_bound"]) > 10, 40.0, "estimates"
    )
    reason = "rejected: unknown input"

    def refused(joint: str) -> int:
        status = statuses.get(f"observer: {joint}: measurements")
        return int(values(status)[reason]) if status else -1

    ros.spin_until(lambda: refused("wrist") > 100 and refused("elbow") >= 0, 10.0, "the counts")

    bounds = {to_nanoseconds(each.header.stamp): each for each in kept["error_bound"]}
    state = next(
        each for each in kept["joint_states"][::-1] if to_nanoseconds(each.header.stamp) in bounds
    )
    bound = bounds[to_nanoseconds(state.header.stamp)]
    seconds = (to_nanoseconds(state.header.stamp) - began) / NANOSECONDS
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


TIMEOUT = 120.0
COUNT = 10_000
WRONG = RejectReason.WRONG_JOINT.value
BEST_EFFORT = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
Make = Callable[[Arm, int, int], Any]

"""A message from the arm, the stamp of its newest good one [ns], and its number in the flood."""


def alone(**changes: Any) -> Make:
    return lambda arm, newest, _: arm.message(newest + 1000, **changes)


def stamped(shift: Callable[[int], int]) -> Make:
    """A good sample, but for its stamp; no two have the same angle."""

    def make(arm: Arm, newest: int, number: int) -> Any:
        y = float(arm.measurement(newest).y[0]) + 0.01 * math.sin(7.0 * number)
        return arm.message(newest + shift(number), position=[y])

    return make


def as_bytes(change: Callable[[bytes], bytes]) -> Make:
    return lambda arm, newest, _: change(bytes(serialize_message(arm.message(newest))))


FLOODS: dict[str, tuple[Make, str | None]] = {
    "nan angle": (alone(position=[math.nan]), RejectReason.NON_FINITE.value),
    "infinite torque": (
        lambda arm, newest, number: arm.message(
            newest + number, position=[0.01 * (number % 5)], effort=[math.inf]
        ),
        RejectReason.IMPLAUSIBLE_TORQUE.value,
    ),
    "foreign joint": (alone(name=["elbow"]), WRONG),
    "truncated bytes": (as_bytes(lambda data: data[:50]), WRONG),
    "random bytes": (as_bytes(lambda _: b"\x00\x01\x00\x00" + b"\xff" * 60), WRONG),
    "clock since boot": (stamped(lambda _: -3600 * NANOSECONDS), RejectReason.TOO_OLD.value),
    "outliers in a row": (
        lambda arm, newest, number: arm.message(newest + number, position=[9.0 + number]),
        RejectReason.GATED.value,
    ),
    "descending": (stamped(lambda number: -20_000 * number), None),
    "late in turn": (stamped(lambda number: -(number % 2) * 200_000_000 - 100 * number), None),
}


class Sensor:
    """Publishes good samples in real time, as often as it is asked to, and floods between them."""

    def __init__(self, ros: Any) -> None:
        self._node = ros.node("sensor")
        self.arm = Arm(time.time_ns())
        self.newest = self.arm.origin
        self.publisher = self._node.create_publisher(JointState, "joint_measurements", BEST_EFFORT)

    def publish_due(self) -> None:
        """Publish the newest good sample if it has not been."""
        now = time.time_ns()
        stamp = now - (now - self.arm.origin) % self.arm.period
        if stamp > self.newest:
            self.newest = stamp
            self.publisher.publish(self.arm.message(stamp))

    def flood(self, make: Make) -> None:
        """Publish a flood as fast as can be, with good samples as they are due."""
        for number in range(COUNT):
            self.publisher.publish(make(self.arm, self.newest, number))
            if number % 50 == 0:
                self.publish_due()


@pytest.mark.slow
def test_after_each_flood_the_observer_goes_on_and_a_signal_ends_it_in_the_last(
    ros: Any, ros_process: Callable[..., Any]
) -> None:
    process = ros_process("observer")
    sensor, estimated, statuses = Sensor(ros), [0], diagnostics(ros)
    node = ros.node("watch")
    node.create_subscription(
        JointState, "observer/joint_states",
        lambda message: estimated.append(to_nanoseconds(message.header.stamp)), BEST_EFFORT,
    )  # fmt: skip

    def counts() -> Counter[str]:
        of_all = values(statuses["observer: measurements"]) if statuses else {}
        return Counter({key: int(value) for key, value in of_all.items() if key != "remedy"})

    def goes_on(condition: Callable[[], bool], what: str) -> None:
        def met() -> bool:
            sensor.publish_due()
            return condition()

        ros.spin_until(met, TIMEOUT, what)

    process.wait_for_line("certificate holds", TIMEOUT)
    began = time.monotonic()
    goes_on(lambda: len(estimated) > 100, "the first estimates")
    for name, (make, reason) in FLOODS.items():
        grow = ["received"] if reason is None else ["received", f"rejected: {reason}"]
        limits = {key: counts()[key] + 1000 for key in grow}
        sensor.flood(make)
        end = time.time_ns()
        goes_on(lambda end=end: estimated[-1] > end, f"an estimate after the flood: {name}")
        since = len(estimated)
        goes_on(lambda since=since: len(estimated) > since + 50, f"its rate after: {name}")
        goes_on(
            lambda limits=limits: all(counts()[key] > limits[key] for key in limits),
            f"the counts of the flood: {name}",
        )
        rejected = {key: value for key, value in counts().items() if key.startswith("rejected")}
        assert counts()["received"] == counts()["used"] + sum(rejected.values()), name
    lasted = time.monotonic() - began

    process.signal(signal.SIGINT)
    sensor.flood(FLOODS["descending"][0])
    finished = process.finish(TIMEOUT)
    assert finished.exit_code == 0, finished.stderr
    assert "Traceback" not in finished.stderr
    logged = Counter(re.findall(r"rejected: ([\w -]+) \(", finished.stderr + finished.stdout))
    assert set(logged) <= set(REASONS)
    assert max(logged.values()) <= 1 + lasted / 5.0
    stamps = np.array(estimated[1:])
    assert (np.diff(stamps) > 0).all()
