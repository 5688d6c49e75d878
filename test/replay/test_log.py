# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""CSV logs: columns, units and times as people write them, and what is wrong with a log."""

import math
from pathlib import Path

import numpy as np
import pytest

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.joint_states import JointStateDecoder
from tsobs_ros.errors import LogError
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.replay.log import LogSource
from tsobs_ros.report.export import export_bag

SECOND = 1_000_000_000


def log(folder: Path, *lines: str) -> Path:
    path = folder / "log.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("header", "options"),
    [
        ("time,angle,torque", {}),
        ("t [s];q [rad];tau [N m]", {}),
        ("Time (s)\tPosition (rad)\tEffort (Nm)", {}),
        ("a,b,c", {"columns": {"time": "a", "angle": "b", "torque": "c"}}),
        ("x, q [rad], tau", {"columns": {"time": "x"}}),
    ],
)
def test_columns_are_found_by_name_or_named(tmp_path, header, options) -> None:
    delimiter = max(",;\t", key=header.count)
    rows = [delimiter.join(row) for row in (["1.5", "0.25", "-2"], ["1.505", "1e-3", "0"])]

    source = LogSource(log(tmp_path, header, *rows), **options)

    assert source.joints == ("elastic_joint",)
    assert source.samples.stamps.tolist() == [1_500_000_000, 1_505_000_000]
    assert source.samples.y.tolist() == [[0.25], [1e-3]]
    assert source.samples.u.tolist() == [[-2.0], [0.0]]


@pytest.mark.parametrize(
    ("header", "row", "units", "expected"),
    [
        ("t [ms],q [deg],tau [mNm]", "5,180,1500", {}, (5_000_000, math.pi, 1.5)),
        ("t [us],q [mrad],tau [kN m]", "7,500,0.5", {}, (7_000, 0.5, 500.0)),
        ("t,q,tau", "9,90,1", {"time": "ns", "angle": "deg"}, (9, math.pi / 2, 1.0)),
    ],
)
def test_units_are_understood(tmp_path, header, row, units, expected) -> None:
    samples = LogSource(log(tmp_path, header, row), units=units).samples

    assert (int(samples.stamps[0]), samples.y[0, 0], samples.u[0, 0]) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        ("1700000000.123456789", 1_700_000_000_123_456_789),
        ("1700000000123456789", 1_700_000_000_123_456_789),
        ("2023-11-14T22:13:20.123456789Z", 1_700_000_000_123_456_789),
        ("2023-11-14 23:13:20+01:00", 1_700_000_000_000_000_000),
        ("0.5", 500_000_000),
    ],
)
def test_times_are_read_to_the_nanosecond(tmp_path, text, stamp) -> None:
    samples = LogSource(log(tmp_path, "time,angle,torque", f"{text},1,2")).samples

    assert samples.stamps.tolist() == [stamp]


def test_times_that_begin_at_zero_are_moved(tmp_path) -> None:
    source = LogSource(log(tmp_path, "t,q,tau", "0,1,2", ",1,2", "0.01,1,2"))

    assert source.moved_by == SECOND
    # An empty cell stays without time.
    assert source.samples.stamps.tolist() == [SECOND, 0, SECOND + 10_000_000]


def test_several_joints_have_columns_of_their_own(tmp_path) -> None:
    lines = ("t,q.a,q.b,tau.a,tau.b", "1,2,3,4,5")
    path = log(tmp_path, *lines)

    assert LogSource(path).joints == ("a", "b")
    one = LogSource(path, joints=["b"])
    assert (one.samples.y.tolist(), one.samples.u.tolist()) == ([[3.0]], [[5.0]])
    named = {"angle.x": "q.b", "torque.x": "tau.a"}
    assert LogSource(path, columns=named).joints == ("x",)
    with pytest.raises(LogError, match="no angle of c; there are angles of a, b"):
        LogSource(path, joints=["c"])


