# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates against a sensor that no observer gets, in logs and bags of a known truth."""

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.cli.main import main
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import Output

STD = 0.003
START = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def motor_design() -> Design:
    """An arm with an encoder on its motor."""
    return ts.synthesise(ts.ArmRequest(outputs=[Output("motor_angle", 0.005)], uncertainty={}))


@pytest.fixture(scope="module")
def run(motor_design: Design) -> Any:
    """Twenty-five seconds of it."""
    return ts.simulate(motor_design, duration=25.0, seed=1)


@pytest.fixture
def design_file(motor_design: Design, tmp_path: Path) -> str:
    """The design as a file."""
    ts.save_design(motor_design, tmp_path / "motor.design.yaml")
    return str(tmp_path / "motor.design.yaml")


def link_sensor(run: Any, std: float = STD) -> np.ndarray:
    """Return what the sensor at the link measures."""
    return run.state[:, 0] + std * np.random.default_rng(5).standard_normal(len(run.time))


def write_log(path: Path, run: Any, link: np.ndarray, title: str = "link_angle") -> str:
    columns = np.column_stack([run.time, run.angle, link, run.torque])
    head = f"time [s],motor_angle,{title},torque"
    np.savetxt(path, columns, "%.8f", delimiter=",", header=head, comments="")
    return str(path)


def true_error(design: Design, run: Any) -> float:
    """Return the RMS error of the link angle once settled."""
    estimates = ts.estimate(design, run.time, run.angle, run.torque)
    error = (estimates.state - run.state)[run.time > 5.0, 0]
    return float(np.sqrt(np.mean(error**2)))


@pytest.mark.parametrize("title", ["link_angle", "angle", "q_link [deg]"])
def test_errors_in_a_log_are_those_against_the_truth_and_the_noise(
    motor_design, run, design_file, tmp_path, capsys, title
) -> None:
    link = link_sensor(run)
    link[2000::500] += 0.05  # outliers of the sensor
    link = np.degrees(link) if "deg" in title else link
    log = write_log(tmp_path / "log.csv", run, link, title)
    option = "link_angle=q_link" if "deg" in title else "link_angle"
    command = ["compare", log, "--design", design_file, "--method", "certified", "ekf"]

    assert main([*command, "--held-out", option, "--json"]) == 0

    rows = json.loads(capsys.readouterr().out)["errors"]
    assert [row["observer"] for row in rows] == ["certified", "ekf"]
    for found in (row["held_out"] for row in rows):
        assert found["sensor"] == {
            "quantity": "link_angle", "unit": "rad", "source": f"column {title!r}",
            "std": pytest.approx(STD, rel=0.05), "std_is_estimated": True,
        }  # fmt: skip
        assert found["samples"] == pytest.approx(4000, abs=5)
        assert found["with_bias"]["inside"] > 0.98
        assert found["largest"] >= found["with_bias"]["rmse"] > found["without_bias"]["rmse"]
        assert abs(found["bias"]) < 0.001
    (certified, _) = rows
    expected = np.hypot(true_error(motor_design, run), STD)
    assert certified["held_out"]["median"] == pytest.approx(0.6745 * expected, rel=0.05)
    assert certified["held_out"]["claimed"] == 1.0


def test_encoders_with_different_zeros_have_a_bias(run, design_file, tmp_path, capsys) -> None:
    log = write_log(tmp_path / "log.csv", run, link_sensor(run) + 0.2)
    command = ["compare", log, "--design", design_file, "--method", "certified"]

    assert main([*command, "--held-out", "link_angle", "--held-out-std", "0.003"]) == 0

    out = capsys.readouterr().out
    lines = [line.split("  ") for line in out.splitlines()]
    cells = {each[0] or each[1]: each[-1].strip() for each in lines if len(each) > 1}
    assert float(cells["bias"]) == pytest.approx(-0.2, abs=0.002)
    assert float(cells["without bias"]) < 0.005
    assert (cells["inside 3σ"], cells["without bias, inside 3σ"]) == ("0.0 %", "100.0 %")
    assert "noise of 0.003 rad (as given)" in out


@pytest.fixture
def both_encoders(run, write_bag) -> str:
    """A bag with both encoders in one message but for 2 s, and the link's on a topic of its own."""
    stamps = START + np.round(run.time * 1e9).astype(np.int64)
    each = zip(
        stamps.tolist(), link_sensor(run).tolist(), run.angle.tolist(), run.torque, strict=True
    )
    there = (run.time < 10.0) | (run.time >= 12.0)
    both = [
        (stamp, ["elbow", "elbow_motor"], [q, y], [], [float(u)] * 2)
        for stamp, q, y, u in itertools.compress(each, there)
    ]
    # Half way between the measurements, and from another clock's grid.
    later = stamps[:-1:2] + 2_500_000
    noise = STD * np.random.default_rng(6).normal(size=len(later))
    own = np.interp(later, stamps, run.state[:, 0]) + noise
    alone = [(stamp, ["link"], [float(q)]) for stamp, q in zip(later.tolist(), own, strict=True)]
    return str(write_bag({"/joint_measurements": both, "/link_encoder": alone}))


