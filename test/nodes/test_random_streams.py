# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Ten thousand messages of anything: the observer goes on, and what it keeps is bounded."""

import gc
import tracemalloc

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from staging.arm import Arm
from staging.stage import Event, Stage
from staging.streams import Mix, arrivals, mixes
from std_srvs.srv import Trigger

from tsobs_ros.series import NANOSECONDS

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
def playing(stage: Stage) -> Stage:
    stage.add(rate=RATE)
    stage.step(1000 * NANOSECONDS)
    return stage


def events(mix: Mix, begin: int, count: int) -> list[Event]:
    """Return a stream as messages; those without a sample are of other joints."""
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
    playing: Stage, mix: Mix, other: Mix
) -> None:
    for part in range(PARTS):
        play(playing, mix._replace(seed=mix.seed + part), PART)
        if part == PARTS // 2:
            playing.step(playing.now - 400 * PERIOD)
            playing.step(playing.now + PERIOD)  # the first tick after that restarts
            assert playing.counts().received == 0
    assert playing.call(Trigger, "/observer/reset", Trigger.Request()).success
    playing.add("/fresh", rate=RATE)
    playing.watcher.published.clear()
    play(playing, other, 1000)
    outputs = [
        [(each.topic, each.stamp, each.bits) for each in playing.watchers[name].published]
        for name in ("", "/fresh")
    ]
    assert outputs[0] == outputs[1]
    assert len(outputs[0]) > 100
    assert playing.counts("") == playing.counts("/fresh")
    playing.remove("/fresh")


def test_memory_is_bounded(playing: Stage) -> None:
    mix = Mix(seed=7, weights=(20, *[1] * 8, 0, 1), period=5_000_000, bias=0.0)
    sizes = []
    for part in range(6):
        play(playing, mix._replace(seed=part), 600)
        playing.watcher.published.clear()
        if part == 1:
            tracemalloc.start()
        if part:
            gc.collect()
            sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    # Only what comes to stay is counted: 600 messages kept would be a quarter of a megabyte. The
    # windows that diagnostics look back over have filled before.
    assert sizes[-1] - sizes[-2] < 60_000, sizes
