# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS parameters from frozen dataclasses: declared, validated, atomically changed, cached.

A node describes its parameters once, as a frozen dataclass, and reads them as plain attributes::

    @dataclass(frozen=True)
    class ExcitationParameters:
        amplitude: float = parameter(1.0, "Torque amplitude", unit="N m", minimum=0.0)

    @dataclass(frozen=True)
    class SimulatorParameters:
        rate: float = parameter(200.0, "Publish rate", unit="Hz", minimum=1.0, read_only=True)
        kind: str = parameter("none", "Disturbance kind", choices=("none", "bias_step"))
        excitation: ExcitationParameters = parameter_group(ExcitationParameters)

    binding = ParameterBinding(node, SimulatorParameters, on_change=self._apply)
    binding.value.excitation.amplitude     # the ROS parameter "excitation.amplitude"

A ``__post_init__`` that raises ParameterError validates fields against each other; it sees every
proposed set as a whole.

Integers for doubles: users write ``gain: 3`` and ``ros2 param set … 3``. Declaring with
``dynamic_typing`` would let them in, but then ``describe`` reports whatever type came last and
``get`` returns an integer where a double is documented. Parameters are therefore statically typed,
and integers become doubles before rclpy compares the types: overrides on their way into the
declaration, sets in a pre-set callback. A value that cannot be converted is replaced there by a
stand-in of the right type that carries the reason, since only an on-set callback may refuse and
give one; otherwise clients would read "Wrong parameter type" without a name.
"""

import difflib
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import field, fields, is_dataclass
from typing import Any, Generic, TypeVar, get_type_hints

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from tsobs_ros.errors import ParameterError
from tsobs_ros.nodes.parameter_values import TYPES, Entry, Spec, convert, shown

T = TypeVar("T")
P = TypeVar("P")

_METADATA_KEY = "tsobs_ros.parameter"
_SEPARATOR = "."
_INT64_MAX = 2**63 - 1

# Declared by rclpy or rcl on behalf of every node, so never "unknown".
_FOREIGN_PREFIXES = ("qos_overrides.",)
_FOREIGN_NAMES = ("use_sim_time", "start_type_description_service")


class _RefusedParameter(Parameter):
    """Stands in for a set that cannot be converted until the on-set callback refuses it."""

    def __init__(self, entry: Entry, value: Any, reason: str) -> None:
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
        default: Value used when the user gives none; must obey the rules below.
        description: One line for `ros2 param describe`, without the unit.
        unit: SI unit shown with the description and in the start-up summary, or "".
        minimum: Least accepted value, in `unit`; of each element of a list.
        maximum: Greatest accepted value, in `unit`; of each element of a list.
        choices: The only accepted values, if not empty; of each element of a list.
        read_only: Whether the value is fixed once the node has started.

    Returns:
        A dataclass field, typed as the default so that annotations check.
    """
    spec = Spec(description, unit, minimum, maximum, tuple(choices), read_only)
    return field(default=default, metadata={_METADATA_KEY: spec})


