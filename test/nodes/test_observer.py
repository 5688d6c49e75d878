# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer node: the tracker's numbers bit for bit, whatever arrives, whatever time does."""

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from tsobs_ros.design.file import load_design
from tsobs_ros.errors import CertificateError, DesignFileError, ParameterError, TsobsError
from tsobs_ros.estimation.records import Innovation, Measurement
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.nodes.observer import Observer, create
from tsobs_ros.nodes.stamps import to_nanoseconds, to_stamp
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
        self.wait_until(lambda: self.sensor.get_subscription_count() == 1, "matching of the sensor")
        self.wait_until(
            lambda: all(each.get_publisher_count() >= 1 for each in self._subscriptions),
            "matching of the outputs",
        )
        return self.observer

    def start_simulated(self, begin: int = 100 * SECOND, **parameters: Any) -> Observer:
        """Start the observer under simulated time, which this bench decides."""
        self._clock = self.node.create_publisher(Clock, "/clock", 100)
        observer = self.start(use_sim_time=True, **parameters)
        self.wait_until(lambda: self._clock.get_subscription_count() == 1, "matching of /clock")
        if begin:
            self.set_clock(begin)
        return observer

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


@pytest.fixture
def bench(ros: Any) -> Bench:
    return Bench(ros)


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


def test_estimates_are_the_trackers_bit_for_bit(bench: Bench) -> None:
    observer = bench.start_simulated()
    bench.feed(range(300))
    bench.wait_for_quiet()
    assert replayed(bench) == len(bench.estimates) > 100
    assert observer.tracker.used == 300
    assert observer.received == 300
    for topic, names in (
        ("joint_states", [f"{JOINT}_link", f"{JOINT}_motor"]),
        ("error_bound", [f"{JOINT}_link", f"{JOINT}_motor"]),
        ("disturbance", [JOINT]),
        ("disturbance_bound", [JOINT]),
        ("innovation", [JOINT]),
    ):
        for each in bench.of(topic):
            assert list(each.message.name) == names
            assert np.isfinite(each.message.position).all()
            assert np.isfinite(each.message.velocity).all()
            assert len(each.message.effort) == 0


@pytest.mark.parametrize(("rate", "every"), [(200.0, 1), (100.0, 2), (25.0, 8)])
def test_estimates_come_at_the_rate_of_the_nodes_clock(
    bench: Bench, rate: float, every: int
) -> None:
    bench.start_simulated(rate=rate)
    bench.feed(range(20))
    first = len(bench.estimates)
    for k in range(10 * every):
        bench.set_clock(bench.now + PERIOD)
        # Whatever a tick publishes has come before the time goes on.
        wanted = first + k // every
        bench.wait_until(lambda n=wanted: len(bench.estimates) >= n, f"{wanted} estimates")
    stamps = [each.stamp for each in bench.estimates]
    steps = np.diff(stamps[first + 1 :])
    assert len(steps) >= 7
    assert set(steps) == {every * PERIOD}


def test_estimates_follow_the_truth_within_their_bounds(bench: Bench) -> None:
    bench.start_simulated()
    bench.feed(range(800))
    bench.wait_for_quiet()
    begin = 100 * SECOND
    bounds = {each.stamp: each.message for each in bench.of("error_bound")}
    compared = 0
    for each in bench.estimates:
        index, rest = divmod(each.stamp - begin, PERIOD)
        if rest or not 400 <= index < 800:
            continue
        q1, v1, q2, v2 = truth(index)
        error = [*each.message.position, *each.message.velocity] - np.array([q1, q2, v1, v2])
        bound = bounds[each.stamp]
        assert (np.abs(error) < 4.0 * np.array([*bound.position, *bound.velocity])).all()
        compared += 1
    assert compared > 200


