# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording of an observer that came late, was reset, silenced and ended, estimated over again.

The recorder runs throughout, so its bag has measurements that the observer never used.
"""

import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from staging import by_topic, estimated_again, start
from staging.arm import Arm
from staging.stage import BEGIN, OUTPUTS, PERIOD, TOPIC, Event, Stage, good
from std_srvs.srv import SetBool, Trigger

from tsobs_ros.bag.joint_states import JointStateDecoder
from tsobs_ros.design.record import Design

RESTARTS, HEALTH, RAN = "/observer/restarts", "/observer/health", "/observer/design"
TICKS = "/observer/ticks"
ARM = Arm(BEGIN)


class Scene:
    """An observer in the hands of a test, and a recorder that misses nothing."""

    def __init__(self, stage: Stage, manage: Callable[[Any], Any], output: Path) -> None:
        self.stage, self._manage = stage, manage
        topics = [TOPIC, RESTARTS, HEALTH, TICKS, *(f"/observer/{name}" for name in OUTPUTS)]
        self._recorder = start(stage.ros, "recorder", output=str(output), topics=topics)
        stage.wait_until(lambda: stage.sensor.get_subscription_count() > 0, "the recorder")
        self.sent = Counter[str]()
        stage.step(BEGIN - PERIOD)

    def start(self, **parameters: Any) -> None:
        """Start the observer; the recorder reads it from its first message on."""
        observer = self.stage.add(**parameters)
        self.stage.wait_until(lambda: self.stage.sensor.get_subscription_count() > 1, "matching")
        self.stage.wait_until(
            lambda: all(
                each.get_subscription_count() > (each.topic_name != TICKS)
                for each in self._outputs(observer)
            ),
            "matching of the outputs",
        )

    def end(self) -> None:
        """End the observer."""
        self.sent.update(f"/observer/{one.topic}" for one in self.stage.watcher.published)
        self.stage.remove()

    def play(self, count: int, outliers: int = 0) -> None:
        """Send samples, the last ones of them far off."""
        begin = self.stage.now + PERIOD
        events = good(ARM, begin, count * PERIOD * 1e-9)
        for k in range(count - outliers, count):
            stamp = events[k].at
            events[k] = Event(stamp, ARM.message(stamp, position=[100.0 + k]))
        self.send(events)

    def send(self, events: list[Event]) -> None:
        """Send messages."""
        self.stage.play(events)
        self.sent[TOPIC] += len(events)

    def call(self, service: str, request: Any) -> None:
        """Call a service of the observer."""
        kind = SetBool if service == "enable" else Trigger
        assert self.stage.call(kind, f"/observer/{service}", request).success

    def change(self, label: str) -> None:
        """Ask the observer for a transition."""
        assert self._manage(self.stage.observer).change(label)

    def recorded(self) -> Path:
        """Return the finished bag."""

        def all_there() -> bool:
            there = self._recorder.statistics.counts
            return all(there[topic] == count for topic, count in self.sent.items())

        self.stage.wait_until(all_there, "everything in the bag")
        self._recorder.close()
        return Path(self._recorder.path)

    @staticmethod
    def _outputs(observer: Any) -> list[Any]:
        return [each for each in observer.publishers
                if each.topic_name.rpartition("/")[2] in (*OUTPUTS, "ticks")]  # fmt: skip


@pytest.fixture
def scene(stage: Stage, manage: Callable[[Any], Any], tmp_path: Path) -> Scene:
    return Scene(stage, manage, tmp_path / "bag")


def test_what_an_observer_did_not_receive_is_left_out_and_all_the_rest_reproduced(
    scene: Scene, design: Design, tmp_path: Path
) -> None:
    scene.play(50)
    scene.start()
    scene.play(60, outliers=3)
    scene.play(60, outliers=1)
    scene.call("reset", Trigger.Request())
    scene.play(60)
    scene.call("enable", SetBool.Request(data=False))
    scene.play(40)
    scene.call("enable", SetBool.Request(data=True))
    scene.play(60, outliers=2)
    scene.change("deactivate")
    scene.play(40)
    scene.change("activate")
    scene.play(60)
    scene.end()
    scene.play(40)
    scene.start()
    scene.play(60, outliers=1)
    scene.stage.step(BEGIN)
    scene.play(60)
    scene.end()
    scene.play(40)
    bag = scene.recorded()
    expected = by_topic(bag)
    restarts = map(JointStateDecoder(), expected[RESTARTS])
    assert [each.position[0] for each in restarts] == [0, 1, 2, 3, 0, 1]

    again = tmp_path / "again"
    agreement = estimated_again(bag, again, design).agreement()

    assert agreement is not None
    assert agreement.complete, agreement.text()
    assert agreement.recorded == 420
    assert agreement.not_received >= 210
    came = by_topic(again)
    # The measurements are those that were used; the design is not recorded here.
    del expected[TOPIC], came[TOPIC], came[RAN]
    assert came == expected


def test_joints_of_late_doubled_and_unusable_messages_are_reproduced(
    scene: Scene, design: Design, tmp_path: Path
) -> None:
    """Two joints, each in messages of its own, before and after a reset."""
    arms = [Arm(BEGIN, joint) for joint in ("elbow", "wrist")]
    scene.start(joints=["elbow", "wrist"])
    for _ in range(2):
        begin = scene.stage.now + PERIOD
        events = [
            Event(stamp, arm.message(stamp))
            for stamp in arms[0].stamps(begin, 60 * PERIOD * 1e-9)
            for arm in arms
        ]
        late = events.pop(20)
        events.insert(30, Event(events[30].at, late.message))
        events.insert(50, events[49])
        for place, position in ((60, math.nan), (70, 100.0)):
            at = events[place].at
            events[place] = Event(at, arms[0].message(at, position=[position]))
        scene.send(events)
        scene.call("reset", Trigger.Request())
    scene.end()
    bag = scene.recorded()

    run = estimated_again(bag, tmp_path / "again", design)

    agreement = run.agreement()
    assert agreement is not None
    assert agreement.complete, agreement.text()
    assert agreement.recorded > 100
    assert (agreement.not_received, agreement.not_recorded, agreement.lost_ticks) == (0, 0, 0)
    assert run.loop.rewinds > 0
    assert {reason.value for reason in run.loop.rejected} >= {"duplicate stamp", "non-finite"}
    expected, came = by_topic(bag), by_topic(tmp_path / "again")
    for topic in expected:
        # Of one tick, messages of single joints and checksums may be in another order.
        if topic not in (TICKS, TOPIC):
            assert sorted(came[topic]) == sorted(expected[topic]), topic
