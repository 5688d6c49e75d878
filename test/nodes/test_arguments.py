# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The executables' command lines: help that is complete, and no argument that is passed over."""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter

from tsobs_ros.bag import BagWriter
from tsobs_ros.nodes.arguments import check_arguments
from tsobs_ros.resources import config_path

PARAMETERS = str(config_path("observer.yaml"))
NODES = ("observer", "plant_simulator", "recorder", "player", "visualizer")
OF_ROS = ("/rosout", "/parameter_events", "/transition_event")


def check(name: str, *arguments: str) -> None:
    check_arguments(import_module(f"tsobs_ros.nodes.{name}"), [name, *arguments])


def help_of(name: str, capsys: Any) -> str:
    with pytest.raises(SystemExit) as ended:
        check(name, "--help")
    assert ended.value.code == 0
    out, err = capsys.readouterr()
    assert not err
    return str(out)


@pytest.mark.parametrize("name", NODES)
def test_the_help_has_every_topic_service_and_parameter(
    name: str, ros: Any, tmp_path: Path, both_design: Path, capsys: Any
) -> None:
    text = help_of(name, capsys)
    BagWriter(tmp_path / "bag").close()
    parameters = {
        "observer": {"design": str(both_design)},
        "plant_simulator": {"publish_clock": True},
        "recorder": {
            "output": str(tmp_path / "new"),
            "topics": ["/nothing"],
            "snapshot_mode": True,
        },
        "player": {"bag": str(tmp_path / "bag"), "clock": 1.0},
    }
    module = import_module(f"tsobs_ros.nodes.{name}")
    overrides = [Parameter(key, value=value) for key, value in parameters.get(name, {}).items()]
    node = ros.add(module.create(context=ros.context, parameter_overrides=overrides))

    def resolved(entities: Any) -> set[str]:
        return {each.topic_name for each in entities if not each.topic_name.endswith(OF_ROS)}

    told = {
        direction: {
            node.resolve_topic_name(topic)
            for topic in re.findall(rf"^  (\S+) \({direction}\)", text, re.MULTILINE)
        }
        for direction in ("in", "out")
    }
    assert told == {"in": resolved(node.subscriptions), "out": resolved(node.publishers)}
    services = {each.srv_name for each in node.services if each.srv_name.startswith("~")}
    head, _, listed = text.partition("\nparameters:\n")
    _, _, served = head.partition("\nservices")
    assert set(re.findall(r"^  (~/\S+) ", served, re.MULTILINE)) == services
    declared = set(node.list_parameters([], 0).names) - {
        "use_sim_time",
        "start_type_description_service",
    }
    shown = set(re.findall(r"^  (\S+) \(", listed, re.MULTILINE))
    assert declared - shown <= {"supervision.disturbance_limit"}
    for parameter in shown:
        assert f"      {node.describe_parameter(parameter).description}\n" in listed


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["my_bag"], "unrecognized arguments: my_bag"),
        (["--rate", "100"], "unrecognized arguments: --rate 100"),
        (["--ros-args", "-p", "bag:=b", "--", "b"], "unrecognized arguments: b"),
        (["--ros-args", "--rate", "2"], "'--rate', '2'"),
    ],
)
def test_unknown_arguments_are_named(arguments: list[str], named: str, capsys: Any) -> None:
    with pytest.raises(SystemExit, match="2"):
        check("player", *arguments)
    out, err = capsys.readouterr()
    assert not out
    assert "usage: player" in err
    assert named in err


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--ros-args", "-r", "__ns:=/arm", "--remap", "a:=b", "--params-file", PARAMETERS],
        ["--ros-args", "-p", "rate:=1.0", "--", "--ros-args", "-r", "__node:=left"],
        ["--ros-args", "--disable-rosout-logs", "--enable-stdout-logs", "-e", "/tsobs"],
        ["__ns:=/arm"],
    ],
)
def test_what_ros_understands_is_left_to_it(arguments: list[str]) -> None:
    check("observer", *arguments)