REJECTED = {
    "non-finite": [
        {"position": [float("nan")]},
        {"position": [float("inf")]},
        {"effort": [float("nan")]},
    ],
    "wrong joint or shape": [
        {"name": ["elbow"]},
        {"name": []},
        {"effort": []},
        {"position": []},
        {"name": ["elbow", JOINT]},
    ],
}


def test_every_reason_to_reject_is_counted_and_estimates_go_on(bench: Bench) -> None:
    observer = bench.start_simulated()
    bench.feed(range(10))
    begin, now = 100 * SECOND, bench.now
    expected = {
        "duplicate stamp": 2,
        "too old": 2,
        "from the future": 2,
        "zero stamp": 2,
        "gated": 0,
        **{reason: len(changes) for reason, changes in REJECTED.items()},
    }
    for changes in (changes for kind in REJECTED.values() for changes in kind):
        bench.send(11, now, **changes)
    for stamp in (begin + 3 * PERIOD, begin + 9 * PERIOD):
        bench.send(11, stamp, header=measurement(0, stamp).header)
    for stamp in (1, now - 2 * SECOND, now + 60 * SECOND, now + 3600 * SECOND, 0, 0):
        bench.send(11, stamp, header=measurement(0, stamp).header)
    total = sum(expected.values())
    bench.advance_until(lambda: observer.received == 10 + total, "the rejections", PERIOD // 5)

    status = bench.status("measurements")
    assert {key: int(value) for key, value in values(status).items()} == {
        "received": 10 + total,
        "used": 10,
        "rewinds": 0,
        **{f"rejected: {reason}": count for reason, count in expected.items()},
    }
    assert status.level == DiagnosticStatus.WARN
    assert status.message == f"{total} rejected"

    before = len(bench.estimates)
    bench.feed(range(12, 30), begin + 100 * PERIOD)
    assert observer.tracker.used == 28
    bench.wait_until(lambda: len(bench.estimates) > before + 10, "further estimates")
    bench.wait_for_quiet()
    assert replayed(bench) > 20


def test_the_joint_may_be_one_of_several(bench: Bench) -> None:
    observer = bench.start_simulated()
    stamp = bench.now
    several = JointState(
        name=["hip", JOINT, "elbow"], position=[9.0, 0.25, 8.0], effort=[7.0, 0.5, 6.0]
    )
    several.header.stamp = to_stamp(stamp)
    bench.sensor.publish(several)
    bench.advance_until(lambda: observer.tracker.used == 1, "the sample's use")
    bench.wait_until(lambda: len(bench.innovations) == 1, "its innovation")
    assert list(bench.innovations[0].message.position) == [0.25]
    bench.sent[stamp] = Measurement(stamp, np.array([0.25]), np.array([0.5]))
    bench.advance_until(lambda: len(bench.estimates) > 3, "estimates")
    bench.wait_for_quiet()
    assert replayed(bench) > 2


def test_without_effort_the_torque_may_be_taken_as_zero(bench: Bench) -> None:
    observer = bench.start_simulated(assume_zero_torque=True)
    stamp = bench.send(0, bench.now, effort=[])
    bench.advance_until(lambda: observer.tracker.used == 1, "the sample's use")
    bench.sent[stamp] = Measurement(stamp, RUN.measurements[0, 0], np.zeros(1))
    bench.advance_until(lambda: len(bench.estimates) > 10, "estimates")
    bench.wait_for_quiet()
    assert replayed(bench) > 9


def test_a_burst_of_500_messages_is_used_to_the_last(bench: Bench) -> None:
    observer = bench.start_simulated()
    begin = bench.now
    bench.set_clock(begin + 500 * PERIOD)
    for index in range(500):
        bench.send(index, begin + index * PERIOD)
    bench.advance_until(lambda: observer.received == 500, "the burst's arrival")
    assert observer.tracker.used == 500
    assert not observer.tracker.rejected
    bench.wait_until(lambda: len(bench.innovations) == 500, "the innovations")
    bench.wait_for_quiet()
    assert [each.stamp for each in bench.innovations] == list(bench.sent)
    assert replayed(bench) == len(bench.estimates)


def test_late_messages_are_put_in_their_place(bench: Bench) -> None:
    observer = bench.start_simulated()
    begin = bench.now
    rng = np.random.default_rng(5)
    # Each up to .2 s late.
    order = sorted(range(200), key=lambda k: k + int(rng.integers(0, 40)))
    bench.set_clock(begin + 40 * PERIOD)
    for place, index in enumerate(order):
        bench.send(index, begin + index * PERIOD)
        bench.set_clock(begin + (40 + place) * PERIOD)
    bench.advance_until(lambda: observer.received == 200, "the samples' arrival")
    assert observer.tracker.used == 200
    assert observer.tracker.rewinds > 50
    bench.wait_until(lambda: len(bench.innovations) == 200, "the innovations")
    bench.wait_for_quiet()
    assert replayed(bench) > 50

    in_order = Tracker(observer.tracker.estimator, observer.tracker.options)
    for stamp in sorted(bench.sent):
        in_order.offer(bench.sent[stamp], END_OF_TIME)
    last, expected = bench.estimates[-1], in_order.estimate(bench.estimates[-1].stamp)
    assert expected is not None
    assert numbers(last) == expected.state[[0, 2, 1, 3]].tobytes()


def test_the_reset_service_leaves_a_fresh_observer(bench: Bench) -> None:
    observer = bench.start_simulated()
    bench.feed(range(60))
    bench.send(60, 1)  # something to have been rejected
    bench.advance_until(lambda: observer.received == 61, "the rejection")
    bench.forget()

    answer = bench.call(Trigger, "reset", Trigger.Request())
    assert (answer.success, answer.message) == (True, "started afresh")
    assert (observer.received, observer.tracker.used) == (0, 0)
    assert not observer.tracker.rejected
    bench.feed(range(100, 160), bench.now)
    bench.wait_until(lambda: len(bench.innovations) == 60, "the innovations")
    bench.wait_for_quiet()
    assert list(bench.innovations[0].message.position) == RUN.measurements[0, 100].tolist()
    assert replayed(bench) > 40  # by a new tracker, to the last bit
    statuses = bench.statuses()
    assert values(statuses["state"])["resets"] == "1"
    assert values(statuses["measurements"])["used"] == "60"


def test_a_disabled_observer_is_silent_and_starts_afresh(bench: Bench) -> None:
    observer = bench.start_simulated()
    bench.feed(range(20))
    bench.forget()
    answer = bench.call(SetBool, "enable", SetBool.Request(data=False))
    assert answer.success
    assert "disabled" in answer.message
    for index in range(20, 60):
        bench.send(index, 100 * SECOND + index * PERIOD)
        bench.set_clock(100 * SECOND + index * PERIOD)
    status = bench.status("state")
    assert (status.message, status.level) == ("DISABLED", DiagnosticStatus.WARN)
    assert bench.published == []
    assert observer.received == 20

    assert bench.call(SetBool, "enable", SetBool.Request(data=True)).message == "enabled"
    assert bench.call(SetBool, "enable", SetBool.Request(data=True)).success
    assert observer.received == 0
    bench.feed(range(100, 130), bench.now)
    bench.wait_until(lambda: len(bench.innovations) == 30, "the innovations")
    bench.wait_for_quiet()
    assert list(bench.innovations[0].message.position) == RUN.measurements[0, 100].tolist()
    assert replayed(bench) > 20
    assert values(bench.status("state"))["resets"] == "1"


def test_a_clock_that_goes_back_starts_afresh_and_says_so(
    bench: Bench, capfd: pytest.CaptureFixture[str]
) -> None:
    observer = bench.start_simulated()
    bench.feed(range(40))
    bench.wait_for_quiet()
    stamps = [each.stamp for each in bench.estimates]
    assert stamps == sorted(set(stamps))
    bench.forget()
    bench.sent.clear()

    bench.set_clock(20 * SECOND)
    bench.advance_until(lambda: observer.received == 0, "the reset")
    bench.feed(range(50, 90), bench.now)
    bench.wait_until(lambda: len(bench.innovations) == 40, "the innovations")
    bench.wait_for_quiet()
    assert list(bench.innovations[0].message.position) == RUN.measurements[0, 50].tolist()
    stamps = [each.stamp for each in bench.estimates]
    assert stamps == sorted(set(stamps))
    assert stamps[0] < 30 * SECOND
    assert replayed(bench) > 20
    assert values(bench.status("state"))["resets"] == "1"
    assert "the clock went back by 8" in capfd.readouterr().err


def test_without_measurements_it_coasts_then_falls_silent(bench: Bench) -> None:
    observer = bench.start_simulated(coast_after=0.1, stale_after=1.0)
    statuses = bench.statuses()
    status = statuses["state"]
    assert (status.message, status.level) == ("WAITING", DiagnosticStatus.WARN)
    assert statuses["premise domain"].message == "no estimate yet"
    bench.feed(range(40))
    last = max(bench.sent)
    bench.set_clock(last + 50_000_000)
    status = bench.status("state")
    assert (status.message, status.level) == ("TRACKING", DiagnosticStatus.OK)
    assert float(values(status)["measurement age [s]"]) == 0.05
    bench.set_clock(last + 500_000_000)
    assert bench.status("state").message == "COASTING"
    bench.wait_until(
        lambda: bench.estimates[-1].stamp == last + 500_000_000, "an estimate while coasting"
    )
    bench.set_clock(last + SECOND)
    bench.wait_until(lambda: bench.estimates[-1].stamp == last + SECOND, "the last estimate")
    for k in range(1, 100):
        bench.set_clock(last + SECOND + k * PERIOD)
    status = bench.status("state")
    assert (status.message, status.level) == ("STALE", DiagnosticStatus.ERROR)
    assert bench.estimates[-1].stamp == last + SECOND
    assert replayed(bench) > 20

    # A measurement after all begins anew.
    bench.published.clear()
    bench.feed(range(100, 140), bench.now)
    assert observer.tracker.restarts == 1
    bench.wait_until(lambda: len(bench.innovations) == 40, "the innovations")
    assert list(bench.innovations[0].message.position) == RUN.measurements[0, 100].tolist()
    assert values(bench.status("state"))["restarts"] == "1"


def test_diagnostics_name_every_concern(bench: Bench) -> None:
    observer = bench.start_simulated(fault__warn=0.05, fault__error=0.3, fault__hold=0.1)
    bench.feed(range(60))
    statuses = bench.statuses()
    assert set(statuses) == {
        "state",
        "measurements",
        "timing",
        "premise domain",
        "innovation",
        "sensor fault",
        "certificate",
    }
    assert {status.hardware_id for status in statuses.values()} == {JOINT}
    assert statuses["state"].message == "TRACKING"
    assert statuses["measurements"].level == DiagnosticStatus.OK
    assert statuses["premise domain"].message == "inside the certificate's domain"
    assert statuses["innovation"].level == DiagnosticStatus.OK
    identity = values(statuses["certificate"])
    assert identity["design"] == str(SHIPPED)
    assert identity["disturbance model"] == "bias"
    assert identity["bound"] == "along the estimate"
    assert float(identity["margin [1/s]"]) > 0.0
    assert observer.tracker.used == 60


def test_a_large_disturbance_is_reported_and_its_thresholds_can_be_tuned(bench: Bench) -> None:
    observer = bench.start_simulated()
    begin = bench.now
    for index in range(400):
        biased = (RUN.measurements[0, index] + 0.35).tolist()
        bench.send(index, begin + index * PERIOD, position=biased)
        bench.set_clock(begin + index * PERIOD)
    status = bench.status("sensor fault")
    assert status.level == DiagnosticStatus.WARN
    assert float(values(status)["magnitude [rad]"]) == pytest.approx(0.35, abs=0.1)

    lower = [Parameter("fault.warn", value=0.1), Parameter("fault.error", value=0.15)]
    # One after the other, error first, would be refused: 0.15 is below the warning at 0.2.
    (first, _) = observer.set_parameters([lower[1], lower[0]])
    assert not first.successful
    assert "fault.error" in first.reason
    observer.set_parameters([Parameter("fault.warn", value=0.2)])
    assert observer.set_parameters_atomically(lower).successful
    for index in range(400, 520):
        biased = (RUN.measurements[0, index] + 0.35).tolist()
        bench.send(index, begin + index * PERIOD, position=biased)
        bench.set_clock(begin + index * PERIOD)
    status = bench.status("sensor fault")
    assert status.level == DiagnosticStatus.ERROR


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("rate", 100.0, "read-only"),
        ("design", "other.yaml", "read-only"),
        ("joints", ["elbow"], "read-only"),
        ("when_stale", "loud", "must be one of"),
        ("gain_mode", "riccati", "read-only"),
        ("history", 1.0, "read-only"),
        ("coast_after", 0.0, "at least"),
        ("coast_after", 10.0, "coast_after: expected at most stale_after"),
        ("coast_after", "soon", "expected a number"),
        ("coast_after", float("nan"), "finite"),
        ("fault.warn", -0.1, "at least"),
        ("fault.warn", 0.6, "fault.error: expected at least fault.warn"),
    ],
)
def test_senseless_or_structural_changes_are_refused_with_a_reason(
    ros: Any, name: str, value: Any, reason: str
) -> None:
    node = ros.add(create(context=ros.context))
    before = node.get_parameter(name).value
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    assert reason in result.reason
    assert node.get_parameter(name).value == before


