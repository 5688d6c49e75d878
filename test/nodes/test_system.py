# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Plant, observer and recorder together: the bag is what was published, and replays to the bit.

Afterwards by `tsobs estimate`'s core, and in real time by the player and another observer.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import JointState
from staging.stamps import to_nanoseconds
from std_msgs.msg import Int64MultiArray
from std_srvs.srv import SetBool

from tsobs_ros.bag import BagReader
from tsobs_ros.design.file import DesignFile
from tsobs_ros.design.record import Design
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.nodes import observer, plant_simulator, player, recorder
from tsobs_ros.nodes.wire import DrainedSubscription
from tsobs_ros.replay.estimate import Observer, Run, make_runs, run_all
from tsobs_ros.replay.source import BagSource

TIMEOUT = 60.0
MEASUREMENTS = "/joint_measurements"
TRUTH = ("/ground_truth/joint_states", "/ground_truth/disturbance")
ESTIMATES = (
    "/observer/joint_states",
    "/observer/error_bound",
    "/observer/disturbance",
    "/observer/disturbance_bound",
)
INNOVATION = "/observer/innovation"
RESTARTS, HEALTH, TICKS = "/observer/restarts", "/observer/health", "/observer/ticks"
TOPICS = (MEASUREMENTS, *TRUTH, *ESTIMATES, INNOVATION, RESTARTS, HEALTH, TICKS)
SAMPLES = 401


class Recording(NamedTuple):
    """A finished run: its bag, what a subscriber of all topics received, the observer's counts."""

    bag: Path
    received: dict[str, list[bytes]]
    used: int
    rejected: int
    lost: int


def start(ros: Any, module: Any, **parameters: Any) -> Any:
    overrides = [Parameter(n, value=v) for n, v in parameters.items()]
    return ros.add(module.create(context=ros.context, parameter_overrides=overrides))


@pytest.fixture
def recording(ros: Any, tmp_path: Path) -> Recording:
    """Two seconds of the three nodes on one executor, in real time."""
    node = ros.node("listener")
    qos = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)
    best_effort = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
    latched = QoSProfile(depth=5000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    profiles = dict.fromkeys(TOPICS, qos) | {MEASUREMENTS: best_effort, RESTARTS: latched}
    listening = {
        topic: DrainedSubscription(node, type_of(topic), topic, profile, raw=True)
        for topic, profile in profiles.items()
    }
    received: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}

    def listen() -> None:
        for topic, subscription in listening.items():
            received[topic] += [data for data, _ in subscription.drain()]

    estimating = start(ros, observer)
    recording = start(ros, recorder, output=str(tmp_path / "bag"), topics=list(TOPICS))
    plant = start(
        ros,
        plant_simulator,
        seed=11,
        duration=(SAMPLES - 1) / 200.0,
        wait_for_subscribers=4,
        wait_timeout=0.0,
    )

    def matched() -> bool:
        return recording.ready and all(s.publisher_count == 1 for s in listening.values())

    ros.spin_until(matched, TIMEOUT, "the match of everything")
    # The fourth subscription, which the plant has waited for.
    node.create_subscription(JointState, MEASUREMENTS, lambda _: None, best_effort)
    ros.spin_until(lambda: plant.finished, TIMEOUT, "the end of the run")
    ros.spin_until(lambda: estimating.received == SAMPLES, TIMEOUT, "all samples' use")

    client = node.create_client(SetBool, "observer/enable")
    ros.spin_until(client.service_is_ready, TIMEOUT, "the service")
    silenced = client.call_async(SetBool.Request(data=False))
    ros.spin_until(silenced.done, TIMEOUT, "the observer's silence")
    for publisher in (*estimating.publishers, *plant.publishers):
        assert publisher.wait_for_all_acked(Duration(seconds=10))

    def all_there() -> bool:
        listen()
        counts = recording.statistics.counts
        return len(received[MEASUREMENTS]) == SAMPLES and all(
            counts[topic] == len(received[topic]) for topic in TOPICS
        )

    ros.spin_until(all_there, TIMEOUT, "everything in the bag")
    recording.close()
    tracker = estimating.joints[0].tracker
    used, rejected = tracker.used, sum(tracker.rejected.values())
    for finished in (estimating, recording, plant):
        ros.remove(finished)
    return Recording(recording.path, received, used, rejected, recording.statistics.lost)


