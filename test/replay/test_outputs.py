# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of several outputs, of torque disturbances and of T–S systems."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tsobs_ros as ts
from tsobs_ros.api import Simulation
from tsobs_ros.bag import BagReader
from tsobs_ros.bag.joint_states import JointState, JointStateDecoder, JointStateEncoder
from tsobs_ros.cli.main import main
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.errors import BagReadError, LogError, ModelError
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.replay.estimate import Observer, Run, run_observers
from tsobs_ros.replay.log import LogSource
from tsobs_ros.replay.source import BagSource
from tsobs_ros.report.export import export_bag
from tsobs_ros.report.run import ESTIMATED

DATA = Path(__file__).parents[1]
BOTH = DATA / "estimation/data/both_encoders.design.yaml"
SYSTEM = DATA / "design/data/system.design.yaml"
START, PERIOD, LATENCY = 1_700_000_000_000_000_000, 5_000_000, 300_000
NAN = float("nan")
DECODE = JointStateDecoder()


@pytest.fixture(scope="module")
def arm() -> Simulation:
    """Two and a half seconds of an arm with two encoders that is touched at 1 s.

    The motor's encoder is silent from sample 100 to 150, the link's from 200 to 220.
    """
    run = ts.simulate(
        ts.load_design(BOTH), duration=2.5, seed=3,
        disturbance={"bias_step": {"amplitude": 0.05, "start": 0.0}},
        torque_disturbance={"link": {"bias_step": {"amplitude": 2.0, "start": 1.0}}},
    )  # fmt: skip
    run.angle[100:150, 1] = run.angle[200:220, 0] = NAN
    return run


@pytest.fixture(scope="module")
def system() -> Simulation:
    """Two seconds of a T–S system, without outputs for a while."""
    made = ts.simulate(ts.load_design(SYSTEM), duration=2.0)
    made.angle[60:80] = NAN
    return made


def stamps_of(run: Simulation) -> list[int]:
    return (START + np.round(run.time * 1e9).astype(np.int64)).tolist()


def messages_of_arm(run: Simulation) -> Iterator[tuple[str, bytes, int]]:
    """Yield measurements and truth; a silent encoder of the motor has no entry."""
    both, alone = JointStateEncoder(["elbow", "elbow_motor"]), JointStateEncoder(["elbow"])
    sides = JointStateEncoder(["elbow_link", "elbow_motor"])
    outputs = JointStateEncoder(["elbow/link_angle", "elbow/motor_angle"])
    for k, stamp in enumerate(stamps_of(run)):
        (link, motor), torque, time = run.angle[k].tolist(), float(run.torque[k]), stamp + LATENCY
        data = both(stamp, [link, motor], (), [NAN, torque])
        if np.isnan(motor):
            data = alone(stamp, [link], (), [torque])
        yield "/joint_measurements", data, time
        truth = run.state[k].tolist()
        yield "/ground_truth/joint_states", sides(stamp, truth[::2], truth[1::2]), time
        yield "/ground_truth/disturbance", outputs(stamp, run.disturbance[k].tolist()), time
        motor, link = run.torque_disturbance[k].tolist()
        yield "/ground_truth/torque_disturbance", sides(stamp, (), (), [link, motor]), time


def messages_of_systems(
    run: Simulation, joints: tuple[str, ...]
) -> Iterator[tuple[str, bytes, int]]:
    """Yield measurements of T–S systems, of several with their names before the signals'."""
    request = ts.load_design(SYSTEM).request
    names = [*request.output_names, *request.input_names]
    before = [f"{joint}/" for joint in joints] if len(joints) > 1 else [""]
    encode = JointStateEncoder([joint + name for joint in before for name in names])
    for stamp, y, u in zip(stamps_of(run), run.angle, run.torque, strict=True):
        values = [*y.tolist(), *u.tolist()] * len(joints)
        yield "/joint_measurements", encode(stamp, values), stamp + LATENCY


def estimate(
    source: Path | BagSource, design: Path, output: Path | None = None, **options: Any
) -> Run:
    """Estimate with a design over a recording, as `tsobs estimate` does."""
    source = BagSource(source) if isinstance(source, Path) else source
    file = load_design(design)
    source.take_for_system([file.request])
    observer = Observer("observer", ObserverSettings(), (file,) * len(source.joints))
    (run,) = run_observers(source, [observer], output, **options)
    return run


