# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An observer with everything around it: what it hears, what time it is, what it says."""

import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.records import Innovation, Measurement
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.nodes.messages import to_nanoseconds, to_stamp
from tsobs_ros.nodes.observer import Observer, create
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

SHIPPED = config_path("elastic_joint.design.yaml")
DESIGN = load_design(SHIPPED)
JOINT = "elastic_joint"
SECOND = 1_000_000_000
PERIOD = 5_000_000
END_OF_TIME = 10**19
RUN = simulate(SCENARIOS["noise"], [8], 8.0)
OUTPUTS = ("joint_states", "error_bound", "disturbance", "disturbance_bound", "innovation")
BEST_EFFORT = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
TIMEOUT = 30.0


class Published(NamedTuple):
    """One message of the observer; source stamps order what one process publishes."""

    source: int
    topic: str
    stamp: int
    message: JointState


def measurement(index: int, stamp: int, **changes: Any) -> JointState:
    """Return a sample of the simulated run as a message."""
    message = JointState(
        name=[JOINT],
        position=RUN.measurements[0, index].tolist(),
        effort=RUN.torques[0, index].tolist(),
    )
    message.header.stamp = to_stamp(stamp)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def truth(index: int) -> np.ndarray:
    return DESIGN.request.arm.to_physical(RUN.states[0, index])


class Bench:
    """An observer with everything around it: measurements and time in, all outputs kept."""

    def __init__(self, ros: Any, namespace: str = "") -> None:
        self.ros = ros
        self.prefix = f"{namespace}/observer"
        self.node = ros.node("bench")
        self.published: list[Published] = []
        self.diagnostics: list[tuple[int, DiagnosticArray]] = []
        self.sent: dict[int, Measurement] = {}
        self.observer: Observer | None = None
        self.now = 0
        self._subscriptions = [
            self.node.create_subscription(
                JointState, f"{self.prefix}/{topic}", self._keeper(topic), QoSProfile(depth=2000)
            )
            for topic in OUTPUTS
        ]
        self._subscriptions.append(
            self.node.create_subscription(
                DiagnosticArray, "/diagnostics", self._keep_diagnostics, 10
            )
        )
        self.sensor = self.node.create_publisher(
            JointState, f"{namespace}/joint_measurements", BEST_EFFORT
        )
        self._clock: Any = None

    def _keeper(self, topic: str) -> Callable[[JointState, Any], None]:
        def keep(message: JointState, info: Any) -> None:
            stamp = to_nanoseconds(message.header.stamp)
            self.published.append(Published(info["source_timestamp"], topic, stamp, message))

        return keep

    def _keep_diagnostics(self, message: DiagnosticArray, info: Any) -> None:
        self.diagnostics.append((info["source_timestamp"], message))

    def start(self, **parameters: Any) -> Observer:
        """Start the observer on this test's context and wait until everything is matched."""
        overrides = [Parameter(n.replace("__", "."), value=v) for n, v in parameters.items()]
        return self.adopt(create(context=self.ros.context, parameter_overrides=overrides))

    def adopt(self, observer: Observer) -> Observer:
        self.observer = self.ros.add(observer)
        self.wait_for_matches()
        return self.observer

    def wait_for_matches(self) -> None:
        """Wait until everything is matched with the observer."""
        self.wait_until(lambda: self.sensor.get_subscription_count() == 1, "matching of the sensor")
        self.wait_until(
            lambda: all(each.get_publisher_count() >= 1 for each in self._subscriptions),
            "matching of the outputs",
        )

    def start_simulated(self, begin: int = 100 * SECOND, **parameters: Any) -> Observer:
        """Start the observer under simulated time, which this bench decides."""
        self.begin_clock()
        observer = self.start(use_sim_time=True, **parameters)
        self.wait_until(lambda: self._clock.get_subscription_count() == 1, "matching of /clock")
        if begin:
            self.set_clock(begin)
        return observer

    def begin_clock(self) -> None:
        """Be the one who says what time it is."""
        self._clock = self.node.create_publisher(Clock, "/clock", 100)

    def set_clock(self, stamp: int) -> None:
        """Publish the time and wait until the observer has it."""
        assert self.observer is not None
        self.now = stamp
        self.publish_clock(stamp)
        clock = self.observer.get_clock()
        self.wait_until(lambda: clock.now().nanoseconds == stamp, "the time's arrival")

    def publish_clock(self, stamp: int) -> None:
        self._clock.publish(Clock(clock=to_stamp(stamp)))

    def wait_until(self, predicate: Callable[[], bool], what: str) -> None:
        self.ros.spin_until(predicate, TIMEOUT, what)

    def send(self, index: int, stamp: int, **changes: Any) -> int:
        """Publish a sample; one that differs from the run only in its stamp can be replayed."""
        if not changes:
            self.sent[stamp] = Measurement(stamp, RUN.measurements[0, index], RUN.torques[0, index])
        self.sensor.publish(measurement(index, stamp, **changes))
        return stamp

    def feed(self, indices: Iterable[int], begin: int | None = None) -> None:
        """Send samples a period apart from now on, the simulated time going along."""
        begin = self.now if begin is None else begin
        observer = self.observer
        assert observer is not None
        wanted = observer.received
        for index in indices:
            self.send(index, begin + index * PERIOD)
            self.set_clock(begin + index * PERIOD)
            wanted += 1
        self.advance_until(lambda: observer.received >= wanted, "the arrival of the samples")

    def advance_until(self, predicate: Callable[[], bool], what: str, step: int = PERIOD) -> None:
        """Let the simulated time pass, slower than ticks are made, until something has happened."""
        for _ in range(2000):
            if predicate():
                return
            self.set_clock(self.now + step)
            for _ in range(12):
                self.ros.executor.spin_once(timeout_sec=0.001)
        raise AssertionError(f"{what} did not happen in {2000 * step / SECOND} simulated s")

    def statuses(self) -> dict[str, DiagnosticStatus]:
        """Return the statuses published next, by their concern."""
        asked = time.time_ns()
        self.wait_until(
            lambda: bool(self.diagnostics) and self.diagnostics[-1][0] > asked, "diagnostics"
        )
        node = f"{self.prefix.lstrip('/')}: "
        return {
            status.name.removeprefix(node): status
            for status in self.diagnostics[-1][1].status
            if status.name.startswith(node)
        }

    def status(self, name: str) -> DiagnosticStatus:
        """Return the next status of a concern."""
        return self.statuses()[name]

    def of(self, topic: str) -> list[Published]:
        return [each for each in self.published if each.topic == topic]

    @property
    def estimates(self) -> list[Published]:
        return self.of("joint_states")

    @property
    def innovations(self) -> list[Published]:
        return self.of("innovation")

    def wait_for_estimates(self, more: int) -> None:
        wanted = len(self.estimates) + more
        self.wait_until(lambda: len(self.estimates) >= wanted, f"{more} more estimates")

    def call(self, kind: Any, name: str, request: Any) -> Any:
        client = self.node.create_client(kind, f"{self.prefix}/{name}")
        self.wait_until(client.service_is_ready, f"the service {name}")
        future = client.call_async(request)
        self.wait_until(future.done, f"the answer of {name}")
        self.node.destroy_client(client)
        return future.result()

    def wait_for_quiet(self) -> None:
        """Let one more tick pass and wait until all that was published has arrived."""
        assert self.observer is not None
        tracker, topics = self.observer.tracker, OUTPUTS[:4]
        self.set_clock(self.now + PERIOD)
        self.wait_until(
            lambda: (
                {each.topic for each in self.published if each.stamp == self.now} >= set(topics)
                and len(self.innovations) >= tracker.used
            ),
            "the last messages",
        )

    def forget(self) -> None:
        """Forget what has been published, once all of it has arrived."""
        self.wait_for_quiet()
        self.published.clear()


