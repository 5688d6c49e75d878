# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS parameters as frozen dataclasses: declared, validated, atomically changed, cached.

A node describes its parameters once, as a frozen dataclass, and reads them as plain attributes::

    @dataclass(frozen=True)
    class SimulatorParameters:
        rate: float = parameter(200.0, "Publish rate", unit="Hz", minimum=1.0, read_only=True)
        kind: str = parameter("none", "Disturbance kind", choices=("none", "bias_step"))
        bias_step: BiasStep = parameter_group(
            BiasStep, amplitude=parameter(0.1, "Bias", unit="rad"), start=parameter(0.0, "Start")
        )

    binding = ParameterBinding(node, SimulatorParameters, on_change=self._apply)
    binding.value.bias_step.amplitude     # the ROS parameter "bias_step.amplitude"

A ``__post_init__`` that raises ParameterError or ModelError validates fields against each other; it
sees every proposed set as a whole.

Integers for doubles: users write ``gain: 3`` and ``ros2 param set … 3``. With ``dynamic_typing``
``describe`` would report the type that came last and ``get`` would return an integer for a double.
Parameters are therefore statically typed, and integers become doubles before rclpy compares the
types: overrides before their declaration, sets in a pre-set callback. A value that cannot be
converted is replaced there by a stand-in of the right type that carries the reason, since only an
on-set callback may refuse with one.
"""

import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import Field, field, fields, is_dataclass
from typing import Any, Generic, NamedTuple, TypeVar, get_type_hints

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from tsobs_ros.checks import meant
from tsobs_ros.errors import ModelError, ParameterError, printable

T = TypeVar("T")
P = TypeVar("P")

_METADATA_KEY = "tsobs_ros.parameter"
_MAX_INTEGER, _MAX_FLOAT = 2**63 - 1, sys.float_info.max

# Declared by rclpy or rcl on behalf of every node, so never "unknown".
_FOREIGN_PREFIXES = ("qos_overrides.",)
_FOREIGN_NAMES = ("use_sim_time", "start_type_description_service")


class _Type(NamedTuple):
    """The ROS parameter type of a Python annotation, its element and its name for users."""

    ros: Parameter.Type
    element: type
    is_array: bool
    wording: str


_TYPES: dict[Any, _Type] = {
    bool: _Type(Parameter.Type.BOOL, bool, False, "true or false"),
    int: _Type(Parameter.Type.INTEGER, int, False, "an integer"),
    float: _Type(Parameter.Type.DOUBLE, float, False, "a number"),
    str: _Type(Parameter.Type.STRING, str, False, "a string"),
    tuple[int, ...]: _Type(Parameter.Type.INTEGER_ARRAY, int, True, "a list of integers"),
    tuple[float, ...]: _Type(Parameter.Type.DOUBLE_ARRAY, float, True, "a list of numbers"),
    tuple[str, ...]: _Type(Parameter.Type.STRING_ARRAY, str, True, "a list of strings"),
}


class _Rules(NamedTuple):
    """The arguments of `parameter`, kept in the dataclass field's metadata."""

    description: str
    unit: str
    minimum: float | None
    maximum: float | None
    choices: tuple[Any, ...]
    read_only: bool


class _Entry(NamedTuple):
    """One ROS parameter: its full name, type, rules and default."""

    name: str
    type: _Type
    rules: _Rules
    default: Any


class _RefusedParameter(Parameter):
    """Stands in for a set that cannot be converted until the on-set callback refuses it."""

    def __init__(self, entry: _Entry, value: Any, reason: str) -> None:
        super().__init__(entry.name, entry.type.ros, _to_ros(value))
        self.reason = reason


def parameter(
    default: T,
    description: str,
    *,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[Any] = (),
    read_only: bool = False,
) -> T:
    """Declare a dataclass field as a ROS parameter.

    Args:
        default: Value if the user gives none; must obey the rules below.
        description: One line for `ros2 param describe`, without the unit.
        unit: SI unit shown with the description, or "".
        minimum: Least accepted value, in `unit`; of each element of a list.
        maximum: Greatest accepted value, in `unit`; of each element of a list.
        choices: The only accepted values, if not empty; of each element of a list.
        read_only: Whether the value is fixed once the node has started.

    Returns:
        A dataclass field, typed as the default so that annotations check.
    """
    rules = _Rules(description, unit, minimum, maximum, tuple(choices), read_only)
    return field(default=default, metadata={_METADATA_KEY: rules})