@pytest.mark.parametrize(
    ("option", "joints", "samples"),
    [("link_angle", [], 3600), ("link_angle=/link_encoder:link", ["elbow_motor"], 1800)],
)
def test_a_bag_has_the_sensor_in_its_measurements_or_on_a_topic(
    motor_design, run, both_encoders, design_file, option, joints, samples
) -> None:
    """Nothing is interpolated across the gap."""
    (found,) = ts.compare(
        both_encoders, design_file, methods=["certified"], joints=joints, held_out=option
    )

    assert found.held_out is not None
    assert found.metrics is not None
    assert found.metrics.nis == pytest.approx(1.0, abs=0.3)  # the observer got the motor's encoder
    expected = np.hypot(true_error(motor_design, run), STD)
    assert found.held_out.with_bias.rmse == pytest.approx(expected, rel=0.15)
    assert found.held_out.sensor.std == pytest.approx(STD, rel=0.08)
    assert found.held_out.samples == pytest.approx(samples, abs=5)


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("link_velocity", "no column is called link_velocity; name it: --held-out link_velocity=…"),
        ("link_angle=knee", "no column is called 'knee'"),
        ("link_angle=motor_angle", "column 'motor_angle' is used by the observer"),
        ("motor_angle", "held out: motor_angle is what the observer measures"),
        ("knee", "held out: expected one of link_angle, link_velocity, motor_angle, motor_veloc"),
        ("link_angle=empty", "expected at least 20 readings in column 'empty', got 0"),
        ("link_angle=early", "between settled estimates, got 0"),
    ],
)
def test_a_sensor_that_cannot_be_compared_is_refused_in_one_line(
    run, design_file, tmp_path, capsys, option, said
) -> None:
    log = tmp_path / "log.csv"
    lines = ["time [s],motor_angle,link_angle,torque,empty,early"]
    for k, (t, y, u, q) in enumerate(
        zip(run.time, run.angle, run.torque, run.state[:, 0], strict=True)
    ):
        early = f"{q}" if k < 500 else ""
        lines.append(f"{t:.4f},{y:.8f},{q:.8f},{u:.8f},,{early}")
    log.write_text("\n".join(lines), encoding="utf-8")
    command = ["compare", str(log), "--design", design_file, "--method", "certified"]

    assert main([*command, "--held-out", option]) == 1

    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert said in line


def test_a_bag_without_the_sensor_is_refused_in_one_line(
    short, write_bag, messages_of, capsys
) -> None:
    bag = str(write_bag(messages_of(short)))
    for option, said in (
        ("motor_angle", "in position of elastic_joint_motor on /joint_measurements, got 0"),
        ("motor_angle=/nowhere", "no topic /nowhere; topics: "),
        ("motor_angle=:elastic_joint", "is what the observer measures"),
    ):
        assert main(["compare", bag, "--method", "certified", "--held-out", option]) == 1
        assert said in capsys.readouterr().err
    assert main(["compare", "--held-out", "motor_angle"]) == 1
    assert "--held-out: is for a recording" in capsys.readouterr().err
    assert main(["compare", bag, "--held-out-std", "0.1"]) == 1
    assert "--held-out-std: is for --held-out" in capsys.readouterr().err


def test_joints_have_sensors_of_their_own(run, design_file, tmp_path) -> None:
    titles = [
        "time",
        *(f"{name}.{j}" for j in "ab" for name in ("motor_angle", "link_angle", "torque")),
    ]
    links = link_sensor(run), run.state[:, 0] + 0.1
    columns = [each for link in links for each in (run.angle, link, run.torque)]
    log = tmp_path / "log.csv"
    rows = np.column_stack([run.time, *columns])
    np.savetxt(log, rows, fmt="%.8f", delimiter=",", header=",".join(titles), comments="")

    of_a, of_b = ts.compare(log, design_file, methods=["certified"], held_out="link_angle")

    assert (of_a.joint, of_b.joint) == ("a", "b")
    assert abs(of_a.held_out.bias) < 0.001
    assert of_b.held_out.bias == pytest.approx(-0.1, abs=0.001)
    assert of_b.held_out.sensor.std < 1e-6 < of_a.held_out.sensor.std
    with pytest.raises(ts.TsobsError, match=r"link_angle\.a is of one joint"):
        ts.compare(log, design_file, methods=["certified"], held_out="link_angle=link_angle.a")
