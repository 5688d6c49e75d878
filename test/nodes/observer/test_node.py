# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer node: the tracker's numbers bit for bit, whatever arrives and drives it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.parameter import Parameter
from staging import start, values
from staging.stage import BEGIN, ESTIMATES, MS, PERIOD, TOPIC, Arm, Event, Stage, good, replayed
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from tsobs_ros.design.file import read_record
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.nodes.wire import LATCHED
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.series import NANOSECONDS
from tsobs_ros.settings import changed

README = (Path(__file__).resolve().parents[3] / "README.md").read_text(encoding="utf-8")
JOINT = "elastic_joint"
ARM = Arm(BEGIN)


def samples(begin: int, count: int) -> list[Event]:
    return good(ARM, BEGIN + begin * PERIOD, count * PERIOD * 1e-9)


def test_every_reason_to_reject_is_counted_logged_once_and_estimates_go_on(
    stage: Stage, capfd: pytest.CaptureFixture[str]
) -> None:
    observer = stage.add()
    stage.step(BEGIN - PERIOD)
    before = samples(0, 10)
    stage.play(before)
    nan, now = float("nan"), stage.now
    bad: dict[str, list[dict[str, Any]]] = {
        "non-finite": [{"position": [nan]}, {"position": [-np.inf]}],
        "wrong joint or shape": [{"name": ["x" * 100_000]}, {"name": []}, {"position": []}],
        "missing input": [{"effort": []}],
        "duplicate stamp": [{"stamp": BEGIN + 3 * PERIOD}, {"stamp": BEGIN + 9 * PERIOD}],
        "too old": [{"stamp": 1}, {"stamp": now - 2 * NANOSECONDS}],
        "from the future": [{"stamp": now + 60 * NANOSECONDS}],
        "zero stamp": [{"stamp": 0}],
    }
    # Of this one the angle is used.
    dead = Event(now, ARM.message(now + PERIOD, effort=[nan]))
    messages = [ARM.message(**{"stamp": now, **each}) for kind in bad.values() for each in kind]
    repeats = 20
    messages = [dead.message, *messages * repeats]
    stage.step(now + PERIOD, [Event(now, message) for message in messages])
    while observer.joints[0].received < 10 + len(messages):  # some at each tick
        stage.step(stage.now + PERIOD)

    status = stage.statuses()["observer: measurements"]
    counts = values(status)
    assert "`joints`" in counts.pop("remedy")
    found = {key.removeprefix("rejected: "): int(n) for key, n in counts.items() if int(n)}
    assert found == {
        "received": 10 + len(messages),
        "used": 10,
        "unknown input": 1,
        "last minute: received": 10 + len(messages),
        "last minute: rejected": len(messages),
        **{reason: repeats * len(kind) for reason, kind in bad.items()},
    }
    assert status.level == DiagnosticStatus.WARN
    assert status.message.endswith("most: wrong joint or shape")
    assert status.hardware_id == JOINT

    after = samples((stage.now - BEGIN) // PERIOD + 1, 18)
    stage.play(after)
    assert observer.joints[0].tracker.used == 28
    assert replayed(stage.watcher, observer, [*before, dead, *after]) >= 28
    logged = [line for line in capfd.readouterr().err.splitlines() if " rejected: " in line]
    reasons = [line.partition(" rejected: ")[2].partition(" (")[0] for line in logged]
    assert set(reasons) == {*bad, "unknown input"}
    assert len(reasons) <= 2 * len(set(reasons))  # each again after five seconds
    assert max(map(len, logged)) < 2000


@pytest.mark.parametrize("how", ["enable", "activate"])
def test_a_silenced_observer_discards_what_comes_and_then_restarts(
    stage: Stage, manage: Callable[[Any], Any], how: str
) -> None:
    observer = stage.add()
    manager = manage(observer)

    def work(on: bool) -> None:
        if how == "activate":
            assert manager.change("activate" if on else "deactivate")
        else:
            answer = stage.call(SetBool, "/observer/enable", SetBool.Request(data=on))
            assert answer.success
            off = "disabled: nothing is published until ~/enable"
            assert answer.message == ("enabled" if on else off)

    stage.step(BEGIN - PERIOD)
    stage.play(samples(0, 20))
    work(False)
    stage.watcher.read()
    stage.watcher.published.clear()
    if how == "activate":
        answer = stage.call(Trigger, "/observer/reset", Trigger.Request())
        assert answer.message == "inactive: each activation restarts"
    stage.play(samples(20, 20))
    status = stage.statuses()["observer: state"]
    message = "DISABLED" if how == "enable" else "INACTIVE"
    assert (status.message, status.level) == (message, DiagnosticStatus.WARN)
    stage.watcher.read()
    assert (stage.watcher.published, observer.joints[0].received) == ([], 20)
    work(True)
    stage.wait_until(lambda: observer.joints[0].received == 0, "the restart")
    events = samples(60, 30)
    stage.play(events)
    assert observer.joints[0].tracker.used == 30
    assert replayed(stage.watcher, observer, events) >= 30
    if how == "enable":
        work(True)
        assert observer.joints[0].received == 30
        assert values(stage.statuses()["observer: state"])["resets"] == "1"


def test_the_joint_states_of_a_robot_are_measurements(
    ros: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    """As ros2_control's broadcaster publishes them: all in one message, in any order, reliably.

    The effort of joints that have none is NaN, which the log says of each.
    """
    stage, arm, events = Stage(ros, "/joint_states", 10), Arm(BEGIN, "elbow"), []
    assert f"-r joint_measurements:={stage.topic} -p joints:=[elbow]" in README
    observer = stage.add(joints=["elbow", "wrist", "shoulder"])
    stage.step(BEGIN - PERIOD)
    for event in good(arm, BEGIN, 0.5):
        (angle,), (torque,) = event.message.position, event.message.effort
        event.message.name = ["wrist", "shoulder", "elbow"]
        event.message.position, event.message.velocity = [angle, 0.5, angle], [0.1, 0.2, 0.3]
        event.message.effort = [np.nan, np.nan, torque]
        events.append(event)
    stage.play(events)

    (elbow, wrist, _), unknown = observer.joints, RejectReason.UNKNOWN_INPUT
    assert (elbow.tracker.used, wrist.tracker.rejected) == (100, {unknown: 100})
    log = capfd.readouterr().err
    for joint in ("wrist", "shoulder"):
        assert f"sample of {joint} rejected: unknown input" in log
    # Without a torque the bound is larger, and the angle is used all the same.
    bound = stage.watcher.of("error_bound")[-1].message
    width = dict(zip(bound.name, bound.position, strict=True))
    assert width["elbow_link"] < width["wrist_link"] < 0.2
    found = stage.statuses()
    assert values(found["observer: wrist: measurements"])["rejected: unknown input"] == "100"


def test_a_stale_joint_may_hold_its_last_estimate_without_bounds(stage: Stage) -> None:
    stage.add(stale_after=0.2, when_stale="hold")
    stage.step(BEGIN - PERIOD)
    fresh_until = BEGIN + 19 * PERIOD + 200 * MS
    stage.play(samples(0, 20), fresh_until + 20 * PERIOD)
    states = {each.stamp: each for each in stage.watcher.of("joint_states")}
    held = [stamp for stamp in states if stamp > fresh_until]
    assert len(held) == 20
    assert all(states[stamp].numbers == states[fresh_until].numbers for stamp in held)
    for topic in ("error_bound", "disturbance_bound"):
        assert stage.watcher.of(topic)[-1].stamp == fresh_until


def test_a_method_without_bounds_publishes_what_it_has(stage: Stage) -> None:
    stage.add(method="paper")
    stage.step(BEGIN - PERIOD)
    stage.play(samples(0, 20))
    topics = {each.topic for each in stage.watcher.published}
    assert topics == {"joint_states", "innovation", "disturbance"}


def test_a_numerical_failure_is_an_error_and_a_fresh_start_of_its_joint(
    stage: Stage, capfd: pytest.CaptureFixture[str]
) -> None:
    observer = stage.add(method="high_gain", theta=100.0)
    events = samples(0, 33)
    events[20] = Event(events[20].at, ARM.message(events[20].at, position=[1.7e308]))
    stage.step(BEGIN - PERIOD)
    stage.play(events)
    assert stage.statuses()
    found = stage.reported("observer: state")
    (status,) = [each for each in found if each.level == DiagnosticStatus.ERROR]
    assert status.message == "TRACKING, after a numerical failure"
    assert values(status)["resets"] == "0"
    assert "numerical failure: an estimate was not finite" in capfd.readouterr().err
    tracker = observer.joints[0].tracker
    assert (tracker.failures, tracker.restarts, tracker.used) == (1, 1, 33)
    assert stage.statuses()["observer: state"].level == DiagnosticStatus.OK


def test_estimates_may_come_with_the_measurements_instead_of_the_ticks(stage: Stage) -> None:
    observer = stage.add(rate=1.0, publish_on="measurement")
    stage.step(BEGIN)
    events = samples(0, 40)
    for index, event in enumerate(events):
        stage.step(event.at, [event])
        stage.wait_until(lambda n=index: observer.joints[0].received > n, "the arrival")
    stage.watcher.read()
    # Long before the first tick.
    assert stage.watcher.stamps == [event.at for event in events]
    assert replayed(stage.watcher, observer, events) == 40
    # Without measurements, the ticks go on.
    stage.play([], stage.now + 2 * NANOSECONDS, 50 * PERIOD)
    assert len(stage.watcher.stamps) > 40
    assert len(stage.watcher.of("innovation")) == 40


def test_on_the_systems_clock_in_a_namespace_it_ticks_all_by_itself(stage: Stage) -> None:
    observer = stage.add("/left", use_sim_time=False)
    watcher = stage.watcher
    stamp = stage.node.get_clock().now().nanoseconds
    stage.sensor.publish(ARM.message(stamp))

    def came() -> bool:
        watcher.read()
        return len(watcher.stamps) > 3

    stage.wait_until(came, "estimates")
    assert [each.stamp for each in watcher.of("innovation")] == [stamp]
    assert {each.topic for each in watcher.published} == {*ESTIMATES, "innovation"}
    found = stage.statuses()
    assert all(name.startswith("left/observer: ") for name in found)
    timing = values(found["left/observer: timing"])
    assert float(timing["achieved rate [Hz]"]) > 0.0
    assert 0.0 < float(timing["latency p50 [ms]"]) <= float(timing["latency p99 [ms]"])
    assert stage.call(Trigger, "/left/observer/reset").success
    assert observer.joints[0].tracker.used == 0


def test_parameters_are_refused_with_a_reason_or_taken_over_by_all_joints_and_published(
    ros: Any, tmp_path: Path
) -> None:
    shipped, own = config_path(SHIPPED_DESIGN), tmp_path / "own.design.yaml"
    own.write_text(shipped.read_text(encoding="utf-8") + "# own\n", encoding="utf-8")
    given = {"joints": ["hip", "knee"], "joint_designs": [str(own), ""], "settle_time": 1.5}
    node = start(ros, "observer", **given)
    assert [joint.design.file for joint in node.joints] == [str(own), str(shipped)]
    gates = [joint.tracker.estimator.model["gate"] for joint in node.joints]
    before = node.parameters
    too_late = {"supervision.gate": 4.0, "fault.hold": 1.0, "coast_after": 10.0}
    for changes, reason in (
        ({"design": "other.yaml"}, "read-only"),
        ({"when_stale": "loud"}, "expected one of"),
        ({"supervision.gate": 0.5}, "out of range"),
        ({"fault.warn": 0.6}, "'fault.*': disturbance error level: expected at least"),
        (too_late, "coast_after: expected at most stale_after"),
    ):
        parameters = [Parameter(name, value=value) for name, value in changes.items()]
        result = node.set_parameters_atomically(parameters)
        assert not result.successful
        assert reason in result.reason
        assert node.parameters == before
        assert node.get_parameter("supervision.gate").value == 5.0
    assert [gate.tolist() for gate in gates] == [[5.0], [5.0]]
    assert node.set_parameters_atomically(parameters[:2]).successful
    for joint in node.joints:
        assert joint.faults.limits.hold == 1.0
        assert joint.tracker.estimator.model["gate"].tolist() == [4.0]

    # For those who come later too.
    received: list[String] = []
    ros.node("late").create_subscription(String, "/observer/design", received.append, LATCHED)
    ros.spin_until(lambda: bool(received), what="the record")
    record = read_record(received[-1].data)
    assert record.measurements == TOPIC
    designs = {joint: one for one in record.designs for joint in one.joints}
    for joint, path in (("hip", own), ("knee", shipped)):
        assert designs[joint].file == str(path)
        assert designs[joint].text == path.read_text(encoding="utf-8")
    known = changed(ObserverSettings(), record.parameters)
    assert (known.settle_time, known.supervision.gate) == (1.5, 4.0)
    assert all(getattr(node.parameters, name) == each for name, each in vars(known).items())