def values(status: DiagnosticStatus) -> dict[str, str]:
    return {item.key: item.value for item in status.values}


def numbers(published: Published) -> bytes:
    message = published.message
    return np.array([*message.position, *message.velocity]).tobytes()


def replayed(bench: Bench, tracker: Tracker[Any] | None = None) -> int:
    """Run a tracker over what the observer used, in its order; return how much was compared.

    An innovation is published when its measurement is used, and an estimate after those of its
    tick, so the source stamps tell which measurements an estimate was made of.
    """
    assert bench.observer is not None
    own = bench.observer.tracker
    tracker = tracker or Tracker(own.estimator, own.options)
    others = {
        (each.topic, each.stamp): each for each in bench.published if each.topic != "innovation"
    }
    compared = 0
    ordered = sorted(bench.published, key=lambda each: each.source)
    for each in ordered:
        if each.topic == "innovation":
            innovation = tracker.offer(bench.sent[each.stamp], END_OF_TIME)
            assert isinstance(innovation, Innovation)
            assert numbers(each) == innovation.value.tobytes()
        elif each.topic == "joint_states":
            estimate = tracker.estimate(each.stamp)
            assert estimate is not None
            expected = {
                "joint_states": estimate.state[[0, 2, 1, 3]],
                "error_bound": estimate.state_bound[[0, 2, 1, 3]],
                "disturbance": np.concatenate([estimate.disturbance, estimate.disturbance_rate]),
                "disturbance_bound": estimate.disturbance_bound,
            }
            for topic, wanted in expected.items():
                assert numbers(others[topic, each.stamp]) == wanted.tobytes()
            compared += 1
    return compared
