# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A run is read from a bag as it was recorded, whatever its topics are called."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from tsobs_ros.bag import BagWriter
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.design.file import load_design
from tsobs_ros.errors import BagReadError
from tsobs_ros.replay.source import BagSource
from tsobs_ros.report import run as runs
from tsobs_ros.report.run import RecordedRun, hold, interpolate
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.series import Series

SECOND = 1_000_000_000


def read_run(bag: Path, topic: str | None = None) -> RecordedRun:
    request = load_design(config_path(SHIPPED_DESIGN)).request
    return runs.read_run(BagSource(bag, topic=topic, joints=["elastic_joint"]), request)


@pytest.mark.parametrize("namespace", ["", "/lab/left"])
def test_a_run_comes_back_from_its_bag(short, messages_of, write_bag, namespace) -> None:
    run = read_run(write_bag(messages_of(short, namespace)))

    assert run.parts.keys() == short.parts.keys()
    for name, part in run.parts.items():
        for read, written in zip(part, short.parts[name][:2], strict=False):
            np.testing.assert_array_equal(read, written, err_msg=name)
    assert run.joint == "elastic_joint"
    assert run.passes == 1
    assert run.origin == short.parts["measurements"].stamps[0]
    assert run.name.startswith("elastic_joint, test_a_run_comes_back")


def test_the_health_of_one_joint_is_read_whoever_else_is_in_it(
    troubled, messages_of, write_bag
) -> None:
    topics = messages_of(troubled)
    for k, one in enumerate(topics["/observer/health"]):
        names = [f"{joint}/{name}" for joint in ("other", troubled.joint) for name in one.names]
        position = [*np.full(7, np.nan), *one.position]
        topics["/observer/health"][k] = one._replace(names=names, position=position)

    health, written = read_run(write_bag(topics)).parts["health"], troubled.parts["health"]

    np.testing.assert_array_equal(health.stamps, written.stamps)
    np.testing.assert_array_equal(health.values, written.values)


def test_missing_topics_are_named_and_of_two_arms_one_is_chosen(
    short, messages_of, write_bag, tmp_path
) -> None:
    stamps, state, _ = short.parts["state"]
    other = replace(short, parts={**short.parts, "state": Series(stamps, state + 1.0)})
    bag = write_bag({**messages_of(short, "/left"), **messages_of(other, "/right")})

    with pytest.raises(BagReadError, match=r"several topics may be the measurements; name one"):
        read_run(bag)
    for name, run in (("left", short), ("right", other)):
        found = read_run(bag, f"/{name}/joint_measurements")
        np.testing.assert_array_equal(found.parts["state"].values, run.parts["state"].values)
    with pytest.raises(BagReadError, match="no topic /nowhere/joint_measurements; topics: /left/"):
        read_run(bag, "/nowhere/joint_measurements")


def test_joints_efforts_and_messages_that_are_missing_leave_gaps(
    short, messages_of, write_bag
) -> None:
    topics = messages_of(short)
    del topics["/observer/error_bound"][10], topics["/observer/disturbance"][20]
    first, second, third, *_ = topics["/joint_measurements"]
    topics["/joint_measurements"] = [
        first._replace(names=["elbow", short.joint], position=[9.0, 0.5], effort=[8.0, 0.25]),
        second._replace(position=[0.75], effort=[]),
        third._replace(names=["elbow"]),
    ]

    run = read_run(write_bag(topics))

    measured = run.parts["measurements"]
    np.testing.assert_array_equal(measured.stamps, [first.stamp, second.stamp])
    np.testing.assert_array_equal(measured.values, [[0.5, 0.25], [0.75, np.nan]])
    link, disturbance = (run.of(run.quantities[place]).bounds for place in (0, 4))
    assert np.flatnonzero(np.isnan(link)).tolist() == [10]
    assert np.flatnonzero(np.isnan(disturbance)).tolist() == []
    assert np.flatnonzero(np.isnan(run.of(run.quantities[4]).values)).tolist() == [20]
    np.testing.assert_array_equal(link[11:], short.parts["state_bound"].values[11:, 0])