def fixed_parameter(default: T, description: str, **rules: Any) -> T:
    """Declare a field as a ROS parameter that is fixed once the node has started: `parameter`."""
    return parameter(default, description, read_only=True, **rules)


def parameter_group(make: Callable[..., T], **members: Any) -> T:
    """Declare a dataclass field that is itself a dataclass of parameters.

    Args:
        make: The frozen dataclass. Its parameters are named "<field>.<name>".
        **members: If it is not made of `parameter` fields itself, such as one of the core: those of
            its fields that are parameters, each as a `parameter`. The others keep their defaults.

    Returns:
        A dataclass field that holds an instance.
    """
    given = {name: item.default for name, item in members.items()}
    return field(default_factory=lambda: make(**given), metadata={_METADATA_KEY: members})


def describe(schema: type) -> list[str]:
    """Return two lines for each parameter of a dataclass, from the descriptor that ROS gets.

    The first has the name, type, default and what is accepted, the second the description.
    """
    lines = []
    for entry in _Schema(schema, None, "").entries:
        descriptor = _descriptor(entry)
        facts = [entry.type.ros.name.lower(), f"default {_shown(entry.default)}"]
        for limits in (*descriptor.floating_point_range, *descriptor.integer_range):
            if limits.from_value > -_MAX_INTEGER:
                facts.append(f"at least {limits.from_value}")
            if limits.to_value < _MAX_INTEGER:
                facts.append(f"at most {limits.to_value}")
        facts += [descriptor.additional_constraints] * bool(descriptor.additional_constraints)
        facts += ["read-only"] * descriptor.read_only
        lines += [f"  {entry.name} ({'; '.join(facts)})", f"      {descriptor.description}"]
    return lines


def design_paths(joints: Sequence[str], own: Sequence[str], common: str) -> dict[str, str]:
    """Return the path of each joint's design file, empty if there is none.

    Args:
        joints: Names of the joints.
        own: The parameter `joint_designs`: a path for each of them, empty for `common`, or none.
        common: The parameter `design`.

    Raises:
        ParameterError: A name is empty or comes twice, or there is another number of paths.
    """
    if not joints or "" in joints or len(set(joints)) < len(joints):
        raise ParameterError(f"joints: expected names, each once, got {list(joints)}")
    if own and len(own) != len(joints):
        raise ParameterError(
            f"joint_designs: expected one for each of the {len(joints)} joints or none, "
            f"got {len(own)}"
        )
    paths = own or ("",) * len(joints)
    return {joint: path or common for joint, path in zip(joints, paths, strict=True)}


def check_pattern(name: str, pattern: str) -> None:
    """Refuse a parameter that must be a regular expression and is none; for a `__post_init__`.

    Raises:
        ParameterError: The pattern is malformed.
    """
    try:
        re.compile(pattern)
    except re.error as error:
        raise ParameterError(
            f"parameter '{name}': not a regular expression ({error}): '{pattern}'"
        ) from error


