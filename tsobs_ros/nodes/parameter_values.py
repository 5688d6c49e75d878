# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One ROS parameter: its type, its rules, and values held to both."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.parameter import Parameter

from tsobs_ros.errors import ParameterError


@dataclass(frozen=True)
class ParameterType:
    """How one Python annotation maps to ROS: its parameter type, element and wording."""

    ros: Parameter.Type
    element: type
    is_array: bool
    wording: str


TYPES: dict[Any, ParameterType] = {
    bool: ParameterType(Parameter.Type.BOOL, bool, False, "true or false"),
    int: ParameterType(Parameter.Type.INTEGER, int, False, "an integer"),
    float: ParameterType(Parameter.Type.DOUBLE, float, False, "a number"),
    str: ParameterType(Parameter.Type.STRING, str, False, "a string"),
    tuple[int, ...]: ParameterType(Parameter.Type.INTEGER_ARRAY, int, True, "a list of integers"),
    tuple[float, ...]: ParameterType(Parameter.Type.DOUBLE_ARRAY, float, True, "a list of numbers"),
    tuple[str, ...]: ParameterType(Parameter.Type.STRING_ARRAY, str, True, "a list of strings"),
}


@dataclass(frozen=True)
class Spec:
    """What `parameter` was told, kept in the dataclass field's metadata."""

    description: str
    unit: str
    minimum: float | None
    maximum: float | None
    choices: tuple[Any, ...]
    read_only: bool


@dataclass(frozen=True)
class Entry:
    """One ROS parameter: its full name, type, rules and default."""

    name: str
    type: ParameterType
    spec: Spec
    default: Any


def convert(entry: Entry, value: Any) -> Any:
    """Turn what came from YAML, a message or a default into the field's type, or refuse it."""
    if entry.type.is_array:
        converted: Any = tuple(_convert_element(entry, item) for item in _sequence(entry, value))
        elements = converted
    else:
        converted = _convert_element(entry, value)
        elements = (converted,)
    for element in elements:
        _check_rules(entry, element)
    return converted


def _sequence(entry: Entry, value: Any) -> Sequence[Any]:
    if value is None:  # how rcl hands over `name: []`
        return ()
    if isinstance(value, str | bytes) or not hasattr(value, "__len__"):
        raise _wrong_type(entry, value)
    return list(value)


def _convert_element(entry: Entry, value: Any) -> Any:
    expected = entry.type.element
    if expected is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, expected) or (isinstance(value, bool) and expected is not bool):
        raise _wrong_type(entry, value)
    return value


def _wrong_type(entry: Entry, value: Any) -> ParameterError:
    hint = ""
    if entry.type.is_array and isinstance(value, str) and value.lstrip().startswith("["):
        # ros2cli sends a list of mixed types as a string, and rcl refuses it in YAML.
        hint = "; lists must not mix types: write every number with a decimal point"
    came = "nothing" if value is None else f"{_came(value)} {shown(value)}"
    return ParameterError(
        f"parameter '{entry.name}': expected {entry.type.wording}, got {came}{hint}"
    )


def _came(value: Any) -> str:
    """Name a value's type in the words users meet in YAML."""
    if isinstance(value, bool):
        return "the boolean"
    for kind, word in ((int, "the integer"), (float, "the number"), (str, "the string")):
        if isinstance(value, kind):
            return word
    return "the list" if hasattr(value, "__len__") else f"the {type(value).__name__}"


def _check_rules(entry: Entry, element: Any) -> None:
    spec, each = entry.spec, "each element of " if entry.type.is_array else ""
    subject = f"{each}parameter '{entry.name}'"
    unit = f" {spec.unit}" if spec.unit else ""
    if isinstance(element, float) and not math.isfinite(element):
        raise ParameterError(f"{subject} must be finite, got {element}")
    if spec.minimum is not None and element < spec.minimum:
        raise ParameterError(f"{subject} must be at least {spec.minimum}{unit}, got {element}")
    if spec.maximum is not None and element > spec.maximum:
        raise ParameterError(f"{subject} must be at most {spec.maximum}{unit}, got {element}")
    if spec.choices and element not in spec.choices:
        listed = ", ".join(map(str, spec.choices))
        raise ParameterError(f"{subject} must be one of {listed}; got {shown(element)}")


def shown(value: Any) -> str:
    """Show a value the way YAML would take it back."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"'{value}'"
    if hasattr(value, "__len__"):
        return f"[{', '.join(shown(item) for item in value)}]"
    return repr(value)
