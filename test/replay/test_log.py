# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""CSV logs: columns, units and times as people and programs write them, and what is wrong."""

import gzip
import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import tsobs_ros as ts
from tsobs_ros.bag import BagReader
from tsobs_ros.bag.joint_states import JointStateDecoder
from tsobs_ros.cli.main import main
from tsobs_ros.design.file import DesignFile
from tsobs_ros.errors import LogError
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.replay.cells import MAX_LINE
from tsobs_ros.replay.estimate import Observer, make_runs, open_source
from tsobs_ros.replay.log import LogSource
from tsobs_ros.replay.source import BagSource
from tsobs_ros.report.export import export_bag

SECOND = 1_000_000_000
EPOCH = 1_700_000_000 * SECOND
DEGREE = math.pi / 180


def log(folder: Path, *lines: str, encoding: str = "utf-8") -> Path:
    path = folder / "log.csv"
    path.write_text("\n".join(lines) + "\n", encoding=encoding)
    return path


def opened(path: Path, **options: Any) -> LogSource:
    """Return a log of arms with an encoder on the link."""
    source = LogSource(path, **options)
    source.observe([ts.ArmRequest()] * len(source.joints))
    return source


def stamps_of(source: LogSource) -> list[int]:
    """Return the stamps as the log has them."""
    return [stamp - source.moved_by for stamp in source.samples.stamps.tolist()]


@pytest.mark.parametrize(
    ("header", "options"),
    [
        ("time,angle,torque", {}),
        ("t [s];q [rad];tau [N m]", {}),
        ("Time (s)\tPosition (rad)\tEffort (Nm)", {}),
        ("t|q|tau", {}),
        ("a,b,c", {"columns": {"time": "a", "angle": "b", "torque": "c"}}),
        ("a,b,c", {"columns": {"time": "1", "angle": "2", "torque": "3"}}),
        ("x, q [rad], tau", {"columns": {"time": "x"}}),
        ("Timestamp (sec),link_angle_rad,Trq (Nm)", {}),
        ("t / s;phi / rad;M / Nm", {}),
        ("Time,link_angle,torque", {}),
        ("Secs (s),Enc (rad),Mot (N-m)", {}),
        ("Time,JointAngle,MotorTorque", {}),
        ("__time,/arm/elbow/position,/arm/elbow/effort", {"joints": ["elbow"]}),
        ("time,position[0],effort[0]", {}),
        ("time,field.position0,field.effort0", {}),
    ],
)
def test_columns_are_found_by_name_or_named(tmp_path, header, options) -> None:
    delimiter = max(",;\t|", key=header.count)
    rows = [delimiter.join(row) for row in (["1.5", "0.25", "-2"], ["1.505", "1e-3", "0"])]

    source = opened(log(tmp_path, header, *rows), **options)

    assert source.joints == tuple(options.get("joints", ["elastic_joint"]))
    assert source.samples.stamps.tolist() == [1_500_000_000, 1_505_000_000]
    assert source.samples.y[:, 0].tolist() == [[0.25], [1e-3]]
    assert source.samples.u[:, 0].tolist() == [[-2.0], [0.0]]


