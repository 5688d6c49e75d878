# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What users meet: parameters, command lines and the rights that each node needs."""

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from staging import start

from tsobs_ros.bag import BagWriter
from tsobs_ros.bag.estimate_topics import TORQUE_TOPICS
from tsobs_ros.cli.demo import ADAPTIVE_TOPICS, MARKERS, RECORDED_TOPICS
from tsobs_ros.errors import ParameterError
from tsobs_ros.methods import read_parameters
from tsobs_ros.nodes.runtime import check_arguments
from tsobs_ros.resources import config_path
from tsobs_ros.settings import changed, settings_of


@pytest.mark.parametrize("name", ["observer", "plant_simulator", "player", "recorder"])
def test_the_shipped_file_has_every_parameter_at_its_default(name: str) -> None:
    shipped = read_parameters(config_path(f"{name}.yaml"), name)
    schema = import_module(f"tsobs_ros.nodes.{name}").Parameters
    assert shipped.keys() == settings_of(schema).keys()
    value = changed(schema(), shipped)
    if name == "recorder":  # which records nothing by default
        value = replace(value, topics=(), regex="")
    assert value == schema()


def test_integers_and_empty_lists_are_accepted_for_lists_of_doubles(ros: Any) -> None:
    node = start(ros, "observer", rate=100, torque_warn=[3])
    assert (node.parameters.rate, node.parameters.torque_warn) == (100.0, (3.0,))
    rate = node.describe_parameter("rate")
    assert rate.read_only
    assert (rate.floating_point_range[0].from_value, rate.type) == (0.0, 3)
    for empty in (None, []):  # `[]` in a file, and from `ros2 param set`
        assert start(ros, "plant_simulator", initial_state=empty).parameters.initial_state == ()


def test_a_misspelt_parameter_is_named_with_the_one_that_is_meant(ros: Any, capfd: Any) -> None:
    start(ros, "observer", desing="my.design.yaml")
    assert "unknown parameter 'desing'; did you mean 'design'?" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("name", "parameters", "reason"),
    [
        ("observer", {"rate": "fast"}, r"'rate': expected a finite number of at least .* Hz, got"),
        ("observer", {"rate": 1e-300}, "rate: expected 0 or at least 0.01 Hz, got 1e-300"),
        ("plant_simulator", {"rate": 1e-9}, "rate: expected a .* of at least 0.01 Hz, got 1e-09"),
        ("observer", {"rate": True}, "'rate': expected a finite number .*, got true"),
        ("observer", {"history": float("nan")}, "'history': expected a finite number .*, got NaN"),
        ("observer", {"history": 61.0}, "'history': expected .* at most 60.0 s, got 61.0"),
        ("observer", {"adapt": 1}, "'adapt': expected true or false, got 1"),
        ("observer", {"gain_mode": "certain"}, "'gain_mode': expected one of: certified"),
        ("observer", {"torque_warn": [1.0, -1.0]}, "each at least 0.0 and at most"),
        ("observer", {"torque_warn": "[1, 2.5]"}, "a list of numbers with decimal points"),
        ("observer", {"joints": ["hip", "knee", "hip"]}, "joints: expected names, each once"),
        ("observer", {"joints": ["a", "b", "c"], "torque_warn": [1.0, 2.0]}, "each of the 3 joint"),
        ("plant_simulator", {"command_timeout": 1.7e308}, "at least 0.0 and at most 1000000000.0"),
        ("plant_simulator", {"duration": 1e300}, "at least 0.0 and at most 1000000000.0 s, got"),
        ("player", {"start_offset": 1e300}, "at least 0.0 and at most 1000000000.0 s, got 1e"),
        ("recorder", {"sync_period": 1e300}, "at least 0.1 and at most 1000000.0 s, got 1e"),
        ("player", {"bag": "~nobody-has-it/b"}, "'bag': expected a path, got '~nobody-has-it/b'"),
        ("recorder", {"output": "~nobody-has-it/b"}, "'output': expected a path, got '~nobody-h"),
        ("observer", {"design": "~nobody-has-it/d"}, "'design': expected a path, got '~nobody-h"),
        ("plant_simulator", {"initial_state": [0.1, 0.2]}, "initial_state: expected 4"),
        ("plant_simulator", {"mismatch.stiffness": -1.0}, "stiffness: expected"),
        ("plant_simulator", {"excitation.multisine.highest": 0.1}, "multisine highest"),
        ("recorder", {"topics": "/a"}, "'topics': expected a list of strings, got"),
        ("recorder", {"topics": ["b ad"]}, "'topics': expected a ROS name, got 'b ad'"),
        ("recorder", {"exclude_topics": ["/a//b"]}, "'exclude_topics': .*, got '/a//b'"),
        ("visualizer", {"observer": "b ad"}, "'observer': expected a ROS name, got 'b ad'"),
        ("player", {"use_sim_time": 5}, "'use_sim_time': expected true or false, got 5"),
        ("recorder", {"regex": "*joints"}, r"'regex': not a regular expression .*'\*joints'"),
        ("recorder", {"queue_depth": 2.0}, "'queue_depth': expected an integer of .*, got 2.0"),
        ("recorder", {"queue_depth": 5001}, "at least 1 and at most 5000"),
    ],
)
def test_senseless_parameters_are_refused_in_a_line(
    ros: Any, tmp_path: Path, monkeypatch: Any, name: str, parameters: dict[str, Any], reason: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ParameterError, match=reason) as caught:
        start(ros, name, **parameters)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def check(name: str, *arguments: str) -> None:
    check_arguments(import_module(f"tsobs_ros.nodes.{name}"), [name, *arguments])


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--rate", "100"], "unrecognized arguments: --rate 100"),
        (["--ros-args", "-p", "bag:=b", "--", "b"], "unrecognized arguments: b"),
        (["--ros-args", "--rate", "2"], "'--rate', '2'"),
        (["--ros-args", "-p", "bag:=\udcff"], r"expected arguments in UTF-8, got 'bag:=\udcff'"),
    ],
)
def test_unknown_arguments_are_named(arguments: list[str], named: str, capsys: Any) -> None:
    check("player", "--ros-args", "-r", "__ns:=/arm", "--params-file", "f", "--", "--ros-args")
    with pytest.raises(SystemExit, match="2"):
        check("player", *arguments)
    out, err = capsys.readouterr()
    assert not out
    assert "usage: player" in err
    assert named in err