class ParameterBinding(Generic[P]):
    """The parameters of one node, bound to one frozen dataclass.

    Args:
        node: Node that owns the parameters and has declared its overrides, as a `ManagedNode` has;
            those that the dataclass lacks are unknown.
        schema: Frozen dataclass made of `parameter` and `parameter_group` fields.
        on_change: Called with the new value after a set took effect; not at start.

    Raises:
        ParameterError: An override has the wrong type, breaks a rule, or the values contradict
            each other.
    """

    def __init__(
        self, node: Node, schema: type[P], on_change: Callable[[P], None] | None = None
    ) -> None:
        self._schema = _Schema(schema, None, "")
        self._on_change = on_change
        self._entries = {entry.name: entry for entry in self._schema.entries}
        given = {
            name: each.value
            for name, each in node.get_parameters_by_prefix("").items()
            if name not in _FOREIGN_NAMES and not name.startswith(_FOREIGN_PREFIXES)
        }
        self._values = {
            name: _convert(entry, given[name]) if name in given else entry.default
            for name, entry in self._entries.items()
        }
        self._value: P = self._schema.build(self._values)
        for name in given:
            node.undeclare_parameter(name)
        for name, entry in self._entries.items():
            _declare(node, entry, self._values[name])
        if unknown := sorted(given.keys() - self._entries.keys()):
            listed = ", ".join(f"'{name}'{meant(name, self._entries)}" for name in unknown)
            node.get_logger().warning(printable(f"ignored unknown parameters: {listed}"))
        node.get_logger().debug(printable(f"parameters: {self._listed()}"))
        node.add_pre_set_parameters_callback(self._convert_proposal)
        node.add_on_set_parameters_callback(self._check_proposal)
        node.add_post_set_parameters_callback(self._take_over)

    @property
    def value(self) -> P:
        """The current parameters; the same object until a set is accepted."""
        return self._value

    def _convert_proposal(self, proposal: list[Parameter]) -> list[Parameter]:
        return [
            _converted(self._entries[each.name], each, self._values[each.name])
            if each.name in self._entries
            else each
            for each in proposal
        ]

    def _check_proposal(self, proposal: list[Parameter]) -> SetParametersResult:
        reason = "; ".join(each.reason for each in proposal if isinstance(each, _RefusedParameter))
        if not reason:
            try:
                self._schema.build(self._merged(proposal))
            except ParameterError as error:
                reason = str(error)
        return SetParametersResult(successful=not reason, reason=reason)

    def _take_over(self, accepted: list[Parameter]) -> None:
        values = self._merged(accepted)
        if values == self._values:
            return
        self._values = values
        self._value = self._schema.build(values)
        if self._on_change is not None:
            self._on_change(self._value)

    def _merged(self, proposal: Iterable[Parameter]) -> dict[str, Any]:
        known = [p for p in proposal if p.name in self._entries]
        return {**self._values, **{p.name: _convert(self._entries[p.name], p.value) for p in known}}

    def _listed(self) -> str:
        return ", ".join(
            f"{name}={_shown(self._values[name])}{rules.unit and f' {rules.unit}'}"
            for name, _, rules, _ in self._entries.values()
        )


class _Schema:
    """A dataclass of parameters and of groups of them.

    Attributes:
        entries: The parameters in the order of the fields, those of groups included.
    """

    def __init__(self, make: Any, members: Mapping[str, Field[Any]] | None, prefix: str) -> None:
        if not (isinstance(make, type) and is_dataclass(make)):
            raise TypeError(f"{make!r} is not a dataclass of parameters")
        self.entries: list[_Entry] = []
        self._make, self._prefix = make, prefix
        self._parts: dict[str, _Schema | _Entry] = {}
        hints = get_type_hints(make)
        for name, item in (members or {item.name: item for item in fields(make)}).items():
            hint, rules = hints[name], item.metadata.get(_METADATA_KEY)
            if isinstance(rules, dict):
                group = _Schema(hint, rules, f"{prefix}{name}.")
                self._parts[name] = group
                self.entries += group.entries
            elif rules is None or hint not in _TYPES:
                raise TypeError(
                    f"{make.__name__}.{name}: {hint} is not a parameter; use parameter() "
                    f"or parameter_group() with one of {', '.join(map(str, _TYPES))}"
                )
            else:
                entry = _Entry(f"{prefix}{name}", _TYPES[hint], rules, item.default)
                self._parts[name] = entry = entry._replace(default=_convert(entry, item.default))
                self.entries.append(entry)

    def build(self, values: Mapping[str, Any]) -> Any:
        """Make the dataclass from the values by full names; its __post_init__ validates them."""
        arguments = {
            name: part.build(values) if isinstance(part, _Schema) else values[part.name]
            for name, part in self._parts.items()
        }
        try:
            return self._make(**arguments)
        except ModelError as error:
            where = f"parameters '{self._prefix}*': " if self._prefix else ""
            raise ParameterError(f"{where}{error}") from error


def _converted(entry: _Entry, proposed: Parameter, current: Any) -> Parameter:
    """Return a proposal with its value converted, or what its refusal needs."""
    try:
        value = _convert(entry, proposed.value)
    except ParameterError as error:
        return _RefusedParameter(entry, current, str(error))
    return Parameter(entry.name, entry.type.ros, _to_ros(value))