def test_integers_are_taken_for_doubles_at_start_and_later(ros: Any) -> None:
    overrides = [Parameter("rate", value=100), Parameter("fault.error", value=1)]
    node = ros.add(create(context=ros.context, parameter_overrides=overrides))
    assert node.get_parameter("rate").value == 100.0
    (result,) = node.set_parameters([Parameter("fault.hold", value=2)])
    assert result.successful
    value = node.get_parameter("fault.hold").value
    assert (value, type(value)) == (2.0, float)


@pytest.mark.parametrize(
    ("overrides", "reason"),
    [
        ({"rate": 0.0}, "rate"),
        ({"rate": "fast"}, "rate"),
        ({"joints": [""]}, "joints: expected names"),
        ({"joints": []}, "joints: expected names"),
        ({"joints": ["hip", "knee", "hip"]}, "joints: expected each name once"),
        ({"joints": ["hip", "knee"], "joint_designs": [""]}, "one for each of the 2 joints"),
        ({"gain_mode": "certain"}, "gain_mode"),
        ({"fault.warn": 0.6}, "fault.error"),
        ({"coast_after": 6.0}, "coast_after"),
    ],
)
def test_senseless_overrides_are_refused(ros: Any, overrides: dict[str, Any], reason: str) -> None:
    parameters = [Parameter(name, value=value) for name, value in overrides.items()]
    with pytest.raises(ParameterError, match=reason):
        create(context=ros.context, parameter_overrides=parameters)