def by_topic(bag: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    for one in BagReader(bag).messages():
        found.setdefault(one.topic, []).append(one.data)
    # It has the path of the design, which comes from another bag.
    del found["/observer/design"]
    return found


def decoded(bag: Path) -> dict[str, list[JointState]]:
    return {
        topic: list(map(DECODE, messages))
        for topic, messages in by_topic(bag).items()
        if topic != "/observer/ticks"
    }


def test_estimates_with_two_encoders_are_those_of_arrays_and_repeated_to_the_bit(
    arm, write_bag, tmp_path
) -> None:
    bag = write_bag(messages_of_arm(arm))
    run = estimate(bag, BOTH, tmp_path / "live")

    expected = ts.estimate(ts.load_design(BOTH), arm.time, arm.angle, arm.torque)
    assert run.used == expected.used == len(arm.time)
    for name in ESTIMATED:
        np.testing.assert_array_equal(run.values(0, name), getattr(expected, name))
    np.testing.assert_array_equal(run.innovations[0], expected.innovation)
    assert run.outputs() == {
        "elbow": {
            "link_angle": {"gated": 0, "missing": 20},
            "motor_angle": {"gated": 0, "missing": 50},
        }
    }
    agreement = estimate(tmp_path / "live", BOTH, tmp_path / "again", window=128).agreement()
    assert agreement is not None
    assert agreement.reproduced == agreement.recorded == len(arm.time), agreement.text()
    assert by_topic(tmp_path / "again") == by_topic(tmp_path / "live")


def test_each_output_and_torque_has_its_entry(arm, write_bag, tmp_path) -> None:
    estimate(write_bag(messages_of_arm(arm)), BOTH, tmp_path / "new")

    topics = decoded(tmp_path / "new")
    link, motor = "elbow/link_angle", "elbow/motor_angle"
    assert topics["/observer/disturbance"][-1].names == (link, motor)
    assert topics["/observer/disturbance_bound"][-1].names == (link, motor)
    torque = topics["/observer/torque_disturbance"][-1]
    bound = topics["/observer/torque_disturbance_bound"][-1]
    assert torque.names == bound.names == ("elbow_link",)
    assert torque.position == torque.velocity == ()
    (value,), (std,) = torque.effort, bound.effort
    assert abs(value - 2.0) < 3.0 * std
    names = [one.names for one in topics["/observer/innovation"]]
    assert names[99] == names[150] == names[199] == (link, motor)
    assert set(names[100:150]) == {(link,)}
    assert set(names[200:220]) == {(motor,)}


@pytest.mark.parametrize("joints", [("system",), ("left", "right")])
def test_ts_systems_are_estimated_and_repeated_to_the_bit(
    system, write_bag, tmp_path, joints
) -> None:
    bag = write_bag(messages_of_systems(system, joints))
    source = BagSource(bag, joints=joints if len(joints) > 1 else ())
    run = estimate(source, SYSTEM, tmp_path / "live")

    design = ts.load_design(SYSTEM)
    expected = ts.estimate(design, system.time, system.angle, system.torque)
    assert run.used == expected.used * len(joints) == 181 * len(joints)
    for joint in range(len(joints)):
        np.testing.assert_array_equal(run.values(joint, "state"), expected.state)
    names = design.request.state_names
    if len(joints) > 1:
        names = tuple(f"{joint}/{name}" for joint in joints for name in names)
    topics = decoded(tmp_path / "live")
    assert topics["/observer/joint_states"][-1].names == names
    assert topics["/observer/joint_states"][-1].velocity == ()
    assert topics["/observer/restarts"][0].names == joints
    agreement = estimate(tmp_path / "live", SYSTEM).agreement()
    assert agreement is not None
    assert agreement.reproduced == agreement.recorded, agreement.text()
    assert agreement.recorded == len(system.time)


def test_an_output_that_messages_never_have_is_named(arm, write_bag) -> None:
    messages = [one for one in messages_of_arm(arm) if DECODE(one[1]).names == ("elbow",)]
    bag = write_bag(messages)

    with pytest.raises(BagReadError, match=r"motor_angle of elbow \(position of elbow_motor\)"):
        estimate(bag, BOTH)
    with pytest.raises(BagReadError, match=r"has y1 of system \(position of y1\).*it has: elbow"):
        estimate(bag, SYSTEM)
    link_only = Observer("link", ObserverSettings(), (ts.load_design(),))
    both = Observer("both", ObserverSettings(), (load_design(BOTH),))
    with pytest.raises(ModelError, match="designs that are run together must measure the same"):
        run_observers(BagSource(bag), [link_only, both])


def opened(path: Path, design: Design, **options: Any) -> LogSource:
    source = LogSource(path, **options)
    source.take_for_system([design.request])
    source.observe([design.request] * len(source.joints))
    return source


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("header", "options"),
    [
        ("time,link_angle,motor_angle,torque", {}),
        ("time,position.elbow,position.elbow_motor,effort.elbow", {}),
        ("a,b,c,d", {"time": "a", "link_angle": "b", "motor_angle": "c", "torque": "d"}),
        ("t,b,c,tau", {"link_angle.elbow": "b", "motor_angle.elbow": "c", "torque.elbow": "tau"}),
    ],
)
def test_columns_of_both_sides_are_found(tmp_path, header, options) -> None:
    rows = (["1", "0.25", "-2", "3"], ["1.005", "", "-1", "4"], ["1.01", "0.5", "", "5"])
    path = write(tmp_path / "log.csv", header, *map(",".join, rows))

    source = opened(path, ts.load_design(BOTH), columns=options)

    samples = source.samples
    np.testing.assert_array_equal(samples.y[:, 0], [[0.25, -2.0], [NAN, -1.0], [0.5, NAN]])
    assert samples.u[:, 0, 0].tolist() == [3.0, 4.0, 5.0]
    assert not samples.codes.any()