def test_a_log_is_estimated_and_becomes_a_bag(arms, estimate, tmp_path) -> None:
    rows = [f"{k * 0.005!r},{float(arms.y[k, 0])!r},{float(arms.u[k, 0])!r}" for k in range(1, 200)]
    rows[50], rows[60] = ",".join([rows[50].split(",")[0], "", "0"]), ",0,0"
    rows[70], rows[71] = rows[71], rows[70]

    run = estimate(LogSource(log(tmp_path, "t [s],q [rad],tau [N m]", *rows)), output="new")

    assert run.replay.used == 197
    assert run.replay.rejected == {RejectReason.NON_FINITE: 1, RejectReason.ZERO_STAMP: 1}
    assert run.replay.rewinds == 1
    written = list(BagReader(tmp_path / "new").messages(["/joint_measurements"]))
    message = JointStateDecoder()(written[10].data)
    assert (message.names, message.position) == (("elastic_joint",), (float(arms.y[11, 0]),))
    assert estimate(tmp_path / "new").agreement().complete


def test_what_was_exported_can_be_estimated(arms, write_bag, estimate, tmp_path) -> None:
    bag = write_bag(arms.messages(100, joints=2))
    (exported,) = export_bag(bag, tmp_path / "csv")

    source = LogSource(exported.path)

    assert source.joints == ("elbow", "wrist")
    assert np.array_equal(estimate(source).table.states, estimate(bag).table.states)


@pytest.mark.parametrize(
    ("lines", "options", "match"),
    [
        ((), {}, "no column looks like the time"),
        (("t,q,tau",), {}, "no lines below the header"),
        (("t,x,tau", "1,2,3"), {}, "no column looks like an angle.*'t', 'x', 'tau'"),
        (("t,q", "1,2"), {}, "torque of elastic_joint.*assume_zero_torque=true"),
        (("t,q,tau", "1,2,3", "2,abc,3"), {}, "line 3, column 'q': expected a number, got 'abc'"),
        (("t,q [deg],tau", "1,1;2,3"), {}, "line 2, column 'q .deg.': expected a number in deg"),
        (("t,q,tau", "1,2,3", "", "now,2,3"), {}, "line 4, column 't': expected a time, got 'now'"),
        (("t,q,tau", "1e12,2,3"), {}, "line 2, column 't': expected a time"),
        (("t,q,tau", "2024-13-01,2,3"), {}, "line 2, column 't': expected a time"),
        (("t,q,tau", "1,2"), {}, "line 2: 2 cells, but column 'tau' is number 3"),
        (("t,q [lb],tau", "1,2,3"), {}, "unit 'lb' of angle is not known; there are rad"),
        (("t,q,q", "1,2,3"), {"columns": {"angle": "q"}}, "several columns are called 'q'"),
        (("t,q,tau", "1,2,3"), {"columns": {"angle": "z"}}, "no column is called 'z'"),
        (("t,q,tau", "1,2,3"), {"columns": {"speed": "q"}}, "expected time, angle or torque"),
        (("t,q,tau", "1,2,3"), {"units": {"speed": "m/s"}}, "expected time, angle or torque"),
    ],
)
def test_what_is_wrong_with_a_log_is_said_with_its_place(tmp_path, lines, options, match) -> None:
    with pytest.raises(LogError, match=match) as raised:
        LogSource(log(tmp_path, *lines), **options)
    assert str(raised.value).startswith(str(tmp_path / "log.csv"))


def test_a_log_that_is_missing_or_no_text_is_refused(tmp_path) -> None:
    with pytest.raises(LogError, match="cannot read it"):
        LogSource(tmp_path / "none.csv")
    (tmp_path / "log.csv").write_bytes(b"\xff\xfe\x00t")
    with pytest.raises(LogError, match="cannot read it"):
        LogSource(tmp_path / "log.csv")


def test_a_log_without_torque_may_be_taken_for_unloaded(tmp_path) -> None:
    source = LogSource(log(tmp_path, "t,q", "1,2"), assume_zero_torque=True)

    assert source.samples.u.tolist() == [[0.0]]
