# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Plant, observer and recorder together: the bag is what was published, and replays to the bit."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from tsobs_ros.bag import BagReader
from tsobs_ros.estimation.records import Innovation, Measurement
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.nodes import observer, plant_simulator, recorder
from tsobs_ros.nodes.draining import DrainedSubscription
from tsobs_ros.nodes.stamps import to_nanoseconds

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
TOPICS = (MEASUREMENTS, *TRUTH, *ESTIMATES, INNOVATION)
SAMPLES = 701
END_OF_TIME = 10**19


class Recording(NamedTuple):
    """A finished run: its bag, what a subscriber of all topics received, and the observer."""

    bag: Path
    received: dict[str, list[bytes]]
    tracker: Tracker[Any]
    lost: int


def start(ros: Any, module: Any, **parameters: Any) -> Any:
    overrides = [Parameter(n.replace("__", "."), value=v) for n, v in parameters.items()]
    return ros.add(module.create(context=ros.context, parameter_overrides=overrides))


@pytest.fixture
def recording(ros: Any, tmp_path: Path) -> Recording:
    """Three and a half seconds of the three nodes on one executor, in real time."""
    node = ros.node("listener")
    qos = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)
    best_effort = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
    listening = {
        topic: DrainedSubscription(
            node, JointState, topic, best_effort if topic == MEASUREMENTS else qos, raw=True
        )
        for topic in TOPICS
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
        disturbance__kind="bias_step",
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
        counts = recording.statistics.topics
        return len(received[MEASUREMENTS]) == SAMPLES and all(
            counts[topic].messages == len(received[topic]) for topic in TOPICS
        )

    ros.spin_until(all_there, TIMEOUT, "everything in the bag")
    recording.close()
    return Recording(recording.path, received, estimating.tracker, recording.statistics.lost)


def bits(message: Any) -> tuple[int, list[str], bytes]:
    stamp = message.header.stamp
    numbers = np.array([*message.position, *message.velocity, *message.effort], dtype=np.float64)
    return stamp.sec * 10**9 + stamp.nanosec, list(message.name), numbers.tobytes()


def numbers(message: Any) -> bytes:
    return bits(message)[2]


def interpolated(truth: list[JointState], stamps: NDArray[np.int64]) -> NDArray[np.float64]:
    times = np.array([to_nanoseconds(m.header.stamp) for m in truth]) - stamps[0]
    values = np.array([[*m.position, *m.velocity] for m in truth])
    at = stamps - stamps[0]
    return np.stack([np.interp(at, times, column) for column in values.T], axis=-1)


def check_independent_readers(run: Recording) -> None:
    expected = {
        topic: [bits(deserialize_message(data, JointState)) for data in messages]
        for topic, messages in run.received.items()
    }
    with AnyReader([run.bag]) as reader:
        came: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
        for connection, _, data in reader.messages():
            came[connection.topic].append(bits(reader.deserialize(data, connection.msgtype)))
    assert came == expected

    (file,) = run.bag.glob("*.mcap")
    came = {topic: [] for topic in TOPICS}
    with file.open("rb") as stream:
        decoding = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in decoding.iter_decoded_messages():
            came[channel.topic].append(bits(message))
    assert came == expected


def check_replay(run: Recording) -> int:
    """Run a tracker over the bag in the order in which the observer published.

    An innovation is published when its measurement is used, an estimate after the innovations of
    its tick; within one process the publish times tell the order of the two topics.
    """
    reader = BagReader(run.bag)
    by_topic: dict[str, dict[int, JointState]] = {topic: {} for topic in TOPICS}
    order: list[tuple[int, str, int]] = []
    for item in reader.messages():
        message = deserialize_message(item.data, JointState)
        stamp = to_nanoseconds(message.header.stamp)
        by_topic[item.topic][stamp] = message
        order.append((item.publish_time, item.topic, stamp))
    tracker = Tracker(run.tracker.estimator, run.tracker.options)
    compared = 0
    for _, topic, stamp in sorted(order):
        message = by_topic[topic][stamp]
        if topic == INNOVATION:
            sample = by_topic[MEASUREMENTS][stamp]
            measurement = Measurement(stamp, np.array(sample.position), np.array(sample.effort))
            innovation = tracker.offer(measurement, END_OF_TIME)
            assert isinstance(innovation, Innovation)
            assert numbers(message) == innovation.value.tobytes()
        elif topic == ESTIMATES[0]:
            estimate = tracker.estimate(stamp)
            assert estimate is not None
            for name, wanted in (
                (ESTIMATES[0], estimate.state[[0, 2, 1, 3]]),
                (ESTIMATES[1], estimate.state_bound[[0, 2, 1, 3]]),
                (ESTIMATES[2], np.append(estimate.disturbance, estimate.disturbance_rate)),
                (ESTIMATES[3], estimate.disturbance_bound),
            ):
                assert numbers(by_topic[name][stamp]) == wanted.tobytes()
            compared += 1
    assert tracker.used == run.tracker.used
    assert tracker.events == run.tracker.events
    return compared


def check_errors(run: Recording) -> None:
    """After three seconds estimates are within four times their bounds of the truth."""
    messages = {
        topic: [deserialize_message(data, JointState) for data in run.received[topic]]
        for topic in TOPICS
    }
    stamps = np.array([to_nanoseconds(m.header.stamp) for m in messages[ESTIMATES[0]]])
    last = to_nanoseconds(messages[TRUTH[0]][-1].header.stamp)
    late = (stamps > last - 500_000_000) & (stamps <= last)
    assert late.sum() > 5
    estimates = np.array([[*m.position, *m.velocity] for m in messages[ESTIMATES[0]]])[late]
    bounds = np.array([[*m.position, *m.velocity] for m in messages[ESTIMATES[1]]])[late]
    errors = estimates - interpolated(messages[TRUTH[0]], stamps[late])
    assert (np.abs(errors) < 4.0 * bounds).all()
    biases = np.array([m.position[0] for m in messages[ESTIMATES[2]]])[late]
    bounds = np.array([m.position[0] for m in messages[ESTIMATES[3]]])[late]
    assert (np.abs(biases - 0.1) < 4.0 * bounds).all()


def test_the_bag_holds_what_was_published_and_replays_to_the_last_bit(
    recording: Recording,
) -> None:
    # One run for all checks: it takes its time.
    assert recording.lost == 0
    assert recording.tracker.used == SAMPLES
    assert sum(recording.tracker.rejected.values()) == 0
    stored: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}
    for item in BagReader(recording.bag).messages():
        stored[item.topic].append(item.data)
    assert stored == recording.received
    for topic in (MEASUREMENTS, *TRUTH, INNOVATION):
        assert len(stored[topic]) == SAMPLES
    stamps = [
        to_nanoseconds(deserialize_message(data, JointState).header.stamp)
        for data in stored[ESTIMATES[0]]
    ]
    assert stamps == sorted(set(stamps))
    assert len(stamps) > 100
    check_independent_readers(recording)
    assert check_replay(recording) == len(stamps)
    check_errors(recording)
