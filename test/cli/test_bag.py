# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`tsobs bag`: info, verify and recover, for people and for programs."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import Writer

from tsobs_ros.bag import BagReader, BagWriter, QosProfile
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.cli.main import main

STRING = "std_msgs/msg/String"
HELLO = b"\0\1\0\0\6\0\0\0hello\0"
NOON = 1_795_262_400_000_000_000
Captured = pytest.CaptureFixture[str]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    with BagWriter(tmp_path / "run", custom_data={"why": "a test"}) as writer:
        writer.add_topic("/a", STRING, [QosProfile(), QosProfile()])
        writer.add_topic("/b", STRING, [QosProfile(durability="transient_local")])
        for number in range(101):
            writer.write("/a", HELLO, NOON + number * 10_000_000, 0)
            if number % 10 == 0:
                writer.flush()
        writer.write("/a", HELLO, NOON + 1_500_000_000, 0)
        writer.write("/b", HELLO, NOON - 500_000_000, 0)
    return tmp_path / "run"


@pytest.fixture
def killed(bag: Path) -> Path:
    """The same, cut off inside of its last chunk, and without metadata."""
    path = bag / "run_0.mcap"
    last = BagReader(path).summaries[0].spans[-1]
    path.write_bytes(path.read_bytes()[: last.offset + last.size - 20])
    (bag / "metadata.yaml").unlink()
    return bag


def test_info_tells_what_a_bag_is_about(bag: Path, capsys: Captured) -> None:
    assert main(["bag", "info", str(bag)]) == 0
    out = capsys.readouterr().out
    assert "NOT FINISHED" not in out
    assert "run_0.mcap (" in out
    assert "Duration:     2.000000000 s" in out
    assert "Start:        2026-11-21 11:59:59.500000000 UTC (1795262399.500000000)" in out
    assert "Messages:     103" in out
    assert "Custom data:  why: a test" in out
    assert f"/a | {STRING} | 102 messages | cdr | 2 x reliable, volatile | 67.33 Hz\n" in out
    assert f"/b | {STRING} | 1 messages | cdr | reliable, transient_local\n" in out

    assert main(["bag", "info", str(bag / "run_0.mcap"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["messages"], summary["problem"]) == (103, "")
    assert summary["end_ns"] - summary["start_ns"] == summary["duration_ns"] == 2_000_000_000
    first, second = summary["topics"]
    assert (first["name"], first["messages"], first["rate"]) == ("/a", 102, 101 / 1.5)
    assert (second["messages"], second["rate"]) == (1, None)
    assert second["qos"][0]["durability"] == "transient_local"


def test_verify_gives_all_reasons(killed: Path, capsys: Captured) -> None:
    assert main(["bag", "verify", str(killed)]) == 1
    out = capsys.readouterr().out
    assert "not a bag folder, it has no metadata.yaml\n" in out
    assert "error: run_0.mcap: the file has no end" in out
    assert out.endswith("NOT sound, errors: 2; files: 1, messages: 0\n")
    assert main(["bag", "verify", str(killed), "--json"]) == 1
    errors = json.loads(capsys.readouterr().out)["errors"]
    assert [error.partition(": ")[0] for error in errors] == ["metadata.yaml", "run_0.mcap"]


def test_recover_makes_a_bag_beside_the_damaged_one(killed: Path, capsys: Captured) -> None:
    assert main(["bag", "recover", str(killed)]) == 0
    new = killed.with_name("run_recovered")
    assert BagReader(new).message_count == 101
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"101 messages in {new}: ")
    assert main(["bag", "verify", str(new)]) == 0
    assert main(["bag", "recover", str(killed)]) == 1
    assert "run_recovered: exists already" in capsys.readouterr().err
    path, new = killed / "run_0.mcap", killed.with_name("new")
    options = ["--output", str(new), "--compression", "none", "--json"]
    assert main(["bag", "recover", str(path), *options]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["source"], report["output"]) == (str(path), str(new))
    assert report["files"][0]["kept"]["/a"] == 101
    assert not report["files"][0]["finished"]


@pytest.fixture
def hostile_bag(tmp_path: Path, hostile: str) -> Path:
    """A file whose topics, types, definitions, hashes, joints and notes are hostile names."""
    path = tmp_path / f"{hostile.replace(chr(0), '')}.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library=hostile)
        metadata = {"offered_qos_profiles": "", "topic_type_hash": hostile}
        schema = writer.register_schema(f"p/msg/{hostile}", "ros2msg", f"string {hostile}".encode())
        channel = writer.register_channel(f"/{hostile}", "cdr", schema, metadata)
        writer.add_message(channel, 1, HELLO, 1)
        schema = writer.register_schema(JOINT_STATE, "ros2msg", b"")
        channel = writer.register_channel("/joint_measurements", "cdr", schema, {})
        encode = JointStateEncoder([hostile])
        for stamp in range(10**9, 2 * 10**9, 5_000_000):
            writer.add_message(channel, stamp, encode(stamp, [0.1], (), [0.0]), stamp)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("command", "exit_code"),
    [
        ("bag info", 0),
        ("bag verify", 1),
        ("bag recover --output OUT", 0),
        ("export --output OUT", 1),
        ("estimate --output OUT", 0),
        ("compare --method certified ekf", 0),
        ("report --output OUT", 1),
    ],
)
def test_names_in_a_bag_do_not_command_the_terminal(
    hostile_bag: Path, check_shown: Callable[[str], None], capfd, command: str, exit_code: int
) -> None:
    words = command.split()
    place = 2 if words[0] == "bag" else 1
    output = str(hostile_bag.parent / "out")
    arguments = [output if word == "OUT" else word for word in words]

    assert main([*arguments[:place], str(hostile_bag), *arguments[place:]]) == exit_code

    told = capfd.readouterr()
    check_shown(told.out + told.err)
    assert r"\x1b[2J" in told.out + told.err or r"\u001b[2J" in told.out
    assert len(told.err.splitlines()) <= 1