EVERYTHING = [
    *RECORDED_TOPICS,
    *ADAPTIVE_TOPICS,
    *(f"/observer/{name}" for name in TORQUE_TOPICS),
    "/ground_truth/torque_disturbance",
]
TYPES = {
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/observer/design": "std_msgs/msg/String",
    "/observer/ticks": "std_msgs/msg/Int64MultiArray",
    MARKERS: "visualization_msgs/msg/MarkerArray",
}
OF_ROS = {"/clock", "/rosout", "/parameter_events"}

# How the policy calls what a node does, what an entry of that kind is called, and who knows it.
KINDS = {
    "publish": ("topic", "get_publisher_names_and_types_by_node"),
    "subscribe": ("topic", "get_subscriber_names_and_types_by_node"),
    "reply": ("service", "get_service_names_and_types_by_node"),
    "request": ("service", "get_client_names_and_types_by_node"),
}


def allowed(node: str) -> set[tuple[str, str]]:
    """Return what the policy allows a node: pairs of what it does and the full name."""
    (profile,) = ElementTree.parse(config_path("sros2_policy.xml")).findall(
        f"./contexts/context[@path='/tsobs_ros/{node}']/profiles/profile[@ns='/'][@node='{node}']"
    )
    return {
        (kind, str(entry.text).replace("~", f"/{node}"))
        for part in profile
        for kind, (element, _) in KINDS.items()
        if part.get(kind) == "ALLOW"
        for entry in part.findall(element)
    }


def actual(node: Any) -> set[tuple[str, str]]:
    """Return what a node has."""
    own = node.get_name(), node.get_namespace()
    return {(kind, n) for kind, (_, query) in KINDS.items() for n, _ in getattr(node, query)(*own)}


def check_help(node: Any, text: str) -> None:
    """Check that a node's help has its topics, but for those of bags, services and parameters."""
    head, _, listed = text.partition("\nparameters:\n")
    _, _, served = head.partition("\nservices")
    for direction, entities in (("in", node.subscriptions), ("out", node.publishers)):
        topics = re.findall(rf"^  (\S+) \({direction}\)", head, re.MULTILINE)
        told = {node.resolve_topic_name(each) for each in topics} - OF_ROS
        has = {each.topic_name for each in entities} - OF_ROS
        has -= {f"/{node.get_name()}/transition_event"}
        assert told == (has & told if node.get_name() in ("recorder", "player") else has)
    services = {each.srv_name for each in node.services if each.srv_name.startswith("~")}
    assert set(re.findall(r"^  (~/\S+) ", served, re.MULTILINE)) == services
    shown = set(re.findall(r"^  (\S+) \(", listed, re.MULTILINE))
    declared = set(node.list_parameters([], 0).names)
    assert declared - shown <= {"use_sim_time", "start_type_description_service"}
    for parameter in shown:
        assert f"      {node.describe_parameter(parameter).description}\n" in listed


def test_help_and_policy_have_what_each_node_has_and_nothing_else(
    ros: Any, tmp_path: Path, both_design: Path, capsys: Any
) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for topic in EVERYTHING:
            writer.add_topic(topic, TYPES.get(topic, "sensor_msgs/msg/JointState"))
            writer.write(topic, b"\x00\x01\x00\x00" + bytes(28), 1, 1)
    # Simulated time for all but the player, which makes it, and whatever else adds names.
    simulated, output = {"use_sim_time": True}, str(tmp_path / "recorded")
    recorder = start(ros, "recorder", output=output, topics=EVERYTHING, **simulated)
    nodes = [
        start(ros, "plant_simulator", publish_clock=True, **simulated),
        start(ros, "observer", design=str(both_design), **simulated),
        start(ros, "player", bag=str(writer.path), clock=40.0, start_paused=True),
        start(ros, "visualizer", **simulated),
        recorder,
    ]
    subscribed = {name for kind, name in allowed("recorder") if kind == "subscribe"} - {"/clock"}
    ros.spin_until(lambda: {n for _, n in actual(recorder)} >= subscribed, what="the recording")

    for node in nodes:
        assert actual(node) == allowed(node.get_name())
        with pytest.raises(SystemExit, match="0"):
            check(node.get_name(), "--help")
        check_help(node, capsys.readouterr().out)
