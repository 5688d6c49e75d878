# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer node: the tracker's numbers bit for bit, whatever arrives."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from observer.bench import (
    BEST_EFFORT,
    JOINT,
    PERIOD,
    RUN,
    SECOND,
    SHIPPED,
    Bench,
    measurement,
    replayed,
    values,
)
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from tsobs_ros.estimation.records import Measurement
from tsobs_ros.nodes.observer import create
from tsobs_ros.resources import config_path


@pytest.fixture
def bench(ros: Any) -> Bench:
    return Bench(ros)


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


def test_without_effort_the_torque_may_be_taken_as_zero(bench: Bench) -> None:
    observer = bench.start_simulated(assume_zero_torque=True)
    stamp = bench.send(0, bench.now, effort=[])
    bench.advance_until(lambda: observer.tracker.used == 1, "the sample's use")
    bench.sent[stamp] = Measurement(stamp, RUN.measurements[0, 0], np.zeros(1))
    bench.advance_until(lambda: len(bench.estimates) > 10, "estimates")
    bench.wait_for_quiet()
    assert replayed(bench) > 9


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

    # A measurement after all restarts.
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
    timing = values(statuses["timing"])
    assert 0.0 < float(timing["latency p50 [ms]"]) <= float(timing["latency p99 [ms]"])


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
    assert "'fault.*': disturbance error level: expected at least" in first.reason
    observer.set_parameters([Parameter("fault.warn", value=0.2)])
    assert observer.set_parameters_atomically(lower).successful
    for index in range(400, 520):
        biased = (RUN.measurements[0, index] + 0.35).tolist()
        bench.send(index, begin + index * PERIOD, position=biased)
        bench.set_clock(begin + index * PERIOD)
    status = bench.status("sensor fault")
    assert status.level == DiagnosticStatus.ERROR


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


class FailsOnce:
    """An estimator whose third sample is one too many for the numbers."""

    def __init__(self, estimator: Any) -> None:
        self._estimator, self.corrections = estimator, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._estimator, name)

    def correct(self, state: Any, y: Any) -> Any:
        self.corrections += 1
        if self.corrections == 3:
            raise FloatingPointError("overflow")
        return self._estimator.correct(state, y)


def test_a_numerical_failure_is_an_error_and_a_fresh_start_of_its_joint(
    bench: Bench, capfd: pytest.CaptureFixture[str]
) -> None:
    observer = bench.start_simulated()
    observer.tracker.estimator = estimator = FailsOnce(observer.tracker.estimator)
    for index in range(3):
        bench.send(index, bench.now)
        bench.set_clock(bench.now + PERIOD)
    bench.wait_until(lambda: estimator.corrections >= 3, "the failure")
    status = bench.status("state")
    assert status.level == DiagnosticStatus.ERROR
    assert "after a numerical failure" in status.message
    assert values(status)["resets"] == "0"
    assert "numerical failure: an estimate was not finite" in capfd.readouterr().err
    assert (observer.tracker.failures, observer.tracker.restarts) == (1, 1)
    bench.feed(range(10, 40), 100 * SECOND)
    bench.wait_for_quiet()
    assert observer.tracker.used == 33
    assert bench.status("state").level == DiagnosticStatus.OK
