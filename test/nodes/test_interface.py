# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What users meet: parameters, command lines and the rights that each node needs."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter
from staging import start

from tsobs_ros.bag import BagWriter
from tsobs_ros.bag.estimate_topics import TORQUE_TOPICS
from tsobs_ros.cli.demo import ADAPTIVE_TOPICS, MARKERS, RECORDED_TOPICS
from tsobs_ros.errors import ParameterError
from tsobs_ros.methods import read_parameters
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.parameters import ManagedParameters
from tsobs_ros.nodes.runtime import check_arguments
from tsobs_ros.resources import config_path
from tsobs_ros.settings import changed, live_setting, schema_of, setting, settings_group

TYPE = Parameter.Type


@dataclass(frozen=True)
class Excitation:
    amplitude: float = live_setting(1.0, "Torque amplitude", unit="N m", minimum=0.0, maximum=100.0)


@dataclass(frozen=True)
class Parameters(ManagedParameters):
    rate: float = setting(200.0, "Publish rate", unit="Hz", minimum=1.0, maximum=2000.0)
    kind: str = live_setting("none", "Disturbance kind", choices=("none", "bias_step"))
    enabled: bool = live_setting(True, "Whether to publish")
    depth: int = live_setting(10, "Queue depth", minimum=1)
    gains: tuple[float, ...] = live_setting((1.0, 2.0), "Gains", minimum=0.0)
    topics: tuple[str, ...] = setting((), "Topics to record")
    lower: float = live_setting(0.0, "Lower end")
    upper: float = live_setting(1.0, "Upper end")
    excitation: Excitation = settings_group(Excitation)

    def __post_init__(self) -> None:
        if self.lower >= self.upper:
            raise ParameterError(f"lower ({self.lower}) must be below upper ({self.upper})")


class Tuned(ManagedNode[Parameters]):
    """A node of Parameters, which notes accepted changes."""

    def __init__(self, **node_kwargs: Any) -> None:
        self.changes: list[Parameters] = []
        super().__init__("parametrised", Parameters, **node_kwargs)
        self.start()

    def retune(self, parameters: Parameters, names: Collection[str]) -> None:
        self.changes.append(parameters)


@pytest.fixture
def make(ros: Any) -> Callable[..., Tuned]:
    """Make a node of Parameters with an override."""

    def bind(name: str = "rate", value: Any = 200.0) -> Tuned:
        given = value if isinstance(value, Parameter) else Parameter(name, value=value)
        made: Tuned = ros.add(Tuned(context=ros.context, parameter_overrides=[given]))
        return made

    return bind


@pytest.mark.parametrize("name", ["observer", "plant_simulator", "player", "recorder"])
def test_the_shipped_file_has_every_parameter_at_its_default(name: str) -> None:
    shipped = read_parameters(config_path(f"{name}.yaml"), name)
    schema = import_module(f"tsobs_ros.nodes.{name}").Parameters
    assert shipped.keys() == schema_of(schema).entries.keys()
    value = changed(schema(), shipped)
    if name == "recorder":  # which records nothing by default
        value = replace(value, topics=(), regex="")
    assert value == schema()


@pytest.mark.parametrize(
    ("name", "given", "expected"),
    [
        ("rate", 100, 100.0),
        ("gains", [3, 4], (3.0, 4.0)),
        ("gains", Parameter("gains", TYPE.NOT_SET, None), ()),  # `gains: []` in YAML
        ("gains", Parameter("gains", TYPE.BOOL_ARRAY, []), ()),  # `ros2 param set … "[]"`
    ],
)
def test_overrides_are_converted(make, name: str, given, expected) -> None:
    node = make(name, given)

    assert getattr(node.parameters, name) == expected
    assert node.get_parameter(name).type_ in (TYPE.DOUBLE, TYPE.DOUBLE_ARRAY)


REFUSED = [
    ("rate", "fast", r"'rate': expected a finite number of at least 1.0 and .* Hz, got .fast."),
    ("rate", True, r"'rate': expected a finite number .*, got true"),
    ("upper", float("nan"), r"'upper': expected a finite number, got NaN"),
    ("rate", 0.5, r"'rate': expected .* of at least 1.0 and at most 2000.0 Hz, got 0.5"),
    ("depth", 2.0, r"'depth': expected an integer of at least 1, got 2.0"),
    ("enabled", 1, r"'enabled': expected true or false, got 1"),
    ("kind", "bais_step", r"'kind': expected one of: none, bias_step, got .bais_step."),
    ("gains", [1.0, -1.0], r"'gains': expected a list of numbers, each at least 0.0, got"),
    ("gains", "[1, 2.5]", r"got .*; .* write every number with a decimal point"),
    ("topics", "/a", r"'topics': expected a list of strings, got ./a."),
    ("lower", 2.0, r"lower \(2.0\) must be below upper \(1.0\)"),
]


@pytest.mark.parametrize(("name", "value", "message"), REFUSED)
def test_a_bad_override_is_refused_at_start(make, name: str, value, message: str) -> None:
    with pytest.raises(ParameterError, match=message) as caught:
        make(name, value)
    assert "\n" not in str(caught.value)