def tampered(path: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    data = yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))
    change(data)
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


def triple_the_gain(data: dict[str, Any]) -> None:
    data["gain"]["K"] = [3.0 * value for value in data["gain"]["K"]]


def drop_the_gain(data: dict[str, Any]) -> None:
    del data["gain"]


@pytest.mark.parametrize(
    ("make", "error", "named"),
    [
        (lambda path: path, DesignFileError, ["no such design file"]),
        (lambda path: tampered(path, drop_the_gain), DesignFileError, ["gain"]),
        (
            lambda path: tampered(path, triple_the_gain),
            CertificateError,
            ["covariance decrease", "slopes (1, 1)", "DOES NOT HOLD"],
        ),
    ],
    ids=["missing", "malformed", "certificate does not hold"],
)
def test_a_design_that_is_none_is_refused_by_name(
    ros: Any, tmp_path: Path, make: Any, error: type[TsobsError], named: Sequence[str]
) -> None:
    path = make(tmp_path / "my.design.yaml")
    with pytest.raises(error) as caught:
        create(context=ros.context, parameter_overrides=[Parameter("design", value=str(path))])
    assert type(caught.value) is error
    for text in [str(path), *named]:
        assert text in str(caught.value)
    # It has left nothing behind: the next one starts.
    assert ros.add(create(context=ros.context)).tracker.used == 0


