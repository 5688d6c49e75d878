# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Definition texts follow rosbag2's rule to the byte, and mean what other tools think they mean."""

import sys
from pathlib import Path

import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tsobs_ros.bag.definitions import find_definition, share_folders
from tsobs_ros.errors import BagWriteError

SEPARATOR = "=" * 80
TYPES = ["sensor_msgs/msg/JointState", "visualization_msgs/msg/InteractiveMarkerUpdate"]


def installed_text(name: str) -> str:
    package, _, type_ = name.partition("/")
    paths = (folder / package / "msg" / f"{type_}.msg" for folder in share_folders())
    return next(path.read_bytes().decode() for path in paths if path.is_file())


def write_package(share: Path, package: str, **messages: str) -> None:
    folder = share / package / "msg"
    folder.mkdir(parents=True)
    for name, text in messages.items():
        (folder / f"{name}.msg").write_bytes(text.encode())


def test_dependencies_follow_depth_first_in_bytewise_order() -> None:
    root, *others = (
        "diagnostic_msgs/DiagnosticArray", "diagnostic_msgs/DiagnosticStatus",
        "diagnostic_msgs/KeyValue", "std_msgs/Header", "builtin_interfaces/Time",
    )  # fmt: skip
    parts = [f"\n{SEPARATOR}\nMSG: {other}\n{installed_text(other)}" for other in others]
    definition = find_definition(root)
    assert definition == find_definition(root.replace("/", "/msg/"))
    assert definition.text == "".join([installed_text(root), *parts])


@pytest.mark.parametrize("msgtype", TYPES)
def test_a_definition_means_the_same_to_rosbags_and_mcap(msgtype: str) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    definition = find_definition(msgtype)
    parsed = get_types_from_msg(definition.text, msgtype)
    assert msgtype in parsed
    assert {name: fields for name, (_, fields) in parsed.items()} == {
        name: store.fielddefs[name][1] for name in parsed
    }
    assert definition.type_hash == store.hash_rihs01(msgtype)
    schema = Schema(id=1, name=msgtype, encoding="ros2msg", data=definition.text.encode())
    assert DecoderFactory().decoder_for("cdr", schema) is not None


@pytest.mark.parametrize("name", ["SetBool_Event", "SetBool_Response"])
def test_messages_of_a_service_have_its_file_and_their_hash(name: str) -> None:
    definition = find_definition(f"std_srvs/srv/{name}")
    assert definition.text.startswith("bool data # e.g. for hardware enabling")
    assert definition.type_hash.startswith("RIHS01_")


def test_messages_of_an_action_have_its_file_with_its_dependencies(tmp_path: Path) -> None:
    text = "Place to\n---\nfloat64 took\n---\nfloat64 left # m\n"
    (tmp_path / "a_msgs" / "action").mkdir(parents=True)
    (tmp_path / "a_msgs" / "action" / "Go.action").write_text(text)
    write_package(tmp_path, "a_msgs", Place="string name\n")
    for name in ("Go_FeedbackMessage", "Go_SendGoal_Event", "Go_GetResult_Response"):
        definition = find_definition(f"a_msgs/action/{name}", [tmp_path])
        assert definition.text == f"{text}\n{SEPARATOR}\nMSG: a_msgs/Place\nstring name\n"


def test_without_a_msg_file_the_definition_is_in_idl(tmp_path: Path) -> None:
    # As rosbag2 does it, which does not know the type wstring either.
    root = '#include "b_msgs/msg/Part.idl"\n\nmodule a_msgs { wstring wide; };\n'
    write_package(tmp_path, "a_msgs", Root="wstring wide\nb_msgs/Part part\n")
    (tmp_path / "a_msgs" / "msg" / "Root.idl").write_text(root)
    write_package(tmp_path, "b_msgs", Part="int8 x\n")
    (tmp_path / "b_msgs" / "msg" / "Part.idl").write_text("module b_msgs {};\n")
    assert find_definition("a_msgs/msg/Root", [tmp_path]) == (
        "a_msgs/msg/Root",
        f"{SEPARATOR}\nIDL: a_msgs/msg/Root\n{root}"
        f"\n{SEPARATOR}\nIDL: b_msgs/msg/Part\nmodule b_msgs {{}};\n",
        "",
        "ros2idl",
    )


def test_sourced_prefixes_come_before_the_interpreters(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'over'}:{tmp_path / 'under'}")
    assert share_folders() == (
        tmp_path / "over" / "share",
        tmp_path / "under" / "share",
        Path(sys.prefix) / "share",
    )
    write_package(tmp_path / "under" / "share", "std_msgs", String="string data # mine\n")
    assert find_definition("std_msgs/msg/String").text == "string data # mine\n"
    monkeypatch.delenv("AMENT_PREFIX_PATH")
    assert share_folders() == (Path(sys.prefix) / "share",)


def test_an_uninstalled_type_or_part_is_named(tmp_path: Path) -> None:
    folders = [tmp_path / "one", tmp_path / "two"]
    with pytest.raises(BagWriteError, match=r"no_msgs/msg/None is not installed.*one, .*two"):
        find_definition("no_msgs/msg/None", folders)
    write_package(tmp_path, "my_msgs", Root="other_msgs/Gone gone\n")
    for name, reason in (
        ("Trigger", "is not a message type"),
        ("my_msgs/msg/Root", "other_msgs/msg/Gone is not installed"),
    ):
        with pytest.raises(BagWriteError, match=reason):
            find_definition(name, [tmp_path])
