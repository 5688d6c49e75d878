# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Several joints in one node: each with its own numbers, states and counts, whatever comes in."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from observer.bench import END_OF_TIME, PERIOD, SECOND, SHIPPED, Bench, values
from sensor_msgs.msg import JointState

from tsobs_ros.estimation.records import Innovation, Measurement
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.nodes.messages import to_stamp
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

JOINTS = [f"joint_{k}" for k in range(1, 8)]
RUN = simulate(SCENARIOS["noise"], list(range(len(JOINTS))), 1.0)
BEGIN = 100 * SECOND
ADAPTIVE = str(config_path("elastic_joint_adaptive.design.yaml"))


@pytest.fixture
def bench(ros: Any) -> Bench:
    return Bench(ros)


def sample(joint: str, index: int) -> Measurement:
    place = JOINTS.index(joint)
    stamp = BEGIN + index * PERIOD
    return Measurement(stamp, RUN.measurements[place, index], RUN.torques[place, index])


def send(bench: Bench, index: int, joints: list[str], foreign: list[str] | None = None) -> None:
    """Publish what some joints measured, and what joints did that are nobody's business."""
    taken = {joint: sample(joint, index) for joint in joints}
    message = JointState(
        name=[*(foreign or []), *joints],
        position=[9.0] * len(foreign or []) + [float(each.y[0]) for each in taken.values()],
        effort=[8.0] * len(foreign or []) + [float(each.u[0]) for each in taken.values()],
    )
    message.header.stamp = to_stamp(BEGIN + index * PERIOD)
    bench.sensor.publish(message)


def used_in_all(bench: Bench, count: int) -> bool:
    return bench.observer is not None and bench.observer.received >= count


def expected_innovations(bench: Bench, joint: str, indices: list[int]) -> dict[int, float]:
    """Return what a tracker of the joint alone makes of its samples."""
    assert bench.observer is not None
    own = next(each for each in bench.observer.joints if each.name == joint).tracker
    alone = Tracker(own.estimator, own.options)
    found = {}
    for index in indices:
        outcome = alone.offer(sample(joint, index), END_OF_TIME)
        assert isinstance(outcome, Innovation)
        found[outcome.stamp] = float(outcome.value[0])
    return found


def published_innovations(bench: Bench, joint: str) -> dict[int, float]:
    return {
        each.stamp: each.message.position[list(each.message.name).index(joint)]
        for each in bench.innovations
        if joint in each.message.name
    }


def test_messages_of_any_joints_in_any_order_give_each_joint_what_it_has_alone(
    bench: Bench,
) -> None:
    observer = bench.start_simulated(joints=JOINTS)
    rng = np.random.default_rng(3)
    foreign = [f"foreign_{k}" for k in range(93)]
    seen: dict[str, list[int]] = {joint: [] for joint in JOINTS}
    total = 0
    for index in range(60):
        some = list(rng.permutation(JOINTS))[: int(rng.integers(1, len(JOINTS) + 1))]
        send(bench, index, some, foreign if index % 3 else None)
        bench.set_clock(BEGIN + index * PERIOD)
        total += len(some)
        for joint in some:
            seen[joint].append(index)
    bench.advance_until(lambda: used_in_all(bench, total), "the samples' arrival")
    bench.wait_until(lambda: len(bench.innovations) == 60, "the innovations")

    assert observer.received == total
    for joint in observer.joints:
        assert joint.received == joint.tracker.used == len(seen[joint.name])
        assert published_innovations(bench, joint.name) == expected_innovations(
            bench, joint.name, seen[joint.name]
        )
    last = bench.estimates[-1].message
    assert list(last.name) == [f"{j}_{side}" for j in JOINTS for side in ("link", "motor")]
    assert list(bench.of("disturbance")[-1].message.name) == JOINTS


def test_a_joint_that_falls_silent_leaves_the_others_alone(bench: Bench) -> None:
    joints = JOINTS[:2]
    bench.start_simulated(joints=joints, stale_after=0.2)
    for index in range(20):
        send(bench, index, joints)
        bench.set_clock(BEGIN + index * PERIOD)
    for index in range(20, 90):
        send(bench, index, joints[:1])
        bench.set_clock(BEGIN + index * PERIOD)
    bench.advance_until(lambda: used_in_all(bench, 110), "the samples' arrival")
    bench.wait_until(lambda: bench.estimates[-1].stamp >= BEGIN + 89 * PERIOD, "the last estimate")
    assert list(bench.estimates[-1].message.name) == ["joint_1_link", "joint_1_motor"]
    statuses = bench.statuses()
    assert statuses["joint_1: state"].message == "TRACKING"
    assert statuses["joint_2: state"].message == "STALE"
    assert (statuses["state"].message, statuses["state"].level) == ("STALE", DiagnosticStatus.ERROR)
    assert statuses["joints"].message == "joint_2: state: STALE"
    assert values(statuses["joints"])["joint_2"] == "ERROR"
    assert statuses["joint_2: state"].hardware_id == "joint_2"


