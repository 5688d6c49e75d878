# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording of an observer is what was published, and is estimated over again to the last bit.

Of an observer that came late, was reset, silenced and ended, while the recorder ran throughout; and
of plant, observer and recorder together, then of another observer of what a player plays.
"""

import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock
from staging import by_topic, call, estimated_again, start, to_stamp
from staging.stage import BEGIN, OUTPUTS, PERIOD, TOPIC, Arm, Event, Stage, good
from std_srvs.srv import SetBool, Trigger

from tsobs_ros.bag.joint_states import JointStateDecoder
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.design.record import Design
from tsobs_ros.replay.estimate import Run

RESTARTS, HEALTH, RAN = "/observer/restarts", "/observer/health", "/observer/design"
TICKS = "/observer/ticks"
OBSERVED = [TOPIC, RESTARTS, HEALTH, TICKS, *(f"/observer/{name}" for name in OUTPUTS)]
ARM = Arm(BEGIN)


class Scene:
    """An observer in the hands of a test, and a recorder that misses nothing."""

    def __init__(self, stage: Stage, output: Path, **parameters: Any) -> None:
        self.stage = stage
        given = {"output": str(output), "topics": OBSERVED, **parameters}
        self._recorder = start(stage.ros, "recorder", **given)
        stage.wait_until(lambda: stage.sensor.get_subscription_count() > 0, "the recorder")
        self.sent = Counter[str]()
        stage.step(BEGIN - PERIOD)

    def start(self, **parameters: Any) -> None:
        """Start the observer; the recorder reads it from its first message on."""
        observer = self.stage.add(**parameters)
        self.stage.wait_until(lambda: self.stage.sensor.get_subscription_count() > 1, "matching")
        # Outputs are read by the stage and the recorder, ticks by the recorder alone.
        read = {f"/observer/{name}": 2 for name in OUTPUTS} | {TICKS: 1}
        self.stage.wait_until(
            lambda: all(
                each.get_subscription_count() >= read.get(each.topic_name, 0)
                for each in observer.publishers
            ),
            "matching of the outputs",
        )

    def end(self) -> None:
        """End the observer."""
        self.sent.update(f"/observer/{one.topic}" for one in self.stage.watcher.published)
        self.stage.remove()

    def play(self, count: int, outliers: int = 0) -> None:
        """Send samples, the last ones of them far off; one is late, one comes twice, one is NaN."""
        begin = self.stage.now + PERIOD
        events = good(ARM, begin, count * PERIOD * 1e-9)
        for k in (2, *range(count - outliers, count)):
            stamp = events[k].at
            events[k] = Event(
                stamp, ARM.message(stamp, position=[math.nan if k == 2 else 100.0 + k])
            )
        late = events[4]
        events[4:8] = [*events[5:7], events[6], Event(events[7].at, late.message), events[7]]
        self.stage.play(events)
        self.sent[TOPIC] += len(events)

    def recorded(self) -> Path:
        """Return the finished bag."""

        def all_there() -> bool:
            there = self._recorder.recording.counts
            return all(there[topic] == count for topic, count in self.sent.items())

        self.stage.wait_until(all_there, "everything in the bag")
        self._recorder.close()
        return Path(self._recorder.path)


def agreed(run: Run) -> Any:
    """Return how estimates agree with recorded ones, which is to the last bit."""
    agreement = run.agreement()
    assert agreement is not None
    assert agreement.reproduced == agreement.recorded, agreement.text()
    return agreement


@pytest.mark.parametrize("use_sim_time", [False, True])
def test_what_an_observer_did_not_receive_is_left_out_and_all_the_rest_reproduced(
    stage: Stage,
    manage: Callable[[Any], Any],
    design: Design,
    tmp_path: Path,
    use_sim_time: bool,
) -> None:
    """Simulated time restarts in between, which the recorder may follow, or not."""
    scene = Scene(stage, tmp_path / "bag", use_sim_time=use_sim_time)
    scene.play(20)
    scene.start()
    scene.play(40, outliers=3)
    scene.play(20, outliers=1)
    assert stage.call(Trigger, "/observer/reset").success
    scene.play(20)
    assert stage.call(SetBool, "/observer/enable", SetBool.Request(data=False)).success
    scene.play(20)
    assert stage.call(SetBool, "/observer/enable", SetBool.Request(data=True)).success
    scene.play(20, outliers=2)
    assert manage(stage.observer).change("deactivate")
    scene.play(20)
    assert manage(stage.observer).change("activate")
    scene.play(20)
    scene.end()
    scene.play(20)
    scene.start()
    scene.play(20, outliers=1)
    stage.step(BEGIN)
    scene.play(20)
    scene.end()
    scene.play(20)
    bag = scene.recorded()
    expected = by_topic(bag)
    restarts = map(JointStateDecoder(), expected[RESTARTS])
    assert [each.position[0] for each in restarts] == [0, 1, 2, 3, 0, 1]

    again = tmp_path / "again"
    run = estimated_again(bag, again, design)
    agreement = agreed(run)
    assert agreement.recorded == 160
    assert run.rewinds > 0
    assert {reason.text for reason in run.rejected} >= {"duplicate stamp", "non-finite"}
    assert agreement.not_received >= 100
    came = by_topic(again)
    # The measurements are those that were used; the design is not recorded here.
    del expected[TOPIC], came[TOPIC], came[RAN]
    assert came == expected


TIMEOUT = 60.0
STATES, INNOVATION = "/observer/joint_states", "/observer/innovation"
SAMPLES = 201


def record(ros: Any, node: Any, bag: Path, source: tuple[str, dict[str, Any]], **of: Any) -> None:
    """Let plant or player publish to an observer, and record all of both without a loss."""
    estimating = start(ros, "observer", **of)
    recording = start(
        ros, "recorder", output=str(bag), topics=OBSERVED, use_sim_time="use_sim_time" in of
    )
    outputs = [each for each in estimating.publishers if each.topic_name in OBSERVED]
    ros.spin_until(
        lambda: all(each.get_subscription_count() for each in outputs), what="the outputs' match"
    )
    name, parameters = source
    publishing = start(ros, name, wait_for_subscribers=2, wait_timeout=0.0, **parameters)
    ros.spin_until(lambda: publishing.finished, TIMEOUT, "the end of the run")
    for publisher in publishing.publishers:
        assert publisher.wait_for_all_acked(Duration(seconds=10))
    ros.remove(publishing)  # a player would say for ever that it is the end
    if "use_sim_time" in of:  # the last sample may have come after the last tick
        after = BagReader(parameters["bag"]).end_time + PERIOD
        nodes, clock = (estimating, recording), node.create_publisher(Clock, "/clock", 10)

        def tick_on() -> bool:
            # Again and again, as a best-effort reader loses what it has not matched yet.
            clock.publish(Clock(clock=to_stamp(after)))
            return all(each.get_clock().now().nanoseconds == after for each in nodes)

        ros.spin_until(tick_on, what="a last clock")
    ros.spin_until(lambda: estimating.joints[0].received == SAMPLES, TIMEOUT, "all samples' use")
    call(ros, node, SetBool, "observer/enable", SetBool.Request(data=False))
    for publisher in estimating.publishers:
        assert publisher.wait_for_all_acked(Duration(seconds=10))

    def all_there() -> bool:
        counts = recording.recording.counts
        return bool(counts[TOPIC] == counts[INNOVATION] == SAMPLES)

    ros.spin_until(all_there, TIMEOUT, "everything in the bag")
    recording.close()
    assert recording.lost == 0
    assert estimating.joints[0].tracker.used == SAMPLES
    for finished in (estimating, recording):
        ros.remove(finished)


def test_a_bag_of_plant_and_observer_replays_and_is_played_to_the_last_bit(
    ros: Any, design: Design, tmp_path: Path
) -> None:
    node, bag, played = ros.node("caller"), tmp_path / "bag", tmp_path / "played"
    plant = {"seed": 11, "duration": (SAMPLES - 1) / 200.0}
    record(ros, node, bag, ("plant_simulator", plant))
    run = estimated_again(bag, tmp_path / "again", design)
    stored, came = by_topic(bag), by_topic(tmp_path / "again")
    del came[RAN]  # what the estimates were made with, which was not recorded here
    assert came == stored
    assert agreed(run).reproduced == len(stored[STATES]) > 10

    player = {"bag": str(bag), "topics": [TOPIC], "clock": 200.0}
    # A machine that is held up may bring measurements before the /clock that they belong to.
    late = {"use_sim_time": True, "future_tolerance": 60.0}
    record(ros, node, played, ("player", player), **late)
    # The innovations do not depend on when ticks were; the estimates are of other moments.
    replayed = by_topic(played)
    assert replayed[INNOVATION] == stored[INNOVATION]
    assert replayed[TOPIC] == stored[TOPIC]
    again = estimated_again(played, tmp_path / "played_again", design, future_tolerance=60.0)
    assert agreed(again).recorded > 10