FORMS = {
    "byte order mark": "\ufefftime,angle,torque\n0.005,0.1,1\n0.01,-0.2,2.5\n",
    "UTF-16": "time,angle,torque\n0.005,0.1,1\n0.01,-0.2,2.5\n".encode("utf-16"),
    "UTF-16 without mark": "time,angle,torque\n0.005,0.1,1\n0.01,-0.2,2.5\n".encode("utf-16-be"),
    "old line ends": "time,angle,torque\r0.005,0.1,1\r0.01,-0.2,2.5\r",
    "blank lines": "\r\n\r\ntime,angle,torque\r\n\r\n0.005,0.1,1\r\n  \r\n0.01,-0.2,2.5",
    "comments": "# t is in s\ntime,angle,torque\n0.005,0.1,1\n# moved\n0.01,-0.2,2.5\n",
    "numpy.savetxt": "# time angle torque\n5.0e-03 1.0e-01 1.0e+00\n1.0e-02 -2.0e-01 2.5e+00\n",
    "aligned": "  time [s]  angle [rad]  torque [N m]\n   0.005   0.1   1\n   0.01   -0.2   2.5\n",
    "quoted": '"time [s]","angle","torque"\n"0.005","0.1","1"\n"0.01","-0.2","2.5"\n',
    "quoted commas": '"time","angle","torque"\n"0,005","0,1","1"\n"0,01","-0,2","2,5"\n',
    "separators at the end": "time,angle,torque,\n0.005,0.1,1,\n,,,\n0.01,-0.2,2.5\n,,,\n",
    "words": "time,angle,torque,mode\n0.005,0.1,1,run\n0.01,-0.2,2.5,run\n",
    "line of units": "time,angle,torque,temp\nms,mrad,mNm,C\n5,100,1e3,20\n10,-200,2.5e3,20\n",
    "units in brackets": "time;angle;torque\n[ms];[rad];[Nm]\n5;0,1;1\n10;-0,2;2,5\n",
    "remarks": "My logger v1.2\nDate,2023-11-14\n\ntime,angle,torque\n0.005,0.1,1\n0.01,-0.2,2.5\n",
    "German Excel": (
        "Zeit [ms];Winkel [°];Drehmoment [Nm]\r\n5;5,729577951308232;1\r\n"
        "10;-11,459155902616464;2,5\r\n"
    ).encode("cp1252"),
    "German preamble": (
        "sep=;\r\nMessung 1;;\r\nDatum;14.11.2023;\r\nZeit;Winkel;Moment\r\n"
        "0,005;0,1;1\r\n0,01;-0,2;2,5\r\n"
    ),
    "writetable": "t_ms,q_rad,tau_Nm\n5,0.1,1\n10,-0.2,2.5\n",
    "writetimetable": "Time,Angle,Torque\n0.005 sec,0.1,1\n0.01 sec,-0.2,2.5\n",
    "PlotJuggler": (
        "__time,/joint_states/arm/position,/joint_states/arm/velocity,/joint_states/arm/effort\n"
        "0.005,0.1,0,1\n0.01,-0.2,0,2.5\n"
    ),
    "rosbag2 to CSV": (
        "header.stamp.sec,header.stamp.nanosec,header.frame_id,name[0],position[0],effort[0]\n"
        "0,5000000,,arm,0.1,1\n0,10000000,,arm,-0.2,2.5\n"
    ),
    "bagpy": (
        "Time,header.seq,header.stamp.secs,header.stamp.nsecs,name_0,position_0,effort_0\n"
        "0.007,1,0,5000000,arm,0.1,1\n0.012,2,0,10000000,arm,-0.2,2.5\n"
    ),
    "clock": "time,angle,torque\n00:00:00.005,0.1,1\n00:00:00.010,-0.2,2.5\n",
}


@pytest.mark.parametrize("form", FORMS)
def test_logs_of_many_programs_are_read(tmp_path, form) -> None:
    content, path = FORMS[form], tmp_path / "log.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())

    source = opened(path)

    assert stamps_of(source) == [5_000_000, 10_000_000]
    assert source.samples.y[:, 0, 0].tolist() == pytest.approx([0.1, -0.2])
    assert source.samples.u[:, 0, 0].tolist() == pytest.approx([1.0, 2.5])