def test_samples_are_counted_joint_by_joint_and_in_total(bench: Bench) -> None:
    joints = JOINTS[:2]
    observer = bench.start_simulated(joints=joints)
    send(bench, 0, joints)
    send(bench, 0, joints[:1])  # the same stamp again
    bench.sensor.publish(JointState(name=["elbow"], position=[1.0], effort=[1.0]))
    short = JointState(name=[*joints], position=[1.0, 1.0], effort=[0.0])
    short.header.stamp = to_stamp(BEGIN + 1)
    bench.sensor.publish(short)
    bench.advance_until(lambda: used_in_all(bench, 7), "the samples' arrival", PERIOD // 5)
    reasons = [
        {reason.value: count for reason, count in joint.tracker.rejected.items()}
        for joint in observer.joints
    ]
    # Nothing for either of them in the third message; the fourth lacks the second one's effort.
    assert reasons == [
        {"duplicate stamp": 1, "wrong joint or shape": 1},
        {"wrong joint or shape": 2},
    ]
    for joint in observer.joints:
        assert joint.received == joint.tracker.used + sum(joint.tracker.rejected.values())
    statuses = bench.statuses()
    counts = [
        {key: int(value) for key, value in values(statuses[f"{prefix}measurements"]).items()}
        for prefix in ("joint_1: ", "joint_2: ", "")
    ]
    assert counts[2] == {key: counts[0][key] + counts[1][key] for key in counts[0]}
    assert counts[2]["received"] == 7


def test_each_joint_may_have_a_design_of_its_own(bench: Bench, tmp_path: Path) -> None:
    joints = JOINTS[:3]
    bench.start_simulated(joints=joints, joint_designs=["", ADAPTIVE, ""])
    for index in range(20):
        send(bench, index, joints)
        bench.set_clock(BEGIN + index * PERIOD)
    bench.advance_until(lambda: used_in_all(bench, 60), "the samples' arrival")
    statuses = bench.statuses()
    designs = [values(statuses[f"{joint}: certificate"])["design"] for joint in joints]
    assert designs == [str(SHIPPED), ADAPTIVE, str(SHIPPED)]
    assert [f"{joint}: parameters" in statuses for joint in joints] == [False, True, False]
    assert bench.observer is not None
    assert bench.observer.count_publishers("/observer/parameters_estimate") == 1


@pytest.mark.parametrize("mode", ["silent", "hold"])
def test_a_stale_joint_is_silent_or_holds_its_last_estimate_without_bounds(
    bench: Bench, mode: str
) -> None:
    observer = bench.start_simulated(joints=JOINTS[:1], stale_after=0.2, when_stale=mode)
    for index in range(20):
        send(bench, index, JOINTS[:1])
        bench.set_clock(BEGIN + index * PERIOD)
    bench.advance_until(lambda: observer.received == 20, "the samples' arrival")
    fresh_until = BEGIN + 19 * PERIOD + SECOND // 5
    bench.set_clock(fresh_until)
    bench.wait_until(lambda: bench.estimates[-1].stamp == fresh_until, "the last fresh estimate")
    last = bench.estimates[-1].message
    for _ in range(20):
        bench.set_clock(bench.now + PERIOD)
    if mode == "hold":
        bench.wait_until(lambda: bench.estimates[-1].stamp == bench.now, "a held estimate")
    assert bench.status("state").message == "STALE"
    stale = [each for each in bench.estimates if each.stamp > fresh_until]
    assert bool(stale) == (mode == "hold")
    assert all(each.message.position == last.position for each in stale)
    assert all(each.message.velocity == last.velocity for each in stale)
    stamps = [each.stamp for each in bench.estimates]
    assert stamps == sorted(set(stamps))
    assert max(each.stamp for each in bench.of("error_bound")) == fresh_until
    assert max(each.stamp for each in bench.of("disturbance_bound")) == fresh_until
