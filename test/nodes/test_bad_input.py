# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every kind of bad input: what becomes of it, and that the observer comes back from it."""

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from faults.arm import Arm
from faults.kinds import KINDS
from faults.script import Event, Kind, complaints, table
from faults.stage import Stage
from faults.watcher import SIGMAS
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from sensor_msgs.msg import JointState

from tsobs_ros.estimation.records import NANOSECONDS
from tsobs_ros.nodes.observer.io import MEASUREMENT_QOS

ROOT = Path(__file__).resolve().parents[2]
BEGIN = 100 * NANOSECONDS
RATE = 25.0
PERIOD = round(NANOSECONDS / RATE)


@pytest.fixture
def stage(ros: Any) -> Iterator[Stage]:
    stage = Stage(ros)
    yield stage
    stage.close()


def test_the_catalogue_is_documented() -> None:
    page = (ROOT / "docs" / "robustness.md").read_text(encoding="utf-8")
    assert len(KINDS) >= 25
    assert table(Arm(BEGIN)) in page, "paste what `python -m faults --list` prints"


def test_no_publisher_is_incompatible() -> None:
    """Sensor data QoS asks for nothing, so there is no QoS that a sensor could get wrong."""
    offers = [
        QoSProfile(depth=1, reliability=reliability, durability=durability, liveliness=liveliness)
        for reliability in (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE)
        for durability in (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL)
        for liveliness in (LivelinessPolicy.AUTOMATIC, LivelinessPolicy.MANUAL_BY_TOPIC)
    ]
    for offer in offers:
        compatible, reason = qos_check_compatible(offer, MEASUREMENT_QOS)
        # A warning is for what it leaves to the system's default.
        assert compatible != QoSCompatibility.ERROR, reason


SPOILT = {
    "not a number": lambda turn: ([math.nan], [0.0]),
    "infinite torque": lambda turn: ([0.1], [math.inf]),
    "largest angle": lambda turn: ([(-1.0) ** turn * 1.7e308], [0.0]),
    "largest torque": lambda turn: ([0.1 + 1e-3 * turn], [(-1.0) ** turn * 1.7e308]),
    "torque steps": lambda turn: ([0.1 + 1e-3 * turn], [(-1.0) ** turn * 1e6]),
    "stuck": lambda turn: ([0.1], [0.0]),
    "absent": lambda turn: ([], []),
}


@pytest.mark.parametrize("spoilt", SPOILT)
def test_what_befalls_one_joint_leaves_the_others_bits_alone(stage: Stage, spoilt: str) -> None:
    """Two joints in one node, one of them spoilt, beside a node with only the good one."""
    kept: dict[str, list[tuple[Any, ...]]] = {"/both": [], "/alone": []}

    def keeper(namespace: str) -> Any:
        def keep(topic: str, message: JointState) -> None:
            rows = zip(message.name, message.position, strict=True)
            rates = message.velocity or [0.0] * len(message.name)
            stamp = message.header.stamp
            kept[namespace] += [
                (topic, stamp.sec, stamp.nanosec, name, struct.pack("<2d", position, rate))
                for (name, position), rate in zip(rows, rates, strict=True)
                if name.startswith("elbow")
            ]

        return keep

    stage.add("/both", keeper("/both"), rate=RATE, joints=["shoulder", "elbow"])
    stage.add("/alone", keeper("/alone"), rate=RATE, joints=["elbow"])
    stage.step(BEGIN - PERIOD)
    arm, events = Arm(BEGIN, "elbow"), []
    for turn, stamp in enumerate(arm.stamps(BEGIN, 1.5)):
        sample = arm.measurement(stamp)
        bad = 60 <= turn < 200
        position, effort = SPOILT[spoilt](turn) if bad else (sample.y.tolist(), sample.u.tolist())
        names = ["shoulder", "elbow"] if position else ["elbow"]
        fields = {"position": [*position, *sample.y], "effort": [*effort, *sample.u]}
        events.append(Event(stamp, arm.message(stamp, name=names, **fields)))
    stage.play(events, BEGIN + round(1.5 * NANOSECONDS), PERIOD)
    assert kept["/both"] == kept["/alone"]
    assert len(kept["/alone"]) > 300
    assert stage.watchers["/both"].broken == []
    counts = stage.counts("/both")
    absent = 140 if spoilt == "absent" else 0
    assert (
        counts.received == 2 * len(events) - absent == counts.used + sum(counts.rejected.values())
    )


@pytest.mark.parametrize("kind", KINDS.values(), ids=list(KINDS))
def test_bad_input_is_counted_for_what_it_is_and_the_observer_recovers(
    stage: Stage, kind: Kind
) -> None:
    stage.add(rate=RATE)
    stage.step(BEGIN - PERIOD)
    arm = Arm(BEGIN)
    events = kind.script(arm)
    stage.play(events, BEGIN + round(kind.seconds * NANOSECONDS), PERIOD)
    watcher = stage.watchers[""]
    assert complaints(events, stage.counts()) == []
    assert watcher.broken == []
    assert watcher.stamp() == stage.now
    assert watcher.sigmas(arm) < SIGMAS