@pytest.mark.parametrize(
    ("header", "row", "units", "expected"),
    [
        ("t [ms],q [deg],tau [mNm]", "5,180,1500", {}, (5_000_000, math.pi, 1.5)),
        ("t [us],q [mrad],tau [kN m]", "7,500,0.5", {}, (7_000, 0.5, 500.0)),
        ("t (µs),q (Degrees),tau (N·mm)", "7,180,500", {}, (7_000, math.pi, 0.5)),
        ("t,q,tau", "9,90,1", {"time": "ns", "angle": "deg"}, (9, math.pi / 2, 1.0)),
    ],
)
def test_units_are_understood(tmp_path, header, row, units, expected) -> None:
    samples = opened(log(tmp_path, header, row), units=units).samples

    assert (int(samples.stamps[0]), samples.y[0, 0, 0], samples.u[0, 0, 0]) == pytest.approx(
        expected
    )


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        ("1700000000.123456789", EPOCH + 123_456_789),
        ("1700000000123456789", EPOCH + 123_456_789),
        ("1700000000123456", EPOCH + 123_456_000),
        ("1700000000123.5", EPOCH + 123_500_000),
        ("2023-11-14T22:13:20.123456789Z", EPOCH + 123_456_789),
        ("2023-11-14 23:13:20+01:00", EPOCH),
        ("14.11.2023 22:13:20.5", EPOCH + 500_000_000),
        ("14-Nov-2023 22:13:20", EPOCH),
        ("1:02:03.000000004", 3723 * SECOND + 4),
        ("0.5", 500_000_000),
    ],
)
def test_times_are_read_to_the_nanosecond(tmp_path, text, stamp) -> None:
    samples = opened(log(tmp_path, "time,angle,torque", f"{text},1,2")).samples

    assert samples.stamps.tolist() == [stamp]


@pytest.mark.parametrize(
    ("cell", "number"),
    [
        ("1.234,5", 1234.5),
        ("-1.234.567,25", -1234567.25),
        ("1 234,5", 1234.5),
        ("2,5e-3", 0.0025),
        (",5", 0.5),
        ("", math.nan),
        ("n/a", math.nan),
        ("-inf", -math.inf),
    ],
)
def test_numbers_are_read_as_programs_write_them(tmp_path, cell, number) -> None:
    samples = opened(log(tmp_path, "t;q;tau", f"0,5;0,25;{cell}")).samples

    assert samples.u[0, 0] == pytest.approx(number, nan_ok=True)


def test_times_that_begin_at_zero_are_moved(tmp_path) -> None:
    source = opened(log(tmp_path, "t,q,tau", "0,1,2", ",1,2", "0.01,1,2"))

    assert source.moved_by == SECOND
    # An empty cell stays without time.
    assert source.samples.stamps.tolist() == [SECOND, 0, SECOND + 10_000_000]


def test_a_last_line_that_is_cut_off_is_left_out(tmp_path) -> None:
    source = opened(log(tmp_path, "t,q [rad],tau", "1,2,3", "1.005,2"))

    assert source.count == 1
    assert source.remarks == ("note: the last line is cut off, and left out",)


def test_clock_times_go_on_at_midnight(tmp_path) -> None:
    source = opened(log(tmp_path, "t,q,tau", "23:59:59.995,1,2", "00:00:00.000,1,2"))

    assert np.diff(source.samples.stamps).tolist() == [5_000_000]


@pytest.mark.parametrize("order", ["shuffled", "newest first", "two late"])
def test_lines_are_sorted_by_time(tmp_path, order) -> None:
    rows = [f"{k * 0.005:.3f},{k},0" for k in range(2000)]
    if order == "shuffled":
        np.random.default_rng(1).shuffle(rows)
    elif order == "newest first":
        rows.reverse()
    else:
        rows = [*rows[:5], *rows[7:1500], *rows[5:7], *rows[1500:]]

    source = opened(log(tmp_path, "t,q [rad],tau", *rows))

    assert source.samples.y[:, 0, 0].tolist() == list(range(2000))
    assert np.diff(source.samples.stamps).tolist() == [5_000_000] * 1999
    assert any("not in order of time" in remark for remark in source.remarks)


def test_a_log_in_which_time_restarts_keeps_its_order(tmp_path) -> None:
    rows = [f"{5 + k % 100 * 0.05:.2f},{k},0" for k in range(300)]

    source = opened(log(tmp_path, "t,q [rad],tau", *rows))

    assert source.samples.y[:, 0, 0].tolist() == list(range(300))
    assert (np.diff(source.samples.log_times) > 0).all()
    assert "note: time restarts 2 times, and each time the observer does" in source.remarks


def test_times_with_too_few_digits_are_noted(tmp_path) -> None:
    rows = [f"{k * 0.001:.2f},0,0" for k in range(1, 201)]

    (remark, *_) = opened(log(tmp_path, "t,q [rad],tau", *rows)).remarks

    assert "have the time of the line before, and are rejected: write times with more" in remark


