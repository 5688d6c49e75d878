# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Floods of bad messages at an observer's process, in real time."""

import math
import re
import signal
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from staging import diagnostics, to_nanoseconds, values
from staging.stage import PERIOD, Arm

from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.series import NANOSECONDS

TIMEOUT = 120.0
COUNT = 10_000
BEST_EFFORT = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
Make = Callable[[Arm, int, int], Any]
"""A message from the arm, the stamp of its newest good one [ns], and its number in the flood."""


def fresh(message: Callable[[Arm, int, int], dict[str, Any]], early: int = 0) -> Make:
    """A good sample, changed, with a stamp of its own and an angle unlike the last."""

    def make(arm: Arm, newest: int, number: int) -> Any:
        y = float(arm.measurement(newest).y[0]) + 0.01 * math.sin(7.0 * number)
        stamp = newest + number - early
        return arm.message(stamp, **{"position": [y], **message(arm, newest, number)})

    return make


FLOODS: dict[str, tuple[Make, RejectReason | None]] = {
    "infinite torque": (fresh(lambda *_: {"effort": [math.inf]}), RejectReason.IMPLAUSIBLE_TORQUE),
    "foreign joint": (fresh(lambda *_: {"name": ["elbow"]}), RejectReason.WRONG_JOINT),
    "bytes": (lambda *_: b"\x00\x01\x00\x00" + b"\xff" * 60, RejectReason.WRONG_JOINT),
    "clock since boot": (fresh(lambda *_: {}, 3600 * NANOSECONDS), RejectReason.TOO_OLD),
    "outliers in a row": (fresh(lambda _, __, n: {"position": [9.0 + n]}), RejectReason.GATED),
    "descending": (lambda arm, newest, number: arm.message(newest - 20_000 * number), None),
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
        stamp = now - (now - self.arm.origin) % PERIOD
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

    def flood(make: Make, grow: list[str]) -> None:
        """Publish a flood, until it is counted and estimates come at their rate again."""
        limits = {key: counts()[key] + 1000 for key in grow}
        sensor.flood(make)
        end = time.time_ns()
        goes_on(lambda: estimated[-1] > end, "an estimate after the flood")
        since = len(estimated)
        goes_on(lambda: len(estimated) > since + 50, "its rate after the flood")
        goes_on(lambda: all(counts()[key] > limits[key] for key in limits), "the flood's counts")
        rejected = sum(value for key, value in counts().items() if key.startswith("rejected"))
        assert counts()["received"] == counts()["used"] + rejected

    process.wait_for_line("certificate holds", TIMEOUT)
    began = time.monotonic()
    goes_on(lambda: len(estimated) > 100, "the first estimates")
    for make, reason in FLOODS.values():
        flood(make, ["received", *([f"rejected: {reason.text}"] if reason else [])])
    lasted = time.monotonic() - began

    process.signal(signal.SIGINT)
    sensor.flood(FLOODS["descending"][0])
    finished = process.finish(TIMEOUT)
    assert finished.exit_code == 0, finished.stderr
    assert "Traceback" not in finished.stderr
    logged = Counter(re.findall(r"rejected: ([\w -]+) \(", finished.stderr + finished.stdout))
    assert set(logged) <= {reason.text for reason in RejectReason}
    assert max(logged.values()) <= 1 + lasted / 5.0
    stamps = np.array(estimated[1:])
    assert (np.diff(stamps) > 0).all()