def test_a_log_of_two_encoders_is_estimated_as_the_bag_that_it_was_exported_from(
    arm, write_bag, tmp_path
) -> None:
    bag = write_bag(messages_of_arm(arm))
    (exported,) = export_bag(bag, tmp_path / "tables", topics=["/joint_measurements"])

    source = LogSource(exported.path)
    assert source.joints == ("elbow",)
    states = [estimate(one, BOTH).values(0, "state") for one in (bag, source)]
    np.testing.assert_array_equal(*states)


def test_the_columns_of_a_ts_system_have_the_names_of_its_signals(tmp_path) -> None:
    design = ts.load_design(SYSTEM)
    names = [*design.request.output_names, *design.request.input_names]
    row = ",".join(["1", *(f"{k}.5" for k in range(len(names)))])

    path = write(tmp_path / "log.csv", ",".join(["time", *names]), row)
    samples = opened(path, design).samples
    assert [*samples.y[0, 0], *samples.u[0, 0]] == [k + 0.5 for k in range(len(names))]
    path = write(tmp_path / "other.csv", ",".join(["time", *names[1:]]), row)
    with pytest.raises(LogError, match=f"no column is called {names[0]} of system"):
        opened(path, design)


@pytest.fixture
def live(arm, write_bag: Callable[..., Path], tmp_path: Path) -> Path:
    """A bag of estimates with two encoders."""
    estimate(write_bag(messages_of_arm(arm)), BOTH, tmp_path / "live")
    return tmp_path / "live"


def test_compare_has_the_design_s_outputs_and_names_what_does_not_apply(live, capsys) -> None:
    assert main(["compare", str(live)]) == 0

    text = capsys.readouterr().out
    assert "motor_angle: 50 missing" in text
    for line in ("innovation of link angle", "innovation of motor angle"):
        assert line in text
    for method in ("high_gain", "proportional_integral", "paper"):
        assert f"{method} is left out: " in text
    assert "reproduced to the last bit" in text


def test_a_report_has_each_output_and_torque(live, tmp_path, capsys) -> None:
    assert main(["report", str(live), "--output", str(tmp_path), "--json"]) == 0

    report = json.loads(capsys.readouterr().out)
    states = ["link_angle", "link_velocity", "motor_angle", "motor_velocity"]
    assert list(report["quantities"]) == [
        *states,
        "disturbance_link_angle",
        "torque_disturbance_link",
    ]
    assert report["ekf"]["method"] == "ekf"
    assert (tmp_path / "report.png").stat().st_size > 50_000
    page = (tmp_path / "report.html").read_text()
    for label in ("torque disturbance at", "innovation of motor"):
        assert label in page


def test_a_report_and_tables_of_a_ts_system_have_its_names(
    system, write_bag, tmp_path, capsys
) -> None:
    estimate(write_bag(messages_of_systems(system, ("system",))), SYSTEM, tmp_path / "live")

    command = ["report", str(tmp_path / "live"), "--no-ekf", "--output", str(tmp_path), "--json"]
    assert main(command) == 0

    report = json.loads(capsys.readouterr().out)
    request = ts.load_design(SYSTEM).request
    names = request.output_names[0], request.state_names[0]
    topics = ["/joint_measurements", "/observer/joint_states"]
    for name, one in zip(
        names, export_bag(tmp_path / "live", tmp_path, topics=topics), strict=True
    ):
        # The design gives no units, and the numbers are no angles.
        assert f",position.{name}," in one.path.read_text().partition("\n")[0]
    assert report["joint"] == "system"
    assert list(report["quantities"])[: len(request.state_names)] == list(request.state_names)
    assert report["estimates"] == len(system.time)