def test_several_joints_have_columns_of_their_own(tmp_path) -> None:
    lines = ("t,q.a,q.b,tau.a,tau.b", "1,2,3,4,5")
    path = log(tmp_path, *lines)

    assert opened(path).joints == ("a", "b")
    one = opened(path, joints=["b"])
    assert (one.samples.y.tolist(), one.samples.u.tolist()) == ([[[3.0]]], [[[5.0]]])
    named = {"angle.x": "q.b", "torque.x": "tau.a"}
    assert opened(path, columns=named).joints == ("x",)
    with pytest.raises(LogError, match="no angle of c; there are angles of a, b"):
        opened(path, joints=["c"])


def test_a_log_is_estimated_and_becomes_a_bag(arms, estimate, tmp_path) -> None:
    rows = [f"{k * 0.005!r},{float(arms.y[k, 0])!r},{float(arms.u[k, 0])!r}" for k in range(1, 200)]
    rows[50], rows[60] = ",".join([rows[50].split(",")[0], "", "0"]), ",0,0"
    rows[70], rows[71] = rows[71], rows[70]

    run = estimate(opened(log(tmp_path, "t [s],q [rad],tau [N m]", *rows)), output="new")

    assert run.loop.used == 197
    assert run.loop.rejected == {RejectReason.NON_FINITE: 1, RejectReason.ZERO_STAMP: 1}
    assert run.loop.rewinds == 0
    written = list(BagReader(tmp_path / "new").messages(["/joint_measurements"]))
    message = JointStateDecoder()(written[10].data)
    assert (message.names, message.position) == (("elastic_joint",), (float(arms.y[11, 0]),))
    assert estimate(tmp_path / "new").agreement().complete


def test_what_was_exported_can_be_estimated(arms, write_bag, estimate, tmp_path) -> None:
    bag = write_bag(arms.messages(100, joints=2))
    (exported,) = export_bag(bag, tmp_path / "csv")

    source = opened(exported.path)

    assert source.joints == ("elbow", "wrist")
    log_run, bag_run = estimate(source), estimate(bag)
    for joint in (0, 1):
        values = [run.table.values(joint, "state") for run in (log_run, bag_run)]
        assert np.array_equal(*values)


