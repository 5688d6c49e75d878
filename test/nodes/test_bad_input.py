# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every kind of bad input: what becomes of it, and that the observer comes back from it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from faults.arm import Arm
from faults.kinds import KINDS
from faults.script import Kind, complaints, table
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

from tsobs_ros.estimation.records import NANOSECONDS
from tsobs_ros.nodes.observer_io import MEASUREMENT_QOS

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