def test_the_design_parameter_chooses_the_design(bench: Bench, tmp_path: Path) -> None:
    copy = tmp_path / "copy.design.yaml"
    copy.write_text(SHIPPED.read_text(encoding="utf-8"), encoding="utf-8")
    bench.start(design=str(copy))
    statuses = bench.statuses()
    assert values(statuses["certificate"])["design"] == str(copy)
    # On the system's clock it ticks although there is nothing to do.
    timing = values(statuses["timing"])
    assert timing["wanted rate [Hz]"] == "200"
    assert 0.0 < float(timing["tick time p50 [ms]"]) <= float(timing["tick time p99 [ms]"])
    assert float(timing["achieved rate [Hz]"]) > 0.0


def test_namespaces_and_remappings_apply(ros: Any) -> None:
    bench = Bench(ros, "/left")
    remapped = ["--ros-args", "-r", "joint_measurements:=sensors/joints"]
    bench.node.destroy_publisher(bench.sensor)
    bench.sensor = bench.node.create_publisher(JointState, "/left/sensors/joints", BEST_EFFORT)
    observer = bench.adopt(create(context=ros.context, namespace="left", cli_args=remapped))
    stamp = bench.node.get_clock().now().nanoseconds
    bench.send(0, stamp)
    bench.wait_until(lambda: len(bench.innovations) == 1, "the innovation")
    bench.wait_for_estimates(3)
    assert observer.tracker.used == 1
    status = bench.status("state")
    assert status.name == "left/observer: state"
    assert bench.call(Trigger, "reset", Trigger.Request()).success
    assert observer.tracker.used == 0