def test_a_set_is_checked_as_a_whole_and_changes_all_or_nothing(make) -> None:
    node = make()
    alone = [[Parameter(name, value=value)] for name, value, _ in REFUSED]
    together = [Parameter("upper", value=3), Parameter("depth", value=0)]
    for parameters in (*alone, together):
        result = node.set_parameters_atomically(parameters)
        assert not result.successful
        assert result.reason
        assert node.parameters == Parameters()
    assert "depth" in result.reason
    assert node.get_parameter("upper").value == 1.0
    assert node.changes == []

    # Neither order of single sets would pass: 2 is above the old upper end.
    result = node.set_parameters_atomically(
        [Parameter("lower", value=2), Parameter("upper", value=3)]
    )
    assert result.successful
    assert (node.parameters.lower, node.parameters.upper) == (2.0, 3.0)
    assert len(node.changes) == 1


def test_descriptors_tell_clients_what_is_allowed(make) -> None:
    node = make()

    rate = node.describe_parameter("rate")
    assert rate.description == "Publish rate [Hz]"
    assert rate.type == ParameterType.PARAMETER_DOUBLE
    assert rate.read_only
    assert not rate.dynamic_typing
    assert rate.floating_point_range[0].to_value == 2000.0
    assert node.describe_parameter("depth").integer_range[0].from_value == 1
    assert node.describe_parameter("kind").additional_constraints == "one of: none, bias_step"
    assert node.describe_parameter("gains").additional_constraints == "each element at least 0.0"
    topics = node.describe_parameter("topics")
    assert topics.read_only
    assert topics.type == ParameterType.PARAMETER_STRING_ARRAY


NODES = ("observer", "plant_simulator", "recorder", "player", "visualizer")
OF_ROS = ("/rosout", "/parameter_events", "/transition_event")


def check(name: str, *arguments: str) -> None:
    check_arguments(import_module(f"tsobs_ros.nodes.{name}"), [name, *arguments])


@pytest.mark.parametrize("name", NODES)
def test_the_help_has_every_topic_service_and_parameter(
    name: str, ros: Any, tmp_path: Path, both_design: Path, capsys: Any
) -> None:
    with pytest.raises(SystemExit, match="0"):
        check(name, "--help")
    text = capsys.readouterr().out
    BagWriter(tmp_path / "bag").close()
    parameters = {
        "observer": {"design": str(both_design)},
        "plant_simulator": {"publish_clock": True},
        "recorder": {"output": str(tmp_path / "new"), "topics": ["/nothing"]},
        "player": {"bag": str(tmp_path / "bag"), "clock": 1.0},
    }
    node = start(ros, name, **parameters.get(name, {}))

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
        (["--rate", "100"], "unrecognized arguments: --rate 100"),
        (["--ros-args", "-p", "bag:=b", "--", "b"], "unrecognized arguments: b"),
        (["--ros-args", "--rate", "2"], "'--rate', '2'"),
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


POLICY = config_path("sros2_policy.xml")
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

# How the policy calls what a node does, what an entry of that kind is called, and who knows it.
KINDS = {
    "publish": ("topic", "get_publisher_names_and_types_by_node"),
    "subscribe": ("topic", "get_subscriber_names_and_types_by_node"),
    "reply": ("service", "get_service_names_and_types_by_node"),
    "request": ("service", "get_client_names_and_types_by_node"),
}


def allowed(node: str) -> set[tuple[str, str]]:
    """Return what the policy allows a node: pairs of what it does and the full name."""
    root = ElementTree.parse(POLICY).getroot()
    (profile,) = root.findall(
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


def test_each_node_is_allowed_what_it_has_and_nothing_else(
    ros: Any, tmp_path: Path, both_design: Path
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


@pytest.mark.parametrize(
    ("name", "parameters", "reason"),
    [
        ("observer", {"joints": ["hip", "knee", "hip"]}, "joints: expected names, each once"),
        ("observer", {"gain_mode": "certain"}, "gain_mode"),
        (
            "observer",
            {"joints": ["a", "b", "c"], "torque_warn": [1.0, 2.0]},
            "each of the 3 joints, a single",
        ),
        ("plant_simulator", {"initial_state": [0.1, 0.2]}, "initial_state: expected 4"),
        ("plant_simulator", {"mismatch.stiffness": -1.0}, "stiffness: expected"),
        ("plant_simulator", {"excitation.multisine.highest": 0.1}, "multisine highest"),
        ("recorder", {"regex": "*joints"}, r"'regex': not a regular expression .*'\*joints'"),
        (
            "recorder",
            {"queue_depth": 5001},
            "'queue_depth': expected an integer of at least 1 and at most 5000",
        ),
    ],
)
def test_senseless_parameters_are_refused(
    ros: Any, tmp_path: Path, monkeypatch: Any, name: str, parameters: dict[str, Any], reason: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ParameterError, match=reason):
        start(ros, name, **parameters)
    assert not list(tmp_path.iterdir())
