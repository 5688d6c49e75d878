# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""CSV logs: columns, units and times as people and programs write them, and what is wrong."""

import gzip
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.bag import BagReader
from tsobs_ros.bag.joint_states import JointStateDecoder
from tsobs_ros.cli.main import main
from tsobs_ros.design.request import ArmRequest, Output
from tsobs_ros.errors import LogError
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.replay.csv_file import MAX_LINE
from tsobs_ros.replay.estimate import open_source
from tsobs_ros.replay.log import LogSource

SECOND = 1_000_000_000
EPOCH = 1_700_000_000 * SECOND


def log(folder: Path, *lines: str, encoding: str = "utf-8") -> Path:
    path = folder / "log.csv"
    path.write_text("\n".join(lines) + "\n", encoding=encoding)
    return path


def opened(path: Path, **options: Any) -> LogSource:
    """Return a log of arms with an encoder on the link."""
    source = LogSource(path, **options)
    source.observe([ts.ArmRequest()] * len(source.joints))
    return source


ROW = (5_000_000, 0.1, 2.5)
READ = {
    "plain": ("time,angle,torque\n0.005,0.1,2.5", {}, ROW),
    "other names": ("Time (s)\tPosition (rad)\tEffort (Nm)\n0.005\t0.1\t2.5", {}, ROW),
    "named": (
        "a,b,c\n0.005,0.1,2.5", {"columns": {"time": "a", "angle": "b", "torque": "c"}}, ROW
    ),
    "one named": ("x,q,tau\n5e-3,0.1,2.5", {"columns": {"time": "x"}}, ROW),
    "of a joint": ("t,angle.elbow,torque.elbow\n.005,0.1,2.5", {"joints": ["elbow"]}, ROW),
    "byte order mark": ("\ufefftime,angle,torque\n0.005,0.1,2.5", {}, ROW),
    "blank lines": ("\r\n\r\ntime,angle,torque\r\n\r\n  \r\n0.005,0.1,2.5\r\n", {}, ROW),
    "comments": ("# t is in s\ntime,angle,torque\n# moved\n0.005,0.1,2.5", {}, ROW),
    "quoted": ('"time [s]","angle","torque"\n"0.005","0.1","2.5"\n', {}, ROW),
    "decimal commas": ("time;angle;torque\n0,005;0,1;2,5", {}, ROW),
    "separators at the end": ("time,angle,torque,\n0.005,0.1,2.5,\n,,,\n", {}, ROW),
    "words": ("time,angle,mode,torque\n0.005,0.1,run,2.5", {}, ROW),
    "ms, deg": ("t [ms],q [deg],tau [mNm]\n5,180,2500", {}, (5_000_000, math.pi, 2.5)),
    "us, mrad": ("t [us],q [mrad],tau [kN m]\n5000,100,0.0025", {}, ROW),
    "signs": ("t (µs),q (°),tau (N·mm)\n5000,180,2500", {}, (5_000_000, math.pi, 2.5)),
    "given units": (
        "t,q,tau\n9,90,1", {"units": {"time": "ns", "angle": "deg"}}, (9, math.pi / 2, 1.0)
    ),
    "s": ("t [s],q,tau\n1700000000.123456789,1,2", {}, (EPOCH + 123_456_789, 1.0, 2.0)),
    "ns": ("t [ns],q,tau\n1700000000123456789,1,2", {}, (EPOCH + 123_456_789, 1.0, 2.0)),
    "ISO 8601": ("t,q,tau\n2023-11-14T22:13:20.123456789Z,1,2", {}, (EPOCH + 123_456_789, 1, 2)),
    "time zone": ("t,q,tau\n2023-11-14 23:13:20+01:00,1,2", {}, (EPOCH, 1.0, 2.0)),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_logs_of_many_forms_are_read(tmp_path, name) -> None:
    text, options, (stamp, angle, torque) = READ[name]
    (path := tmp_path / "log.csv").write_bytes(text.encode())

    source = opened(path, **options)

    assert source.joints == tuple(options.get("joints", ["elastic_joint"]))
    assert source.samples.stamps.tolist() == [stamp]
    assert source.samples.y.ravel().tolist() == pytest.approx([angle])
    assert source.samples.u.ravel().tolist() == pytest.approx([torque])


def test_times_that_begin_at_zero_are_moved(tmp_path) -> None:
    source = opened(log(tmp_path, "t,q,tau", "0,1,2", ",n/a,2", "0.01,1,2"))

    assert source.remarks == ("note: 1 s was added to all times: 0 means no time",)
    # An empty cell stays without time.
    assert source.samples.stamps.tolist() == [SECOND, 0, SECOND + 10_000_000]
    assert np.isnan(source.samples.y[1, 0, 0])


@pytest.mark.parametrize("end", ["1.005,2\n", "1.005,2,1.5e-", "1.005,-"])
def test_a_last_line_that_is_cut_off_is_left_out(tmp_path, end: str) -> None:
    path = log(tmp_path, "t,q [rad],tau", "1,2,3")
    with path.open("a", encoding="utf-8") as stream:
        stream.write(end)
    source = opened(path)

    assert source.count == 1
    assert source.remarks == ("note: the last line is cut off, and left out",)


def test_a_motor_has_its_own_column_whichever_side_the_design_measures(tmp_path) -> None:
    path = log(tmp_path, "t,position.a,position.a_motor,effort.a", "1,2,3,4")
    for side, angle in (("link", 2.0), ("motor", 3.0)):
        source = LogSource(path)
        assert source.joints == ("a",)
        source.observe([ArmRequest(outputs=(Output(f"{side}_angle", 0.001),))])
        assert source.samples.y.item() == angle


@pytest.mark.parametrize("title", ["motor_angle", "angle", "position.elbow"])
def test_a_motor_without_its_own_entry_has_the_joints(tmp_path, title: str) -> None:
    torque = "effort.elbow" if "." in title else "torque"
    source = LogSource(log(tmp_path, f"time,{title},{torque}", "1,2,3"))
    source.observe([ArmRequest(outputs=(Output("motor_angle", 0.001),))])
    assert (source.samples.y.item(), source.samples.u.item()) == (2.0, 3.0)


def test_several_joints_have_columns_of_their_own(tmp_path) -> None:
    lines = ("t,q.a,q.b,tau.a,tau.b", "1,2,3,4,5")
    path = log(tmp_path, *lines)

    assert opened(path).joints == ("a", "b")
    one = opened(path, joints=["b"])
    assert (one.samples.y.tolist(), one.samples.u.tolist()) == ([[[3.0]]], [[[5.0]]])
    named = {"angle.x": "q.b", "torque.x": "tau.a", "angle.y": "q.a", "torque.y": "tau.b"}
    both = opened(path, columns=named)
    assert (both.joints, both.samples.y.tolist()) == (("x", "y"), [[[3.0], [2.0]]])
    with pytest.raises(LogError, match=r"no column is called link_angle of c.*'q.a', 'q.b'"):
        opened(path, joints=["c"])


@pytest.mark.parametrize("is_ros_there", [True, False])
def test_a_log_is_estimated_and_becomes_a_bag(
    arms, estimate, tmp_path, monkeypatch, is_ros_there
) -> None:
    if not is_ros_there:
        monkeypatch.setattr("sys.prefix", str(tmp_path))
        monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    rows = [f"{k * 0.005!r},{float(arms.y[k, 0])!r},{float(arms.u[k, 0])!r}" for k in range(1, 200)]
    rows[50], rows[60] = ",".join([rows[50].split(",")[0], "", "0"]), ",0,0"
    run = estimate(opened(log(tmp_path, "t [s],q [rad],tau [N m]", *rows)), output="new")

    assert run.used == 197
    assert run.rejected == {RejectReason.NON_FINITE: 1, RejectReason.ZERO_STAMP: 1}
    assert run.rewinds == 0
    written = list(BagReader(tmp_path / "new").messages(["/joint_measurements"]))
    message = JointStateDecoder()(written[10].data)
    assert (message.names, message.position) == (("elastic_joint",), (float(arms.y[11, 0]),))
    agreement = estimate(tmp_path / "new").agreement()
    assert agreement.reproduced == agreement.recorded


def test_times_in_ms_that_are_read_as_s_are_suspected(estimate, tmp_path) -> None:
    rows = [f"{5 * k},0.1,0" for k in range(1, 20)]
    (warning,) = estimate(opened(log(tmp_path, "t,q,tau", *rows))).warnings()
    assert warning.endswith("another unit? For ms: --units time=ms")


@pytest.mark.parametrize(
    ("lines", "options", "match"),
    [
        ((), {}, "the file is empty"),
        (("t,q,tau",), {}, "no line below the titles has a time"),
        (("t,x,tau", "1,2,3"), {}, "no column is called link_angle; .*'t', 'x', 'tau'"),
        (("t,q", "1,2"), {}, "no column is called torque.*assume_zero_torque=true"),
        (("t,q,tau", "1,2,3", "2,abc,3"), {}, "line 3, column 'q': expected a number in rad, got"),
        (("t,q,tau", "4e18,2,3"), {}, "line 2, column 't': .*below 68 years.*--units time=ns"),
        (("t,q,tau", *(f"{9 - k / 9},2,3" for k in range(30))), {}, "line 12: .*sort them by time"),
        (("t,q,tau", "2024-13-01T00:00:00,2,3"), {}, "line 2, column 't': expected a time"),
        (
            ("t,q,tau", *["1,2,3"] * 20, '1,"2,3', *["1,2,3"] * 300, '1,"2,3'),
            {},
            "line 22: a quote opens a cell that is not closed there",
        ),
        (("t,q,tau", "1,2", "2,3,4"), {}, "line 2 ends before column 'tau'"),
        (("t,q,tau", "0,005,0,1,1"), {}, "line 2: 5 cells, but 3 titles"),
        (("t,q,tau", '0.5,0.1,"1,234"'), {}, "expected a number in Nm, got '1,234'"),
        (("t,q [lb],tau", "1,2,3"), {}, "unit 'lb' of angle is not known; there are rad"),
        (("t,q,tau [MNm]", "1,2,3"), {}, "unit 'MNm' of torque is not known"),
        (("t,q [deg],tau", "1,2,3"), {"units": {"angle": "rad"}}, "its unit is not the given one"),
        (("t,q,q,tau", "1,2,3,4"), {}, "several columns are called 'q'"),
        (("t,q,tau", "1,1_0,3"), {}, "line 2, column 'q': expected a number in rad, got '1_0'"),
        (("t,q,tau", "1_0,1,3"), {}, "line 2, column 't': expected a time in s, .* got '1_0'"),
        (("t,q,tau", "1,2,3"), {"columns": {"time": "q"}}, "'q' is taken for time and for link_an"),
        (("t,q,tau", "1,2,3"), {"columns": {"angle": "z"}}, "no column is called 'z'"),
        (
            ("t,q,tau", "1,2,3"),
            {"columns": {"speed": "q"}},
            "some of time, link_angle, torque, got",
        ),
        (("t,q,tau", "1,2,3"), {"units": {"speed": "m/s"}}, "some of time, angle, torque, got"),
    ],
)
def test_what_is_wrong_with_a_log_is_said_with_its_place(tmp_path, lines, options, match) -> None:
    with pytest.raises(LogError, match=match) as raised:
        opened(log(tmp_path, *lines), **options)
    assert str(raised.value).startswith(str(tmp_path / "log.csv"))


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (None, "cannot read it"),
        (gzip.compress(b"t,q,tau\n1,2,3\n", mtime=0), "expected text in UTF-8"),
        (b"PK\x03\x04" + bytes(100), "no column is called time"),
        (b"1," * MAX_LINE, "line 1 is longer than 1,048,576 characters"),
    ],
)
def test_what_is_no_log_is_refused(tmp_path, content, match) -> None:
    path = tmp_path / "log.csv"
    if content is not None:
        path.write_bytes(content)

    with pytest.raises(LogError, match=match):
        opened(path)


def test_a_log_may_have_any_name_but_no_report(tmp_path, arms, write_bag, capsys) -> None:
    path = log(tmp_path, "t,q [rad],tau", "1,2,3").rename(tmp_path / "arm.dat")
    (bag,) = write_bag(arms.messages(10)).glob("*.mcap")

    assert isinstance(open_source(path), LogSource)
    assert not isinstance(open_source(bag.rename(tmp_path / "bag.csv")), LogSource)
    assert main(["report", str(path)]) == 1
    assert f"no estimates to report on; first write a bag of them: tsobs estimate {path}" in (
        capsys.readouterr().err
    )
