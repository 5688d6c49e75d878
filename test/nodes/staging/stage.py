# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An observer in the process of a test, under a time that only the test lets pass, and an arm.

Nothing waits and nothing races: what is published in one process is in every queue of it when
`publish` returns, time is where the test has put it, and a step ends when all ticks that it made
due are done.
"""

import math
import time
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import ClockType
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from staging import call, start, to_nanoseconds, to_stamp
from tsobs_ros.bag.estimate_topics import TORQUE_TOPICS
from tsobs_ros.estimation.records import Measurement
from tsobs_ros.methods import make_tracker
from tsobs_ros.nodes.observer import Observer
from tsobs_ros.nodes.wire import DrainedSubscription
from tsobs_ros.replay.samples import MeasurementReader
from tsobs_ros.series import NANOSECONDS
from tsobs_ros.simulation.plant import Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

BEGIN = 100 * NANOSECONDS
MS = 1_000_000
PERIOD = 5 * MS
"""Time between ticks at the default rate, and between an arm's samples [ns]."""
TOPIC = "/joint_measurements"
ESTIMATES = ("joint_states", "error_bound", "disturbance", "disturbance_bound")
OUTPUTS = (*ESTIMATES, "innovation")

_SENSOR_QOS = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)


@lru_cache(maxsize=1)
def _simulated() -> Trajectories:
    return simulate(SCENARIOS["noise"], [8], 20.0)


class Arm:
    """A run of an arm of 20 s, over and over, from a stamp on [ns], sampled each `PERIOD`."""

    def __init__(self, origin: int, joint: str = "elastic_joint") -> None:
        self.origin, self.joint = origin, joint
        run = _simulated()
        self._angles, self._torques = run.measurements[0], run.torques[0]

    def measurement(self, stamp: int) -> Measurement:
        """Return the sample taken at the stamp, or last before it."""
        index = (stamp - self.origin) // PERIOD % (len(self._angles) - 1)
        return Measurement(stamp, self._angles[index], self._torques[index])

    def message(self, stamp: int, **changes: Any) -> JointState:
        """Return that sample as a message, with any of its fields changed."""
        _, y, u = self.measurement(stamp)
        fields = {"name": [self.joint], "position": y.tolist(), "effort": u.tolist(), **changes}
        message = JointState(**fields)
        message.header.stamp = to_stamp(stamp)
        return message


class Event(NamedTuple):
    """A message or its CDR bytes, and when it is sent [ns]."""

    at: int
    message: Any


def good(arm: Arm, begin: int, seconds: float, period: int = PERIOD) -> list[Event]:
    """Return the samples of a good sensor with a period from a stamp on, sent as they are taken."""
    stamps = range(begin, begin + round(seconds * NANOSECONDS), period)
    return [Event(stamp, arm.message(stamp)) for stamp in stamps]


class Published(NamedTuple):
    """One message of an observer."""

    topic: str
    stamp: int
    message: JointState

    @property
    def numbers(self) -> list[float]:
        """All of the message's numbers."""
        return [*self.message.position, *self.message.velocity, *self.message.effort]


class Watcher:
    """Reads an observer's topics: numbers are finite, and stamps of estimates rise."""

    def __init__(self, node: Any, prefix: str) -> None:
        qos = QoSProfile(depth=5000)
        self.subscriptions = {
            topic: DrainedSubscription(node, JointState, f"{prefix}/{topic}", qos)
            for topic in (*OUTPUTS, *TORQUE_TOPICS)
        }
        self._node, self.published = node, list[Published]()
        self.newest: dict[str, int] = {}

    def close(self) -> None:
        """Stop reading."""
        for subscription in self.subscriptions.values():
            self._node.destroy_subscription(subscription.subscription)

    def read(self) -> None:
        """Take what has been published."""
        for topic, subscription in self.subscriptions.items():
            for message, _ in subscription.drain():
                one = Published(topic, to_nanoseconds(message.header.stamp), message)
                assert all(map(math.isfinite, one.numbers)), one
                # Innovations bear the stamps of measurements, which may be late.
                if topic in ESTIMATES:
                    assert one.stamp > self.newest.get(topic, 0), one
                    self.newest[topic] = one.stamp
                self.published.append(one)

    def of(self, topic: str) -> list[Published]:
        """Return the messages of a topic."""
        return [each for each in self.published if each.topic == topic]

    @property
    def stamps(self) -> list[int]:
        """The stamps of the estimates [ns]."""
        return [each.stamp for each in self.of("joint_states")]