@pytest.mark.parametrize("leap", [0, 10**5 * SECOND])
def test_of_a_looped_bag_the_longest_pass_is_read(short, messages_of, write_bag, leap) -> None:
    """Three passes over two seconds of stamps, the second one being the longest.

    The third may be on another clock.
    """
    parts = ((150, 0), (200, 10 * SECOND), (120, 20 * SECOND))
    topics, logs = {}, {}
    for name, rows in messages_of(short).items():
        # Twice as slow, so that a pass spans more than the second that late messages may have.
        slow = [r._replace(stamp=2 * r.stamp - rows[0].stamp) for r in rows]
        topics[name] = [r for count, _ in parts[:2] for r in slow[:count]]
        topics[name] += [r._replace(stamp=r.stamp + leap) for r in slow[: parts[2][0]]]
        logs[name] = [r.stamp + lag for count, lag in parts for r in slow[:count]]

    run = read_run(write_bag(topics, logs))

    assert run.passes == 3
    assert len(run.stamps) == 200
    for name in ("state", "true_state"):
        np.testing.assert_array_equal(run.parts[name].values, short.parts[name].values)


def motion(stamps: np.ndarray, w: float = 5.0) -> np.ndarray:
    t = stamps / 1e9
    return np.column_stack([np.sin(w * t), w * np.cos(w * t), np.cos(t), -np.sin(t)])


def test_interpolated_motion_keeps_the_documented_error() -> None:
    """At most h³/24 times the largest third derivative."""
    h, stamps = 5e-3, 5_000_000 * np.arange(400)
    wanted = stamps[1:-2] + round(1e9 * h / 3)

    off = np.abs(interpolate(Series(stamps, motion(stamps)), wanted) - motion(wanted)).max(axis=0)

    assert (off <= h**3 / 24 * np.array([5.0**3, 5.0**4, 1.0, 1.0])).all()


def test_nothing_is_interpolated_outside_or_in_gaps() -> None:
    stamps = np.array([0, 1, 2, 30, 31]) * 10_000_000
    wanted = np.array([-1, 5, 20, 25, 305, 310]) * 1_000_000

    known = np.isfinite(interpolate(Series(stamps, np.zeros((5, 4))), wanted)).all(axis=1)

    assert known.tolist() == [False, True, False, False, True, True]
    assert np.isnan(interpolate(Series(stamps[:1], np.zeros((1, 4))), wanted)).all()


def test_a_held_value_is_the_newest_and_not_too_old() -> None:
    series = Series(np.array([100, 200, 300]) * 1_000_000, np.array([[1.0], [2.0], [3.0]]))
    wanted = np.array([99, 100, 199, 200, 400, 401]) * 1_000_000

    held = hold(series, wanted)[:, 0]

    np.testing.assert_array_equal(held, [np.nan, 1.0, 1.0, 2.0, 3.0, np.nan])


def test_statuses_of_the_observer_are_read_and_malformed_ones_left_out(tmp_path) -> None:
    store, array = get_typestore(Stores.ROS2_JAZZY), "diagnostic_msgs/msg/DiagnosticArray"
    make = {name.rpartition("/")[2]: type_ for name, type_ in store.types.items()}
    values = [make["KeyValue"](key="k", value="1")]
    each = [
        make["DiagnosticStatus"](level=2, name=name, message="", hardware_id="", values=values)
        for name in ("recorder: topics", "observer: health")
    ]
    header = make["Header"](stamp=make["Time"](sec=3, nanosec=4), frame_id="")
    data = bytes(store.serialize_cdr(make["DiagnosticArray"](header=header, status=each), array))
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/diagnostics", array)
        writer.add_topic("/joint_measurements", JOINT_STATE)
        writer.write("/joint_measurements", JointStateEncoder(["j"])(5, [0.0], (), [0.0]), 5, 5)
        for place, message in enumerate((data, data[:-3], data)):
            writer.write("/diagnostics", message, place, place)
    found = list(runs.diagnostics(BagSource(tmp_path / "bag")))
    assert found == [(3_000_000_004, 2, ("observer", "health"), {"k": "1"})] * 2