def type_of(topic: str) -> Any:
    return Int64MultiArray if topic == TICKS else JointState


def bits(message: Any) -> Any:
    if hasattr(message, "data"):
        return [int(number) for number in message.data]
    stamp = message.header.stamp
    numbers = np.array([*message.position, *message.velocity, *message.effort], dtype=np.float64)
    return stamp.sec * 10**9 + stamp.nanosec, list(message.name), numbers.tobytes()


def check_an_independent_reader(run: Recording) -> None:
    expected = {
        topic: [bits(deserialize_message(data, type_of(topic))) for data in messages]
        for topic, messages in run.received.items()
    }
    with AnyReader([run.bag]) as reader:
        came: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
        for connection, _, data in reader.messages():
            came[connection.topic].append(bits(reader.deserialize(data, connection.msgtype)))
    assert came == expected


def estimated_again(bag: Path, output: Path, design: Design) -> Run:
    """Run a design over a bag as `tsobs estimate` does, and write a bag of that."""
    source = BagSource(bag)
    (run,) = make_runs(
        source,
        [Observer("observer", ObserverSettings(), (DesignFile.of(design),))],
        rate=None,
        as_live=True,
    )
    run_all(source, [run], output)
    return run


def by_topic(bag: Path) -> dict[str, list[bytes]]:
    """Return the messages of a bag by topic, each in the order of its stamps."""
    found: dict[str, list[bytes]] = {}
    for message in BagReader(bag).messages():
        found.setdefault(message.topic, []).append(message.data)
    return found


def check_estimates_after_the_fact(run: Recording, design: Design) -> int:
    """Estimate over the bag: the same messages, to the last byte."""
    again = estimated_again(run.bag, run.bag.with_name("again"), design)
    agreement = again.agreement()
    assert agreement is not None
    assert agreement.complete, agreement.text()
    assert again.loop.used == run.used
    came = by_topic(run.bag.with_name("again"))
    # What the estimates were made with, which was not recorded here.
    assert len(came.pop("/observer/design")) == 1
    assert came == run.received
    return agreement.reproduced


def play_again(ros: Any, bag: Path, output: Path) -> None:
    """Play the measurements of a bag, with its time, to an observer that is recorded."""
    # A machine that is held up may bring measurements before the /clock that they belong to.
    estimating = start(ros, observer, use_sim_time=True, future_tolerance=60.0)
    recording = start(ros, recorder, output=str(output), topics=list(TOPICS), use_sim_time=True)
    playing = start(
        ros,
        player,
        bag=str(bag),
        topics=[MEASUREMENTS],
        clock=200.0,
        wait_for_subscribers=2,
        wait_timeout=0.0,
    )
    ros.spin_until(lambda: playing.finished, TIMEOUT, "the end of the bag")
    ros.spin_until(lambda: estimating.received == SAMPLES, TIMEOUT, "all samples' use")
    for publisher in estimating.publishers:
        assert publisher.wait_for_all_acked(Duration(seconds=10))

    def all_there() -> bool:
        return recording.statistics.counts[INNOVATION] == SAMPLES

    ros.spin_until(all_there, TIMEOUT, "everything in the bag")
    recording.close()
    assert recording.statistics.lost == 0


def test_the_bag_holds_what_was_published_and_replays_to_the_last_bit(
    ros: Any, recording: Recording, design: Design
) -> None:
    # One run for all checks: it takes its time.
    assert recording.lost == 0
    assert recording.used == SAMPLES
    assert recording.rejected == 0
    stored = by_topic(recording.bag)
    assert stored == recording.received
    stamps = [
        to_nanoseconds(deserialize_message(data, JointState).header.stamp)
        for data in stored[ESTIMATES[0]]
    ]
    assert stamps == sorted(set(stamps))
    assert len(stamps) > 10
    check_an_independent_reader(recording)
    assert check_estimates_after_the_fact(recording, design) == len(stamps)

    played = recording.bag.with_name("played")
    play_again(ros, recording.bag, played)
    # The innovations do not depend on when ticks were; the estimates are of other moments.
    replayed = by_topic(played)
    assert replayed[INNOVATION] == stored[INNOVATION]
    assert replayed[MEASUREMENTS] == stored[MEASUREMENTS]
    agreement = estimated_again(played, played.with_name("played_again"), design).agreement()
    assert agreement is not None
    assert agreement.complete, agreement.text()
    assert agreement.recorded > 10