class Stage:
    """An observer with the reader of its topics, a sensor, and the simulated time [ns]."""

    observer: Observer
    watcher: Watcher

    def __init__(self, ros: Any, topic: str = TOPIC, qos: Any = _SENSOR_QOS) -> None:
        self.ros, self.topic = ros, topic
        self.now = 0
        self.node = ros.node("stage")
        self.sensor = self.node.create_publisher(JointState, topic, qos)
        self._clock = self.node.create_publisher(Clock, "/clock", 100)
        self._diagnostics: list[tuple[int, DiagnosticArray]] = []
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._keep, 100)

    def add(self, namespace: str = "", **parameters: Any) -> Observer:
        """Start the observer and wait until everything is connected; it has the time there is."""
        self.watcher = Watcher(self.node, f"{namespace}/observer")
        remap = ["--ros-args", "-r", f"joint_measurements:={self.topic}"]
        options = {"namespace": namespace, "cli_args": remap}
        given = {"use_sim_time": True, **parameters}
        self.observer = start(self.ros, "observer", options=options, **given)
        outputs = [self.watcher.subscriptions[topic].subscription for topic in OUTPUTS]
        self.wait_until(lambda: all(each.get_publisher_count() for each in outputs), "the outputs")
        inputs = [self.sensor, *([self._clock] if given["use_sim_time"] else [])]
        self.wait_until(lambda: all(each.get_subscription_count() for each in inputs), "matching")
        if self.now:
            self.step(self.now)
        return self.observer

    def remove(self) -> None:
        """End the observer and its reader."""
        self.watcher.close()
        self.ros.remove(self.observer)
        del self.observer

    def call(self, kind: Any, name: str, request: Any = None) -> Any:
        """Call a service and return its answer."""
        return call(self.ros, self.node, kind, name, request)

    def play(self, events: Iterable[Event], until: int | None = None, period: int = PERIOD) -> None:
        """Send events as their time comes, time going on by a period at a time, to `until` [ns]."""
        waiting, place = list(events), 0
        until = waiting[-1].at if until is None else until
        for now in range(self.now + period, until + period, period):
            first = place
            while place < len(waiting) and waiting[place].at <= now:
                place += 1
            self.step(now, waiting[first:place])

    def step(self, now: int, batch: Iterable[Event] = ()) -> None:
        """Send a batch, set the time, and let everybody do what is then due."""
        for event in batch:
            self.sensor.publish(event.message)
        there = hasattr(self, "observer")
        if there and now < self.now:
            self.watcher.read()
            self.watcher.newest.clear()
        self.now = now
        self._clock.publish(Clock(clock=to_stamp(now)))
        if there:
            self.wait_until(self._settled, f"the ticks of {now}")
            self.watcher.read()

    def statuses(self) -> dict[str, DiagnosticStatus]:
        """Return the statuses that are published next, by their names."""
        asked = time.time_ns()
        self.wait_until(
            lambda: bool(self._diagnostics) and self._diagnostics[-1][0] > asked, "diagnostics"
        )
        return {status.name: status for status in self._diagnostics[-1][1].status}

    def reported(self, name: str) -> list[DiagnosticStatus]:
        """Return all statuses of a name that were published so far."""
        arrays = [array for _, array in self._diagnostics]
        return [each for array in arrays for each in array.status if each.name == name]

    def wait_until(self, predicate: Callable[[], bool], what: str) -> None:
        """Spin until something is so."""
        self.ros.spin_until(predicate, 30.0, what)

    def _keep(self, message: DiagnosticArray, info: Any) -> None:
        self._diagnostics.append((info["source_timestamp"], message))

    def _settled(self) -> bool:
        """Return whether no tick is due: an executor returns when a due timer's work is done."""
        own = (each for each in self.observer.timers if each.clock.clock_type == ClockType.ROS_TIME)
        now = self.observer.get_clock().now().nanoseconds
        return now == self.now and not any(each.is_ready() for each in own)


def replayed(watcher: Watcher, observer: Observer, sent: Iterable[Event]) -> int:
    """Hold all that was published to what a tracker makes of the same samples, bit for bit.

    The observer has one joint, and was sent the events in the order of their stamps since its
    start. Returns the number of estimates that were compared.
    """
    (joint,) = observer.joints
    tracker = make_tracker(joint.design, observer.parameters, joint.tracker.estimator)
    reader, waiting = MeasurementReader({joint.name: joint.signals}, False), list(sent)
    bits = {
        (each.topic, each.stamp): np.array(each.numbers).tobytes() for each in watcher.published
    }
    # Positions come before velocities in a message.
    order = np.argsort([place.field for place in joint.signals.states], kind="stable")
    for stamp in watcher.stamps:
        while waiting and waiting[0].at <= stamp:
            batch = reader.read([serialize_message(waiting.pop(0).message)])
            sample = Measurement(int(batch.stamps[0]), batch.y[0][0], batch.u[0][0])
            outcome = tracker.offer(sample, stamp)
            if not outcome.codes[0]:
                known = outcome.innovations[~np.isnan(outcome.innovations)]
                assert bits["innovation", sample.stamp] == known.tobytes()
        estimate = tracker.estimate(stamp)
        assert estimate is not None
        for topic, wanted in {
            "joint_states": estimate.state[order],
            "error_bound": estimate.state_bound[order if estimate.state_bound.size else []],
            "disturbance": np.append(estimate.disturbance, estimate.disturbance_rate),
            "disturbance_bound": estimate.disturbance_bound,
            "torque_disturbance": estimate.torque_disturbance,
        }.items():
            assert bits.get((topic, stamp), b"") == wanted.tobytes(), (topic, stamp)
    return len(watcher.stamps)
