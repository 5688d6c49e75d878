# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates, comparisons and reports of a bag use what its observer ran, or refuse."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import tsobs_ros as ts
from tsobs_ros.bag import BagReader
from tsobs_ros.bag.cdr import encode_text
from tsobs_ros.bag.joint_states import JointStateEncoder
from tsobs_ros.cli.main import main
from tsobs_ros.design.file import checksum, identity, load_design, record_text, save_design
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, Output
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.errors import BagReadError
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.replay.source import BagSource
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path
from tsobs_ros.settings import values_of

SHIPPED, FIXED = (str(config_path(name)) for name in (SHIPPED_DESIGN, FIXED_DESIGN))
START = 1_700_000_000_000_000_000


@pytest.fixture(scope="session")
def soft(design: Design, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A design file for a softer and heavier arm with a noisier sensor."""
    arm = ElasticJointArm(stiffness=4.0, link_inertia=2.0, gravity_torque=6.0)
    request = replace(design.arm_request, arm=arm, measurement_std=0.05)
    path = tmp_path_factory.mktemp("designs") / "soft.design.yaml"
    save_design(synthesise(request), path)
    return str(path)


@pytest.fixture
def live(arms: Any, write_bag: Callable[..., Path], soft: str, capsys: Any) -> str:
    """A bag of two joints, of which an observer has observed each with a design of its own."""
    bag = write_bag(arms.messages(200, joints=2))
    assert estimate(bag, "--design", f"elbow={soft}", f"wrist={FIXED}", "--rate", "90",
                    "--param", "settle_time=0.5,supervision.gate=4") == 0  # fmt: skip
    capsys.readouterr()
    return f"{bag}_estimates"


def estimate(bag: object, *options: str) -> int:
    return main(["estimate", str(bag), *options])


def record(*designs: str, joints: tuple[str, ...] = ("elbow",), **parameters: Any) -> bytes:
    files = [load_design(each) for each in designs]
    known = values_of(ObserverSettings()) | parameters
    return encode_text(record_text("/joint_measurements", joints, files, known))


def test_each_joint_is_estimated_as_live_with_its_own_design_and_parameters(
    live: str, capsys: Any
) -> None:
    assert estimate(live, "--output", f"{live}_again", "--json") == 0

    result = json.loads(capsys.readouterr().out)["live"]
    assert result["reproduced"] == result["recorded"] > 80
    (message,) = BagReader(f"{live}_again").messages(["/observer/design"])
    (before,) = BagReader(live).messages(["/observer/design"])
    assert message.data == before.data
    assert ts.estimate_bag(live).reproduced == 1.0


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("estimate", ["--design", SHIPPED]),
        ("compare", ["--design", f"wrist={SHIPPED}"]),
        ("report", ["--design", SHIPPED, "--joint", "wrist"]),
    ],
)
def test_another_design_is_refused_with_both_names(
    live: str, command: str, options: list[str], tmp_path: Path, capsys: Any
) -> None:
    assert main([command, live, *options, "--output", str(tmp_path / "output")]) == 1

    (line,) = capsys.readouterr().err.splitlines()
    for file in (SHIPPED, FIXED) if command != "estimate" else (SHIPPED,):
        assert f"{file} (SHA-256 {identity(load_design(file))})" in line
    assert "add --other-design" in line


def test_another_design_is_used_if_it_is_meant(live: str, tmp_path: Path, capsys: Any) -> None:
    options = ["--design", SHIPPED, "--other-design", "--output", str(tmp_path / "output")]

    assert estimate(live, "--design", f"knee={SHIPPED}") == 1
    assert "no such joint; joints: elbow, wrist" in capsys.readouterr().err
    assert estimate(live, "--design", f"elbow={FIXED}", SHIPPED, FIXED) == 1
    assert "expected one file for the joints without their own" in capsys.readouterr().err
    assert estimate(live, *options) == 0
    assert f"design {SHIPPED} ({identity(load_design(SHIPPED))})" in capsys.readouterr().out


def test_a_report_is_of_one_joint_and_names_those_there_are(
    live: str, tmp_path: Path, capsys: Any
) -> None:
    command = ["report", live, "--no-ekf", "--output", str(tmp_path / "report")]

    for options, error in (
        ((), "several joints, choose one of elbow, wrist"),
        (("--joint", "knee"), "ran no design for knee, but for elbow, wrist"),
    ):
        assert main([*command, *options]) == 1
        assert error in capsys.readouterr().err
    assert main([*command, "--joint", "wrist"]) == 0
    assert "the run is too short" in capsys.readouterr().out
    report = json.loads((tmp_path / "report" / "report.json").read_text(encoding="utf-8"))
    known = load_design(FIXED)
    assert (report["joint"], report["windows"]) == ("wrist", [])
    assert report["design"] == {"file": known.file, "sha256": checksum(known)}


def test_a_live_run_of_unknown_design_is_estimated_with_a_warning(
    live: str, write_bag: Callable[..., Path], capsys: Any
) -> None:
    messages = [
        (one.topic, one.data, one.log_time)
        for one in BagReader(live).messages()
        if one.topic != "/observer/design"
    ]

    assert estimate(write_bag(messages, "old")) == 0
    assert "warning: the bag does not show which design its observer ran" in capsys.readouterr().out


def test_an_observer_that_ran_two_designs_leaves_the_choice_to_the_user(
    arms: Any, write_bag: Callable[..., Path], soft: str, capsys: Any
) -> None:
    designs = [
        ("/observer/design", record(file), START + k) for k, file in enumerate((FIXED, soft))
    ]
    bag = write_bag([*designs, *arms.messages(50)])

    assert estimate(bag) == 1
    assert f"{FIXED} (SHA-256" in (line := capsys.readouterr().err)
    assert f"and then {soft} (SHA-256" in line
    assert estimate(bag, "--design", soft, "--other-design") == 0


def test_changes_of_parameters_are_named(
    arms: Any, write_bag: Callable[..., Path], capsys: Any
) -> None:
    both = record(FIXED), record(FIXED, **{"supervision.gate": 3.0})
    designs = [("/observer/design", data, START + k) for k, data in enumerate((*both, *both))]

    assert estimate(write_bag([*designs, *arms.messages(50)])) == 0
    assert "were changed while it ran: supervision.gate; the first" in capsys.readouterr().out


@pytest.mark.parametrize("observer", ["/arm/observer", "/arm/mine"])
def test_measurements_of_any_topic_are_found_by_the_record(
    observer: str, arms: Any, write_bag: Callable[..., Path], capsys: Any
) -> None:
    """Of a robot's /joint_states, with more joints than are observed, beside another's."""
    file = load_design(FIXED)
    text = record_text("/joint_states", ["wrist"], [file], values_of(ObserverSettings()))
    moved = [("/joint_states", data, time) for _, data, time in arms.messages(50, joints=2)]
    others = [(f"/other{topic}", data, time) for topic, data, time in arms.messages(20)]
    bag = write_bag([(f"{observer}/design", encode_text(text), START), *moved, *others])

    assert estimate(bag) == 0
    shown = capsys.readouterr().out
    assert "50 measurements of wrist over" in shown
    assert FIXED in shown
    assert "/arm/observer/joint_states" in BagReader(f"{bag}_estimates").topics


def test_of_two_observers_of_a_topic_one_is_named(
    arms: Any, write_bag: Callable[..., Path], soft: str, capsys: Any
) -> None:
    files = {"/mine": soft, "/observer": FIXED}
    designs = [(f"{name}/design", record(file), START) for name, file in files.items()]

    assert estimate(write_bag([*designs, *arms.messages(20)])) == 0
    shown = capsys.readouterr().out
    assert "of /joint_measurements, /observer is meant, not /mine" in shown
    assert FIXED in shown


@pytest.mark.parametrize("joint", ["wrist", "left/wrist"])
@pytest.mark.parametrize("is_observed", [True, False])
def test_a_joint_that_begins_late_is_estimated(
    joint: str, is_observed: bool, arms: Any, write_bag: Callable[..., Path]
) -> None:
    late = JointStateEncoder([joint])(START + 10**10, [0.0], (), [0.0])
    data = record(*3 * [FIXED], joints=("elbow", joint, "absent"))
    bag = write_bag(
        [
            *([("/observer/design", data, START)] if is_observed else []),
            *[message for _ in range(4) for message in arms.messages(300)],
            ("/joint_measurements", late, START + 10**10),
        ]
    )
    assert BagSource(bag).joints == ("elbow", joint)


def changed(data: str, **entries: Any) -> bytes:
    return encode_text(json.dumps(json.loads(data) | entries))


def hostile(file: str) -> dict[str, tuple[bytes, str]]:
    """Return messages that are no records, each with what is said of it."""
    known = load_design(file)
    good = record_text("/joint_measurements", ["elbow"], [known], {})
    nested = "[" * 100_000

    def of_text(text: str, name: str = "my.yaml") -> bytes:
        return changed(good, designs=[{"joints": ["elbow"], "file": name, "text": text}])

    tampered = known.source.replace("stiffness: 10.0", "stiffness: 7.0")
    return {
        "no cdr": (b"\x00", "CDR"),
        "deep": (encode_text(nested), "no record of an observer"),
        "large": (encode_text(good + " " * 2**20), "larger than 1048576 bytes"),
        "version": (changed(good, version=2), "of version 1, got"),
        "aliases": (of_text("a: &a [1]\nb: *a"), "aliases are not supported"),
        "no certificate": (of_text(tampered), "DOES NOT HOLD"),
        "escapes": (of_text("a: 1", "\x1b[2J.yaml"), "\\x1b[2J.yaml: format: missing"),
        "endless": (
            changed(good, parameters={"theta": 1e12}),
            "'theta': expected a finite number of at least 0.1",
        ),
    }


@pytest.mark.parametrize("name", hostile(FIXED))
def test_what_anybody_wrote_into_a_record_is_refused_in_one_line(
    arms: Any, write_bag: Callable[..., Path], capsys: Any, name: str
) -> None:
    data, why = hostile(FIXED)[name]
    bag = write_bag([("/observer/design", data, START), *arms.messages(10)])

    assert estimate(bag) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert "/observer/design: " in line
    assert why in line
    assert line.isprintable()
    assert len(line) < 1000


def test_a_motor_has_its_own_entry_whichever_side_the_design_measures(write_bag) -> None:
    encode = JointStateEncoder(("elbow", "elbow_motor"))
    bag = write_bag([("/joint_measurements", encode(START, [2.0, 3.0], (), [4.0, 5.0]), START)])
    for side, angle in (("link", 2.0), ("motor", 3.0)):
        source = BagSource(bag)
        assert source.joints == ("elbow",)
        source.observe([ArmRequest(outputs=(Output(f"{side}_angle", 0.001),))])
        assert (source.samples.y.item(), source.samples.u.item()) == (angle, 4.0)


def test_each_joint_has_a_motor_of_its_own_or_none(write_bag) -> None:
    encode = JointStateEncoder(("elbow", "elbow_motor", "wrist"))
    data = encode(START, [2.0, 3.0, 6.0], (), [4.0, 5.0, 7.0])
    source = BagSource(write_bag([("/joint_measurements", data, START)]))
    source.observe([ArmRequest(outputs=(Output("motor_angle", 0.001),))] * 2)
    assert source.joints == ("elbow", "wrist")
    assert source.samples.y.ravel().tolist() == [3.0, 6.0]


def test_a_bag_that_names_no_joint_is_refused(design: Design, write_bag, capsys) -> None:
    bag = write_bag([("/joint_measurements", JointStateEncoder(())(START, (), (), ()), START)])
    assert estimate(bag) == 1
    assert "no message of /joint_measurements names a joint" in capsys.readouterr().err
    with pytest.raises(BagReadError, match="names a joint"):
        ts.estimate_bag(bag, design)
    bag = write_bag([("/joint_measurements", b"", START)], "rubbish")
    with pytest.raises(BagReadError, match=r"/joint_measurements: 0 bytes, .* not plain little"):
        BagSource(bag)


def test_only_the_joints_that_designs_name_are_estimated(arms, write_bag, capsys) -> None:
    bag = write_bag(arms.messages(20, joints=2))
    assert estimate(bag, "--design", f"wrist={FIXED}", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["joints"] == ["wrist"]
    assert "note: --design is for wrist, so no other joint is estimated" in found["remarks"]
