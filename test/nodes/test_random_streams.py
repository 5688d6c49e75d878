# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Ten thousand messages of anything: the observer goes on, and what it keeps is bounded."""

import gc
import tracemalloc
from typing import Any

import numpy as np
import pytest
from faults.arm import Arm
from faults.stage import Event, Stage
from faults.streams import Mix, arrivals, mixes
from hypothesis import HealthCheck, Phase, given, settings
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from tsobs_ros.estimation.records import NANOSECONDS

RATE = 10.0
PERIOD = round(NANOSECONDS / RATE)
PART, PARTS = 1250, 4
PROPERTY = settings(
    max_examples=2,
    # The observer lives on from one example to the next, as it must; so there is no shrinking.
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@pytest.fixture
def stage(ros: Any) -> Stage:
    stage = Stage(ros)
    stage.add(rate=RATE)
    stage.step(1000 * NANOSECONDS)
    return stage


def events(mix: Mix, begin: int, count: int) -> list[Event]:
    """Return a stream as messages; those without a sample are of somebody else's joints."""
    arm = Arm(begin)
    sent = []
    for at, sample in arrivals(mix, arm, begin, count):
        if sample is None:
            sent.append(Event(at, arm.message(begin, name=["elbow", "wrist"])))
            continue
        message = arm.message(begin, position=sample.y.tolist(), effort=sample.u.tolist())
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(sample.stamp, NANOSECONDS)
        sent.append(Event(at, message))
    return sent


def play(stage: Stage, mix: Mix, count: int) -> None:
    """Send a stream from now on; the books balance all the way."""
    sent = events(mix, stage.now + PERIOD, count)
    begun = {name: stage.counts(name).received for name in stage.observers}
    end = max(stage.now + PERIOD, sent[-1].at + PERIOD)
    stage.play(sent, end - end % PERIOD, PERIOD)
    for name, before in begun.items():
        counts = stage.counts(name)
        assert counts.received - before == count
        assert counts.received == counts.used + sum(counts.rejected.values())
        assert stage.watchers[name].broken == []


@PROPERTY
@given(mix=mixes(), other=mixes())
def test_anything_may_come_and_a_reset_observer_is_a_new_one(
    stage: Stage, mix: Mix, other: Mix
) -> None:
    for part in range(PARTS):
        play(stage, mix._replace(seed=mix.seed + part), PART)
        if part == PARTS // 2:
            stage.step(stage.now - 400 * PERIOD)
            stage.step(stage.now + PERIOD)  # the first tick after that restarts
            assert stage.counts().received == 0
    assert stage.call(Trigger, "/observer/reset", Trigger.Request()).success
    outputs: dict[str, list[Any]] = {"": [], "/fresh": []}
    stage.watchers[""].keep = keeper(outputs[""])
    stage.add("/fresh", keeper(outputs["/fresh"]), rate=RATE)
    play(stage, other, 1000)
    assert outputs[""] == outputs["/fresh"]
    assert len(outputs[""]) > 100
    assert stage.counts("") == stage.counts("/fresh")
    stage.watchers[""].keep = None
    stage.remove("/fresh")


def keeper(kept: list[Any]) -> Any:
    def keep(topic: str, message: JointState) -> None:
        stamp, numbers = message.header.stamp, (*message.position, *message.velocity)
        kept.append((topic, stamp.sec, stamp.nanosec, np.array(numbers).tobytes()))

    return keep


def test_memory_is_bounded(stage: Stage) -> None:
    mix = Mix(seed=7, weights=(20, *[1] * 8, 0, 1), period=5_000_000, bias=0.0)
    sizes = []
    for part in range(4):
        play(stage, mix._replace(seed=part), 1000)
        if part == 1:
            tracemalloc.start()
        if part:
            gc.collect()
            sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    # Only what comes to stay is counted: a thousand messages kept would be half a megabyte.
    assert sizes[2] - sizes[1] < 100_000, sizes
