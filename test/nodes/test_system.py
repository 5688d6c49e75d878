# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Plant, observer and recorder together: the bag is what was published, and replays to the bit.

Afterwards by `tsobs estimate`'s core, and in real time by the player and another observer.
"""

from pathlib import Path
from typing import Any, NamedTuple

import pytest
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from staging import by_topic, call, estimated_again, start, to_nanoseconds
from std_msgs.msg import Int64MultiArray
from std_srvs.srv import SetBool

from tsobs_ros.design.record import Design
from tsobs_ros.nodes.wire import DrainedSubscription

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

    estimating = start(ros, "observer")
    recording = start(ros, "recorder", output=str(tmp_path / "bag"), topics=list(TOPICS))
    plant = start(
        ros,
        "plant_simulator",
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

    call(ros, node, SetBool, "observer/enable", SetBool.Request(data=False))
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
    estimating = start(ros, "observer", use_sim_time=True, future_tolerance=60.0)
    recording = start(ros, "recorder", output=str(output), topics=list(TOPICS), use_sim_time=True)
    playing = start(
        ros,
        "player",
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