@pytest.mark.parametrize("speed", [0.5, 1.0, 5.0])
def test_simulated_time_may_run_at_any_speed(bench: Bench, speed: float) -> None:
    """The time and the samples come from a steady timer; a tick of it is up to five samples."""
    observer = bench.start_simulated(begin=0)
    begin, period = 50 * SECOND, 10_000_000
    clock, sent, ticks = [0], [0], [0]

    def tick() -> None:
        if ticks[0] >= 150:
            return
        ticks[0] += 1
        clock[0] += round(speed * period)
        while sent[0] * PERIOD <= clock[0]:
            bench.send(sent[0], begin + sent[0] * PERIOD)
            sent[0] += 1
        bench.publish_clock(begin + clock[0])

    bench.node.create_timer(period / SECOND, tick)
    bench.wait_until(lambda: ticks[0] >= 150, "a second and a half")
    bench.now = begin + clock[0]
    bench.advance_until(lambda: observer.received == sent[0], "the samples' arrival")
    bench.wait_for_quiet()
    assert observer.tracker.used == sent[0]
    stamps = [each.stamp for each in bench.estimates]
    assert stamps == sorted(set(stamps))
    assert min(stamps) >= begin
    assert replayed(bench) > 40
    last = bench.estimates[-1]
    index = min((last.stamp - begin) // PERIOD, 1600)
    bound = bench.of("error_bound")[-1].message
    q1, v1, q2, v2 = truth(index)
    error = np.array([*last.message.position, *last.message.velocity]) - [q1, q2, v1, v2]
    # The truth is at the sample before the estimate, half a period away at most.
    slack = 0.005 * np.array([abs(v1), abs(v2), 10.0, 10.0])
    assert (np.abs(error) < 4.0 * np.array([*bound.position, *bound.velocity]) + slack).all()


def test_before_simulated_time_begins_nothing_is_judged(bench: Bench) -> None:
    observer = bench.start_simulated(begin=0)
    begin = 50 * SECOND
    for index in range(20):
        bench.send(index, begin + index * PERIOD)
    status = bench.status("state")
    assert status.message == "WAITING"
    assert observer.received == 0
    assert bench.published == []
    # They have waited; the clock comes late and starts in the middle.
    bench.set_clock(begin + 20 * PERIOD)
    bench.advance_until(lambda: observer.received == 20, "the use of what has waited")
    assert observer.tracker.used == 20
    bench.wait_until(lambda: len(bench.innovations) == 20, "the innovations")
    bench.advance_until(lambda: len(bench.estimates) > 5, "estimates")
    bench.wait_for_quiet()
    assert replayed(bench) > 4
    assert values(bench.status("state"))["resets"] == "0"


@pytest.mark.parametrize("change", [{"position": [1e300]}, {"effort": [1e300]}])
def test_an_enormous_number_on_the_topic_does_not_end_the_node(
    ros: Any, change: dict[str, Any]
) -> None:
    b = Bench(ros)
    observer = b.start_simulated()
    b.feed(range(20))
    begin = 100 * SECOND
    b.send(20, begin + 20 * PERIOD, **change)
    b.advance_until(lambda: observer.received == 21, "the sample's arrival")
    for k in range(21, 60):
        b.send(k, begin + 60 * PERIOD + k * PERIOD)
        b.set_clock(begin + 60 * PERIOD + k * PERIOD)
    b.advance_until(lambda: observer.received == 60, "the samples' arrival")


def test_slow_simulated_time_misses_no_ticks(ros: Any) -> None:
    # At half speed a 200 Hz timer of the node's clock ticks 100 times a wall second, as it must.
    b = Bench(ros)
    b.start_simulated()
    n = [0]

    def tick() -> None:
        n[0] += 1
        b.publish_clock(100 * SECOND + n[0] * 5_000_000)

    b.node.create_timer(0.01, tick)
    b.wait_until(lambda: n[0] >= 250, "2.5 s")
    timing = b.status("timing")
    assert timing.message == "on time", (timing.message, values(timing))


@pytest.mark.parametrize(
    ("method", "disturbed"),
    [("paper", True), ("high_gain", False), ("proportional_integral", False)],
)
def test_methods_to_compare_with_publish_no_bound(
    bench: Bench, method: str, disturbed: bool
) -> None:
    bench.start_simulated(method=method)
    bench.feed(range(60))
    bench.wait_until(lambda: len(bench.published) > 50, "estimates")
    topics = {each.topic for each in bench.published}
    assert {"joint_states", "innovation"} <= topics
    assert not topics & {"error_bound", "disturbance_bound"}
    assert ("disturbance" in topics) == disturbed
    status = bench.status("certificate")
    assert (status.level, status.message) == (
        DiagnosticStatus.WARN,
        f"method {method}: nothing is certified",
    )


def test_learnt_parameters_are_published_once_they_can_be_believed(bench: Bench) -> None:
    adaptive = str(config_path("elastic_joint_adaptive.design.yaml"))
    observer = bench.start_simulated(design=adaptive)
    bench.feed(range(40))
    status = bench.status("parameters")
    assert status.message == "not yet: the motion is too poor"
    assert set(values(status)) == {"stiffness", "gravity"}
    assert observer.count_publishers("/observer/parameters_estimate") == 1