@pytest.mark.parametrize(
    ("lines", "options", "match"),
    [
        ((), {}, "the file is empty"),
        (("t,q,tau",), {}, "no lines below the header"),
        (("t,x,tau", "1,2,3"), {}, "no column looks like an angle.*'t', 'x', 'tau'"),
        (("t,q", "1,2"), {}, "torque of elastic_joint.*assume_zero_torque=true"),
        (("t,q,tau", "1,2,3", "2,abc,3"), {}, "line 3, column 'q': expected a number, got 'abc'"),
        (("t,q [deg],tau", "1,1;2,3"), {}, "line 2, column 'q .deg.': expected a number in deg"),
        (("t,q,tau", "1,2,3", "", "now,2,3"), {}, "line 4, column 't': expected a time in s, got"),
        (("t,q,tau", "4e18,2,3"), {}, "line 2, column 't': expected a time.*is its unit another"),
        (("t,q,tau", "1e999999999,2,3"), {}, "line 2, column 't': expected a time"),
        (("t,q,tau", "2024-13-01,2,3"), {}, "line 2, column 't': expected a time"),
        (("t,q,tau", "11/14/2023 1:00:00 PM,2,3"), {}, "expected a time.*HH:MM:SS.sss or ISO 8601"),
        (("t,q,tau", "05:30.5,2,3"), {}, "expected a time.*HH:MM:SS.sss or ISO 8601"),
        (
            ("t,q,tau", *["1,2,3"] * 20, '1,"2,3', *["1,2,3"] * 300),
            {},
            "line 22: a quote opens a cell that is not closed there",
        ),
        (
            ("t,q,tau,note", *["1,2,3,"] * 600, '1,2,3,"odd', *["1,2,3,"] * 9, '1,2,3,odd"'),
            {},
            "line 602: a quote opens a cell that is not closed there",
        ),
        (("t,q,tau", "1,2", "2,3,4"), {}, "line 2 ends before column 'tau'"),
        (("t,q,tau", "99999999999:00:00,2,3"), {}, "line 2, column 't': expected a time"),
        (("t,q,tau", f"1,0.{'1' * 1000},3"), {}, "line 2: a cell of more than 1,000 characters"),
        (("t,q,tau", "0,005,0,1,1"), {}, "5 cells, but 3 titles: with decimal commas, separate"),
        (("t,q,tau", '0.5,0.1,"1,234"'), {}, "got '1,234': write all with the same decimal sign"),
        (("t;q;tau", "0,5;0,1;1,5", "1,5;0,1;1.234"), {}, "line 3.*got '1.234': write all with"),
        (("t,q,tau", "1,0x1F,3"), {}, "expected a number, got '0x1F'"),
        (("t,q,tau", '1,"[0.1, 0.2]",3'), {}, r"write one number a cell.*position\[0\]"),
        (("0.5,0.1,1", "0.505,0.1,1"), {}, "no titles.*--columns time=1,angle=2,torque=3"),
        (("t,q [lb],tau", "1,2,3"), {}, "unit 'lb' of angle is not known; there are rad"),
        (("t,q [deg],tau", "1,2,3"), {"units": {"angle": "rad"}}, "'deg', but --units says angle"),
        (("t,q,q", "1,2,3"), {"columns": {"angle": "q"}}, "several columns are called 'q'"),
        (("t,q,q,tau", "1,2,3,4"), {}, "several columns look like angle: 'q', 'q'.*angle=2"),
        (("t,q,tau", "1,2,3"), {"columns": {"angle": "z"}}, "no column is called 'z'"),
        (("t,q,tau", "1,2,3"), {"columns": {"speed": "q"}}, "expected time, angle or torque"),
        (("t,q,tau", "1,2,3"), {"units": {"speed": "m/s"}}, "expected time, angle or torque"),
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
        (gzip.compress(b"t,q,tau\n1,2,3\n", mtime=0), "gzip data: unpack it first"),
        (b"PK\x03\x04" + bytes(100), "Excel workbook.*save it as CSV"),
        (b"PAR1" + bytes(100), "a Parquet file: write it as CSV"),
        (bytes(range(256)) * 20, "no text"),
        (b"1," * MAX_LINE, "line 1 is longer than 1,048,576 characters"),
        (
            b't,q,tau\n1,2,"3\n' + b"1,2,3\n" * 50_000,
            "a quote opens a cell that is not closed there",
        ),
    ],
)
def test_what_is_no_log_is_refused(tmp_path, content, match) -> None:
    path = tmp_path / "log.csv"
    if content is not None:
        path.write_bytes(content)

    with pytest.raises(LogError, match=match):
        opened(path)


MEASURE = """
import resource, sys
from pathlib import Path
from tsobs_ros.errors import LogError
from tsobs_ros.replay.log import LogSource
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    LogSource(Path(sys.argv[1]))
except LogError as error:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, error)
"""


def test_a_file_of_one_line_takes_little_memory(tmp_path) -> None:
    with (tmp_path / "log.csv").open("wb") as file:
        for _ in range(100):
            file.write(b"0.005,0.1,1," * 85_000)

    command = [sys.executable, "-c", MEASURE, str(tmp_path / "log.csv")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)

    kilobytes, _, error = done.stdout.partition(" ")
    assert "line 1 is longer than" in error
    assert int(kilobytes) < 32_000


def test_a_log_without_torque_may_be_taken_for_unloaded(tmp_path) -> None:
    source = opened(log(tmp_path, "t,q", "1,2"), assume_zero_torque=True)

    assert source.samples.u.tolist() == [[[0.0]]]


