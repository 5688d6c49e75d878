# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters behave as users and parameter clients expect, and never half-way."""

from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import pytest
import yaml
from rcl_interfaces.msg import ParameterType
from rclpy.node import Node
from rclpy.parameter import Parameter

from tsobs_ros.errors import ParameterError
from tsobs_ros.nodes.managed import ManagedNode, ManagedParameters
from tsobs_ros.nodes.parameters import ParameterBinding
from tsobs_ros.resources import config_path
from tsobs_ros.settings import live_setting, schema_of, setting, settings_group

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


@pytest.fixture
def make(ros):
    """Make a node of Parameters with the given overrides, which notes accepted changes."""

    class Tuned(ManagedNode[Parameters]):
        def __init__(self, **node_kwargs) -> None:
            self.changes: list[Parameters] = []
            super().__init__("parametrised", Parameters, **node_kwargs)
            self.start()

        def retune(self, parameters: Parameters) -> None:
            self.changes.append(parameters)

    def bind(overrides=None) -> Tuned:
        given = [
            value if isinstance(value, Parameter) else Parameter(name, value=value)
            for name, value in (overrides or {}).items()
        ]
        return ros.add(Tuned(context=ros.context, parameter_overrides=given))

    return bind


def set_one(node: Node, name: str, value, type_=None):
    (result,) = node.set_parameters([Parameter(name, type_, value)])
    return result


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of a tree by their full names."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        one = f"{prefix}{name}"
        found |= flat(value, f"{one}.") if isinstance(value, dict) else {one: value}
    return found


@pytest.mark.parametrize("name", ["observer", "plant_simulator", "player", "recorder"])
def test_the_shipped_file_has_every_parameter_at_its_default(name: str, ros: Any) -> None:
    content = yaml.safe_load(config_path(f"{name}.yaml").read_text(encoding="utf-8"))
    shipped = flat(content["/**"]["ros__parameters"])
    schema = import_module(f"tsobs_ros.nodes.{name}").Parameters
    assert shipped.keys() == schema_of(schema).entries.keys()
    node = ros.node(
        "shipped",
        parameter_overrides=[Parameter(k, value=v) for k, v in shipped.items() if v != []],
        automatically_declare_parameters_from_overrides=True,
    )
    value = ParameterBinding(node, schema).value
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
    node = make({name: given})

    assert getattr(node.parameters, name) == expected
    assert node.get_parameter(name).type_ in (TYPE.DOUBLE, TYPE.DOUBLE_ARRAY)


REFUSED = [
    ("rate", "fast", r"'rate': expected a number, got 'fast'"),
    ("rate", True, r"'rate': expected a number, got true"),
    ("upper", float("nan"), r"'upper' must be finite, got nan"),
    ("rate", 0.5, r"'rate' must be at least 1.0 and at most 2000.0 Hz, got 0.5"),
    ("depth", 2.0, r"'depth': expected an integer, got 2.0"),
    ("enabled", 1, r"'enabled': expected true or false, got 1"),
    ("kind", "bais_step", r"'kind' must be one of: none, bias_step, got 'bais_step'"),
    ("gains", [1.0, -1.0], r"each element of parameter 'gains' must be at least 0.0, got -1.0"),
    ("gains", "[1, 2.5]", r"got '.*'; .* write every number with a decimal point"),
    ("topics", "/a", r"'topics': expected a list of strings, got '/a'"),
    ("lower", 2.0, r"lower \(2.0\) must be below upper \(1.0\)"),
]


@pytest.mark.parametrize(("name", "value", "message"), REFUSED)
def test_a_bad_override_is_refused_at_start(make, name: str, value, message: str) -> None:
    with pytest.raises(ParameterError, match=message) as caught:
        make({name: value})
    assert "\n" not in str(caught.value)


def test_a_bad_set_is_refused_with_a_reason(make) -> None:
    node = make()
    for name, value, _ in (*REFUSED, ("upper", None, "")):
        result = set_one(node, name, value)
        assert not result.successful
        assert result.reason
        assert node.parameters == Parameters()
    assert node.get_parameter("upper").value == 1.0
    assert node.changes == []


def test_an_atomic_set_is_checked_as_a_whole_and_changes_all_or_nothing(make) -> None:
    node = make()

    result = node.set_parameters_atomically(
        [Parameter("upper", value=3), Parameter("depth", value=0)]
    )
    assert not result.successful
    assert "depth" in result.reason
    assert node.get_parameter("upper").value == node.parameters.upper == 1.0

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