def _declare(node: Node, entry: _Entry, value: Any) -> None:
    descriptor = _descriptor(entry)
    if value != ():
        node.declare_parameter(entry.name, _to_ros(value), descriptor, ignore_override=True)
        return
    # rclpy infers an empty list to be bytes, so an empty array is declared without a value, then
    # set with its type, and only then made read-only.
    writable = ParameterDescriptor(
        description=descriptor.description, additional_constraints=descriptor.additional_constraints
    )
    node.declare_parameter(entry.name, entry.type.ros, writable, ignore_override=True)
    node.set_parameters_atomically([Parameter(entry.name, entry.type.ros, [])])
    descriptor.type = entry.type.ros.value
    node.set_descriptor(entry.name, descriptor)


def _descriptor(entry: _Entry) -> ParameterDescriptor:
    rules = entry.rules
    descriptor = ParameterDescriptor(
        description=f"{rules.description} [{rules.unit}]" if rules.unit else rules.description,
        read_only=rules.read_only,
    )
    if rules.choices:
        descriptor.additional_constraints = f"one of: {', '.join(map(str, rules.choices))}"
    low, high = rules.minimum, rules.maximum
    if low is None and high is None:
        return descriptor
    if entry.type.is_array:  # ROS ranges bind scalars only
        bounds = [f"at least {low}"] * (low is not None) + [f"at most {high}"] * (high is not None)
        descriptor.additional_constraints = f"each element {' and '.join(bounds)}"
    elif entry.type.element is int:
        descriptor.integer_range = [
            IntegerRange(
                from_value=-_MAX_INTEGER if low is None else math.ceil(low),
                to_value=_MAX_INTEGER if high is None else math.floor(high),
            )
        ]
    else:
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=-_MAX_FLOAT if low is None else float(low),
                to_value=_MAX_FLOAT if high is None else float(high),
            )
        ]
    return descriptor


def _convert(entry: _Entry, value: Any) -> Any:
    """Turn what came from YAML, a message or a default into the field's type, or refuse it."""
    if not entry.type.is_array:
        return _convert_element(entry, value)
    if value is None:  # how rcl hands over `name: []`
        return ()
    if isinstance(value, str | bytes) or not hasattr(value, "__len__"):
        raise _wrong_type(entry, value)
    return tuple(_convert_element(entry, item) for item in list(value))


def _convert_element(entry: _Entry, value: Any) -> Any:
    expected: Any = entry.type.element
    if expected is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, expected) or (isinstance(value, bool) and expected is not bool):
        raise _wrong_type(entry, value)
    rules, each = entry.rules, "each element of " if entry.type.is_array else ""
    subject = f"{each}parameter '{entry.name}' must be"
    unit = f" {rules.unit}" if rules.unit else ""
    if isinstance(value, float) and not math.isfinite(value):
        raise ParameterError(f"{subject} finite, got {value}")
    if rules.minimum is not None and value < rules.minimum:
        raise ParameterError(f"{subject} at least {rules.minimum}{unit}, got {value}")
    if rules.maximum is not None and value > rules.maximum:
        raise ParameterError(f"{subject} at most {rules.maximum}{unit}, got {value}")
    if rules.choices and value not in rules.choices:
        listed = ", ".join(map(str, rules.choices))
        raise ParameterError(f"{subject} one of {listed}; got {_shown(value)}")
    return value


def _wrong_type(entry: _Entry, value: Any) -> ParameterError:
    hint = ""
    if entry.type.is_array and isinstance(value, str) and value.lstrip().startswith("["):
        # ros2cli sends a list of mixed types as a string, and rcl refuses it in YAML.
        hint = "; lists must not mix types: write every number with a decimal point"
    kinds = {bool: "boolean", int: "integer", float: "number", str: "string"}
    kind = kinds.get(type(value), "list" if hasattr(value, "__len__") else type(value).__name__)
    came = "nothing" if value is None else f"the {kind} {_shown(value)}"
    return ParameterError(
        f"parameter '{entry.name}': expected {entry.type.wording}, got {came}{hint}"
    )


def _shown(value: Any) -> str:
    """Show a value the way YAML would take it back."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"'{value}'"
    if hasattr(value, "__len__"):
        return f"[{', '.join(_shown(item) for item in value)}]"
    return repr(value)


def _to_ros(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