def parameter_group(group: Callable[[], T]) -> T:
    """Declare a dataclass field that is itself a dataclass of parameters.

    Args:
        group: Frozen dataclass whose fields all have defaults. Its parameters are named
            "<field>.<name>".

    Returns:
        A dataclass field holding an instance of the group.
    """
    return field(default_factory=group)


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

    Bind once per node: overrides the dataclass does not know are reported as unknown unless the
    node has declared them before.
    """

    def __init__(
        self,
        node: Node,
        schema: type[P],
        on_change: Callable[[P], None] | None = None,
    ) -> None:
        """Declare every field as a ROS parameter and take the overrides the user gave.

        Args:
            node: Node that owns the parameters.
            schema: Frozen dataclass made of `parameter` and `parameter_group` fields.
            on_change: Called with the new value after a set took effect; not at start.

        Raises:
            ParameterError: An override has the wrong type, breaks a rule, or the values
                contradict each other. Nothing has been declared then.
        """
        self._node = node
        self._schema = schema
        self._on_change = on_change
        self._entries = {entry.name: entry for entry in _entries(schema, "")}
        overrides: Mapping[str, Parameter] = node._parameter_overrides
        self._values = {
            name: convert(entry, overrides[name].value) if name in overrides else entry.default
            for name, entry in self._entries.items()
        }
        self._value: P = _build(schema, "", self._values)
        for name, entry in self._entries.items():
            _declare(node, entry, self._values[name])
        self._warn_of_unknown(overrides)
        node.get_logger().info(f"parameters: {self._summary()}")
        node.add_pre_set_parameters_callback(self._convert_proposal)
        node.add_on_set_parameters_callback(self._check_proposal)
        node.add_post_set_parameters_callback(self._take_over)

    @property
    def value(self) -> P:
        """The current parameters; the same object until a set is accepted."""
        return self._value

    def _convert_proposal(self, proposal: list[Parameter]) -> list[Parameter]:
        return [self._converted(proposed) for proposed in proposal]

    def _converted(self, proposed: Parameter) -> Parameter:
        entry = self._entries.get(proposed.name)
        if entry is None:
            return proposed
        try:
            value = convert(entry, proposed.value)
        except ParameterError as error:
            return _RefusedParameter(entry, self._values[entry.name], str(error))
        return Parameter(entry.name, entry.type.ros, _to_ros(value))

    def _check_proposal(self, proposal: list[Parameter]) -> SetParametersResult:
        refusals = [p.reason for p in proposal if isinstance(p, _RefusedParameter)]
        if refusals:
            return SetParametersResult(successful=False, reason="; ".join(refusals))
        try:
            _build(self._schema, "", self._merged(proposal))
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take_over(self, accepted: list[Parameter]) -> None:
        values = self._merged(accepted)
        if values == self._values:
            return
        self._values = values
        self._value = _build(self._schema, "", values)
        if self._on_change is not None:
            self._on_change(self._value)

    def _merged(self, proposal: Iterable[Parameter]) -> dict[str, Any]:
        changes = {
            p.name: convert(self._entries[p.name], p.value)
            for p in proposal
            if p.name in self._entries
        }
        return {**self._values, **changes}

    def _warn_of_unknown(self, overrides: Mapping[str, Parameter]) -> None:
        unknown = [
            name
            for name in overrides
            if not self._node.has_parameter(name)
            and name not in _FOREIGN_NAMES
            and not name.startswith(_FOREIGN_PREFIXES)
        ]
        if unknown:
            listed = ", ".join(_with_suggestion(name, self._entries) for name in sorted(unknown))
            self._node.get_logger().warning(f"ignored unknown parameters: {listed}")

    def _summary(self) -> str:
        return ", ".join(
            f"{name}={shown(self._values[name])}{' ' * bool(entry.spec.unit)}{entry.spec.unit}"
            for name, entry in self._entries.items()
        )


def _entries(schema: Any, prefix: str) -> Iterable[Entry]:
    """Flatten a dataclass of parameters and groups, in the order of its fields."""
    if not (isinstance(schema, type) and is_dataclass(schema)):
        raise TypeError(f"{schema!r} is not a dataclass of parameters")
    hints = get_type_hints(schema)
    for item in fields(schema):
        name, annotation = f"{prefix}{item.name}", hints[item.name]
        if is_dataclass(annotation):
            yield from _entries(annotation, f"{name}{_SEPARATOR}")
            continue
        spec = item.metadata.get(_METADATA_KEY)
        if spec is None or annotation not in TYPES:
            raise TypeError(
                f"{schema.__name__}.{item.name}: {annotation} is not a parameter; use parameter() "
                f"or parameter_group() with one of {', '.join(map(str, TYPES))}"
            )
        entry = Entry(name, TYPES[annotation], spec, item.default)
        yield Entry(name, entry.type, spec, convert(entry, item.default))


def _build(schema: Any, prefix: str, values: Mapping[str, Any]) -> Any:
    """Make the dataclass from flat parameter values; its __post_init__ validates them."""
    hints = get_type_hints(schema)
    arguments: dict[str, Any] = {}
    for item in fields(schema):
        name, annotation = f"{prefix}{item.name}", hints[item.name]
        if is_dataclass(annotation):
            arguments[item.name] = _build(annotation, f"{name}{_SEPARATOR}", values)
        else:
            arguments[item.name] = values[name]
    return schema(**arguments)


def _declare(node: Node, entry: Entry, value: Any) -> None:
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


def _descriptor(entry: Entry) -> ParameterDescriptor:
    spec = entry.spec
    descriptor = ParameterDescriptor(
        description=f"{spec.description} [{spec.unit}]" if spec.unit else spec.description,
        read_only=spec.read_only,
    )
    if spec.choices:
        descriptor.additional_constraints = f"one of: {', '.join(map(str, spec.choices))}"
    if spec.minimum is None and spec.maximum is None:
        return descriptor
    if entry.type.is_array:  # ROS ranges bind scalars only
        low = "" if spec.minimum is None else f" at least {spec.minimum}"
        high = "" if spec.maximum is None else f" at most {spec.maximum}"
        descriptor.additional_constraints = f"each element{low}{' and' * bool(low and high)}{high}"
    elif entry.type.element is int:
        low_int = -_INT64_MAX if spec.minimum is None else math.ceil(spec.minimum)
        high_int = _INT64_MAX if spec.maximum is None else math.floor(spec.maximum)
        descriptor.integer_range = [IntegerRange(from_value=low_int, to_value=high_int)]
    else:
        limit = sys.float_info.max
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=-limit if spec.minimum is None else float(spec.minimum),
                to_value=limit if spec.maximum is None else float(spec.maximum),
            )
        ]
    return descriptor


def _to_ros(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _with_suggestion(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"'{name}' (did you mean '{close[0]}'?)" if close else f"'{name}'"
