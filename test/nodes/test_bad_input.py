# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bad input on the topics of a live observer, of which one joint's bits never depend on another's.

test/estimation/test_faults_of_input.py has all kinds of bad samples, without a node.
"""

import numpy as np
import pytest
from rclpy.qos import (
    DurabilityPolicy,
    ReliabilityPolicy,
)
from staging.arm import Arm
from staging.stage import BEGIN, Event, Stage, Watcher

from tsobs_ros.series import NANOSECONDS

RATE = 25.0
PERIOD = round(NANOSECONDS / RATE)
RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
LATCHING = DurabilityPolicy.TRANSIENT_LOCAL


SPOILT = {
    "largest torque": lambda turn: ([0.1 + 1e-3 * turn], [(-1.0) ** turn * 1.7e308]),
    "absent": lambda turn: ([], []),
}


def elbows(watcher: Watcher) -> list[tuple[str, int, str, bytes]]:
    return [
        (topic, stamp, name, np.array([position, rate]).tobytes())
        for topic, stamp, message in watcher.published
        for name, position, rate in zip(
            message.name,
            message.position,
            message.velocity or [0.0] * len(message.name),
            strict=True,
        )
        if name.startswith("elbow")
    ]


@pytest.mark.parametrize("spoilt", SPOILT)
def test_what_befalls_one_joint_leaves_the_others_bits_alone(stage: Stage, spoilt: str) -> None:
    """Two joints in one node, one of them spoilt, beside a node with only the good one."""
    stage.add("/both", rate=RATE, joints=["shoulder", "elbow"])
    stage.add("/alone", rate=RATE, joints=["elbow"])
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
    both, alone = elbows(stage.watchers["/both"]), elbows(stage.watchers["/alone"])
    assert both == alone
    assert len(alone) > 300
    assert stage.watchers["/both"].broken == []
    counts = stage.counts("/both")
    absent = 140 if spoilt == "absent" else 0
    assert (
        counts.received == 2 * len(events) - absent == counts.used + sum(counts.rejected.values())
    )