@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    rate=st.floats(5.0, 2000.0),
    start=st.sampled_from([0.0, -3.0, 12345.678, 1.7e9]),
    jitter=st.floats(0.0, 0.4),
    gap=st.floats(0.0, 100.0),
    unit=st.sampled_from([1.0, 1e3, 1e6, 1e9]),
)
def test_the_unit_of_times_is_found(tmp_path, rate, start, jitter, gap, unit) -> None:
    """Logs in seconds are read, whatever their rate and start; those in other units are not."""
    random = np.random.default_rng(1)
    times = start + (np.arange(60) + random.uniform(-jitter, jitter, 60)) / rate
    times[40:] += gap
    texts = [f"{time * unit:.6f}" for time in times]
    path = log(tmp_path, "t,q [rad],tau", *(f"{text},0,0" for text in texts))

    if unit == 1.0 or start == 1.7e9:
        assert stamps_of(opened(path)) == pytest.approx(times * 1e9, abs=1e3)
    else:
        name = {1e3: "ms", 1e6: "us", 1e9: "ns"}[unit]
        with pytest.raises(LogError, match=rf"'t \[{name}\]' or --units time={name}"):
            opened(path)
        stated = opened(path, units={"time": name})
        assert stamps_of(stated) == pytest.approx(times * 1e9, abs=1e3)


@pytest.fixture(scope="module")
def observer() -> Observer:
    return Observer("observer", ObserverSettings(), (DesignFile.of(ts.load_design()),))


def write_motion(
    folder: Path, header: str, factor: float, torque: Sequence[float], rate: float, noise: float
) -> Path:
    arm = ts.load_design()
    run = ts.simulate(
        arm, duration=(len(torque) - 1) / rate, rate=rate, seed=1, noise_std=noise, torque=torque
    )
    rows = zip(run.time.tolist(), run.angle.tolist(), run.torque.tolist(), strict=True)
    return log(folder, header, *(f"{t:.4f},{y * factor:.7f},{u:.6f}" for t, y, u in rows))


@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    amplitude=st.floats(0.0, 8.0),
    offset=st.sampled_from([0.0, 3.0, 14.0]),
    frequency=st.floats(0.01, 2.0),
    rate=st.sampled_from([20.0, 100.0, 200.0, 1000.0]),
    noise=st.floats(1e-4, 0.06),
)
def test_degrees_are_told_from_radians_by_the_arm(
    tmp_path, observer, amplitude, offset, frequency, rate, noise
) -> None:
    """Slow arms, those at rest and those that turn many times are taken as they are."""
    times = np.arange(int(min(8 * rate, 2000)) + 1) / rate
    torque = offset + amplitude * np.sin(2 * math.pi * frequency * times)

    def run(header: str, factor: float) -> None:
        path = write_motion(tmp_path, header, factor, torque, rate, noise)
        make_runs(opened(path), [observer], rate=None, as_live=False)

    run("time,angle,torque", 1.0)
    with pytest.raises(LogError, match=r"'angle \[deg\]' or --units angle=deg; if they are rad"):
        run("time,angle,torque", 1 / DEGREE)
    for header in ("time,angle [deg],torque", "time,angle [rad],torque"):
        run(header, 1 / DEGREE)


def test_a_log_may_have_any_name_but_no_report(tmp_path, arms, write_bag, capsys) -> None:
    path = log(tmp_path, "t,q [rad],tau", "1,2,3").rename(tmp_path / "arm.dat")
    (bag,) = write_bag(arms.messages(10)).glob("*.mcap")

    assert isinstance(open_source(path), LogSource)
    assert isinstance(open_source(bag.rename(tmp_path / "bag.csv")), BagSource)
    assert main(["report", str(path)]) == 1
    assert f"no estimates to report on; first write a bag of them: tsobs estimate {path}" in (
        capsys.readouterr().err
    )


def test_degrees_and_milliseconds_end_the_command_with_what_to_write(tmp_path, capsys) -> None:
    torque = np.sin(np.arange(1001) / 200)
    path = write_motion(tmp_path, "time,angle,torque", 1 / DEGREE, torque, 200.0, 0.02)

    for command in ("estimate", "compare"):
        assert main([command, str(path)]) == 1
        assert "--units angle=deg" in capsys.readouterr().err
    assert main(["estimate", str(path), "--units", "angle=deg"]) == 0
    assert "1,001 measurements; rejected: none" in capsys.readouterr().out
